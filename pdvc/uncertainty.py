"""Covariance of the amplitudes, and what the data determine.

At the solution, with H the Hessian of all unknowns (equations.joined), V the covariance of its right-hand side
(`pdvc.noise`), gamma the rms residual and P the prior's precision, an error of the amplitudes is
(H + gamma^2 P)^-1 times what noise does to the right-hand side, and what the prior pulls there. Their covariance is

    C = A^-1 (V + gamma^4 P) A^-1,        A = H + gamma^2 P

which is gamma^2 A^-1 if the residuals are white, V = gamma^2 H. It holds noise and prior; not what the model cannot
follow. The share 1 - C_ii P_ii of an unknown's prior variance that the data removed is near 1 where they determine
it, near 0 where the value rests on the prior. A section that no used pixel sees is unobserved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import step_covariance
from pdvc.equations import Equations, joined
from pdvc.noise import separate
from pdvc.prior import LEAST_RMS, Prior, solved
from pdvc.solution import Known

Floats = NDArray[np.float64]

UNSEEN = 1e-6
"""A section with less than this share of the median section's information is unobserved."""


@dataclass(frozen=True, kw_only=True)
class Posterior(Known):
    """How well each step's amplitudes are known, and what is said of each."""

    deviation: Floats
    """Standard deviations (step, section, motion), voxels."""
    data_share: Floats
    """1 - posterior / prior variance (step, section, motion)."""
    observed: NDArray[np.bool_]
    """(section,)"""


def posterior(
    equations: Equations, time_functions: Floats, prior: Prior, noise: Mapping[str, Floats] | None = None
) -> Posterior:
    """Return what noise and prior leave uncertain.

    `noise` are the parts of V (noise.Propagated.parts); without it residuals are taken as white, of the observed size.
    """
    precision = prior.precision()
    by_source: dict[str, Floats] = {}
    if separate(time_functions):
        parts = None if noise is None else np.sum(list(noise.values()), axis=0)
        covariance = np.stack(
            [
                _of_one_step(equations, f, precision, None if parts is None else parts[k])
                for k, f in enumerate(time_functions)
            ]
        )
    else:
        matrix, gamma2 = joined(equations.matrix, time_functions), max(equations.rms, LEAST_RMS) ** 2
        ridge = np.tile(prior.ridge(equations.rms), len(time_functions))
        inverse = solved(matrix + np.diag(ridge), np.eye(len(matrix)))
        for name, part in ({"residual": gamma2 * matrix} if noise is None else noise).items():
            whole = inverse @ part @ inverse
            by_source[name] = (whole + whole.T) / 2
        by_source["prior"] = (inverse * (gamma2 * ridge)) @ inverse
        covariance = np.sum(list(by_source.values()), axis=0)
    return stated(Known(covariance=covariance, by_source=by_source), equations, time_functions, prior)


def stated(known: Known, equations: Equations, time_functions: Floats, prior: Prior) -> Posterior:
    """Return what is said of each amplitude, from the covariance of all."""
    shape = prior.deviation_voxel.shape
    steps = time_functions.shape[1]
    variance = np.stack([np.diag(step_covariance(known.covariance, time_functions, t)) for t in range(steps)])
    before = (time_functions**2).sum(axis=0)[:, None] / prior.precision()
    information = np.einsum("tnn->n", equations.matrix).reshape(shape).sum(axis=1)
    return Posterior(
        covariance=known.covariance,
        by_source=known.by_source,
        deviation=np.sqrt(np.maximum(variance, 0)).reshape(steps, *shape),
        data_share=np.clip(1 - variance / before, 0, 1).reshape(steps, *shape),
        observed=information > UNSEEN * np.median(information),
    )


def _of_one_step(equations: Equations, function: Floats, precision: Floats, noise: Floats | None) -> Floats:
    """Return C of the coefficients of a function (step,) that is alone at its step: the residual is that step's."""
    step = int(np.argmax(function != 0))
    pixels = equations.pixels / len(equations.chi2)
    gamma2 = max(float(equations.chi2[step]) / pixels, LEAST_RMS**2)
    matrix = function[step] ** 2 * equations.matrix[step]
    return sandwich(matrix, gamma2 * matrix if noise is None else noise, gamma2 * precision, gamma2)


def sandwich(matrix: Floats, noise: Floats, ridge: Floats, gamma2: float) -> Floats:
    """Return C from H, V, the flat diagonal of gamma^2 P, and gamma^2."""
    total, middle = matrix + np.diag(ridge), noise + np.diag(gamma2 * ridge)
    half = solved(total, middle)
    whole = solved(total, half.T)
    return np.asarray((whole + whole.T) / 2)
