"""Two steps: first the motion, as measured, then the law with the nearest one (finite element model updating).

Weighted, distances are in the covariance of each step's measured motion, with what the noise of the recorded force
adds to it. A measurement's file tells no covariance between steps, so that each step counts as if it were
independent. Unweighted, as laboratories often do it, all displacements count alike and the force is taken as exact;
the scatter that is left tells the deviations.

The sample's shift along the beam is free at each step. Compared are the axial motion and the contraction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pdvc.identify.model import Model
from pdvc.sections import CONTRACTION, TRANSLATION_Z, SectionBasis

Floats = NDArray[np.float64]

FREE_VOXEL = 1e3
"""Standard deviation of a shift of the whole that is free, voxels."""
RIDGE = 1e-6
"""Share of the mean variance that is added to each: rounding leaves directions without any."""
_REWEIGHED = 3
MOST_EVALUATIONS = 30


@dataclass(frozen=True, kw_only=True)
class LawEstimate:
    """What a method made of the unknowns."""

    vector: Floats
    """(unknown,)"""
    covariance: Floats
    """(unknown, unknown)"""
    misfit: float
    """rms of what is left, in standard deviations where they are known, else in voxels."""


def seen_motions(basis: SectionBasis, observed: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return which unknowns of a step tell the stretch: axial motion, then contraction, of observed sections."""
    place = np.arange(np.prod(basis.shape)).reshape(basis.shape)[observed]
    return np.concatenate([place[:, basis.motions.index(each)] for each in _telling(basis)])


def _telling(basis: SectionBasis) -> list[object]:
    return [each for each in (TRANSLATION_Z, CONTRACTION) if each in basis.motions]


def unweighted(
    model: Model,
    amplitude: Floats,
    seen: NDArray[np.intp],
    force_N: Floats,
    sections: int,
    start: Floats | None = None,
) -> LawEstimate:
    """Return the nearest law by least squares of all displacements, amplitudes (step, unknown), voxels.

    `seen` are the unknowns that count, those of the axial motion, one for each of `sections`, first.
    """
    free = np.zeros(len(seen))
    free[:sections] = 1 / np.sqrt(sections)
    without = np.eye(len(seen)) - np.outer(free, free)
    spread = 1.0
    for _ in range(_REWEIGHED):
        white = np.broadcast_to(without / spread, (len(force_N), *without.shape))
        found = _nearest(model, amplitude[:, seen], seen, force_N, white, start)
        start = found.vector
        spread *= found.misfit
    return LawEstimate(vector=found.vector, covariance=found.covariance, misfit=spread)


def weighted(
    model: Model,
    amplitude: Floats,
    covariance: Floats,
    seen: NDArray[np.intp],
    force_N: Floats,
    sections: int,
    start: Floats,
) -> LawEstimate:
    """Return the nearest law in the metric of covariances (step, unknown, unknown), voxel^2, from a start."""
    found = start
    for _ in range(_REWEIGHED):
        white = _white(model, covariance, seen, force_N, sections, found)
        estimate = _nearest(model, amplitude[:, seen], seen, force_N, white, found)
        found = estimate.vector
    return estimate


def zeroed(amplitude: Floats, steps: int) -> Floats:
    """Return amplitudes (step, unknown) less their mean over the first steps, in which nothing was loaded."""
    return amplitude - amplitude[:steps].mean(axis=0) if steps else amplitude


def _white(
    model: Model, covariance: Floats, seen: NDArray[np.intp], force_N: Floats, sections: int, vector: Floats
) -> Floats:
    """Return L^-1 (step, seen, seen) of the covariance of each step's motion, shifts of the whole left free."""
    free = np.zeros(len(seen))
    free[:sections] = FREE_VOXEL
    own = covariance[np.ix_(np.arange(len(force_N)), seen, seen)]
    by_force = model.linear(vector, force_N).by_force[:, seen] * model.force_noise_N
    total = own + np.outer(free, free) + by_force[:, :, None] * by_force[:, None]
    total = total + RIDGE * np.einsum("tnn->tn", own).mean() * np.eye(len(seen))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(total)))


def _nearest(
    model: Model,
    data: Floats,
    seen: NDArray[np.intp],
    force_N: Floats,
    white: Floats,
    start: Floats | None = None,
) -> LawEstimate:
    """Return the law nearest to data (step, seen) once they are white, under the prior of the unknowns."""
    unknowns = model.unknowns

    def left(x: Floats) -> Floats:
        vector = unknowns.mean + x * unknowns.deviation
        away = np.einsum("tnm,tm->tn", white, data - model.amplitude(vector, force_N)[:, seen])
        return np.concatenate([away.ravel(), x])

    def slope(x: Floats) -> Floats:
        vector = unknowns.mean + x * unknowns.deviation
        own = white @ model.linear(vector, force_N).slopes[:, seen] * unknowns.deviation
        return np.concatenate([-own.reshape(-1, len(x)), np.eye(len(x))])

    first = np.zeros(len(unknowns.mean)) if start is None else (start - unknowns.mean) / unknowns.deviation
    found = least_squares(left, first, jac=slope, x_scale="jac", max_nfev=MOST_EVALUATIONS)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * np.outer(unknowns.deviation, unknowns.deviation)
    away = found.fun[: data.size]
    freedom = max(data.size - len(force_N) - len(first), 1)
    return LawEstimate(
        vector=unknowns.mean + found.x * unknowns.deviation,
        covariance=covariance,
        misfit=float(np.sqrt((away**2).sum() / freedom)),
    )
