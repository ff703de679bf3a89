"""The smoother: motion of any history, every step from the radiographs of all, by a Gaussian process over steps.

At amplitudes a_0(t), one pass over the radiographs gives c = B (a - a_0) + h, with h the noise of radiographs,
reference views and flats, of covariance V(t) at a step (`pdvc.noise`). With L L^T = V the data are white,

    y = L^-1 (c + B a_0) = X a + noise,          X = L^-1 B

and `pdvc.process` finds the likeliest process and the amplitudes under all data, about which the next pass is made.

The posterior covariance holds noise and what the process leaves open. Steps that look along the same views, and all
steps by the flats, have noise in common, which V(t) of each step alone does not tell. What varies slowly of it counts:
with few smooth functions Psi of the step, h = sum_i Psi_i(t) g_i, and

    cov g = [ V_Psi - sum_t Psi(t) Psi(t)^T (x) V(t) ] / T^2           V_Psi: of all steps together, T steps

whose effect on the amplitudes is added. Both parts are split by the sources of noise with draws of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import linalg

from pdvc.banded import Blocks
from pdvc.equations import Equations, joined
from pdvc.history import Angle, Polynomial, TimeFunction, time_basis
from pdvc.noise import Propagated
from pdvc.process import ROUNDS, Deviations, Process, Seen, Smoothed, StateSpace
from pdvc.solution import SHORTER, Known, Problem, Solution, Solver
from pdvc.verdict import Stop, listed

Floats = NDArray[np.float64]

RIDGE = 1e-6
"""Share of the typical variance that is added to V: rounding leaves directions without any."""
WORSE = 1e-3
"""A step that raises chi2 by more than this share is shortened: amplitudes under a prior may fit a little less."""
SLOW_DEGREE = 4
"""Degree of the polynomials among the functions Psi."""
DRAWS = 64
"""Draws of each source of noise that tell its part."""
RANK = 250
"""Directions of noise common to steps that are followed, the largest."""
EVENT = 25.0
"""Scale of bends from which on a step is told as an event: five times the typical bend."""
MISFIT = 2.0
"""Variance of a step's data over its noise from which on that is told."""


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """The process at one pass: what was seen, and what follows."""

    process: Process
    deviations: Deviations
    smoothed: Smoothed
    inverse: Blocks

    @property
    def amplitude(self) -> Floats:
        """Return amplitudes (step, unknown), voxels."""
        return self.process.amplitude(self.smoothed)


class Smoother(Solver):
    """A motion of any history, smooth over the steps as far as the data say so."""

    kind: Literal["smoother"] = "smoother"
    """any history: each step from the radiographs of all, by a Gaussian process over the steps"""
    most_passes: Annotated[int, Field(ge=1)] = 4
    """largest number of steps, each a pass over all radiographs"""
    least_change_voxel: Annotated[float, Field(gt=0)] = 2e-3
    """converged: the displacement changes by less than this, voxel rms"""
    trend: tuple[TimeFunction, ...] = (Angle(),)
    """time functions of the rigid motion of the whole sample, beside the process"""
    bend_voxel: Annotated[float, Field(gt=0)] | Literal["fit"] = "fit"
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
        space = StateSpace(
            problem.basis,
            problem.series.time_s,
            time_basis(self.trend, problem.series) if self.trend else np.empty((0, steps)),
            contraction_of_strain=None if self.contraction_of_strain == "none" else self.contraction_of_strain,
            prior_voxel=float(problem.prior.deviation_voxel.max()),
        )
        equations = problem.linearise(amplitude.reshape(steps, *shape))
        slow = slow_functions(problem)
        noise = problem.noise_at(amplitude.reshape(steps, *shape), equations, slow)
        rms, last, stop, reason = [equations.rms], 0.0, Stop.MOST, f"{self.most_passes} passes done, the most allowed"
        deviations, rounds = space.first_guess(), ROUNDS
        if self.bend_voxel != "fit":
            deviations, rounds = space.fixed(self.bend_voxel), 0
        for _ in range(self.most_passes):
            fit, _ = _fitted(space, equations, noise, amplitude, deviations, rounds)
            deviations, rounds = fit.deviations, min(rounds, 1)
            moved, trial = self._carefully(problem, equations, amplitude, fit.amplitude)
            last = float(np.sqrt(np.mean((moved - amplitude) ** 2)))
            amplitude, equations = moved, trial
            rms.append(equations.rms)
            if last < self.least_change_voxel:
                stop, reason = Stop.CONVERGED, f"converged: the last change was {last:.2g} voxel rms"
                break
        fit, white = _fitted(space, equations, noise, amplitude, deviations, 0)
        return Solution(
            coefficients=amplitude.reshape(steps, *shape) / np.sqrt(steps),
            equations=equations,
            temporal=np.empty((0, steps)),
            spatial=np.empty((0, *shape)),
            rms=np.array(rms),
            stop=stop,
            stop_reason=f"{reason}; {_in_words(fit.deviations)}",
            last_change_voxel=last,
            known=_known(fit, noise, slow, white),
        )

    @property
    def passes(self) -> float:
        """Return about how many passes over all radiographs it may take."""
        return self.most_passes * 0.6 + 3

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


def slow_functions(problem: Problem) -> Floats:
    """Return Psi (function, step), orthonormal: what noise that steps have in common is followed in."""
    parts = (Polynomial(degree=min(SLOW_DEGREE, len(problem.series) - 1)), Angle())
    return time_basis(parts, problem.series)


def seen(equations: Equations, noise: Floats, amplitude: Floats) -> tuple[Seen, Floats]:
    """Return the white data of equations at amplitudes (step, unknown), and L^-1 of each step.

    `noise` is V (step, unknown, unknown). An unknown that no radiograph sees has no data.
    """
    matrix, vector = equations.matrix, equations.vector
    diagonal = np.einsum("tnn->tn", matrix)
    scale = np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    scaled = noise * scale[:, :, None] * scale[:, None]
    variance = np.einsum("tnn->tn", scaled)
    typical = np.array([np.median(row[row > 0]) if (row > 0).any() else 1.0 for row in variance])
    unknown = np.arange(matrix.shape[1])
    # what is not seen has unit noise, and no data
    scaled[:, unknown, unknown] += np.where(variance > 0, RIDGE * typical[:, None], 1.0)
    white = np.linalg.inv(np.linalg.cholesky(scaled)) * scale[:, None]
    right = vector + np.einsum("tnm,tm->tn", matrix, amplitude)
    return Seen(design=white @ matrix, data=np.einsum("tnm,tm->tn", white, right)), white


def _fitted(
    space: StateSpace, equations: Equations, noise: Propagated, amplitude: Floats, deviations: Deviations, rounds: int
) -> tuple[_Fit, Floats]:
    """Return the likeliest process about amplitudes (step, unknown), and L^-1."""
    data, white = seen(equations, _of_all(noise), amplitude)
    process = Process(space, data)
    found, smoothed, inverse = process.fitted(deviations, rounds)
    return _Fit(process=process, deviations=found, smoothed=smoothed, inverse=inverse), white


def _of_all(noise: Propagated) -> Floats:
    """Return V of each step, of all sources."""
    return np.asarray(sum(noise.own.values()))


def _known(fit: _Fit, noise: Propagated, slow: Floats, white: Floats) -> Known:
    """Return the covariance of the amplitudes over the square root of the steps, and what makes it."""
    process, steps = fit.process, len(white)
    own = process.covariance(fit.smoothed, fit.inverse)

    def effect(of_vector: Floats) -> Floats:
        """Return the covariance that draws of h (step, unknown, draw), each worth one over their number, leave."""
        moved = process.response(fit.smoothed, fit.deviations, white @ of_vector)
        return np.asarray(moved @ moved.transpose(0, 2, 1))

    rng = np.random.default_rng(0)
    parts = {}
    for name, covariance in noise.own.items():
        draws = rng.standard_normal((*covariance.shape[:2], DRAWS)) / np.sqrt(DRAWS)
        parts[name] = effect(_root(covariance) @ draws)
    parts["process"] = own - np.sum(list(parts.values()), axis=0)
    total = _of_all(noise)
    for name in noise.own:
        common = _common(noise.parts[name], joined(noise.own[name], slow), joined(total, slow))
        if common is not None:
            shared = np.einsum("ft,fnr->tnr", slow / steps, common.reshape(len(slow), -1, common.shape[1]))
            left = effect(shared)
            parts[name] = parts[name] + left
            own = own + left
    return Known(covariance=own / steps, by_source={name: part / steps for name, part in parts.items()})


def _root(covariance: Floats) -> Floats:
    """Return a square root (step, unknown, unknown) of covariances that may lack directions."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0))[:, None])


def _common(whole: Floats, own: Floats, total: Floats) -> Floats | None:
    """Return a root (function * unknown, direction) of the noise that steps have in common; None where there is none.

    `whole`, of all steps together, less `own`, of each step, both on the functions Psi; `total` tells what counts.
    Steps whose common noise cancels leave less than each its own: that is not taken off.
    """
    if whole.ndim != own.ndim:
        return None
    scale = np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, vectors = linalg.eigh((whole - own) / scale[:, None] / scale)
    kept = np.argsort(values)[::-1][:RANK]
    kept = kept[values[kept] > RIDGE]
    if len(kept) == 0:
        return None
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]) * scale[:, None])


def _in_words(deviations: Deviations) -> str:
    """Say what the process is like."""
    bends = deviations.bend_voxel
    said = f"bends from step to step of {bends.min():.1g} to {bends.max():.1g} voxel"
    events = np.flatnonzero(np.maximum(deviations.rigid_scale, deviations.own_scale) > EVENT) + 1
    if len(events):
        said += f", far larger at step {listed(events.tolist())}"
    misfits = np.flatnonzero(deviations.misfit > MISFIT)
    if len(misfits):
        said += f"; radiographs that fit less well than their noise tells: step {listed(misfits.tolist())}"
    return said
