"""Time functions that share no step: solved block by block, with the result of the dense solve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc import gauss_newton
from pdvc.gauss_newton import blocks_of
from pdvc.prior import Prior
from tests.laws import law
from tests.linear_problems import linear_model, random_equations
from tests.small_case import SECTIONS, STEPS, lineariser, radiographs

SHAPE = (2, 3)


def groups_of(labels, seed):
    """Return time functions (function, step): two random ones on the steps of each label, orthonormal over all."""
    labels = np.asarray(labels)
    rng = np.random.default_rng(seed)
    rows = []
    for label in np.unique(labels):
        steps = np.flatnonzero(labels == label)
        q = np.linalg.qr(rng.normal(size=(len(steps), min(2, len(steps)))))[0]
        part = np.zeros((q.shape[1], len(labels)))
        part[:, steps] = q.T
        rows.append(part)
    functions = np.concatenate(rows) * np.sqrt(len(labels))
    return functions[rng.permutation(len(functions))]


@given(st.lists(st.integers(0, 3), min_size=9, max_size=9), st.integers(0, 10**6))
@law(30)
def test_blocks_give_the_dense_solution(labels, seed):
    """One pass on a linear problem, against numpy's solve of the whole system with each block's own prior."""
    equations, functions = random_equations(seed, shape=SHAPE), groups_of(labels, seed)
    blocks = blocks_of(functions)
    assert len(blocks) == len(set(labels))
    assert sorted(np.concatenate([block.steps for block in blocks])) == list(range(9))
    deviation = 0.7
    found = gauss_newton.solve(
        linear_model(equations),
        functions,
        np.zeros((len(functions), *SHAPE)),
        Prior(deviation_voxel=np.full(SHAPE, deviation)),
        most_passes=1,
        least_change_voxel=1e-12,
    )
    matrix = sum(np.kron(np.outer(functions[:, t], functions[:, t]), equations.matrix[t]) for t in range(9))
    for block in blocks:
        mean_square = equations.chi2[block.steps].sum() / (equations.pixels * len(block.steps) / 9)
        for function in block.functions:
            matrix[np.diag_indices_from(matrix)] += np.repeat(np.arange(len(functions)) == function, 6) * (
                mean_square / deviation**2
            )
    vector = sum(np.kron(functions[:, t], equations.vector[t]) for t in range(9))
    np.testing.assert_allclose(found.coefficients.ravel(), np.linalg.solve(matrix, vector), rtol=1e-6, atol=1e-9)


def test_what_is_found_at_a_step_does_not_depend_on_the_others():
    """A strong prior, which is weighed against the residual: that of the step alone."""
    equations = random_equations(7, shape=SHAPE)
    louder = replace(equations, chi2=equations.chi2 * np.where(np.arange(9) == 3, 1.0, 50.0))
    believed = Prior(deviation_voxel=np.full(SHAPE, 0.05))
    found = [
        gauss_newton.solve(
            linear_model(each),
            3 * np.eye(9),
            np.zeros((9, *SHAPE)),
            believed,
            most_passes=1,
            least_change_voxel=1e-9,
        ).coefficients
        for each in (equations, louder)
    ]
    np.testing.assert_array_equal(found[0][3], found[1][3])
    assert (np.abs(found[0][4] - found[1][4]) > 1e-6).all()


def test_linked_functions_are_one_block():
    functions = np.array([[1.0, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1], [0, 0, 0, 2]])
    (block,) = blocks_of(functions)
    np.testing.assert_array_equal(block.functions, range(4))
    np.testing.assert_array_equal(block.steps, range(4))


def test_a_step_that_goes_too_far_holds_no_other_back():
    """The residual of step 4 rises unless it goes a quarter of the way; the other steps go the whole way."""
    equations, functions = random_equations(2, shape=SHAPE), np.sqrt(9) * np.eye(9)
    exact = linear_model(equations)
    whole = np.stack([np.linalg.solve(b, c) for b, c in zip(equations.matrix, equations.vector, strict=True)])

    def model(amplitude):
        found = exact(amplitude)
        gone = np.linalg.norm(amplitude[4]) / np.linalg.norm(whole[4])
        chi2 = found.chi2.copy()
        chi2[4] *= 1 if gone < 0.3 else 100
        return replace(found, chi2=chi2)

    believed = Prior(deviation_voxel=np.full(SHAPE, 1e6))
    found = gauss_newton.solve(
        model, functions, np.zeros((9, *SHAPE)), believed, most_passes=1, least_change_voxel=1e-9
    )
    share = np.full((9, 1), 1.0)
    share[4] = 0.25
    np.testing.assert_allclose(3 * found.coefficients.reshape(9, -1), share * whole, rtol=1e-6)
    # the equations are those of where each step is
    np.testing.assert_allclose(found.equations.chi2, model(3 * found.coefficients).chi2)


@pytest.mark.parametrize("stuck", [[3], list(range(9))])
def test_steps_that_nothing_improves_are_left_and_said(stuck):
    equations, functions = random_equations(2, shape=SHAPE), np.sqrt(9) * np.eye(9)
    exact = linear_model(equations)
    passes = 0

    def model(amplitude):
        nonlocal passes
        passes += 1
        found = exact(amplitude)
        worse = np.any(amplitude[stuck] != 0, axis=(1, 2))
        chi2 = found.chi2.copy()
        chi2[stuck] = np.where(worse, 2 * equations.chi2[stuck], equations.chi2[stuck])
        return replace(found, chi2=chi2)

    believed = Prior(deviation_voxel=np.full(SHAPE, 1e6))
    found = gauss_newton.solve(
        model, functions, np.zeros((9, *SHAPE)), believed, most_passes=9, least_change_voxel=1e-6
    )
    assert not found.coefficients[stuck].any()
    np.testing.assert_array_equal(found.equations.vector[stuck], equations.vector[stuck])
    if len(stuck) == 9:
        assert found.stop_reason.startswith("no step lowers the residual further")
        assert len(found.rms) == 1
    else:
        assert found.coefficients[0].any()
        assert "of 9 parts no step lowered" in found.stop_reason
        assert passes < 9


def test_each_step_alone_finds_the_motion_of_its_own_radiograph():
    """The inverse crime, without time basis: what one radiograph determines is found, step by step."""
    rng = np.random.default_rng(5)
    true = np.zeros((STEPS, *SECTIONS.shape))
    true[..., 2] = rng.normal(scale=0.5, size=true.shape[:2])  # vertical: plain to see in every radiograph
    found = gauss_newton.solve(
        lineariser(radiographs(SECTIONS, true), SECTIONS),
        np.sqrt(STEPS) * np.eye(STEPS),
        np.zeros_like(true),
        Prior(deviation_voxel=np.full(SECTIONS.shape, 1.0 / np.sqrt(STEPS))),
        most_passes=12,
        least_change_voxel=1e-3,
    )
    error = np.sqrt(STEPS) * found.coefficients[..., 2] - true[..., 2]
    assert np.sqrt((error**2).mean()) < 0.02
    assert found.rms[-1] < 0.02 * found.rms[0]
