"""Proper generalised decomposition: greedy space-time modes, one at a time (section 2.3, Algorithm 1).

A mode is alpha(t) b with alpha(t) = sum_i a_i sigma_i(t). At the current motion, with B(t) and c(t),

    N_ij = sum_t alpha(t)^2 B_ij(t),             n_j = sum_t alpha(t) c_j(t),        b = N^-1 n      Eqs. 12 to 14
    M_ij = sum_t sigma_i sigma_j b^T B(t) b,     m_j = sum_t sigma_j(t) b^T c(t),    a = M^-1 m      Eqs. 15 to 17

are repeated until neither changes; then the mode is added, and B and c are computed anew. A prior adds its terms to
N, n, M, m. Two slips of the paper are settled: the inner loop goes on *while* the changes exceed their tolerance, and
the noise criterion compares chi^2 with 2 gamma^2 N_pix (both squared; 2 for noise in both f and g).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdvc.equations import Equations, Linearise
from pdvc.prior import Prior
from pdvc.solution import Solution, evaluated, shortened

Floats = NDArray[np.float64]

FIXED_POINT_TOLERANCE = 1e-6
FIXED_POINT_MOST = 60


def solve(
    linearise: Linearise,
    time_functions: Floats,
    start: Floats,
    prior: Prior,
    *,
    most_modes: int,
    least_gain: float,
    noise_rms: float | None,
) -> Solution:
    """Add modes until the residual is noise, stops falling, or `most_modes` are found.

    `time_functions` (function, step) orthonormal; `start` (function, section, motion) in voxels; a mode that lowers
    the rms residual by less than the share `least_gain` is the last, and one that does not lower it, even halved
    twice, is left out. `noise_rms` is gamma_f in grey levels, None where unknown.
    """
    shape = start.shape
    coefficients = start.reshape(len(start), -1).copy()
    at = evaluated(linearise, time_functions, shape)

    equations = at(coefficients)
    rms, temporal, spatial = [equations.rms], [], []
    reason = f"{most_modes} modes found, the most allowed: allow more if the residual still shows motion"
    for _ in range(most_modes):
        if noise_rms is not None and equations.rms**2 <= 2 * noise_rms**2:
            reason = (
                f"residual at noise level: rms {equations.rms:.3g} within sqrt(2) times {noise_rms:.3g} grey levels"
            )
            break
        a, b = find_mode(equations, time_functions, coefficients, prior)
        step, trial = shortened(at, coefficients, np.outer(a, b), equations)
        if trial is None:
            reason = "no further mode lowers the residual: what is left lies outside the bases, or is noise"
            break
        coefficients = coefficients + step * np.outer(a, b)
        temporal.append(a @ time_functions)
        spatial.append((step * b).reshape(shape[1:]))
        gain = 1 - trial.rms / equations.rms
        equations = trial
        rms.append(equations.rms)
        if gain < least_gain:
            reason = f"the last mode lowered the rms residual by {gain:.2%}, less than {least_gain:.2%}"
            break
    return Solution(
        coefficients=coefficients.reshape(shape),
        equations=equations,
        temporal=np.array(temporal).reshape(-1, time_functions.shape[1]),
        spatial=np.array(spatial).reshape(-1, *shape[1:]),
        rms=np.array(rms),
        stop_reason=reason,
    )


def find_mode(
    equations: Equations, time_functions: Floats, coefficients: Floats, prior: Prior
) -> tuple[Floats, Floats]:
    """Return a (function,), of norm 1, and b (section * motion,) that lower chi2 most, by the fixed point.

    Every time function alone is tried as a start, and the best one is followed.
    """
    ridge = equations.rms**2 * prior.precision()
    starts = np.eye(len(time_functions))
    gains = []
    for a in starts:
        matrix, vector = _spatial(equations, time_functions, coefficients, ridge, a)
        gains.append(vector @ _solved(matrix, vector))
    a = starts[int(np.argmax(gains))]
    b = np.zeros(coefficients.shape[1])
    for _ in range(FIXED_POINT_MOST):
        before = np.outer(a, b)
        b = _solved(*_spatial(equations, time_functions, coefficients, ridge, a))
        a = _solved(*_temporal(equations, time_functions, coefficients, ridge, b))
        size = np.linalg.norm(a)
        if size == 0:
            break
        a, b = a / size, b * size
        if np.linalg.norm(np.outer(a, b) - before) <= FIXED_POINT_TOLERANCE * np.linalg.norm(b):
            break
    return a, b


def _spatial(
    equations: Equations, time_functions: Floats, coefficients: Floats, ridge: Floats, a: Floats
) -> tuple[Floats, Floats]:
    alpha = a @ time_functions
    matrix = np.tensordot(alpha**2, equations.matrix, axes=1) + np.diag(ridge * (a @ a))
    return matrix, alpha @ equations.vector - ridge * (a @ coefficients)


def _temporal(
    equations: Equations, time_functions: Floats, coefficients: Floats, ridge: Floats, b: Floats
) -> tuple[Floats, Floats]:
    curvature = (equations.matrix @ b) @ b
    matrix = (time_functions * curvature) @ time_functions.T + np.eye(len(time_functions)) * (b @ (ridge * b))
    return matrix, time_functions @ (equations.vector @ b) - coefficients @ (ridge * b)


def _solved(matrix: Floats, vector: Floats) -> Floats:
    """Solve a small symmetric system; directions without information stay at zero."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = linalg.eigh(matrix / np.outer(scale, scale))
    keep = values > 1e-12 * values[-1]
    parts = (vectors[:, keep].T @ (vector / scale)) / values[keep]
    return np.asarray(vectors[:, keep] @ parts / scale)
