"""The smoother: motion of any history, every step from the radiographs of all, by a Gaussian process over steps.

At amplitudes a_0(t), one pass over the radiographs gives c = B (a - a_0) + h, with h the noise of radiographs,
reference views and flats, of covariance V(t) at a step (`pdvc.noise`). With L L^T = V the data are white,

    y = L^-1 (c + B a_0) = X a + noise,          X = L^-1 B

and `pdvc.process` finds the likeliest process and the amplitudes under all data, about which the next pass is made.

The posterior covariance holds noise and what the process leaves open. Steps that look along the same views, and all
steps by the flats, have noise in common, which V(t) of each step alone does not tell. What varies slowly of it counts:
motions in the span of a few smooth functions Psi of the step, on which all noise together has the covariance V_Psi
and that of each step alone W_Psi = sum_t Psi Psi^T (x) V(t). With H = sum_t Psi Psi^T (x) B(t), what they differ by is

    cov g = H^-1 (V_Psi - W_Psi) H^-1 = sum_k lambda_k v_k v_k^T,        (V_Psi - W_Psi) u = lambda H u,  v = u

of coefficients g, and each direction v_k does to the amplitudes what data y = X sum_i Psi_i v_ki would. Noise that
cancels between steps has a negative lambda. Draws of the noise of each step tell what each source makes.

What the model of the image misses at a step alone is an apparent motion of the process (`pdvc.apparent`); what it
misses over many steps is told by blocks of the residual (`pdvc.coherent`): they move the amplitudes more than noise
would.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Literal

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import linalg

from pdvc.coherent import by_block, excess
from pdvc.equations import Equations, joined
from pdvc.history import Angle, Polynomial, TimeFunction, time_basis
from pdvc.noise import Propagated
from pdvc.process import FITTED_MODES, ROUNDS, Process, Seen, Smoothed
from pdvc.projection import BlockVectors
from pdvc.sections import SectionBasis
from pdvc.solution import SHORTER, Known, Problem, Solution, Solver
from pdvc.state_space import Deviations, StateSpace
from pdvc.threads import one_thread
from pdvc.verdict import Stop, listed

Floats = NDArray[np.float64]

RIDGE = 1e-6
"""Share of each variance that is added to V: rounding leaves directions without any."""
WORSE = 1e-3
"""A step that raises chi2 by more than this share is shortened: amplitudes under a prior may fit a little less."""
SLOW_DEGREE = 4
"""Degree of the polynomials among the functions Psi."""
COHERENT_DEGREE = 8
"""The same of those in which the image model's errors are followed: texture passes a pixel within some ten steps."""
DRAWS = 64
"""Draws of each source of noise that tell its part."""
RANK = 300
"""Directions of noise common to steps that are followed, the largest."""
WEAK = 1e-6
"""Ridge of the metric, over its diagonal."""
EVENT = 25.0
"""Scale of bends or of apparent motion from which on a step is told: five times what is typical."""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """The process at one pass: what was seen, and what follows."""

    process: Process
    deviations: Deviations
    smoothed: Smoothed
    white: Floats
    """L^-1 (step, unknown, unknown)."""

    @property
    def amplitude(self) -> Floats:
        """Return amplitudes (step, unknown), voxels."""
        return self.process.amplitude(self.smoothed)

    @property
    def deviation(self) -> Floats:
        """Return their standard deviations (step, unknown), voxels, never zero."""
        variance = np.einsum("tnn->tn", self.process.covariance(self.smoothed, self.smoothed.factor.inverted()))
        return np.asarray(np.sqrt(np.maximum(variance, 1e-300)))


class Smoother(Solver):
    """A motion of any history, smooth over the steps as far as the data say so."""

    kind: Literal["smoother"] = "smoother"
    """any history: each step from the radiographs of all, by a Gaussian process over the steps"""
    most_passes: Annotated[int, Field(ge=1)] = 4
    """largest number of steps, each a pass over all radiographs"""
    least_change: Annotated[float, Field(gt=0)] = 0.1
    """converged: amplitudes would change by less than this share of their standard deviations, rms"""
    trend: tuple[TimeFunction, ...] = (Angle(),)
    """time functions of the rigid motion of the whole sample, beside the process"""
    bend_voxel: Annotated[float, Field(ge=1e-5)] | Literal["fit"] = "fit"
    """deviation of all bends from step to step, voxels; fit: found in the data, for each motion"""
    contraction_of_strain: Annotated[float, Field(ge=-0.5, le=0.5)] | Literal["none"] = 0.5
    """contraction expected for an axial strain, the rest of it found: 0.5 keeps the volume; none: not tied"""

    def functions(self, time_functions: Floats) -> Floats:
        """Return one function for each step."""
        steps = time_functions.shape[1]
        return np.asarray(np.eye(steps) * np.sqrt(steps))

    def solve(self, problem: Problem) -> Solution:
        """Repeat pass and smoothing until the motion stays, or as often as allowed.

        Raises ValueError at a coarse scale, where the noise is not known as it must be.
        """
        if problem.noise_at is None:
            raise ValueError("solver: expected kind = 'smoother' in the last stage, at scale 1, got it in another one")
        steps, shape = len(problem.series), problem.start.shape[1:]
        amplitude = problem.start.reshape(steps, -1) * np.sqrt(steps)
        spaces = self.spaces(problem)
        equations = problem.linearise(amplitude.reshape(steps, *shape))
        slow = slow_functions(problem)
        noise = problem.noise_at(amplitude.reshape(steps, *shape), equations, slow)
        rms, stop = [equations.rms], Stop.UNFINISHED
        reason = f"{self.most_passes} passes done, the most allowed"
        deviations, rounds = spaces[0].first_guess(), ROUNDS
        if self.bend_voxel != "fit":
            deviations, rounds = spaces[0].fixed(self.bend_voxel), 0
        for moves in range(self.most_passes + 1):
            with one_thread():
                fit = _fitted(spaces, equations, noise, amplitude, deviations, rounds)
                wanted, deviation = fit.amplitude, fit.deviation
            deviations, rounds = fit.deviations, 1 if rounds > 1 else 0
            left, share = _rms(wanted - amplitude), _rms((wanted - amplitude) / deviation)
            # what the equations still ask for is known before another pass
            if share < self.least_change:
                stop = Stop.CONVERGED
                reason = f"converged: what is left is {left:.2g} voxel rms, {share:.2g} of the standard deviations"
                break
            if moves == self.most_passes:
                break
            amplitude, equations = self._carefully(problem, equations, amplitude, wanted)
            rms.append(equations.rms)
        with one_thread():
            known = known_of(fit, noise, slow, equations.matrix)
            if equations.blocks and steps > COHERENT_DEGREE + 2:
                finer = slow_functions(problem, COHERENT_DEGREE)
                missed = of_image_model(fit, finer, equations.blocks, problem.basis.shape) / steps
                known = Known(
                    covariance=known.covariance + missed, by_source={**known.by_source, "image model": missed}
                )
        return Solution(
            coefficients=amplitude.reshape(steps, *shape) / np.sqrt(steps),
            equations=equations,
            temporal=np.empty((0, steps)),
            spatial=np.empty((0, *shape)),
            rms=np.array(rms),
            stop=stop,
            stop_reason=f"{reason}; {_in_words(fit.deviations)}",
            last_change_voxel=left,
            known=known,
        )

    @property
    def passes(self) -> float:
        """Return about how many passes over all radiographs it may take."""
        return self.most_passes * 0.6 + 3

    def spaces(self, problem: Problem) -> tuple[StateSpace, StateSpace]:
        """Return the states of a problem's steps: with the few modes in which deviations are found, and with all."""
        series, prior = problem.series, float(problem.prior.deviation_voxel.max())
        trend = time_basis(self.trend, series) if self.trend else np.empty((0, len(series)))
        few, every = (self.space(problem.basis, series.time_s, trend, prior, modes) for modes in (FITTED_MODES, None))
        return few, every

    def space(
        self, basis: SectionBasis, time_s: Floats, trend: Floats, prior_voxel: float, most_modes: int | None
    ) -> StateSpace:
        """Return the states of steps at times (step,), with a trend (function, step), as this solver takes them."""
        tied = self.contraction_of_strain
        return StateSpace(
            basis,
            time_s,
            trend,
            contraction_of_strain=None if tied == "none" else tied,
            prior_voxel=prior_voxel,
            most_modes=most_modes,
        )

    def _carefully(
        self, problem: Problem, now: Equations, amplitude: Floats, wanted: Floats
    ) -> tuple[Floats, Equations]:
        """Go all the way, half of it or a quarter: as far as the residual does not rise."""
        for share in SHORTER:
            moved = amplitude + share * (wanted - amplitude)
            trial = problem.linearise(moved.reshape(len(moved), *problem.basis.shape))
            if trial.chi2.sum() <= now.chi2.sum() * (1 + WORSE):
                break
        return moved, trial


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def slow_functions(problem: Problem, degree: int = SLOW_DEGREE) -> Floats:
    """Return Psi (function, step), orthonormal: what errors that steps have in common are followed in."""
    parts = (Polynomial(degree=min(degree, len(problem.series) - 1)), Angle())
    return time_basis(parts, problem.series)


def seen(equations: Equations, noise: Floats, amplitude: Floats) -> tuple[Seen, Floats]:
    """Return the white data of equations at amplitudes (step, unknown), and L^-1 of each step.

    `noise` is V (step, unknown, unknown). An unknown that no radiograph sees has no data.
    """
    matrix, vector = equations.matrix, equations.vector
    variance = np.einsum("tnn->tn", noise)
    scale = np.where(variance > 0, 1 / np.sqrt(np.maximum(variance, 1e-300)), 0.0)
    scaled = noise * scale[:, :, None] * scale[:, None]
    unknown = np.arange(matrix.shape[1])
    # what is not seen has unit noise, and no data
    scaled[:, unknown, unknown] += np.where(variance > 0, RIDGE, 1.0)
    white = np.linalg.inv(np.linalg.cholesky(scaled)) * scale[:, None]
    right = vector + np.einsum("tnm,tm->tn", matrix, amplitude)
    return Seen(design=white @ matrix, data=np.einsum("tnm,tm->tn", white, right)), white


def _fitted(
    spaces: tuple[StateSpace, StateSpace],
    equations: Equations,
    noise: Propagated,
    amplitude: Floats,
    deviations: Deviations,
    rounds: int,
) -> Fitted:
    """Return the likeliest process about amplitudes (step, unknown): found with few modes, then followed with all.

    Raises ValueError where none is likely: the radiographs show something else than this sample.
    """
    try:
        data, white = seen(equations, _of_all(noise), amplitude)
        if rounds:
            deviations = Process(spaces[0], data).fitted(deviations, rounds)
        process = Process(spaces[1], data)
        return Fitted(process=process, deviations=deviations, smoothed=process.smoothed(deviations), white=white)
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"deformation: expected radiographs that some motion of the sample explains, found none that does: {error}"
        ) from None


def _of_all(noise: Propagated) -> Floats:
    """Return V of each step, of all sources."""
    return np.asarray(sum(noise.own.values()))


def known_of(fit: Fitted, noise: Propagated, slow: Floats, matrix: Floats) -> Known:
    """Return the covariance of the amplitudes over the square root of the steps, and what makes it.

    `matrix` is B (step, unknown, unknown). What the model of the image misses over many steps is not in it.
    """
    process, steps = fit.process, len(matrix)
    own = process.covariance(fit.smoothed, fit.smoothed.factor.inverted())

    def effect(errors: Floats, weight: Floats) -> Floats:
        """Return the covariance left by errors of y (step, unknown, draw), each of a weight."""
        moved = process.response(fit.smoothed, fit.deviations, errors)
        return np.asarray((moved * weight) @ moved.transpose(0, 2, 1))

    rng = np.random.default_rng(0)
    parts = {}
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        roots = dict(zip(noise.own, pool.map(_root, noise.own.values()), strict=True))
    for name, root in roots.items():
        draws = rng.standard_normal((*root.shape[:2], DRAWS))
        parts[name] = effect(fit.white @ (root @ draws), np.full(DRAWS, 1 / DRAWS))
    parts["process"] = own - np.sum(list(parts.values()), axis=0)
    errors = np.einsum("tnm,tm->tn", fit.white, noise.systematic)[..., None]
    parts["systematic"] = effect(errors, np.ones(1))
    own = own + parts["systematic"]
    metric = joined(matrix, slow)
    for name, each in noise.own.items():
        together = noise.parts[name]
        # a single step has nothing in common with others
        if together.ndim != metric.ndim:
            continue
        difference = together - joined(each, slow)
        # nor has the noise of one radiograph with that of another
        if not difference.any():
            continue
        weight, directions = _common(difference, metric)
        moved = np.einsum("ft,fnr->tnr", slow, directions.reshape(len(slow), -1, len(weight)))
        left = effect(process.seen.design @ moved, weight)
        parts[name] = parts[name] + left
        own = own + left
    return Known(covariance=own / steps, by_source={name: part / steps for name, part in parts.items()})


def of_image_model(fit: Fitted, slow: Floats, blocks: tuple[BlockVectors, ...], shape: tuple[int, int]) -> Floats:
    """Return the covariance (step, unknown, unknown) of slow errors beyond noise: `pdvc.coherent`."""
    covariance, moved = slow_effects(fit, slow, blocks)
    squares = np.concatenate([(each**2).sum(axis=0) for each in moved], axis=1)
    more = excess(squares, np.einsum("tnn->n", covariance), shape)
    larger = np.sqrt(np.tile(more, shape[0]))
    return np.asarray(covariance * (np.outer(larger, larger) - 1))


def slow_effects(
    fit: Fitted, slow: Floats, blocks: tuple[BlockVectors, ...], draws: int = DRAWS
) -> tuple[Floats, Iterator[Floats]]:
    """Return what noise makes of slow errors, and what each block does.

    The covariance (step, unknown, unknown), from `draws` draws, and the amplitudes that blocks make, some blocks at a
    time (step, unknown, block).
    """
    process, design = fit.process, fit.process.seen.design
    turned = design.transpose(0, 2, 1)
    metric = joined(turned @ design, slow)
    metric[np.diag_indices_from(metric)] += WEAK * np.diag(metric)
    factor = linalg.cho_factor(metric)

    def effect(z: Floats) -> Floats:
        """Return what z (function, unknown, draw) does to the amplitudes (step, unknown, draw)."""
        found = linalg.cho_solve(factor, z.reshape(len(metric), -1)).reshape(z.shape)
        return process.response(fit.smoothed, fit.deviations, design @ np.einsum("ft,fnd->tnd", slow, found))

    drawn = np.random.default_rng(0).standard_normal((*design.shape[:2], draws))
    noise = effect(np.einsum("ft,tnd->fnd", slow, turned @ drawn))
    z = by_block(blocks, turned @ fit.white, slow)
    moved = (effect(z[..., start : start + DRAWS]) for start in range(0, z.shape[2], DRAWS))
    return noise @ noise.transpose(0, 2, 1) / draws, moved


def _root(covariance: Floats) -> Floats:
    """Return a square root (step, unknown, unknown) of covariances that may lack directions."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0))[:, None])


def _common(difference: Floats, metric: Floats) -> tuple[Floats, Floats]:
    """Return the largest lambda (direction,) of a difference in a metric, and their v (function * unknown, direction).

    Motions that the radiographs hardly show are left to the process.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(metric), 1e-300))
    scaled = metric * scale[:, None] * scale
    scaled[np.diag_indices_from(scaled)] += WEAK
    values, vectors = linalg.eigh(difference * scale[:, None] * scale, scaled)
    kept = np.argsort(np.abs(values))[::-1][:RANK]
    return values[kept], vectors[:, kept] * scale[:, None]


def _in_words(deviations: Deviations) -> str:
    """Say what the process is like."""
    bends = deviations.bend_voxel
    said = f"bends from step to step of {bends.min():.1g} to {bends.max():.1g} voxel"
    events = np.flatnonzero(np.maximum(deviations.rigid_scale.max(axis=1), deviations.own_scale) > EVENT) + 1
    if len(events):
        said += f", far larger at step {listed(events.tolist())}"
    strange = np.flatnonzero(deviations.apparent_scale.max(axis=1) > EVENT)
    if len(strange):
        said += f"; radiographs that tell another motion than their neighbours: step {listed(strange.tolist())}"
    return said
