"""What is known of the amplitudes: the posterior against closed forms, draws, and Bayes' rule written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pdvc.equations import linearise
from pdvc.prior import Prior
from pdvc.sections import SectionBasis
from pdvc.uncertainty import posterior
from tests.laws import law
from tests.linear_problems import random_equations, random_functions
from tests.small_case import SECTIONS, SHAPE, STEPS, radiographs, time_functions

FUNCTIONS = 4
PIXELS = 50
UNKNOWNS = SECTIONS.shape[0] * SECTIONS.shape[1]


def prior(deviation, shape=SECTIONS.shape):
    return Prior(deviation_voxel=np.full(shape, deviation))


def test_without_data_the_posterior_is_the_prior():
    blank = replace(random_equations(1), matrix=np.zeros((9, 6, 6)), vector=np.zeros((9, 6)))
    functions = random_functions(1)
    known = posterior(blank, functions, prior(2.5, (2, 3)))
    expected = 2.5 * np.sqrt((functions**2).sum(axis=0))
    np.testing.assert_allclose(known.deviation, np.broadcast_to(expected[:, None, None], (9, 2, 3)), rtol=1e-9)
    np.testing.assert_allclose(known.data_share, 0, atol=1e-9)
    assert not known.observed.any()


def test_without_any_residual_the_posterior_knows_what_the_data_see_and_no_more():
    equations, functions = random_equations(1), random_functions(1)
    matrix = equations.matrix.copy()
    matrix[:, 3:] = 0
    matrix[:, :, 3:] = 0
    perfect = replace(equations, matrix=matrix, vector=0 * equations.vector, chi2=0 * equations.chi2)
    known = posterior(perfect, functions, prior(30, (2, 3)))
    before = 30 * np.sqrt((functions**2).sum(axis=0))
    assert (known.deviation[:, 0] < 1e-6 * before[:, None]).all()
    np.testing.assert_allclose(known.deviation[:, 1], np.broadcast_to(before[:, None], (9, 3)), rtol=1e-9)
    np.testing.assert_array_equal(known.observed, [True, False])


def steps_seen(seed):
    """Return S (step, pixel, unknown), noise variances (step, pixel), and the equations of such data."""
    rng = np.random.default_rng(seed)
    s = rng.normal(size=(9, PIXELS, 6))
    variance = np.exp(rng.normal(size=(9, PIXELS)))
    equations = replace(random_equations(seed), matrix=np.einsum("tri,trj->tij", s, s))
    return s, variance, equations


def written_out(s, functions):
    """Return the sensitivity (step * pixel, function * unknown) of all residuals to all coefficients."""
    return np.einsum("ft,trn->trfn", functions, s).reshape(-1, len(functions) * s.shape[2])


@given(st.integers(0, 10**6), st.floats(0.02, 10.0))
@law(15)
def test_under_white_noise_the_covariance_is_that_of_bayes_rule(seed, deviation):
    """Information adds: C^-1 = H / gamma^2 + P, of functions that share steps, and of one for each step."""
    s, _, equations = steps_seen(seed)
    believed = np.eye(18) / deviation**2
    functions = random_functions(seed)
    whole = written_out(s, functions)
    known = posterior(equations, functions, prior(deviation, (2, 3)))
    information = whole.T @ whole / equations.rms**2 + believed
    np.testing.assert_allclose(known.covariance @ information, np.eye(18), atol=1e-8)
    alone = posterior(equations, np.eye(9), prior(deviation, (2, 3)))
    for t in range(9):
        mean_square = equations.chi2[t] / PIXELS
        information = s[t].T @ s[t] / mean_square + believed[:6, :6]
        np.testing.assert_allclose(alone.covariance[t] @ information, np.eye(6), atol=1e-8)


@given(st.integers(0, 10**6), st.floats(0.02, 10.0))
@law(15)
def test_the_covariance_is_that_of_what_noise_and_the_prior_s_pull_do_to_the_estimate(seed, deviation):
    """The estimate (H + gamma^2 P)^-1 G^T (G a + n) misses a by a linear map of noise n and truth a, written out."""
    s, variance, equations = steps_seen(seed)

    def missed(g, noise, gamma2):
        total = np.linalg.inv(g.T @ g + gamma2 / deviation**2 * np.eye(g.shape[1]))
        by_noise = total @ g.T * np.sqrt(noise)
        by_truth = (total @ g.T @ g - np.eye(g.shape[1])) * deviation
        return by_noise @ by_noise.T + by_truth @ by_truth.T

    functions = random_functions(seed)
    g = written_out(s, functions)
    noise = {"all": (g.T * variance.reshape(-1)) @ g}
    known = posterior(equations, functions, prior(deviation, (2, 3)), noise)
    expected = missed(g, variance.reshape(-1), equations.rms**2)
    np.testing.assert_allclose(known.covariance, expected, atol=1e-9 * np.abs(expected).max())
    noise = {"all": np.einsum("trn,tr,trm->tnm", s, variance, s)}
    alone = posterior(equations, np.eye(9), prior(deviation, (2, 3)), noise)
    for t in range(9):
        expected = missed(s[t], variance[t], equations.chi2[t] / PIXELS)
        np.testing.assert_allclose(alone.covariance[t], expected, atol=1e-9 * np.abs(expected).max())


def test_the_data_s_share_is_what_they_took_of_the_prior_s_variance():
    equations, functions, believed = random_equations(2), random_functions(2), prior(0.3, (2, 3))
    known = posterior(equations, functions, believed)
    before = 0.3**2 * (functions**2).sum(axis=0)[:, None, None]
    np.testing.assert_allclose(known.data_share, 1 - known.deviation**2 / before, atol=1e-9)
    assert ((known.data_share > 0) & (known.data_share < 1)).all()


def test_more_data_never_make_an_amplitude_less_known():
    equations, functions, believed = random_equations(6), random_functions(6), prior(0.3, (2, 3))
    once = posterior(equations, functions, believed)
    # every pixel seen twice, with the same rms residual
    twice = replace(equations, matrix=2 * equations.matrix, chi2=2 * equations.chi2, pixels=2 * equations.pixels)
    assert (posterior(twice, functions, believed).deviation < once.deviation).all()


def test_posterior_deviations_are_the_scatter_over_noise_draws():
    """Sensitivities of the small sample, linear model: 300 draws of white noise, the direct solve of each."""
    noise = 0.02
    at_rest = np.zeros((STEPS, *SECTIONS.shape))
    start = linearise(radiographs(SECTIONS, at_rest), SECTIONS, at_rest)
    functions, believed = time_functions(), prior(1e3)
    rng = np.random.default_rng(11)
    pixels = SHAPE[0] * SHAPE[1]
    roots = [np.linalg.cholesky(b + 1e-9 * np.trace(b) * np.eye(UNKNOWNS)) for b in start.matrix]
    hessian = sum(np.kron(np.outer(functions[:, t], functions[:, t]), start.matrix[t]) for t in range(STEPS))
    draws = []
    for _ in range(300):
        # c = S^T noise has covariance noise^2 B, whatever S
        c = noise * np.stack([root @ rng.normal(size=UNKNOWNS) for root in roots])
        solved = np.linalg.solve(hessian, (functions @ c).ravel()).reshape(FUNCTIONS, UNKNOWNS)
        draws.append(functions.T @ solved)
    scatter = np.std(draws, axis=0).reshape(STEPS, *SECTIONS.shape)
    noisy = replace(start, chi2=np.full(STEPS, pixels * noise**2))
    # a deviation from 300 draws is known to 4 %
    ratio = posterior(noisy, functions, believed).deviation / scatter
    assert np.abs(ratio - 1).max() < 0.2
    assert np.abs(ratio.mean() - 1) < 0.03


def test_a_section_out_of_the_window_is_unobserved():
    """The window sees 1.2 mm up and down; a section's hat reaches to its neighbours."""
    far = SectionBasis(height_mm=np.array([-1.2, 0.0, 1.25, 1.4, 1.55]), radius_mm=0.5)
    images = radiographs(far, np.zeros((STEPS, *far.shape)))
    known = posterior(linearise(images, far, np.zeros((STEPS, *far.shape))), time_functions(), prior(1.0, far.shape))
    np.testing.assert_array_equal(known.observed, [True, True, True, False, False])
    expected = np.sqrt((time_functions() ** 2).sum(axis=0))
    np.testing.assert_allclose(
        known.deviation[:, 3:], np.broadcast_to(expected[:, None, None], (STEPS, 2, 6)), rtol=1e-6
    )


def test_a_section_that_some_rows_see_in_part_is_observed_and_better_known_than_before():
    """Its hat reaches 0.2 mm into the window, four rows of 46, where it counts for a third at most."""
    far = SectionBasis(height_mm=np.array([-1.1, 0.0, 0.95, 1.5]), radius_mm=0.5)
    rested = np.zeros((STEPS, *far.shape))
    images = radiographs(far, rested)
    noisy = replace(linearise(images, far, rested), chi2=np.full(STEPS, SHAPE[0] * SHAPE[1] * 0.01**2))
    known = posterior(noisy, time_functions(), prior(1.0, far.shape))
    assert known.observed.all()
    assert (known.data_share[:, 3, 2] > 0.9).all()


@given(st.integers(0, 10**6), st.sampled_from((3e-4, 3e-3)), st.integers(0, 3))
@law(15)
def test_a_section_is_observed_unless_it_shows_a_thousand_times_less_than_the_others(seed, share, section):
    """S comes from sums in single precision, over rays that other sections move too: that much of it is rounding."""
    equations = random_equations(seed, shape=(4, 2), pixels=200)
    size = np.ones((4, 2))
    size[section] = share
    fainter = replace(equations, matrix=equations.matrix * np.outer(size, size))
    observed = posterior(fainter, random_functions(seed), prior(1.0, (4, 2))).observed
    np.testing.assert_array_equal(observed, (np.arange(4) != section) | (share > 1e-3))
