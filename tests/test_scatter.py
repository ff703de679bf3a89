"""Scattered radiation, against single scattering behind slabs and points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulator.images import clear_image, prepare
from simulator.scatter import Scatter
from simulator.scenario import course_of, load_scenario
from tests.laws import law
from tests.tiny_scenarios import tinier


@law(40)
@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(1, 50))
def test_behind_a_wide_sample_the_ratio_is_that_of_its_attenuation(transmission, ratio, width_mm):
    image = np.full((30, 40), transmission, dtype=np.float32)
    scattered = Scatter(ratio=ratio, width_mm=width_mm).on(image, 0.5) - image
    np.testing.assert_allclose(scattered / image, -ratio * np.log(transmission), atol=2e-5)


def test_all_that_is_scattered_arrives_spread_out_over_its_width():
    image = np.ones((201, 181), dtype=np.float32)
    image[100, 90] = 0.4
    scattered = (Scatter(ratio=0.5, width_mm=6.0).on(image, 0.5) - image).astype(float)
    total = scattered.sum()
    assert total == pytest.approx(-0.5 * 0.4 * np.log(0.4), rel=2e-3)
    for axis, middle in ((1, 100), (0, 90)):
        profile = scattered.sum(axis=axis)
        spread = profile @ (np.arange(len(profile)) - middle) ** 2 / total
        assert np.sqrt(spread) == pytest.approx(6.0 / 0.5, rel=5e-3)


def test_the_mean_ratio_behind_a_sample_that_ends_is_less():
    """Half of the Gaussian around a place at a straight edge of the sample comes from it."""
    image = np.ones((101, 201), dtype=np.float32)
    image[:, :100] = 0.5
    scattered = Scatter(ratio=0.2, width_mm=5.0).on(image, 0.5) - image
    whole = 0.2 * -0.5 * np.log(0.5)
    assert scattered[50, 99:101].mean() == pytest.approx(whole / 2, rel=1e-3)
    assert scattered[50, 30] == pytest.approx(whole, rel=1e-3)


def test_no_scatter_is_no_change_and_no_light_none_to_scatter():
    image = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    assert Scatter().on(image, 1.0) is image
    dark = np.zeros((3, 4), dtype=np.float32)
    np.testing.assert_array_equal(Scatter(ratio=0.3).on(dark, 1.0), dark)


def test_scatter_is_part_of_the_image_of_a_scenario():
    images = []
    for ratio in (0.0, 0.3):
        scenario = tinier(scanner={"scatter": {"ratio": ratio, "width_mm": 40.0}})
        bench = prepare(scenario, course_of(scenario))
        images.append(clear_image(bench, bench.body, 0.3, 0.0))
    np.testing.assert_allclose(images[1], Scatter(ratio=0.3, width_mm=40.0).on(images[0], 7.1), atol=1e-6)
    assert (images[1] / images[0]).max() > 1.05


def test_the_law_is_that_of_a_published_monte_carlo_computation():
    """Steps of an iron wedge at 200 kV behind 2 mm of copper: primary over open beam, scattered over primary.

    Means of two programs: the reference of test 2D-SW-2, scenario 4, in CTSimU's toolbox 1.7.0 (Apache-2.0).
    """
    primary = np.array([0.1289, 0.1606, 0.2012, 0.2540, 0.3230, 0.4154, 0.5420, 0.7222], dtype=np.float32)
    ratio = np.array([0.0944, 0.0896, 0.0774, 0.0635, 0.0495, 0.0362, 0.0244, 0.0150])
    laboratory = load_scenario("laboratory").scanner.scatter
    found = [laboratory.on(np.full((4, 4), each), 1.2)[0, 0] / each - 1 for each in primary]
    np.testing.assert_allclose(found, ratio, rtol=0.14)
    assert np.mean(found / ratio) == pytest.approx(1, abs=0.02)
