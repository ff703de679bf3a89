"""Errors that steps have in common: the residual's blocks, and how much more they tell than noise makes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc.coherent import by_block, excess
from pdvc.projection import BlockVectors
from tests.laws import law

SHAPE = (6, 2)
UNKNOWNS = SHAPE[0] * SHAPE[1]


@law(20)
@given(st.integers(0, 99), st.integers(1, 5), st.integers(1, 3))
def test_all_blocks_together_are_the_slow_part_of_the_whole(seed, steps, functions):
    """Also where the sections of the lowest band reach beyond the last: there nothing is."""
    rng, size, first = np.random.default_rng(seed), 6, np.array([0, 4, 8])
    blocks, whole = [], np.zeros((steps, UNKNOWNS))
    for t in range(steps):
        values = rng.normal(size=(3, 4, size))
        values[2, :, UNKNOWNS - 8 :] = 0
        blocks.append(BlockVectors(values=values, first=first))
        for band, start in enumerate(first):
            end = min(start + size, UNKNOWNS)
            whole[t, start:end] += values[band, :, : end - start].sum(axis=0)
    weighed, slow = rng.normal(size=(steps, UNKNOWNS, UNKNOWNS)), rng.normal(size=(functions, steps))
    found = by_block(blocks, weighed, slow)
    assert found.shape == (functions, UNKNOWNS, 12)
    expected = np.einsum("ft,tnm,tm->fn", slow, weighed, whole)
    np.testing.assert_allclose(found.sum(axis=2), expected, atol=1e-9 * np.abs(expected).max())


def moved(rng: np.random.Generator, deviation: np.ndarray, blocks: int, *, fitted: bool) -> np.ndarray:
    """Return squares (unknown, block), over 40 steps, of what blocks alike do; a solution leaves no sum."""
    found = deviation[None, :, None] * rng.normal(size=(40, UNKNOWNS, blocks)) / np.sqrt(blocks)
    return ((found - found.mean(axis=2, keepdims=True) if fitted else found) ** 2).sum(axis=0)


@pytest.mark.parametrize("fitted", [False, True])
def test_noise_alone_is_no_excess_and_each_motion_has_its_own(fitted):
    rng, blocks = np.random.default_rng(3), 5
    deviation = np.tile([2.0, 3.0], SHAPE[0])
    found = excess(moved(rng, deviation, blocks, fitted=fitted), np.full(UNKNOWNS, 40.0), SHAPE)
    # as of what is fitted, of which a fifth is gone
    expected = np.array([4, 9]) * (1 if fitted else blocks / (blocks - 1))
    np.testing.assert_allclose(found, expected, rtol=0.12)


def test_less_than_noise_is_none():
    rng = np.random.default_rng(4)
    found = excess(moved(rng, np.full(UNKNOWNS, 0.1), 8, fitted=True), np.full(UNKNOWNS, 40.0), SHAPE)
    np.testing.assert_array_equal(found, 1)


def test_an_unknown_that_one_block_alone_sees_does_not_count():
    rng = np.random.default_rng(5)
    errors = moved(rng, np.ones(UNKNOWNS), 8, fitted=False)
    errors[0] = 0
    errors[0, 3] = 1e6
    assert (excess(errors, np.full(UNKNOWNS, 40.0), SHAPE) < 2).all()
