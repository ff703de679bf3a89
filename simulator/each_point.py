"""What a motion does to each of many points, compiled: rotations, splines along a beam, products of matrices.

A scenario's counts rest on the last digit of where its nodules are. The sums below are therefore written in one order,
and products that are fused with a sum are so on every processor; another order is another noise.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from simulator.rounding import fused


@numba.njit(cache=True, nogil=True, error_model="numpy")
def products(first, second):  # type: ignore[no-untyped-def]
    """Return the product of each two matrices (point, 3, 3)."""
    result = np.empty(first.shape)
    for p in range(len(first)):
        for a in range(3):
            for b in range(3):
                start = first[p, a, 0] * second[p, 0, b]
                result[p, a, b] = fused(first[p, a, 2], second[p, 2, b], fused(first[p, a, 1], second[p, 1, b], start))
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turned(points, matrix, before, after):  # type: ignore[no-untyped-def]
    """Turn points (point, 3) by a matrix (3, 3) about the place `before` (3,), which comes to be at `after` (3,)."""
    result = np.empty(points.shape)
    for p in range(len(points)):
        x, y, z = points[p, 0] - before[0], points[p, 1] - before[1], points[p, 2] - before[2]
        for a in range(3):
            result[p, a] = matrix[a, 0] * x + matrix[a, 2] * z + matrix[a, 1] * y + after[a]
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def along_beam(points, centre, tangent, matrix, spin, stretch, growth):  # type: ignore[no-untyped-def]
    """Return x = c + R s [X, Y, 0] (point, 3) and dx/dX (point, 3, 3), from the section of each point."""
    moved, gradient = np.empty(points.shape), np.empty(matrix.shape)
    for p in range(len(points)):
        x, y = points[p, 0], points[p, 1]
        s, g, q = stretch[p], growth[p], spin[p]
        arm = (
            matrix[p, 0, 0] * (x * s) + matrix[p, 0, 1] * (y * s),
            matrix[p, 1, 0] * (x * s) + matrix[p, 1, 1] * (y * s),
            matrix[p, 2, 0] * (x * s) + matrix[p, 2, 1] * (y * s),
        )
        swing = q[1] * arm[2] - q[2] * arm[1], q[2] * arm[0] - q[0] * arm[2], q[0] * arm[1] - q[1] * arm[0]
        for a in range(3):
            moved[p, a] = centre[p, a] + arm[a]
            gradient[p, a, 0] = matrix[p, a, 0] * s
            gradient[p, a, 1] = matrix[p, a, 1] * s
            # along Z the section moves on and turns, and its points move out
            out = matrix[p, a, 0] * (g * x) + matrix[p, a, 1] * (g * y)
            gradient[p, a, 2] = tangent[p, a] + swing[a] + out
    return moved, gradient


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turns(vector, slope):  # type: ignore[no-untyped-def]
    """Return R = exp([r]x) (point, 3, 3), and q of dR/dZ = [q]x R for dr/dZ = slope (point, 3).

    With the angle a = |r|, C = [r]x and C^2 = r r^T - a^2: R = 1 + f C + g C^2 and q = (1 + g C + h C^2) dr/dZ, where
    f = sin a / a, g = (1 - cos a) / a^2 and h = (a - sin a) / a^3.
    """
    matrix, spin = np.empty((len(vector), 3, 3)), np.empty((len(vector), 3))
    for p in range(len(vector)):
        x, y, z = vector[p, 0], vector[p, 1], vector[p, 2]
        a = math.sqrt(x * x + y * y + z * z)
        # the closed forms lose digits at small angles, where three terms of the series are exact to 1e-15
        if a < 0.02:
            square = a * a
            f = 1 - square / 6 + square * square / 120 - square * square * square / 5040
            g, h = 0.5 - square / 24 + square * square / 720, 1 / 6 - square / 120 + square * square / 5040
        else:
            f, g, h = math.sin(a) / a, (1 - math.cos(a)) / (a * a), (a - math.sin(a)) / a**3.0
        # C^2
        xx, yy, zz = -fused(y, y, z * z), -fused(x, x, z * z), -fused(x, x, y * y)
        xy, xz, yz = x * y, x * z, y * z
        matrix[p, 0] = 1 + g * xx, g * xy - f * z, g * xz + f * y
        matrix[p, 1] = g * xy + f * z, 1 + g * yy, g * yz - f * x
        matrix[p, 2] = g * xz - f * y, g * yz + f * x, 1 + g * zz
        u, v, w = slope[p, 0], slope[p, 1], slope[p, 2]
        spin[p, 0] = (1 + h * xx) * u + (h * xz + g * y) * w + (h * xy - g * z) * v
        spin[p, 1] = (h * xy + g * z) * u + (h * yz - g * x) * w + (1 + h * yy) * v
        spin[p, 2] = (h * xz - g * y) * u + (1 + h * zz) * w + (h * yz + g * x) * v
    return matrix, spin


@numba.njit(cache=True, nogil=True, error_model="numpy")
def on_spline(knots, coefficients, height):  # type: ignore[no-untyped-def]
    """Return values and slopes (point, profile) of cubic splines, which go on linearly beyond their knots.

    `coefficients` (4, piece, profile) of powers of the height above the knot below, that of the cube first.
    """
    value, slope = np.empty((len(height), coefficients.shape[2])), np.empty((len(height), coefficients.shape[2]))
    for p in range(len(height)):
        inside = min(max(height[p], knots[0]), knots[-1])
        below = min(np.searchsorted(knots, inside, side="right"), len(knots) - 1) - 1
        s, beyond = inside - knots[below], height[p] - inside
        for n in range(value.shape[1]):
            c3, c2 = coefficients[0, below, n], coefficients[1, below, n]
            c1, c0 = coefficients[2, below, n], coefficients[3, below, n]
            slope[p, n] = c1 + c2 * s * 2 + c3 * (s * s) * 3
            value[p, n] = c0 + c1 * s + c2 * (s * s) + c3 * (s * s * s) + slope[p, n] * beyond
    return value, slope
