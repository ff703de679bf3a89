"""Proper generalised decomposition: greedy space-time modes, one at a time (section 2.3, Algorithm 1).

A mode is alpha(t) b with alpha(t) = sum_i a_i sigma_i(t). At the current motion, with B(t) and c(t),

    N_ij = sum_t alpha(t)^2 B_ij(t),             n_j = sum_t alpha(t) c_j(t),        b = N^-1 n      Eqs. 12 to 14
    M_ij = sum_t sigma_i sigma_j b^T B(t) b,     m_j = sum_t sigma_j(t) b^T c(t),    a = M^-1 m      Eqs. 15 to 17

are repeated until neither changes; then the mode is added, and B and c are computed anew. A prior adds its terms to
N, n, M, m. Two slips of the paper are settled: the inner loop goes on *while* the changes exceed their tolerance, and
the noise criterion compares chi^2 with 2 gamma^2 N_pix (both squared; 2 for noise in both f and g).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pdvc.equations import Equations, Linearise
from pdvc.prior import Prior, solved
from pdvc.solution import SHORTER, Problem, Solution, Solver, evaluated, lowers
from pdvc.verdict import Stop

Floats = NDArray[np.float64]

FIXED_POINT_TOLERANCE = 1e-6
FIXED_POINT_MOST = 500
WORTH_A_PASS = 0.005
"""A mode is found again about itself as long as that lowers the residual by more than this share."""


class Pgd(Solver):
    """Greedy space-time modes, one at a time, as in the paper."""

    kind: Literal["pgd"] = "pgd"
    """greedy space-time modes, one at a time, as in the paper"""
    most_modes: Annotated[int, Field(ge=1)] = 4
    """largest number of modes"""
    passes_per_mode: Annotated[int, Field(ge=1)] = 1
    """linearisations about each mode, while they help; one in the paper"""
    least_gain: Annotated[float, Field(ge=0, lt=1)] = 1e-3
    """a mode that lowers the rms residual by less than this share is the last"""

    def solve(self, problem: Problem) -> Solution:
        """Add modes until the residual is noise, stops falling, or there are as many as allowed."""
        return solve(
            problem.linearise,
            problem.time_functions,
            problem.start,
            problem.prior,
            most_modes=self.most_modes,
            passes_per_mode=self.passes_per_mode,
            least_gain=self.least_gain,
            noise_rms=problem.noise_rms,
        )

    @property
    def passes(self) -> float:
        """Return about how many passes over all radiographs it may take: few modes need all that are allowed."""
        return self.most_modes * self.passes_per_mode * 0.6 + 1


def solve(
    linearise: Linearise,
    time_functions: Floats,
    start: Floats,
    prior: Prior,
    *,
    most_modes: int,
    passes_per_mode: int,
    least_gain: float,
    noise_rms: float | None,
) -> Solution:
    """Add modes until the residual is noise, stops falling, or `most_modes` are found.

    `time_functions` (function, step) orthonormal; `start` (function, section, motion) in voxels. The paper computes
    each mode from one linearisation; with `passes_per_mode` above one a mode is found again, about itself, while
    that helps. A mode that lowers the rms residual by less than the share `least_gain` is the last, and one
    that does not lower it, even shortened, is left out. `noise_rms` is gamma_f in grey levels, None where unknown.
    """
    shape = start.shape
    coefficients = start.reshape(len(start), -1).copy()
    at = evaluated(linearise, time_functions, shape)
    equations = at(coefficients)
    rms, temporal, spatial = [equations.rms], [], []
    stop, reason = Stop.MOST, f"{most_modes} modes found, as many as were asked for"
    for _ in range(most_modes):
        if noise_rms is not None and equations.rms**2 <= 2 * noise_rms**2:
            stop = Stop.NOISE_LEVEL
            reason = (
                f"residual at noise level: rms {equations.rms:.3g} within sqrt(2) times {noise_rms:.3g} grey levels"
            )
            break
        before = equations.rms
        a, b = np.zeros(len(start)), np.zeros(coefficients.shape[1])
        for _ in range(passes_per_mode):
            found = find_mode(equations, time_functions, coefficients, prior, now=(a, b))
            trial = _improved(at, coefficients, (a, b), found, equations, prior)
            if trial is None:
                break
            gain = 1 - trial[2].rms / equations.rms
            a, b, equations = trial
            rms.append(equations.rms)
            if gain < WORTH_A_PASS:
                break
        if not b.any():
            stop = Stop.NO_GAIN
            reason = "no further mode lowers the residual: what is left lies outside the bases, or is noise"
            break
        coefficients = coefficients + np.outer(a, b)
        temporal.append(a @ time_functions)
        spatial.append(b.reshape(shape[1:]))
        gain = 1 - equations.rms / before
        if gain < least_gain:
            stop = Stop.SMALL_GAIN
            reason = f"the last mode lowered the rms residual by {gain:.2%}, less than {least_gain:.2%}"
            break
    return Solution(
        coefficients=coefficients.reshape(shape),
        equations=equations,
        temporal=np.array(temporal).reshape(-1, time_functions.shape[1]),
        spatial=np.array(spatial).reshape(-1, *shape[1:]),
        rms=np.array(rms),
        stop=stop,
        stop_reason=reason,
    )


Mode = tuple[Floats, Floats]
"""a (function,) of norm one, and b (section * motion,) in voxels."""


def find_mode(
    equations: Equations, time_functions: Floats, coefficients: Floats, prior: Prior, now: Mode | None = None
) -> Mode:
    """Return the mode that lowers chi2 most, by the fixed point of Eqs. 12 and 15.

    `coefficients` (function, section * motion) are what the mode is added to; where the equations were made with a
    mode `now` already added, the mode that replaces it is returned. Without one, every time function alone is
    tried as a start, and the best is followed.
    """
    ridge = prior.ridge(equations.rms)
    vectors = equations.vector
    if now is not None and now[1].any():
        # linear about the present mode: chi2(m) = m B m - 2 m (c + B m_now), with m = alpha b
        alpha = now[0] @ time_functions
        vectors = vectors + alpha[:, None] * (equations.matrix @ now[1])
        a, b = now
    else:
        gains = []
        for start in np.eye(len(time_functions)):
            matrix, vector = _spatial(equations.matrix, vectors, time_functions, coefficients, ridge, start)
            gains.append(vector @ solved(matrix, vector))
        a, b = np.eye(len(time_functions))[int(np.argmax(gains))], np.zeros(coefficients.shape[1])
    for _ in range(FIXED_POINT_MOST):
        before = np.outer(a, b)
        b = solved(*_spatial(equations.matrix, vectors, time_functions, coefficients, ridge, a))
        if not b.any():
            break
        a = solved(*_temporal(equations.matrix, vectors, time_functions, coefficients, ridge, b))
        size = np.linalg.norm(a)
        if size == 0:
            return a, np.zeros_like(b)
        a, b = a / size, b * size
        if np.linalg.norm(np.outer(a, b) - before) <= FIXED_POINT_TOLERANCE * np.linalg.norm(b):
            break
    return a, b


def _spatial(
    matrices: Floats, vectors: Floats, time_functions: Floats, coefficients: Floats, ridge: Floats, a: Floats
) -> tuple[Floats, Floats]:
    """Return N and n of Eqs. 13 and 14, with the prior's terms."""
    alpha = a @ time_functions
    matrix = np.tensordot(alpha**2, matrices, axes=1) + np.diag(ridge * (a @ a))
    return matrix, alpha @ vectors - ridge * (a @ coefficients)


def _temporal(
    matrices: Floats, vectors: Floats, time_functions: Floats, coefficients: Floats, ridge: Floats, b: Floats
) -> tuple[Floats, Floats]:
    """Return M and m of Eqs. 16 and 17, with the prior's terms."""
    curvature = (matrices @ b) @ b
    matrix = (time_functions * curvature) @ time_functions.T + np.eye(len(time_functions)) * (b @ (ridge * b))
    return matrix, time_functions @ (vectors @ b) - coefficients @ (ridge * b)


def _improved(
    at: Callable[[Floats], Equations],
    coefficients: Floats,
    now: Mode,
    found: Mode,
    equations: Equations,
    prior: Prior,
) -> tuple[Floats, Floats, Equations] | None:
    """Try the mode found, then ways half and a quarter towards it; None where none lowers the residual."""
    standing = coefficients + np.outer(*now)
    for share in SHORTER:
        # a mixture of two modes is none, so that the way from one to the other keeps the new history
        a, b = found[0], share * found[1] + (1 - share) * (now[0] @ found[0]) * now[1]
        moved = coefficients + np.outer(a, b)
        trial = at(moved)
        if lowers(equations, standing, trial, moved, prior):
            return a, b, trial
    return None
