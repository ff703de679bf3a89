"""A Gaussian prior on amplitudes: what is believed before the data, stated in voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Floats = NDArray[np.float64]

LEAST_RMS = 1e-7
"""Grey levels: data without noise still leave what single precision rounds away."""


@dataclass(frozen=True, kw_only=True)
class Prior:
    """The standard deviation of every amplitude, all independent and of mean zero.

    An amplitude multiplies an orthonormal time function and a section motion, so that it is the rms displacement,
    over the steps, that the motion makes. The solvers minimise chi2 + rms^2 sum (amplitude / deviation)^2,
    with rms the current residual: where the fit is still bad the prior holds steps back.
    """

    deviation_voxel: Floats
    """(section, motion), voxels."""

    def precision(self) -> Floats:
        """Return 1 / deviation^2, flat (section * motion,)."""
        return np.asarray(1 / self.deviation_voxel.reshape(-1) ** 2)

    def ridge(self, rms: float) -> Floats:
        """Return what the prior adds to the diagonal of the equations, flat, at a residual of `rms` grey levels."""
        return np.asarray(max(rms, LEAST_RMS) ** 2 * self.precision())


def solved(matrix: Floats, right: Floats) -> Floats:
    """Solve a symmetric system, made positive definite by a prior, for a vector or for columns.

    It is scaled to a unit diagonal first, as sections that hardly show have tiny entries. Raises ValueError where it
    is not positive definite, or not finite: then radiographs and volume have nothing to do with each other.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    sides = scale if right.ndim == 1 else scale[:, None]
    try:
        factor = linalg.cho_factor(matrix * scale[:, None] * scale, lower=True, overwrite_a=True, check_finite=False)
    except linalg.LinAlgError:
        raise _unsolvable(len(matrix), "they are not positive definite") from None
    solution = np.asarray(linalg.cho_solve(factor, right * sides, check_finite=False) * sides)
    if not np.isfinite(solution).all():
        raise _unsolvable(len(matrix), "their solution is not finite")
    return solution


def _unsolvable(unknowns: int, why: str) -> ValueError:
    return ValueError(
        f"equations of {unknowns} unknowns: cannot be solved for a motion, {why}: expected radiographs and a "
        "reference scan of the same sample"
    )
