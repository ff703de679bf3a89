import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pdvc.settings import SettingsError
from simulator.loading import Loading, load_history, strains
from simulator.specimen import Specimen, area_mm2
from tests.laws import law

TIME_S = 2.0 * np.arange(127)
HEIGHT_MM = np.linspace(-6.5, 6.5, 261)


@pytest.fixture(scope="module")
def paper():
    area = area_mm2(Specimen(thinned="both"), HEIGHT_MM)
    return load_history(Loading(), TIME_S, HEIGHT_MM, area)


def test_force_follows_the_paper(paper):
    # text and captions of the paper's section 4.2: 250 N, then 630, 715 and 736 N, about 750 N at failure
    np.testing.assert_array_equal(paper.force_N[:51], 250.0)
    np.testing.assert_allclose(paper.force_N[[90, 110, 123]], [630, 715, 736], rtol=0.025)
    assert 735 < paper.force_N[126] < 755


def test_force_never_falls(paper):
    assert np.all(np.diff(paper.force_N[50:]) > 0)


def test_strain_and_extension_are_the_papers(paper):
    assert 0.08 < paper.strain[-1].max() < 0.09
    assert abs(HEIGHT_MM[paper.strain[-1].argmax()]) < 1e-9
    used = np.abs(HEIGHT_MM) <= 754 / 2 * 0.0107
    extension = np.trapezoid(paper.strain[-1, used], HEIGHT_MM[used]) / 0.0107
    assert 14 < extension < 16  # voxels


def test_strain_is_relative_to_the_plateau(paper):
    np.testing.assert_array_equal(paper.strain[:51], 0.0)
    np.testing.assert_array_equal(paper.plastic[:51], 0.0)
    assert np.all(paper.plastic <= paper.strain + 1e-15)


def test_stroke_is_shared_by_machine_and_sample(paper):
    elongation = np.trapezoid(paper.strain, HEIGHT_MM, axis=1)
    stroke = Loading().compliance_mm_per_N * (paper.force_N - 250) + elongation
    np.testing.assert_allclose(stroke, 0.002 * np.maximum(TIME_S - 100, 0), atol=1e-12)


def test_uniform_elastic_bar_has_the_closed_form():
    loading = Loading(yield_MPa=1e6, necking_strain=0.0)
    history = load_history(loading, TIME_S, np.linspace(-5, 5, 11), np.full(11, 2.0))
    stiffness = 1 / (loading.compliance_mm_per_N + 10 / (168e3 * 2.0))
    expected = 250 + stiffness * 0.002 * np.maximum(TIME_S - 100, 0)
    np.testing.assert_allclose(history.force_N, expected, rtol=1e-12)
    np.testing.assert_allclose(history.strain, (expected[:, None] - 250) / (168e3 * 2.0) + np.zeros(11), atol=1e-15)


def test_ludwik_law_is_inverted_exactly():
    loading = Loading()
    elastic, plastic = strains(loading, np.array([200.0, 300.0, 500.0]))
    np.testing.assert_allclose(elastic * loading.young_MPa, [200, 300, 500])
    assert plastic[0] == plastic[1] == 0
    assert loading.yield_MPa + loading.hardening_MPa * plastic[2] ** loading.hardening_exponent == pytest.approx(500)


def test_without_stroke_nothing_happens():
    history = load_history(Loading(stroke_mm_per_s=0.0), TIME_S, HEIGHT_MM, np.ones(261))
    np.testing.assert_array_equal(history.force_N, 250.0)
    np.testing.assert_array_equal(history.strain, 0.0)
    np.testing.assert_array_equal(history.load_fraction, 0.0)


def test_a_neck_faster_than_the_stroke_is_refused():
    with pytest.raises(ValueError, match=r"loading\.necking_strain: expected .* got 0\.5 over 8 steps"):
        load_history(Loading(necking_strain=0.5), TIME_S, HEIGHT_MM, np.ones(261))


@law(40)
@given(st.floats(-4.0, 4.0), st.floats(0.001, 0.06), st.integers(20, 60), st.floats(0.1, 0.6))
def test_a_neck_is_a_gaussian_where_it_is_told_and_grows_in_its_steps(at, strain, steps, width):
    """What a neck adds to the strain of the same force is the neck alone: the law is asked for the rest."""
    area = area_mm2(Specimen(thinned="both"), HEIGHT_MM)
    loading = Loading(necking_strain=strain, necking_steps=steps, necking_mm=width, necking_at_mm=at)
    # lengthens by strain sqrt(2 pi) width, at the end by 2 / steps of that in a step; 0.004 mm is the stroke's
    assume(strain * np.sqrt(2 * np.pi) * width * 2 / steps < 0.0039)
    history = load_history(loading, TIME_S, HEIGHT_MM, area)
    elastic, plastic = strains(loading, history.force_N[:, None] / area)
    elastic_0, plastic_0 = strains(loading, 250.0 / area)
    neck = history.strain - (elastic + plastic - elastic_0 - plastic_0)
    growth = np.clip((np.arange(127) - (126 - steps)) / steps, 0, None)[:, None] ** 2
    np.testing.assert_allclose(neck, growth * strain * np.exp(-((HEIGHT_MM - at) ** 2) / (2 * width**2)), atol=1e-14)


def test_a_wrong_law_is_refused_with_its_key():
    with pytest.raises(SettingsError, match=r"mine\.toml: young_MPa: expected greater than 0, given -1"):
        Loading.parse({"young_MPa": -1}, where="mine.toml")
