"""A Gaussian prior on amplitudes: what is believed before the data, stated in voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Prior:
    """Hold the standard deviation of every amplitude, all independent and of mean zero.

    An amplitude multiplies an orthonormal time function and a section motion, so that it is the rms displacement,
    over the steps, that the motion makes. The solvers minimise chi2 + rms^2 sum (amplitude / deviation)^2,
    with rms the current residual: where the fit is still bad the prior holds steps back.
    """

    deviation_voxel: Floats
    """(section, motion), voxels."""

    def precision(self) -> Floats:
        """Return 1 / deviation^2, flat (section * motion,)."""
        return np.asarray(1 / self.deviation_voxel.reshape(-1) ** 2)
