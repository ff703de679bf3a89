"""What a solver is asked and returns, and the careful step that solvers share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.equations import Equations, Linearise
from pdvc.experiment import Series
from pdvc.noise import Propagated
from pdvc.prior import Prior
from pdvc.sections import SectionBasis
from pdvc.settings import Choice
from pdvc.verdict import Stop

Floats = NDArray[np.float64]


NoiseAt = Callable[[Floats, Equations, Floats], Propagated]
"""From amplitudes (step, section, motion), the equations there, and time functions (function, step), to noise."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """A motion to be found in radiographs of one scale."""

    linearise: Linearise
    basis: SectionBasis
    series: Series
    """What was recorded with the radiographs."""
    time_functions: Floats
    """Orthonormal (function, step)."""
    start: Floats
    """Amplitudes (function, section, motion) to start from, voxels."""
    prior: Prior
    noise_rms: float | None
    """gamma_f, the rms noise of the radiographs, grey levels; None where it is unknown or says nothing yet."""
    noise_at: NoiseAt | None = None
    """What the noise of all images does to the equations; None at coarse scales."""


class Solver(Choice):
    """A way to solve a stage, with how far it goes; TOML finds a further kind as soon as it is defined."""

    def functions(self, time_functions: Floats) -> Floats:
        """Return the orthonormal functions (function, step) of its solution, by default those of the options."""
        return time_functions

    def solve(self, problem: Problem) -> Solution:
        """Return the motion that solves a problem, or comes as near as the solver goes."""
        raise NotImplementedError

    @property
    def passes(self) -> float:
        """Return about how many passes over all radiographs it may take."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Solution:
    """What a solver found: the motion, how it got there, and why it stopped."""

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
    known: Known | None = None
    """How well it is known, where the solver tells."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """How well each step's amplitudes are known."""

    covariance: Floats
    """C (function * unknown, function * unknown), voxel^2, with unknown = section * motion; or (function, unknown,
    unknown), where each step has a function of its own and nothing joins them."""
    by_source: dict[str, Floats]
    """What each part of the noise, and the prior, add to C; empty where nothing joins the functions."""


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
