"""Which views radiographs of the test are like, on spheres whose radiographs have a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.likeness import likeness
from pdvc.radiographs import calibrate
from tests.spheres import experiment, with_test

FEW = settings(max_examples=4, deadline=None)


def found(here):
    return likeness(here, calibrate(here))


@FEW
@given(seed=st.integers(0, 10**6))
def test_a_sample_at_rest_is_most_like_itself_at_its_angle(seed):
    like = found(experiment(seed, views=72))
    assert like.recorded.min() > 0.8
    assert np.abs(like.off_rad).max() <= like.spacing_rad * (1 + 1e-9)
    assert like.upside_down.max() < 0.7


@FEW
@given(seed=st.integers(0, 10**6), off_deg=st.sampled_from((-90.0, -40.0, 25.0, 60.0, 120.0)))
def test_angles_that_are_off_by_some_are_told_by_how_much(seed, off_deg):
    here = experiment(seed, views=72)
    like = found(with_test(here, angle_rad=here.test.angle_rad - np.deg2rad(off_deg)))
    assert np.rad2deg(np.median(like.off_rad)) == pytest.approx(off_deg, abs=np.rad2deg(like.spacing_rad))
    assert np.median(like.best - like.recorded[like.steps]) > 0.1


@FEW
@given(seed=st.integers(0, 10**6))
def test_a_stack_upside_down_is_told(seed):
    here = experiment(seed, views=72)
    like = found(with_test(here, counts=here.test.counts[:, ::-1]))
    assert np.median(like.upside_down) > 0.9
    assert np.median(like.upside_down) > np.median(like.best) + 0.2


@FEW
@given(seed=st.integers(0, 10**6))
def test_a_mirrored_stack_is_like_the_view_from_behind_if_not_for_the_fan(seed):
    """Parallel rays seen from behind are the mirror image: where the fan is narrow only the angles tell them apart."""
    here = experiment(seed, views=72)
    like = found(with_test(here, counts=here.test.counts[:, :, ::-1]))
    assert np.median(like.mirrored) > np.median(like.best) > 0.8
    assert np.median(like.recorded) < 0.5


def test_another_sample_is_like_no_view():
    here = experiment(1, views=72)
    like = found(with_test(here, counts=experiment(2, views=72).test.counts))
    assert np.median(like.best) < 0.6


def test_the_least_like_step_is_looked_at():
    here = experiment(4, views=72, steps=40)
    counts = here.test.counts.copy()
    counts[[17, 29]] = counts[[29, 17]]
    like = found(with_test(here, counts=counts))
    assert {17, 29} <= set(like.steps.tolist())
