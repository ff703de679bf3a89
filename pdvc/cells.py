"""Where on the sample something new shows in the residual: a crack that opens, that no motion explains.

The residual of a step over its standard deviation, summed over squares of pixels as large as a cell of the sample and
scaled to a deviation of one, is w_t(p). A cell at X, moved with the sample, is seen at pixel p_t(X), and the mean of
what was seen there,

    m_t(X) = (1 - a) m_(t-1)(X) + a w_t(p_t(X))

is taken over the last few steps, and with a smaller a over many. What the model of the image always misses there is in
both: their difference, over its own deviation over all cells, tells what is new. Of a cell that looked as usual a
radiograph tells `MOST` at most, so that no single one makes a crack.

Rays cross many cells, so that a spot in one residual may lie anywhere along its ray; those of several directions meet
where it is. Its place is therefore the middle of where much is new over some more steps, at the height of the spot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.geometry import ConeBeam
from pdvc.rays import ray_vectors
from pdvc.robust import usual_size
from pdvc.sections import SectionBasis
from pdvc.volume import Hull

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

LEAST_VOXEL = 4
"""Voxels along the side of a cell, at least."""
MOST_CELLS = 30_000
"""Cells of a sample, about, at most."""
SOON, PLACED, LATE = 1 / 3, 1 / 12, 1 / 30
"""Share of a step in the mean over few steps, over as many as tell a place, and over many."""
CRACK = 8.0
"""Deviations from which on a spot is taken for something that opened, and not for noise."""
LEAST_STEPS = 8
"""Steps that tell what is usual, at least."""
USED_SHARE = 0.3
"""Share of a square of pixels that is used, at least, to count."""
MOST, TRUST = 5.0, 2.0
"""Deviations that a radiograph tells of a cell, at most: it may look odd from one direction. And by how many times
what was new there before this is more."""


@dataclass(frozen=True, kw_only=True)
class Spot:
    """The cell in which most is new."""

    score: float
    """What is new there, over its deviation over all cells."""
    place_mm: tuple[float, float, float]
    """Its middle (x, y, z), on the sample as it was at rest; across the beam it is known first."""


class Cells:
    """What the residuals of the steps so far show, cell by cell of the sample between the outermost sections."""

    def __init__(self, geometry: ConeBeam, basis: SectionBasis, hull: Hull) -> None:
        """Begin without a step; `geometry` of the window in which residuals are, of one pixel a voxel."""
        self._geometry, self._basis = geometry, basis
        low, high = hull.box_mm()
        # sections of one height move the sample as one, and all of it is looked at
        if len(basis.height_mm) > 1:
            low[2], high[2] = max(low[2], basis.height_mm[0]), min(high[2], basis.height_mm[-1])
        voxels = max(LEAST_VOXEL, round((float(np.prod(high - low)) / MOST_CELLS) ** (1 / 3) / geometry.voxel_mm))
        self._pixels = voxels + 1 - voxels % 2
        x, y, self._z = (
            np.arange(start + voxels * geometry.voxel_mm / 2, end, voxels * geometry.voxel_mm)
            for start, end in zip(low, high, strict=True)
        )
        self._xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        slab = np.clip(((self._z - hull.z_mm) / hull.slab_mm).astype(int), 0, len(hull.support_mm) - 1)
        self._inside = ((self._xy @ hull.normals().T) <= hull.support_mm[slab][:, None]).all(axis=-1)
        self._means = np.zeros((3, *self._inside.shape))
        self.steps = 0
        """Steps so far."""

    def add(self, residual: Image, amplitude: Floats, angle_rad: float) -> Spot:
        """Take in a step: residual over its deviation (row, column), zero where unused, at amplitudes in voxels.

        Nothing is new on a sample thinner than a cell.
        """
        if not self._inside.any():
            return Spot(score=0.0, place_mm=(math.nan, math.nan, math.nan))
        seen, (row, column) = self._summed(residual), self._places(amplitude, angle_rad)
        on = self._inside & (row >= 0) & (column >= 0) & (row < seen.shape[0]) & (column < seen.shape[1])
        whole = np.where(on, seen[np.where(on, row, 0), np.where(on, column, 0)], 0.0)
        most = MOST + TRUST * np.maximum(self._means[0] - self._means[2], 0)
        new = np.clip(whole, -most, most)
        share = np.maximum([[[SOON]], [[PLACED]]], 1 / (self.steps + 1))
        self._means[:2] += share * (np.stack([new, whole]) - self._means[:2])
        soon, placed = self._means[:2] - self._means[2]
        scale = float(usual_size(soon[self._inside]))
        at = np.unravel_index(int(np.argmax(np.where(self._inside, soon, -np.inf))), soon.shape)
        score = float(soon[at]) / scale if scale > 0 else 0.0
        self._means[2] += max(LATE, 1 / (self.steps + 1)) * (new - self._means[2])
        self.steps += 1
        layer = int(at[0])
        weight = np.where(self._inside[layer], placed[layer], 0)
        weight = np.maximum(weight - weight.max() / 2, 0)
        x, y = (self._xy.T @ weight / weight.sum() if weight.any() else self._xy[at[1]]).tolist()
        return Spot(score=score, place_mm=(x, y, float(self._z[layer])))

    def kept(self) -> dict[str, NDArray[Any]]:
        """Return all that has to be known to be restored."""
        return {"means": self._means, "steps": np.array(self.steps)}

    def restore(self, kept: Mapping[str, NDArray[Any]]) -> None:
        """Know again what it knew when `kept` was asked."""
        self._means, self.steps = kept["means"].copy(), int(kept["steps"])

    def _summed(self, residual: Image) -> Floats:
        """Return w_t (row, column); zero where too little is used."""
        residual = np.where(np.isfinite(residual), residual, 0)
        used = ndimage.uniform_filter((residual != 0).astype(float), self._pixels, mode="constant")
        mean = ndimage.uniform_filter(residual.astype(float), self._pixels, mode="constant")
        counts = used > USED_SHARE
        summed = np.where(counts, mean / np.sqrt(np.maximum(used, USED_SHARE)), 0)
        scale = float(usual_size(summed[counts])) if counts.any() else 0.0
        return summed / scale if scale > 0 else summed

    def _places(self, amplitude: Floats, angle_rad: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the pixel in which each cell is seen: rows and columns (layer, cell)."""
        basis, voxel_mm = self._basis, self._geometry.voxel_mm
        affine, z = basis.affine(amplitude) * voxel_mm, self._z
        # u is known where the sample is now: twice is enough for some voxels
        for _ in range(2):
            maps = np.einsum("lj,jab->lab", basis.weights(z), affine)
            z = self._z + maps[:, 2, 2] * self._z + maps[:, 2, 3]
        cells = np.empty((*self._inside.shape, 3))
        cells[..., :2], cells[..., 2] = self._xy, self._z[:, None]
        cells += cells @ maps[..., :3].transpose(0, 2, 1) + maps[:, None, :, 3]
        source, corner, down, right = ray_vectors(self._geometry, angle_rad).stacked()[0]
        normal, ray = np.cross(down, right), cells - source
        on_panel = source + ray * (((corner - source) @ normal) / (ray @ normal))[..., None] - corner
        row, column = (np.rint(on_panel @ each / (each @ each)).astype(np.int64) for each in (down, right))
        return row, column
