"""Symmetric positive definite matrices of blocks, two beside the diagonal: what second differences in time leave.

With blocks A(t, t), A(t+1, t), A(t+2, t) of M x M, Cholesky's factor has as many, and factor, solution and the blocks
of the inverse inside the band cost O(T M^3) for T steps:

    L(t, t) L(t, t)^T = A(t, t) - G(t-1) G(t-1)^T - H(t-2) H(t-2)^T
    G(t) = L(t+1, t) = [A(t+1, t) - H(t-1) G(t-1)^T] L(t, t)^-T,         H(t) = L(t+2, t) = A(t+2, t) L(t, t)^-T

The inverse inside the band follows from the last block to the first (Takahashi, Fagan and Chin, 1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """The blocks of a symmetric matrix, or of its inverse, on and below the diagonal."""

    own: Floats
    """A(t, t) (T, M, M)."""
    next: Floats
    """A(t+1, t) (T - 1, M, M)."""
    after: Floats
    """A(t+2, t) (T - 2, M, M)."""


@dataclass(frozen=True, kw_only=True)
class Factor:
    """Cholesky's factor of such a matrix."""

    inverse: Floats
    """L(t, t)^-1 (T, M, M)."""
    next: Floats
    """G (T - 1, M, M)."""
    after: Floats
    """H (T - 2, M, M)."""
    log_determinant: float
    """Of the matrix."""

    def solved(self, right: Floats) -> Floats:
        """Return the solution (T, M, n) for right-hand sides of the same shape."""
        steps, x = len(self.inverse), np.empty_like(right)
        for t in range(steps):
            rest = right[t]
            if t >= 1:
                rest = rest - self.next[t - 1] @ x[t - 1]
            if t >= 2:
                rest = rest - self.after[t - 2] @ x[t - 2]
            x[t] = self.inverse[t] @ rest
        for t in reversed(range(steps)):
            rest = x[t]
            if t + 1 < steps:
                rest = rest - self.next[t].T @ x[t + 1]
            if t + 2 < steps:
                rest = rest - self.after[t].T @ x[t + 2]
            x[t] = self.inverse[t].T @ rest
        return x

    def inverted(self) -> Blocks:
        """Return the blocks of the inverse inside the band."""
        own, near, far = np.empty_like(self.inverse), np.empty_like(self.next), np.empty_like(self.after)
        steps = len(own)
        for t in reversed(range(steps)):
            inverse = self.inverse[t]
            here = inverse.T @ inverse
            if t + 1 < steps:
                g = self.next[t] @ inverse
                near[t] = -own[t + 1] @ g
                if t + 2 < steps:
                    h = self.after[t] @ inverse
                    near[t] -= near[t + 1].T @ h
                    far[t] = -(near[t + 1] @ g + own[t + 2] @ h)
                    here -= far[t].T @ h
                here -= near[t].T @ g
            own[t] = (here + here.T) / 2
        return Blocks(own=own, next=near, after=far)


def factored(matrix: Blocks) -> Factor:
    """Return the factor of a matrix; raises numpy.linalg.LinAlgError where it is not positive definite."""
    inverse, near, far = np.empty_like(matrix.own), np.empty_like(matrix.next), np.empty_like(matrix.after)
    steps, log_determinant = len(inverse), 0.0
    for t in range(steps):
        here = matrix.own[t]
        if t >= 1:
            here = here - near[t - 1] @ near[t - 1].T
        if t >= 2:
            here = here - far[t - 2] @ far[t - 2].T
        lower = np.linalg.cholesky(here)
        log_determinant += 2 * float(np.log(np.diag(lower)).sum())
        inverse[t] = inverse_of_lower(lower)
        if t + 1 < steps:
            following = matrix.next[t]
            if t >= 1:
                following = following - far[t - 1] @ near[t - 1].T
            near[t] = following @ inverse[t].T
        if t + 2 < steps:
            far[t] = matrix.after[t] @ inverse[t].T
    return Factor(inverse=inverse, next=near, after=far, log_determinant=log_determinant)


def inverse_of_lower(lower: Floats) -> Floats:
    """Return the inverse of a lower triangle of no zero on its diagonal."""
    return np.asarray(lapack.dtrtri(lower.T, lower=0)[0].T)


def inverse_of(lower: Floats) -> Floats:
    """Return (L L^T)^-1 of a lower triangle L of no zero on its diagonal."""
    upper, _ = lapack.dpotri(lower.T, lower=0)
    return np.asarray(np.triu(upper) + np.triu(upper, 1).T)
