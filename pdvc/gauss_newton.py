"""Direct Gauss-Newton solve of all unknowns over the same equations that PGD uses.

With u_ij the amplitudes, sigma the time functions, and B(t), c(t) of one pass,

    H = sum_t sigma(t) sigma(t)^T (x) B(t),       h = sum_t sigma(t) (x) c(t),       H du = h

(x) being Kronecker's product: 7 x 90 = 630 unknowns at the paper's size. A prior adds to H and h.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdvc.equations import Equations, Linearise
from pdvc.prior import Prior, solved
from pdvc.solution import SHORTER, Solution, evaluated, lowers

Floats = NDArray[np.float64]


def hessian(equations: Equations, time_functions: Floats) -> Floats:
    """Return H (function * unknown, function * unknown), with unknown = section * motion."""
    functions, steps = time_functions.shape
    size = equations.vector.shape[1]
    pairs = np.einsum("ft,gt->fgt", time_functions, time_functions).reshape(-1, steps)
    blocks = (pairs @ equations.matrix.reshape(steps, -1)).reshape(functions, functions, size, size)
    return np.ascontiguousarray(blocks.transpose(0, 2, 1, 3)).reshape(functions * size, functions * size)


def solve(
    linearise: Linearise,
    time_functions: Floats,
    start: Floats,
    prior: Prior,
    *,
    most_passes: int,
    least_change_voxel: float,
) -> Solution:
    """Repeat the direct solve until the rms change of displacement falls under `least_change_voxel`.

    Shapes and units as in pgd.solve.
    """
    shape = start.shape
    functions = len(start)
    coefficients = start.reshape(functions, -1).copy()
    at = evaluated(linearise, time_functions, shape)

    equations = at(coefficients)
    rms = [equations.rms]
    reason = f"{most_passes} passes done, the most allowed: allow more, the solution still moves"
    for _ in range(most_passes):
        change = _change(equations, time_functions, coefficients, prior)
        for step in SHORTER:
            moved = coefficients + step * change
            trial = at(moved)
            if lowers(equations, coefficients, trial, moved, prior):
                break
        else:
            reason = "no step lowers the residual further: converged, within the precision of the sums"
            break
        coefficients, equations = moved, trial
        rms.append(equations.rms)
        size = step * float(np.sqrt((change**2).sum() / np.prod(shape[1:])))
        if size < least_change_voxel:
            reason = f"converged: the last change was {size:.2g} voxel rms, under {least_change_voxel:.2g}"
            break
    return Solution(
        coefficients=coefficients.reshape(shape),
        equations=equations,
        temporal=np.empty((0, time_functions.shape[1])),
        spatial=np.empty((0, *shape[1:])),
        rms=np.array(rms),
        stop_reason=reason,
    )


def _change(equations: Equations, time_functions: Floats, coefficients: Floats, prior: Prior) -> Floats:
    ridge = np.tile(prior.ridge(equations.rms), len(coefficients))
    matrix = hessian(equations, time_functions)
    matrix[np.diag_indices_from(matrix)] += ridge
    vector = (time_functions @ equations.vector).ravel() - ridge * coefficients.ravel()
    return solved(matrix, vector).reshape(coefficients.shape)
