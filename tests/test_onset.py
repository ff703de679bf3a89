"""The onset of loading: where a kink is known, where there is none, and what does not matter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.onset import onset

plateaus, rises = st.integers(6, 60), st.integers(8, 80)


def record(plateau, rise, slope, noise, seed, level=200.0):
    """Return a force (step,) that leaves its level after step `plateau` with a slope in deviations of its noise."""
    step = np.arange(plateau + rise)
    away = np.maximum(step - plateau, 0.0)
    rng = np.random.default_rng(seed)
    return level + noise * slope * away * (1 - 0.002 * away) + noise * rng.normal(size=len(step))


@given(plateaus, rises, st.floats(12, 100), st.integers(0, 10**6))
def test_the_kink_is_found_to_a_step(plateau, rise, slope, seed):
    assert onset(record(plateau, rise, slope, 1.0, seed)) == pytest.approx(plateau, abs=1)


@given(plateaus, rises, st.floats(0.5, 100))
def test_without_noise_it_is_exact(plateau, rise, slope):
    force = np.concatenate([np.zeros(plateau + 1), slope * np.arange(1.0, rise)])
    assert onset(force) == plateau


@given(plateaus, rises, st.integers(0, 10**6), st.floats(0.01, 1e4), st.sampled_from((1, -1)), st.floats(-1e3, 1e3))
def test_neither_unit_nor_sign_nor_level_matter(plateau, rise, seed, unit, sign, level):
    force = record(plateau, rise, 30.0, 1.0, seed)
    assert onset(sign * unit * (force + level)) == onset(force)


@given(st.integers(1, 80), st.integers(0, 10**6))
@settings(max_examples=30)
def test_a_force_that_never_leaves_its_level_has_none(steps, seed):
    assert onset(np.random.default_rng(seed).normal(size=steps)) is None
    assert onset(np.full(steps, 7.0)) is None


def test_a_force_that_rises_from_the_first_step_has_none():
    assert onset(np.linspace(0, 100, 40)) is None
