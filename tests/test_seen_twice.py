"""What opposite views tell, on spheres whose radiographs have a closed form: sign, fan angle, axis, source."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.radiographs import calibrate
from pdvc.seen_twice import seen_twice
from tests.spheres import BEAM, experiment, with_reference

FEW = settings(max_examples=5, deadline=None)


@cache
def scan(seed, views=96):
    """Return an experiment with hardly any test."""
    return experiment(seed, views=views, steps=2)


def found(here, geometry=None):
    return seen_twice(here.reference, geometry or here.geometry, calibrate(here))


@FEW
@given(seed=st.integers(0, 100))
def test_a_right_description_agrees_with_itself(seed):
    twice = found(scan(seed))
    assert abs(twice.factor - 1) < 5 * twice.factor_std + 0.02 < 0.7
    assert twice.axis_px == pytest.approx(0, abs=0.1)
    assert abs(twice.plane_px) < 5 * twice.plane_std_px
    assert twice.mismatch_reversed > 1.2 * twice.mismatch


@FEW
@given(seed=st.integers(0, 100))
def test_the_other_sign_of_rotation_is_told(seed):
    here = scan(seed)
    twice = found(with_reference(here, angle_rad=-here.reference.angle_rad))
    assert abs(twice.factor + 1) < 5 * twice.factor_std + 0.02 < 0.7
    assert twice.mismatch_reversed > 1.2 * twice.mismatch


@FEW
@given(seed=st.integers(0, 100), times=st.sampled_from((0.4, 0.5, 2.0, 10.0)))
def test_pixels_of_another_size_change_the_fan_angle_by_as_much(seed, times):
    here = scan(seed)
    twice = found(here, replace(BEAM, pixel_mm=times * BEAM.pixel_mm))
    assert abs(twice.factor - 1 / times) < 5 * twice.factor_std + 0.02 / times < 0.7 / times


@FEW
@given(seed=st.integers(0, 100), columns=st.integers(-4, 4), rows=st.integers(-12, 12))
def test_a_detector_that_is_elsewhere_is_told_by_how_much(seed, columns, rows):
    """The image is of a detector in the middle; its description shifts the place where axis and source are due."""
    here = scan(seed)
    beam = replace(BEAM, column_shift_mm=columns * BEAM.pixel_mm, row_shift_mm=rows * BEAM.pixel_mm)
    twice = found(here, beam)
    assert twice.axis_px == pytest.approx(columns, abs=0.15)
    assert abs(twice.plane_px - rows) < 5 * twice.plane_std_px < 60


@FEW
@given(seed=st.integers(0, 100), start=st.floats(-7, 7))
def test_the_zero_of_the_angles_and_their_order_do_not_matter(seed, start):
    here, rng = scan(seed), np.random.default_rng(seed)
    order = rng.permutation(len(here.reference))
    other = with_reference(
        here, angle_rad=here.reference.angle_rad[order] + start, counts=here.reference.counts[order]
    )
    assert found(other).factor == pytest.approx(found(here).factor, abs=0.02)


def test_unequal_angles_are_interpolated():
    here = scan(3)
    kept = np.setdiff1d(np.arange(96), [5, 17, 18, 40, 77])
    twice = found(with_reference(here, angle_rad=here.reference.angle_rad[kept], counts=here.reference.counts[kept]))
    assert twice.factor == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize("kept", [np.s_[:24], np.s_[::4]], ids=["half a turn", "too few views"])
def test_what_is_no_turn_tells_nothing(kept):
    here = experiment()
    assert (
        found(with_reference(here, angle_rad=here.reference.angle_rad[kept], counts=here.reference.counts[kept]))
        is None
    )
