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
    """Hold, for each step, the two reference views next to its angle and the share of the second."""

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
    """Hold e at the reference views that the steps need."""

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

    def registered(self, step: int, rays: Floats, basis: SectionBasis, amplitude: Floats, voxel_mm: float) -> Image:
        """Return e (row, column) over the window, moved with the sample.

        `rays` (4, 3) of the window, mm; `amplitude` (section, motion) in voxels of `voxel_mm`.
        """
        share = self.share[step]
        field = self.fields[self.first[step]]
        if share > 0:
            field = (1 - share) * field + share * self.fields[self.second[step]]
        result = np.empty(self.shape, dtype=np.float32)
        _register(
            np.ascontiguousarray(field, dtype=np.float32),
            rays,
            basis.height_mm,
            basis.affine(amplitude) * voxel_mm,
            np.array(self.corner, dtype=np.int64),
            result,
        )
        return result


@njit(nogil=True, cache=True, error_model="numpy", parallel=True)
def _register(field, rays, heights, maps, corner, out):  # type: ignore[no-untyped-def]
    """Sample `field` where each pixel's material was before it moved; zero outside."""
    n = len(heights)
    source, origin, down, right = rays[0], rays[1], rays[2], rays[3]
    pitch2 = down[0] ** 2 + down[1] ** 2 + down[2] ** 2
    normal = np.cross(down, right)
    depth = np.sum((origin - source) * normal)
    for row in prange(out.shape[0]):
        for column in range(out.shape[1]):
            ray = origin + row * down + column * right - source
            # the point of the ray that is nearest to the axis
            at = -(source[0] * ray[0] + source[1] * ray[1]) / (ray[0] ** 2 + ray[1] ** 2)
            x = source + at * ray
            k = 0
            while k + 2 < n and heights[k + 1] < x[2]:
                k += 1
            s = 0.0
            if n > 1:
                s = min(max((x[2] - heights[k]) / (heights[k + 1] - heights[k]), 0.0), 1.0)
            was = np.empty(3)
            for i in range(3):
                one = maps[k, i, 0] * x[0] + maps[k, i, 1] * x[1] + maps[k, i, 2] * x[2] + maps[k, i, 3]
                if n > 1:
                    m = maps[k + 1]
                    two = m[i, 0] * x[0] + m[i, 1] * x[1] + m[i, 2] * x[2] + m[i, 3]
                    one = (1 - s) * one + s * two
                was[i] = x[i] - one
            scale = depth / np.sum((was - source) * normal)
            hit = source + scale * (was - source) - origin
            r = np.sum(hit * down) / pitch2 + corner[0]
            c = np.sum(hit * right) / pitch2 + corner[1]
            out[row, column] = 0.0
            if -0.01 <= r <= field.shape[0] - 0.99 and -0.01 <= c <= field.shape[1] - 0.99:
                i, j = min(max(int(r), 0), field.shape[0] - 2), min(max(int(c), 0), field.shape[1] - 2)
                fr, fc = r - i, c - j
                upper = (1 - fc) * field[i, j] + fc * field[i, j + 1]
                lower = (1 - fc) * field[i + 1, j] + fc * field[i + 1, j + 1]
                out[row, column] = (1 - fr) * upper + fr * lower
