"""PGD, Gauss-Newton and the posterior: brute force on small systems, Monte Carlo, and the inverse crime on purpose.

Radiographs made with pdvc's own projector must give the motion back almost exactly; what is left with simulated
radiographs is then the error of the model, not of the solvers.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc import gauss_newton, pgd
from pdvc.equations import joined, linearise, residuals
from pdvc.prior import Prior
from pdvc.systematic import Systematic
from pdvc.verdict import Stop
from tests.laws import law
from tests.linear_problems import chi2_of, linear_model, random_equations, random_functions
from tests.small_case import (
    ANGLES,
    SECTIONS,
    SHAPE,
    STEPS,
    VOXEL_MM,
    lineariser,
    radiographs,
    time_functions,
)

FUNCTIONS = 4
UNKNOWNS = SECTIONS.shape[0] * SECTIONS.shape[1]
ZERO = np.zeros((FUNCTIONS, *SECTIONS.shape))
ONE_PASS = {"passes_per_mode": 1}
"""As in the paper."""


def prior(deviation=1e3, shape=SECTIONS.shape):
    return Prior(deviation_voxel=np.full(shape, deviation))


# Equations and Hessian by brute force


@given(st.integers(0, 10**6))
@law(20)
def test_the_hessian_is_the_sum_of_kronecker_products(seed):
    equations, functions = random_equations(seed), random_functions(seed)
    expected = sum(
        np.kron(np.outer(functions[:, t], functions[:, t]), equations.matrix[t]) for t in range(functions.shape[1])
    )
    np.testing.assert_allclose(joined(equations.matrix, functions), expected, rtol=1e-10, atol=1e-8)


@given(st.integers(0, 10**6), st.integers(1, 5))
@law(20)
def test_blocks_that_join_pairs_of_steps_have_the_functions_of_both(seed, pairs):
    rng = np.random.default_rng(seed)
    blocks, one, other = rng.normal(size=(pairs, 4, 4)), rng.normal(size=(3, pairs)), rng.normal(size=(3, pairs))
    expected = sum(np.kron(np.outer(one[:, n], other[:, n]), blocks[n]) for n in range(pairs))
    np.testing.assert_allclose(joined(blocks, one, other), expected, atol=1e-10)


@given(st.integers(0, 10**6), st.floats(0.05, 10.0))
@law(20)
def test_a_mode_fulfils_equations_12_to_17_with_the_prior_s_terms(seed, deviation):
    """Neither b at given a, nor a at given b, can lower chi2 + prior: written out element by element."""
    equations, functions = random_equations(seed), random_functions(seed)
    before = np.random.default_rng(seed).normal(scale=0.1, size=(3, 6))
    a, b = pgd.find_mode(equations, functions, before, prior(deviation, (2, 3)))
    ridge = equations.rms**2 / deviation**2
    alpha = a @ functions
    n_matrix = sum(alpha[t] ** 2 * equations.matrix[t] for t in range(9)) + ridge * (a @ a) * np.eye(6)
    n_vector = sum(alpha[t] * equations.vector[t] for t in range(9)) - ridge * (a @ before)
    m_matrix, m_vector = np.zeros((3, 3)), np.zeros(3)
    for i in range(3):
        m_vector[i] = sum(functions[i, t] * (b @ equations.vector[t]) for t in range(9)) - ridge * before[i] @ b
        for j in range(3):
            m_matrix[i, j] = sum(functions[i, t] * functions[j, t] * b @ equations.matrix[t] @ b for t in range(9))
    m_matrix += ridge * (b @ b) * np.eye(3)
    assert np.linalg.norm(a) == pytest.approx(1)
    tolerance = 1e-3 * np.linalg.norm(b)
    np.testing.assert_allclose(np.linalg.solve(n_matrix, n_vector), b, atol=tolerance)
    np.testing.assert_allclose(np.linalg.solve(m_matrix, m_vector), a, atol=1e-3)


def test_a_mode_s_value_is_no_worse_than_that_of_any_random_start():
    equations, functions = random_equations(7), random_functions(7)
    zero = np.zeros((3, 6))
    found = chi2_of(equations, functions, np.outer(*pgd.find_mode(equations, functions, zero, prior(1e4, (2, 3)))))
    rng = np.random.default_rng(8)
    for _ in range(50):
        a = rng.normal(size=3)
        alpha = a @ functions
        b = np.linalg.solve(np.tensordot(alpha**2, equations.matrix, axes=1), alpha @ equations.vector)
        assert found <= chi2_of(equations, functions, np.outer(a, b)) + 1e-9


def test_gauss_newton_solves_a_linear_problem_in_one_pass():
    equations, functions = random_equations(3), random_functions(3)
    found = gauss_newton.solve(
        linear_model(equations),
        functions,
        np.zeros((3, 2, 3)),
        prior(1e6, (2, 3)),
        most_passes=5,
        least_change_voxel=1e-9,
    )
    hessian = sum(np.kron(np.outer(functions[:, t], functions[:, t]), equations.matrix[t]) for t in range(9))
    vector = sum(np.kron(functions[:, t], equations.vector[t]) for t in range(9))
    np.testing.assert_allclose(found.coefficients.ravel(), np.linalg.solve(hessian, vector), rtol=1e-6, atol=1e-9)


def test_pgd_comes_to_gauss_newton_s_solution_with_enough_modes():
    equations, functions = random_equations(4), random_functions(4)
    model, start, believed = linear_model(equations), np.zeros((3, 2, 3)), prior(1e6, (2, 3))
    direct = gauss_newton.solve(model, functions, start, believed, most_passes=5, least_change_voxel=1e-9)
    greedy = pgd.solve(model, functions, start, believed, most_modes=300, least_gain=0.0, noise_rms=None, **ONE_PASS)
    np.testing.assert_allclose(greedy.coefficients, direct.coefficients, atol=1e-4)


# The prior


@pytest.mark.parametrize("solver", ["pgd", "gauss-newton"])
def test_a_strong_prior_leaves_no_motion(solver):
    equations, functions = random_equations(5), random_functions(5)
    model, start, believed = linear_model(equations), np.zeros((3, 2, 3)), prior(1e-5, (2, 3))
    if solver == "pgd":
        found = pgd.solve(model, functions, start, believed, most_modes=3, least_gain=0.0, noise_rms=None, **ONE_PASS)
    else:
        found = gauss_newton.solve(model, functions, start, believed, most_passes=3, least_change_voxel=1e-12)
    assert np.abs(found.coefficients).max() < 1e-6


def test_a_strong_prior_pulls_back_to_no_motion_from_a_start():
    """The data know nothing better than the start: what is minimised falls although the residual rises."""
    equations, functions = random_equations(9), random_functions(9)
    start = np.full((3, 2, 3), 2.0)
    begun = functions.T @ start.reshape(3, 6)
    vector = np.einsum("tij,tj->ti", equations.matrix, begun)
    equations = replace(equations, vector=vector, chi2=equations.chi2 + (vector * begun).sum(axis=1))
    found = gauss_newton.solve(
        linear_model(equations),
        functions,
        start,
        prior(1e-4, (2, 3)),
        most_passes=9,
        least_change_voxel=1e-9,
    )
    assert np.abs(found.coefficients).max() < 1e-3


# The inverse crime on purpose


@cache
def true_motion():
    """Return coefficients (function, section, motion) of a motion of one to three voxels."""
    return np.random.default_rng(12).normal(scale=0.45, size=ZERO.shape)


@cache
def rank_one():
    """Return (temporal coefficients, spatial amplitudes, their product) of one space-time mode."""
    rng = np.random.default_rng(13)
    a = np.array([0.3, -0.2, 0.8, 0.5])
    b = rng.normal(scale=0.8, size=SECTIONS.shape)
    return a, b, np.einsum("f,jk->fjk", a, b)


def moved(coefficients):
    return np.einsum("ft,fjk->tjk", time_functions(), coefficients)


@cache
def images_of(which):
    return radiographs(SECTIONS, moved(true_motion() if which == "full" else rank_one()[2]))


def equations_of(coefficients, which="full"):
    return linearise(images_of(which), SECTIONS, moved(coefficients))


def rms_displacement(coefficients):
    """Return the rms displacement, over steps and points of the bar in the window, voxels."""
    z, y, x = np.meshgrid(np.linspace(-1.0, 1.0, 9), [-0.3, 0.0, 0.3], [-0.45, 0.0, 0.45], indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=-1)
    u = np.array([SECTIONS.displacement(amplitude, points) for amplitude in moved(coefficients)])
    return np.sqrt((u**2).sum(axis=-1).mean())


@cache
def recovered():
    return gauss_newton.solve(
        lineariser(images_of("full"), SECTIONS),
        time_functions(),
        ZERO,
        prior(),
        most_passes=25,
        least_change_voxel=1e-4,
    )


def test_gauss_newton_gives_the_motion_back():
    assert 1 < rms_displacement(true_motion()) < 3
    assert rms_displacement(recovered().coefficients - true_motion()) < 1e-3


def test_gauss_newton_lowers_the_residual_in_each_of_ten_passes_at_most_and_says_that_it_converged():
    assert (np.diff(recovered().rms) < 0).all()
    assert recovered().rms[-1] < 1e-4 * recovered().rms[0]
    assert "converged" in recovered().stop_reason
    assert recovered().stop is Stop.CONVERGED
    assert len(recovered().rms) <= 11


def test_gauss_newton_has_no_modes_but_their_shapes():
    assert recovered().temporal.shape == (0, STEPS)
    assert recovered().spatial.shape == (0, *SECTIONS.shape)


def pgd_of_rank_one(**options):
    return pgd.solve(
        lineariser(images_of("one"), SECTIONS),
        time_functions(),
        ZERO,
        prior(),
        least_gain=1e-3,
        noise_rms=None,
        **options,
    )


def test_one_mode_found_about_itself_gives_a_rank_one_motion_back():
    found = pgd_of_rank_one(most_modes=1, passes_per_mode=12)
    assert len(found.temporal) == 1
    assert (np.diff(found.rms) < 0).all()
    assert rms_displacement(found.coefficients - rank_one()[2]) < 1e-3


def test_a_mode_is_found_again_while_that_pays_and_no_longer(monkeypatch):
    """Of a motion that no single mode holds, each pass gains less than the one before.

    They end where the residual is that of the best mode, as passes without end find it, to a hundredth of a per cent:
    a further pass would cost as much as a new mode.
    """

    def one_mode():
        return pgd.solve(
            lineariser(images_of("full"), SECTIONS),
            time_functions(),
            ZERO,
            prior(),
            most_modes=1,
            passes_per_mode=12,
            least_gain=0.0,
            noise_rms=None,
        )

    found = one_mode()
    monkeypatch.setattr(pgd, "WORTH_A_PASS", 0.0)
    best = one_mode()
    assert found.rms[-1] < 1.0001 * best.rms[-1]
    gains = 1 - found.rms[1:] / found.rms[:-1]
    assert (gains[:-1] > 1e-3).all()
    assert len(found.rms) < len(best.rms)


def test_modes_of_one_pass_lower_the_residual_one_by_one_and_add_up_to_the_motion():
    found = pgd_of_rank_one(most_modes=12, **ONE_PASS)
    assert (np.diff(found.rms) < 0).all()
    assert found.rms[-1] < 1e-3 * found.rms[0]
    assert rms_displacement(found.coefficients - rank_one()[2]) < 5e-3
    total = np.einsum("mt,mjk->tjk", found.temporal, found.spatial)
    np.testing.assert_allclose(total, moved(found.coefficients), atol=1e-9)


def test_one_pass_from_four_times_closer_ends_more_than_four_times_closer():
    errors = []
    for size in (0.4, 0.1):
        start = true_motion() * (1 + size)
        found = gauss_newton.solve(
            lineariser(images_of("full"), SECTIONS), time_functions(), start, prior(), most_passes=1,
            least_change_voxel=1e-9,
        )  # fmt: skip
        errors.append(rms_displacement(found.coefficients - true_motion()))
    assert errors[1] < errors[0] / 4


def test_the_equations_at_the_truth_ask_for_nothing():
    at_truth = equations_of(true_motion())
    assert at_truth.rms < 1e-5
    np.testing.assert_allclose(
        residuals(images_of("full"), SECTIONS, moved(true_motion())), at_truth.residual, atol=1e-5
    )


def test_the_systematic_residual_is_taken_off_the_radiographs():
    """A constant left by the re-projection, found in all views, changes the residual by just that."""
    images = images_of("full")
    detector = (SHAPE[0] + 8, SHAPE[1] + 8)
    systematic = Systematic(
        left=lambda view: np.full(detector, 0.25, dtype=np.float32),
        view_rad=np.linspace(0, 2 * np.pi, 9, endpoint=False),
        step_rad=ANGLES,
        corner=(4, 4),
        shape=SHAPE,
        detector=detector,
        width_rad=0.1,
    )
    rested = np.zeros((STEPS, *SECTIONS.shape))
    plain = residuals(images, SECTIONS, rested)
    corrected = residuals(replace(images, systematic=systematic), SECTIONS, rested)
    np.testing.assert_allclose(plain - corrected, 0.25, atol=1e-5)
    equations = linearise(replace(images, systematic=systematic), SECTIONS, rested)
    np.testing.assert_allclose(equations.residual, corrected, atol=1e-5)


# Why a solver stops


def greedy(**options):
    equations, functions = random_equations(9), random_functions(9)
    options = {**ONE_PASS, "most_modes": 3, "least_gain": 0.0, "noise_rms": None, **options}
    model = linear_model(equations)
    return pgd.solve(model, functions, np.zeros((3, 2, 3)), prior(1e3, (2, 3)), **options)


def test_pgd_stops_at_the_most_modes():
    found = greedy(most_modes=2)
    assert "2 modes found, as many as were asked for" in found.stop_reason
    assert found.stop is Stop.MOST
    assert len(found.temporal) == len(found.spatial) == len(found.rms) - 1 == 2


def test_pgd_stops_at_a_mode_that_gains_too_little():
    found = greedy(most_modes=50, least_gain=0.5)
    assert "less than 50.00%" in found.stop_reason
    assert found.stop is Stop.SMALL_GAIN
    assert len(found.temporal) == 1


def test_pgd_stops_where_the_residual_is_that_of_two_noisy_images():
    """chi^2 <= 2 gamma^2 N_pix."""
    rms = random_equations(9).rms
    found = greedy(noise_rms=1.001 * rms / np.sqrt(2))
    assert "residual at noise level" in found.stop_reason
    assert found.stop is Stop.NOISE_LEVEL
    assert len(greedy(noise_rms=0.999 * rms / np.sqrt(2)).temporal) > 0


def test_pgd_stops_where_no_mode_helps():
    equations = replace(random_equations(9), vector=np.zeros((9, 6)))
    functions = random_functions(9)
    found = pgd.solve(
        linear_model(equations),
        functions,
        np.zeros((3, 2, 3)),
        prior(1e3, (2, 3)),
        most_modes=3,
        least_gain=0.0,
        noise_rms=None,
        **ONE_PASS,
    )
    assert "no further mode lowers the residual" in found.stop_reason
    assert found.stop is Stop.NO_GAIN
    assert not found.coefficients.any()
    assert found.temporal.shape == (0, 9)


def test_gauss_newton_stops_at_the_most_passes():
    found = gauss_newton.solve(
        lineariser(images_of("full"), SECTIONS),
        time_functions(),
        ZERO,
        prior(),
        most_passes=1,
        least_change_voxel=1e-9,
    )
    assert "1 passes done, the most allowed: allow more" in found.stop_reason
    assert f"by {found.last_change_voxel:.2g} voxel rms" in found.stop_reason
    assert found.stop is Stop.UNFINISHED


def test_gauss_newton_stops_where_no_step_helps():
    found = gauss_newton.solve(
        linear_model(replace(random_equations(9), vector=np.zeros((9, 6)))),
        random_functions(9),
        np.zeros((3, 2, 3)),
        prior(1e3, (2, 3)),
        most_passes=3,
        least_change_voxel=1e-9,
    )
    assert "no step lowers the residual further" in found.stop_reason
    assert found.stop is Stop.NO_GAIN


def test_amplitudes_count_in_voxels_of_scale_1_at_any_scale():
    """The same motion, seen by a volume of the same voxel but counted in half as large ones, is twice the number."""
    images = replace(images_of("full"), voxel_mm=VOXEL_MM / 2)
    doubled = gauss_newton.solve(
        lineariser(images, SECTIONS), time_functions(), ZERO, prior(2e3), most_passes=1, least_change_voxel=1e-9
    )
    single = gauss_newton.solve(
        lineariser(images_of("full"), SECTIONS),
        time_functions(),
        ZERO,
        prior(),
        most_passes=1,
        least_change_voxel=1e-9,
    )
    np.testing.assert_allclose(doubled.coefficients, 2 * single.coefficients, atol=1e-6)


def test_used_pixels_are_counted_over_all_steps():
    weight = np.ones((1, *SHAPE), dtype=np.float32)
    weight[:, :6] = 0
    images = replace(images_of("full"), weight=weight)
    assert images.used_pixels == STEPS * (SHAPE[0] - 6) * SHAPE[1]
