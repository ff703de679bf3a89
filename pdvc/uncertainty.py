"""Covariance of the amplitudes, and what the data determine.

At the solution, with H the Hessian of all unknowns (gauss_newton.hessian), gamma the rms residual and P the prior's
precision, the posterior covariance is

    C = gamma^2 (H + gamma^2 P)^-1

for white residuals of standard deviation gamma. The share 1 - C_ii P_ii of an unknown's prior variance that the data
removed is near 1 where they determine it, near 0 where the value rests on the prior. A section that no used
pixel sees is unobserved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.equations import Equations
from pdvc.gauss_newton import hessian
from pdvc.prior import LEAST_RMS, Prior, solved

Floats = NDArray[np.float64]

UNSEEN = 1e-6
"""A section with less than this share of the median section's information is unobserved."""


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """Hold how well each step's amplitudes are known."""

    deviation: Floats
    """Standard deviations (step, section, motion), voxels."""
    data_share: Floats
    """1 - posterior / prior variance (step, section, motion)."""
    observed: NDArray[np.bool_]
    """(section,)"""


def posterior(equations: Equations, time_functions: Floats, prior: Prior) -> Posterior:
    """Return the standard deviations that white residuals of the observed size leave."""
    shape = prior.deviation_voxel.shape
    functions, steps = time_functions.shape
    size = shape[0] * shape[1]
    gamma2 = max(equations.rms, LEAST_RMS) ** 2
    precision = prior.precision()
    matrix = hessian(equations, time_functions)
    matrix[np.diag_indices_from(matrix)] += np.tile(prior.ridge(equations.rms), functions)
    inverse = solved(matrix, np.eye(len(matrix))) * gamma2
    blocks = inverse.reshape(functions, size, functions, size)
    same = np.einsum("fngn->nfg", blocks)
    variance = np.einsum("ft,nfg,gt->tn", time_functions, same, time_functions, optimize=True)
    before = (time_functions**2).sum(axis=0)[:, None] / precision
    information = np.einsum("tnn->n", equations.matrix).reshape(shape).sum(axis=1)
    return Posterior(
        deviation=np.sqrt(np.maximum(variance, 0)).reshape(steps, *shape),
        data_share=np.clip(1 - variance / before, 0, 1).reshape(steps, *shape),
        observed=information > UNSEEN * np.median(information),
    )
