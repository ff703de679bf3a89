"""The smoother: white data, linear problems with a known answer, and the inverse crime with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc.equations import Equations, joined
from pdvc.experiment import Series
from pdvc.noise import ImageNoise, Noise, Propagated, propagate
from pdvc.prior import Prior
from pdvc.sections import CONTRACTION, RIGID, SectionBasis
from pdvc.smoother import Smoother, _in_words, seen
from pdvc.solution import Problem
from pdvc.state_space import StateSpace
from pdvc.systematic import Systematic
from pdvc.verdict import Stop
from tests import small_case
from tests.laws import law
from tests.linear_problems import linear_model, random_equations

STEPS = 20
BASIS = SectionBasis(height_mm=np.array([-1.0, 0.1, 1.0]), radius_mm=0.5, motions=(*RIGID, CONTRACTION))
UNKNOWNS = BASIS.shape[0] * BASIS.shape[1]
SERIES = Series(
    counts=np.zeros((STEPS, 1, 1), dtype=np.uint16),
    angle_rad=np.linspace(0, 4 * np.pi, STEPS, endpoint=False),
    time_s=2.0 * np.arange(STEPS),
    force_N=np.zeros(STEPS),
)


def history(seed: int, size: float = 0.3) -> np.ndarray:
    """Return a smooth motion (step, unknown), voxels: a parabola in time of each amplitude."""
    factors = np.random.default_rng(seed).normal(size=(3, UNKNOWNS))
    return size * np.polynomial.legendre.legvander(np.linspace(-1, 1, STEPS), 2) @ factors


def moved_by(truth: np.ndarray, noise: Equations) -> Equations:
    """Return equations at rest of radiographs with noise and a motion: c = h + B a, of the same sensitivities."""
    bent = np.einsum("tij,tj->ti", noise.matrix, truth)
    chi2 = noise.chi2 + 2 * (truth * noise.vector).sum(axis=1) + (truth * bent).sum(axis=1)
    return replace(noise, vector=noise.vector + bent, chi2=chi2)


def noise_of(matrix: np.ndarray, shared: float = 0.0):
    """Return white noise of variance one: V = B; a share of it the same at all steps, as far as B is."""
    root = np.linalg.cholesky(matrix)

    def at(amplitude: np.ndarray, equations: Equations, functions: np.ndarray) -> Propagated:
        whole = joined(matrix, functions)
        for t in range(STEPS):
            for other in set(range(STEPS)) - {t}:
                joint = np.kron(np.outer(functions[:, t], functions[:, other]), root[t] @ root[other].T)
                whole += shared * joint
        return Propagated(parts={"views": whole}, own={"views": matrix}, systematic=np.zeros((STEPS, UNKNOWNS)))

    return at


def problem(start: Equations, *, deviation: float = 30.0, begun: np.ndarray | None = None, **changes) -> Problem:
    first = np.zeros((STEPS, UNKNOWNS)) if begun is None else begun
    given = Problem(
        linearise=linear_model(start),
        basis=BASIS,
        series=SERIES,
        time_functions=Smoother().functions(np.ones((1, STEPS))),
        start=first.reshape(STEPS, *BASIS.shape) / np.sqrt(STEPS),
        prior=Prior(deviation_voxel=np.full(BASIS.shape, deviation)),
        noise_rms=None,
        noise_at=noise_of(start.matrix),
    )
    return replace(given, **changes)


def drawn(seed: int, pixels: int = 200) -> Equations:
    return random_equations(seed, steps=STEPS, shape=BASIS.shape, pixels=pixels)


def amplitude_of(solution) -> np.ndarray:
    return solution.coefficients.reshape(STEPS, -1) * np.sqrt(STEPS)


def alone(start: Equations) -> np.ndarray:
    """Return amplitudes (step, unknown), of each step by its own equations."""
    return np.linalg.solve(start.matrix, start.vector[..., None])[..., 0]


# White data


def a_noise(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return V (3, size, size) of unknowns that show differently."""
    root = rng.normal(size=(3, size, size))
    scale = np.exp(0.5 * rng.normal(size=size))
    return scale[:, None] * (root @ root.transpose(0, 2, 1) + np.eye(size)) * scale


def test_white_data_scatter_about_the_motion_with_variance_one_and_apart():
    """y = X a + noise, whatever the noise of the equations, and wherever they were made."""
    size, draws = 5, 4000
    rng = np.random.default_rng(1)
    noise, start = a_noise(rng, size), random_equations(1, steps=3, shape=(1, size))
    root = np.linalg.cholesky(noise)
    truth, now = rng.normal(size=(2, 3, size))
    left = []
    for _ in range(draws):
        h = np.einsum("tnm,tm->tn", root, rng.normal(size=(3, size)))
        vector = np.einsum("tnm,tm->tn", start.matrix, truth - now) + h
        data, _ = seen(replace(start, vector=vector), noise, now)
        left.append(data.data - np.einsum("tnm,tm->tn", data.design, truth))
    for t in range(3):
        covariance = np.cov(np.array(left)[:, t], rowvar=False)
        # of 4000 draws: to 2 %
        np.testing.assert_allclose(covariance, np.eye(size), atol=0.1)
    np.testing.assert_allclose(np.mean(left, axis=0), 0, atol=0.1)


@law(20)
@given(st.integers(0, 10**6), st.integers(0, 4))
def test_an_unknown_that_no_radiograph_sees_has_no_data_and_changes_none(seed, hidden):
    size = 5
    rng = np.random.default_rng(seed)
    noise, start = a_noise(rng, size), random_equations(seed, steps=3, shape=(1, size))
    now, others = rng.normal(size=(3, size)), np.delete(np.arange(size), hidden)
    matrix, vector, dark = start.matrix.copy(), start.vector.copy(), noise.copy()
    for each in (matrix, dark):
        each[:, hidden], each[:, :, hidden] = 0, 0
    vector[:, hidden] = 0
    found, _ = seen(replace(start, matrix=matrix, vector=vector), dark, now)
    assert np.isfinite(found.design).all()
    assert not found.design[:, :, hidden].any()
    information = found.design.transpose(0, 2, 1) @ found.design
    right = np.einsum("tnm,tn->tm", found.design, found.data)
    part = replace(start, matrix=matrix[:, others][:, :, others], vector=vector[:, others])
    less, _ = seen(part, dark[:, others][:, :, others], now[:, others])
    expected = less.design.transpose(0, 2, 1) @ less.design
    np.testing.assert_allclose(information[:, others][:, :, others], expected, atol=1e-4 * np.abs(expected).max())
    expected = np.einsum("tnm,tn->tm", less.design, less.data)
    np.testing.assert_allclose(right[:, others], expected, atol=1e-4 * np.abs(expected).max())


@law(20)
@given(st.integers(0, 10**6))
def test_white_data_hold_what_the_equations_and_their_noise_tell(seed):
    """X^T X = B V^-1 B, the information of the best unbiased estimate."""
    rng = np.random.default_rng(seed)
    noise, start = a_noise(rng, 4), random_equations(seed, steps=3, shape=(1, 4))
    data, white = seen(start, noise, np.zeros((3, 4)))
    expected = start.matrix @ np.linalg.inv(noise) @ start.matrix
    found = data.design.transpose(0, 2, 1) @ data.design
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_allclose(white @ start.matrix, data.design)


# Linear problems


def test_every_step_has_a_function_of_its_own():
    functions = Smoother().functions(np.ones((2, 7)))
    np.testing.assert_allclose(functions @ functions.T / 7, np.eye(7), atol=1e-12)
    assert np.count_nonzero(functions) == 7


def test_a_smooth_motion_is_found_closer_than_by_each_step_alone_and_as_well_as_is_said():
    # a pass is smoothing about the last one: of linear equations the second changes only the process
    ratios, squares = [], []
    for seed in range(4):
        truth = history(seed)
        start = moved_by(truth, drawn(seed))
        found = Smoother().solve(problem(start))
        assert found.stop is Stop.CONVERGED
        assert len(found.rms) <= 5
        assert found.last_change_voxel < 2e-3
        away = amplitude_of(found) - truth
        ratios.append(np.sqrt((away**2).mean() / ((alone(start) - truth) ** 2).mean()))
        variance = STEPS * np.einsum("tnn->tn", found.known.covariance)
        squares.append(away**2 / variance)
    assert max(ratios) < 0.7
    assert np.sqrt(np.mean(squares)) == pytest.approx(1, abs=0.15)


def test_where_steps_may_bend_without_limit_each_is_solved_by_itself():
    start = moved_by(history(1), drawn(1))
    found = Smoother(bend_voxel=1e3).solve(problem(start, deviation=1e3))
    np.testing.assert_allclose(amplitude_of(found), alone(start), atol=1e-4)
    own = np.linalg.inv(start.matrix) / STEPS
    np.testing.assert_allclose(found.known.covariance, own, atol=1e-3 * np.abs(own).max())
    np.testing.assert_allclose(found.equations.vector, 0, atol=1e-2)


def test_where_steps_hardly_bend_the_motion_is_steady_beside_the_trend():
    start = moved_by(history(1), drawn(1))
    found = amplitude_of(Smoother(bend_voxel=1e-5, trend=()).solve(problem(start)))
    assert np.abs(np.diff(found, 2, axis=0)).max() < 1e-3
    assert np.abs(np.diff(found, axis=0)).max() > 1e-2


def test_a_sample_that_runs_round_with_the_stage_is_the_trend():
    """However little it bends: sine and cosine of the angle are its own, of the sample as a whole."""
    turning = np.zeros((STEPS, *BASIS.shape))
    turning[:, :, 0] = np.cos(SERIES.angle_rad)[:, None]
    turning[:, :, 1] = np.sin(SERIES.angle_rad)[:, None]
    start = moved_by(turning.reshape(STEPS, -1), drawn(2))
    found = amplitude_of(Smoother(bend_voxel=1e-5).solve(problem(start)))
    assert np.sqrt(((found - turning.reshape(STEPS, -1)) ** 2).mean()) < 0.05


def test_where_it_starts_is_not_where_it_ends():
    start = moved_by(history(3), drawn(3))
    elsewhere = history(9, size=2.0)
    one, two = (Smoother().solve(problem(start, begun=begun)) for begun in (None, elsewhere))
    np.testing.assert_allclose(amplitude_of(two), amplitude_of(one), atol=0.01)
    # and it does start there
    for found, begun in ((one, 0 * elsewhere), (two, elsewhere)):
        assert found.rms[0] == pytest.approx(linear_model(start)(begun).rms)


def test_it_stops_after_the_most_passes_and_says_so():
    found = Smoother(most_passes=1, least_change=1e-9).solve(problem(moved_by(history(1), drawn(1))))
    assert found.stop is Stop.UNFINISHED
    assert "1 passes done, the most allowed" in found.stop_reason
    assert len(found.rms) == 2
    assert found.temporal.shape == (0, STEPS)
    assert found.spatial.shape == (0, *BASIS.shape)


def test_a_step_that_goes_too_far_is_shortened():
    """Equations that ask for three times what is missing: half of that lowers the residual, the whole does not."""
    start = moved_by(history(4, size=2.0), drawn(4))
    model = linear_model(start)

    def hasty(amplitude: np.ndarray) -> Equations:
        now = model(amplitude)
        return replace(now, vector=3 * now.vector)

    found = Smoother(bend_voxel=1e5, most_passes=1).solve(problem(start, deviation=1e5, linearise=hasty))
    np.testing.assert_allclose(amplitude_of(found), 1.5 * alone(start), atol=1e-3)


def test_a_slip_is_told_by_its_steps():
    truth = history(5)
    truth[11:] += np.tile([3.0, -3, 3, 3, 3, -3, 0], 3)
    found = Smoother().solve(problem(moved_by(truth, drawn(5))))
    assert "far larger at step" in found.stop_reason
    events = found.stop_reason.split("; ")[1]
    assert {"10", "11"} <= set(events.replace(",", " ").split())
    assert np.abs(amplitude_of(found) - truth)[11:].max() < 0.3


def test_a_radiograph_that_its_neighbours_contradict_is_told_by_its_step():
    space = StateSpace(BASIS, SERIES.time_s, np.empty((0, STEPS)), contraction_of_strain=None, prior_voxel=30.0)
    usual = space.first_guess()
    scale = usual.apparent_scale.copy()
    scale[4, 2] = 30
    assert "neighbours" not in _in_words(usual)
    told = _in_words(replace(usual, apparent_scale=scale))
    assert told.endswith("; radiographs that tell another motion than their neighbours: step 4")


def test_what_sources_and_the_process_leave_adds_up():
    found = Smoother().solve(problem(moved_by(history(6), drawn(6))))
    assert set(found.known.by_source) == {"views", "process", "systematic"}
    total = sum(found.known.by_source.values())
    np.testing.assert_allclose(total, found.known.covariance, atol=1e-9 * np.abs(total).max())


def test_noise_that_all_steps_have_in_common_is_not_averaged_away():
    start = moved_by(history(7), drawn(7))
    own, shared = (
        Smoother(bend_voxel=1e-3).solve(problem(start, noise_at=noise_of(start.matrix, share))).known.covariance
        for share in (0.0, 0.5)
    )
    wider = np.einsum("tnn->tn", shared) / np.einsum("tnn->tn", own)
    assert (wider > 0.99).all()
    assert wider.mean() > 2


def test_a_coarse_stage_is_refused_in_one_line():
    with pytest.raises(ValueError, match="expected kind = 'smoother' in the last stage, at scale 1") as at:
        Smoother().solve(problem(drawn(1), noise_at=None))
    assert "\n" not in str(at.value)


# The inverse crime, with noise


def test_a_motion_is_found_in_noisy_radiographs_as_well_as_is_said():
    """By pdvc's own projector, with white noise, from rest: a smooth motion of all sections, none of the trend's."""
    level, steps, sections = 0.02, small_case.STEPS, small_case.SECTIONS
    time = np.linspace(-1, 1, steps)
    factors = np.random.default_rng(3).normal(size=(4, *sections.shape))
    truth = 0.3 * np.einsum("tf,fjk->tjk", np.polynomial.legendre.legvander(time, 3), factors)
    images = small_case.radiographs(sections, truth)
    rough = level * np.random.default_rng(4).normal(size=images.grey.shape)
    images = replace(images, grey=(images.grey + rough).astype(np.float32))
    shape = small_case.SHAPE
    nothing = np.zeros(shape, dtype=np.float32)
    white = ImageNoise(variance=np.full(shape, level**2, dtype=np.float32), slope=nothing)
    still = ImageNoise(variance=nothing, slope=nothing)
    noise = Noise(step=lambda t: white, view=lambda v: still, flat=nothing)
    systematic = Systematic(
        left=lambda view: nothing,
        view_rad=np.linspace(0, 2 * np.pi, 30, endpoint=False),
        step_rad=small_case.ANGLES,
        corner=(0, 0),
        shape=shape,
        detector=shape,
        width_rad=0.1,
    )
    found = Smoother().solve(
        Problem(
            linearise=small_case.lineariser(images, sections),
            basis=sections,
            series=small_case.series(),
            time_functions=np.sqrt(steps) * np.eye(steps),
            start=np.zeros_like(truth),
            prior=Prior(deviation_voxel=np.full(sections.shape, 30.0)),
            noise_rms=None,
            noise_at=lambda amplitude, now, slow: propagate(images, systematic, sections, amplitude, slow, noise),
        )
    )
    assert found.rms[-1] == pytest.approx(level, rel=0.07)
    assert found.rms[-1] < 0.5 * found.rms[0]
    away = (found.coefficients * np.sqrt(steps) - truth).reshape(steps, -1)
    variance = steps * np.einsum("tnn->tn", found.known.covariance)
    assert np.sqrt((away**2 / variance).mean()) == pytest.approx(1, abs=0.3)
    at_once = np.linalg.inv(found.equations.matrix) * level**2
    assert variance.sum() < 0.6 * np.einsum("tnn->", at_once)
