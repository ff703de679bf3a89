"""What the volume's re-projection leaves of the reference views: registered to a step, then subtracted.

Reconstructing from few, noisy, cone-beam views and projecting again misses part of each radiograph,

    e(r, theta) = P_theta[F](r) - f(r, theta)        with f the reference view,

the same part for a test radiograph g at the same angle, where the sample has moved little. So it is moved with
the sample and subtracted from the residual (section 4.1): a pixel's e is taken where the point of its ray that is
nearest to the axis was before it moved, projected at the same angle. Between reference angles e is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from pdvc.sections import SectionBasis

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """The two reference views next to each step's angle, and the share of the second."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    share: Floats


def neighbouring_views(reference_rad: Floats, test_rad: Floats) -> Neighbours:
    """Find the reference views on both sides of each test angle, over the turn's end too."""
    turned = np.mod(reference_rad, 2 * np.pi)
    order = np.argsort(turned, kind="stable")
    ring = turned[order]
    at = np.mod(test_rad, 2 * np.pi)
    after = np.searchsorted(ring, at - 1e-9)
    first = order[(after - 1) % len(ring)]
    second = order[after % len(ring)]
    gap = np.mod(turned[second] - turned[first], 2 * np.pi)
    way = np.mod(at - turned[first], 2 * np.pi)
    share = np.where(gap > 0, np.minimum(way / np.where(gap > 0, gap, 1), 1), 0)
    # a step at a reference angle takes that view alone
    share = np.where(share > 1 - 1e-6, 1.0, np.where(share < 1e-6, 0.0, share))
    first, second = np.where(share == 1, second, first), np.where(share == 0, first, second)
    return Neighbours(first=first, second=second, share=np.where(first == second, 0.0, share))


@dataclass(frozen=True, kw_only=True)
class Systematic:
    """e at the reference views that the steps need."""

    fields: Image
    """e (field, row, column), grey levels, over the whole detector; zero where the volume does not reach."""
    first: NDArray[np.int64]
    """Index into `fields` of the view before each step's angle (step,)."""
    second: NDArray[np.int64]
    """Index into `fields` of the view after it (step,)."""
    share: Floats
    """Share of the second (step,)."""
    corner: tuple[int, int]
    """First row and column of the used window on the whole detector."""
    shape: tuple[int, int]
    """Rows and columns of the used window."""

    def registered(self, steps: slice, rays: Floats, basis: SectionBasis, amplitude: Floats, voxel_mm: float) -> Image:
        """Return e (step, row, column) over the window, for a range of steps, moved with the sample.

        `rays` (step, 4, 3) of the window, mm; `amplitude` (step, section, motion) in voxels of `voxel_mm`, both
        for the steps of the range.
        """
        result = np.empty((len(rays), *self.shape), dtype=np.float32)
        maps = basis.affine(amplitude) * voxel_mm
        corner = np.array(self.corner, dtype=np.int64)
        chosen = self.first[steps], self.second[steps], self.share[steps]
        _register(self.fields, *chosen, rays, basis.height_mm, maps, corner, result)
        return result

    def places(self, rays: Floats, basis: SectionBasis, amplitude: Floats, voxel_mm: float) -> Floats:
        """Return where e is taken for each pixel of one step: (row, column, 2), row and column on the detector.

        `rays` (4, 3) of the window, mm; `amplitude` (section, motion) in voxels of `voxel_mm`.
        """
        result = np.empty((*self.shape, 2))
        _find_places(
            rays,
            basis.height_mm,
            basis.affine(amplitude) * voxel_mm,
            np.array(self.corner, dtype=np.int64),
            result,
        )
        return result


@njit(nogil=True, cache=True, error_model="numpy")
def _bilinear(field, r, c):  # type: ignore[no-untyped-def]
    """Interpolate between pixels; zero outside the detector."""
    if r < -0.01 or r > field.shape[0] - 0.99 or c < -0.01 or c > field.shape[1] - 0.99:
        return 0.0
    i, j = min(max(int(r), 0), field.shape[0] - 2), min(max(int(c), 0), field.shape[1] - 2)
    fr, fc = r - i, c - j
    upper = (1 - fc) * field[i, j] + fc * field[i, j + 1]
    lower = (1 - fc) * field[i + 1, j] + fc * field[i + 1, j + 1]
    return (1 - fr) * upper + fr * lower


@njit(nogil=True, cache=True, error_model="numpy")
def _moved(m, i, x, y, z):  # type: ignore[no-untyped-def]
    """Return coordinate i of an affine map."""
    return m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]


@njit(nogil=True, cache=True, error_model="numpy")
def _place(rays, normal, depth, pitch2, heights, maps, corner, row, column):  # type: ignore[no-untyped-def]
    """Return the row and the column, on the whole detector, where a pixel's material was seen before it moved."""
    n = len(heights)
    sx, sy, sz = rays[0]
    ox, oy, oz = rays[1]
    dx, dy, dz = rays[2]
    rx, ry, rz = rays[3]
    x, y, z = ox + row * dx + column * rx, oy + row * dy + column * ry, oz + row * dz + column * rz
    x, y, z = x - sx, y - sy, z - sz
    # the point of the ray that is nearest to the axis
    at = -(sx * x + sy * y) / (x * x + y * y)
    x, y, z = sx + at * x, sy + at * y, sz + at * z
    k = 0
    while k + 2 < n and heights[k + 1] < z:
        k += 1
    ux, uy, uz = _moved(maps[k], 0, x, y, z), _moved(maps[k], 1, x, y, z), _moved(maps[k], 2, x, y, z)
    if n > 1:
        s = min(max((z - heights[k]) / (heights[k + 1] - heights[k]), 0.0), 1.0)
        m = maps[k + 1]
        ux += s * (_moved(m, 0, x, y, z) - ux)
        uy += s * (_moved(m, 1, x, y, z) - uy)
        uz += s * (_moved(m, 2, x, y, z) - uz)
    x, y, z = x - ux - sx, y - uy - sy, z - uz - sz
    scale = depth / (x * normal[0] + y * normal[1] + z * normal[2])
    x, y, z = sx + scale * x - ox, sy + scale * y - oy, sz + scale * z - oz
    return (x * dx + y * dy + z * dz) / pitch2 + corner[0], (x * rx + y * ry + z * rz) / pitch2 + corner[1]


@njit(nogil=True, cache=True, error_model="numpy")
def _panel(rays):  # type: ignore[no-untyped-def]
    """Return the detector's normal, its distance from the source along it, and the square of the pitch."""
    dx, dy, dz = rays[2]
    rx, ry, rz = rays[3]
    nx, ny, nz = dy * rz - dz * ry, dz * rx - dx * rz, dx * ry - dy * rx
    depth = (rays[1, 0] - rays[0, 0]) * nx + (rays[1, 1] - rays[0, 1]) * ny + (rays[1, 2] - rays[0, 2]) * nz
    return (nx, ny, nz), depth, dx * dx + dy * dy + dz * dz


@njit(nogil=True, cache=True, parallel=True, error_model="numpy")
def _register(fields, first, second, share, rays, heights, maps, corner, out):  # type: ignore[no-untyped-def]
    """Sample the fields where each pixel's material was before it moved."""
    rows = out.shape[1]
    for task in prange(len(out) * rows):
        t, row = task // rows, task % rows
        normal, depth, pitch2 = _panel(rays[t])
        for column in range(out.shape[2]):
            r, c = _place(rays[t], normal, depth, pitch2, heights, maps[t], corner, row, column)
            value = _bilinear(fields[first[t]], r, c)
            if share[t] > 0:
                value += share[t] * (_bilinear(fields[second[t]], r, c) - value)
            out[t, row, column] = value


@njit(nogil=True, cache=True, error_model="numpy")
def _find_places(rays, heights, maps, corner, out):  # type: ignore[no-untyped-def]
    """Write the places of all pixels of one step."""
    normal, depth, pitch2 = _panel(rays)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            out[row, column] = _place(rays, normal, depth, pitch2, heights, maps, corner, row, column)
