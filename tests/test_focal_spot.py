"""The size of the focal spot: the width of an edge's image. Its drift is tested where the scanner stands."""

import numpy as np
import pytest

from simulator.detector import seen
from simulator.focal_spot import FWHM, FocalSpot
from simulator.images import maps_of, prepare
from simulator.scenario import course_of
from tests.tiny_scenarios import tinier


def edge_variance_px2(scenario):
    """Return the second central moment of the derivative of an edge's image, pixels squared."""
    bench = prepare(scenario, course_of(scenario))
    sharp = np.ones((40 * 4, 24 * 4), dtype=np.float32)
    sharp[:, 12 * 4 :] = 0.2
    profile = seen(sharp, bench.optics, maps_of(scenario), 4)[20]
    spread, place = -np.diff(profile) / 0.8, np.arange(23.0)
    return spread @ (place - spread @ place) ** 2


@pytest.mark.parametrize("size_mm", [0.3, 0.6])
def test_an_edge_is_as_wide_as_the_spot_times_the_magnification_less_one(size_mm):
    blur = {"blur_px": 0.8}
    sharp = edge_variance_px2(tinier(detector=blur))
    wide = edge_variance_px2(tinier(detector=blur, scanner={"focal_spot": {"size_mm": size_mm}}))
    # variances add up; M = 28, and pixels of 7.1 mm
    assert np.sqrt(wide - sharp) * FWHM * 7.1 == pytest.approx(size_mm * (28 - 1), rel=2e-3)


def test_the_magnification_is_the_true_one():
    nearer = tinier(misalignment={"source_axis_mm": -2.0}, scanner={"focal_spot": {"size_mm": 0.5}})
    bench = prepare(nearer, course_of(nearer))
    expected = FocalSpot(size_mm=0.5).size_mm / FWHM * (800 / (800 / 28 - 2) - 1) / 7.1
    assert np.sqrt(bench.optics.blur_px**2 - nearer.detector.blur_px**2) == pytest.approx(expected)


def test_a_point_blurs_nothing():
    bench = prepare(tinier(), course_of(tinier()))
    assert bench.optics is bench.scenario.detector


def test_half_of_the_maximum_is_at_half_of_the_width():
    assert np.exp(-((FWHM / 2) ** 2) / 2) == pytest.approx(0.5)
