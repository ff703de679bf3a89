"""What a solver returns, and the careful step that solvers share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.equations import Equations, Linearise
from pdvc.prior import Prior
from pdvc.verdict import Stop

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Hold what a solver found: the motion, how it got there, and why it stopped."""

    coefficients: Floats
    """u_ij: amplitudes (function, section, motion), voxels, the start included."""
    equations: Equations
    """The equations at the solution."""
    temporal: Floats
    """alpha (mode, step) of each mode; (0, step) for a solver without modes."""
    spatial: Floats
    """b (mode, section, motion), voxels."""
    rms: Floats
    """Rms residual (pass,), grey levels: before the first mode and after each."""
    stop: Stop
    stop_reason: str
    last_change_voxel: float = float("nan")
    """Rms displacement of the last change, in the part that it moved most; NaN for a solver by modes."""


def evaluated(linearise: Linearise, time_functions: Floats, shape: tuple[int, ...]) -> Callable[[Floats], Equations]:
    """Return the equations as a function of coefficients (function, section * motion).

    `shape` is (function, section, motion).
    """

    def at(coefficients: Floats) -> Equations:
        return linearise(np.einsum("ft,fn->tn", time_functions, coefficients).reshape(-1, *shape[1:]))

    return at


SHORTER = (1.0, 0.5, 0.25)
"""Shares of a change that are tried in turn, until one lowers what is minimised."""


def lowers(now: Equations, coefficients: Floats, trial: Equations, moved: Floats, prior: Prior) -> bool:
    """Return whether chi2 + rms^2 sum (amplitude / deviation)^2 falls, with rms that of `now`.

    `coefficients` and `moved` (function, section * motion) belong to `now` and `trial`.
    """
    believed = now.rms**2 * float((prior.precision() * (moved**2 - coefficients**2)).sum())
    return bool(trial.chi2.sum() + believed < now.chi2.sum())
