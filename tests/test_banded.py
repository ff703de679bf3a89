"""Matrices of blocks beside the diagonal: factor, determinant, solution and inverse, against the whole matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc.banded import Blocks, factored
from tests.laws import law

seeds = st.integers(0, 10**6)
lengths = st.sampled_from((1, 2, 3, 5, 8))
sizes = st.integers(1, 4)


def dense(matrix: Blocks) -> np.ndarray:
    """Return the whole symmetric matrix (step * unknown, step * unknown)."""
    steps, size = matrix.own.shape[:2]
    whole = np.zeros((steps, size, steps, size))
    for blocks, away in ((matrix.next, 1), (matrix.after, 2)):
        for t, block in enumerate(blocks):
            whole[t + away, :, t] = block
            whole[t, :, t + away] = block.T
    for t, block in enumerate(matrix.own):
        whole[t, :, t] = block
    return whole.reshape(steps * size, steps * size)


def drawn(seed: int, steps: int, size: int) -> Blocks:
    """Return a positive definite matrix: D^T D of a random D that joins each step with the two before it."""
    rng = np.random.default_rng(seed)
    root = np.zeros((steps, size, steps, size))
    for t in range(steps):
        for other in range(max(t - 2, 0), t + 1):
            root[t, :, other] = rng.normal(size=(size, size))
        root[t, :, t] += 3 * np.eye(size)
    flat = root.reshape(steps * size, steps * size)
    whole = (flat.T @ flat).reshape(steps, size, steps, size)
    own, near, far = ([whole[t + k, :, t] for t in range(steps - k)] for k in range(3))
    shape = (0, size, size)
    return Blocks(
        own=np.stack(own),
        next=np.stack(near) if near else np.empty(shape),
        after=np.stack(far) if far else np.empty(shape),
    )


@law(60)
@given(seeds, lengths, sizes)
def test_the_factor_times_its_transpose_is_the_matrix(seed, steps, size):
    matrix = drawn(seed, steps, size)
    factor = factored(matrix)
    lower = np.zeros((steps, size, steps, size))
    for t in range(steps):
        lower[t, :, t] = np.linalg.inv(factor.inverse[t])
    for blocks, away in ((factor.next, 1), (factor.after, 2)):
        assert len(blocks) == max(steps - away, 0)
        for t, block in enumerate(blocks):
            lower[t + away, :, t] = block
    flat = lower.reshape(steps * size, steps * size)
    expected = dense(matrix)
    np.testing.assert_allclose(np.triu(flat, 1), 0, atol=1e-12 * np.abs(flat).max())
    np.testing.assert_allclose(flat @ flat.T, expected, atol=1e-10 * np.abs(expected).max())


@law(60)
@given(seeds, lengths, sizes)
def test_the_determinant_is_that_of_the_whole_matrix(seed, steps, size):
    matrix = drawn(seed, steps, size)
    sign, expected = np.linalg.slogdet(dense(matrix))
    assert sign == 1
    assert factored(matrix).log_determinant == pytest.approx(expected, abs=1e-9 * max(abs(expected), 1))


@law(60)
@given(seeds, lengths, sizes, st.integers(0, 3))
def test_the_solution_is_that_of_the_whole_matrix(seed, steps, size, columns):
    matrix = drawn(seed, steps, size)
    right = np.random.default_rng(seed + 1).normal(size=(steps, size, columns))
    kept = right.copy()
    expected = np.linalg.solve(dense(matrix), right.reshape(steps * size, columns)).reshape(right.shape)
    np.testing.assert_allclose(
        factored(matrix).solved(right), expected, atol=1e-8 * max(np.abs(expected).max(initial=0), 1)
    )
    np.testing.assert_array_equal(right, kept)


@law(60)
@given(seeds, lengths, sizes)
def test_the_inverse_inside_the_band_is_that_of_the_whole_matrix(seed, steps, size):
    matrix = drawn(seed, steps, size)
    whole = np.linalg.inv(dense(matrix)).reshape(steps, size, steps, size)
    found = factored(matrix).inverted()
    for blocks, away in ((found.own, 0), (found.next, 1), (found.after, 2)):
        assert len(blocks) == max(steps - away, 0)
        for t, block in enumerate(blocks):
            np.testing.assert_allclose(block, whole[t + away, :, t], atol=1e-9 * np.abs(whole).max())
    np.testing.assert_array_equal(found.own, found.own.transpose(0, 2, 1))


@pytest.mark.parametrize("step", [0, 2, 4])
def test_a_matrix_that_is_not_positive_definite_is_refused(step):
    matrix = drawn(1, 5, 2)
    own = matrix.own.copy()
    own[step, 1, 1] *= -1
    with pytest.raises(np.linalg.LinAlgError):
        factored(replace(matrix, own=own))
