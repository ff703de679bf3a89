"""Linear problems with full B(t), from random sensitivities and no image behind them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pdvc.equations import Equations, Linearise

Floats = NDArray[np.float64]


def random_equations(seed: int, *, steps: int = 9, shape: tuple[int, int] = (2, 3), pixels: int = 50) -> Equations:
    """Return equations from random sensitivities and residuals, both of size one."""
    rng = np.random.default_rng(seed)
    size = shape[0] * shape[1]
    s, rho = rng.normal(size=(steps, pixels, size)), rng.normal(size=(steps, pixels))
    return Equations(
        matrix=np.einsum("tri,trj->tij", s, s),
        vector=np.einsum("tri,tr->ti", s, rho),
        chi2=(rho**2).sum(axis=1),
        residual=rho[:, :, None].astype(np.float32),
        pixels=steps * pixels,
    )


def random_functions(seed: int, *, functions: int = 3, steps: int = 9) -> Floats:
    """Return orthonormal time functions (function, step), of mean square one."""
    q = np.linalg.qr(np.random.default_rng(seed + 1000).normal(size=(steps, functions)))[0]
    return q.T * np.sqrt(steps)


def linear_model(start: Equations) -> Linearise:
    """Return a linear problem's equations at any amplitudes, from those at zero: S does not change."""

    def at(amplitude: Floats) -> Equations:
        a = amplitude.reshape(len(amplitude), -1)
        bent = np.einsum("tij,tj->ti", start.matrix, a)
        chi2 = start.chi2 - 2 * (a * start.vector).sum(axis=1) + (a * bent).sum(axis=1)
        return replace(start, vector=start.vector - bent, chi2=chi2)

    return at


def chi2_of(equations: Equations, functions: Floats, coefficients: Floats) -> float:
    """Return chi2 of the linear model at coefficients (function, unknown), straight from its definition."""
    a = coefficients.T @ functions
    return sum(
        equations.chi2[t] - 2 * a[:, t] @ equations.vector[t] + a[:, t] @ equations.matrix[t] @ a[:, t]
        for t in range(functions.shape[1])
    )
