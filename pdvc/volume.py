"""A reconstructed volume and its hull: where the sample is, so that no time is spent on air."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float64]

_MARGIN_VOXEL = 3.0
"""Voxels outside a hull that those inside are interpolated with, with room for how it was found."""
DIRECTIONS = 16
"""Number of half-planes that bound each slab of a hull."""


@dataclass(frozen=True, kw_only=True)
class Hull:
    """A bound of the sample, slab by slab along z a convex polygon: {(x, y): n_k . (x, y) <= support_k}.

    n_k are unit vectors at angles 2 pi k / DIRECTIONS. Slab i covers z_mm + i slab_mm .. z_mm + (i + 1) slab_mm.
    """

    z_mm: float
    """Bottom of the lowest slab, mm."""
    slab_mm: float
    """Height of a slab, mm."""
    support_mm: Floats
    """(slab, direction), mm; -inf where the slab is empty."""

    @staticmethod
    def normals() -> Floats:
        """Return the unit normals n_k (direction, 2)."""
        angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def grown(self, margin_mm: float) -> Hull:
        """Return the hull with every half-plane, and every slab's height, moved outwards by a margin."""
        reach = int(np.ceil(margin_mm / self.slab_mm))
        padded = np.pad(self.support_mm, ((2 * reach, 2 * reach), (0, 0)), constant_values=-np.inf)
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0)
        return Hull(
            z_mm=self.z_mm - reach * self.slab_mm,
            slab_mm=self.slab_mm,
            support_mm=windows.max(axis=-1) + margin_mm,
        )

    def around_voxels(self, voxel_mm: float) -> Hull:
        """Return the hull that encloses all voxels reconstructed within this one, and those they are mixed with."""
        return self.grown(_MARGIN_VOXEL * voxel_mm)

    def box_mm(self) -> tuple[Floats, Floats]:
        """Return the lowest and highest corner (x, y, z) of the box around the hull, mm."""
        filled = np.flatnonzero(np.isfinite(self.support_mm).all(axis=1))
        if len(filled) == 0:
            raise ValueError("hull: expected a sample, found only air")
        support = self.support_mm[filled].max(axis=0)
        quarter = DIRECTIONS // 4
        low = [-support[2 * quarter], -support[3 * quarter], self.z_mm + filled[0] * self.slab_mm]
        high = [support[0], support[quarter], self.z_mm + (filled[-1] + 1) * self.slab_mm]
        return np.array(low), np.array(high)

    def radius_mm(self) -> float:
        """Return the distance of the farthest corner of its box from the axis, mm."""
        low, high = self.box_mm()
        return float(np.hypot(*np.maximum(np.abs(low), np.abs(high))[:2]))


def hull_of(inside: NDArray[np.bool_], grid: Grid, slab_voxels: int) -> Hull:
    """Return the hull of the voxels that are inside (z, y, x), their whole area included."""
    slabs = -(-inside.shape[0] // slab_voxels)
    normals = Hull.normals()
    x = grid.origin_mm[0] + grid.voxel_mm * np.arange(inside.shape[2])
    y = grid.origin_mm[1] + grid.voxel_mm * np.arange(inside.shape[1])
    support = np.full((slabs, DIRECTIONS), -np.inf)
    for slab in range(slabs):
        rows, columns = np.nonzero(inside[slab * slab_voxels : (slab + 1) * slab_voxels].any(axis=0))
        if len(rows):
            reach = grid.voxel_mm / 2 * np.abs(normals).sum(axis=1)
            support[slab] = (np.stack([x[columns], y[rows]], axis=-1) @ normals.T).max(axis=0) + reach
    return Hull(z_mm=grid.origin_mm[2] - grid.voxel_mm / 2, slab_mm=grid.voxel_mm * slab_voxels, support_mm=support)


@dataclass(frozen=True, kw_only=True)
class Grid:
    """The places of voxels: the centre of voxel (k, j, i) is at origin + voxel (i, j, k)."""

    shape: tuple[int, int, int]
    """(z, y, x)"""
    voxel_mm: float
    origin_mm: tuple[float, float, float]
    """Centre of voxel (0, 0, 0): (x, y, z), mm."""

    def __post_init__(self) -> None:
        if min(self.shape) < 2 or not self.voxel_mm > 0:
            raise ValueError(f"grid: expected at least 2 voxels each way, got {self.shape}, {self.voxel_mm} mm")

    @staticmethod
    def around(low_mm: Floats, high_mm: Floats, voxel_mm: float) -> Grid:
        """Return the smallest grid that covers a box (x, y, z), voxel edges on multiples of the voxel."""
        first = np.floor(np.asarray(low_mm) / voxel_mm).astype(int)
        last = np.ceil(np.asarray(high_mm) / voxel_mm).astype(int)
        count = np.maximum(last - first, 2)
        origin = (first + 0.5) * voxel_mm
        return Grid(
            shape=(int(count[2]), int(count[1]), int(count[0])),
            voxel_mm=voxel_mm,
            origin_mm=(float(origin[0]), float(origin[1]), float(origin[2])),
        )


@dataclass(frozen=True, kw_only=True)
class Volume:
    """The attenuation F of one state, usually the reference, in grey levels per mm, zero outside the hull."""

    values: NDArray[np.float32]
    """(z, y, x), grey levels per mm; one layer of zeros on every face."""
    grid: Grid
    hull: Hull
    """Encloses every voxel that is not zero, with its interpolation neighbours."""
    phase: float = 0.0
    """Correction b of linear interpolation between voxels: the next one's share f becomes f + b f (1 - f) (1 - 2 f).

    Linear interpolation shifts a wave of k radians per voxel by k^2 / 6 f (1 - f) (1 - 2 f) voxel, to the order of
    k^2: a hundredth of a voxel at f = 1/5 for a wave of eight voxels. b = k^2 / 6 undoes it. 0: none.
    """

    def __post_init__(self) -> None:
        if self.values.shape != self.grid.shape or self.values.dtype != np.float32:
            raise ValueError(
                f"volume: expected float32 {self.grid.shape}, got {self.values.dtype} {self.values.shape}"
            )


def framed(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Set the outermost layer of voxels to zero, in place, so that interpolation at the hull ends in air."""
    for axis in range(3):
        face = np.moveaxis(values, axis, 0)
        face[0] = 0
        face[-1] = 0
    return values


def smoothed(volume: Volume, deviation_voxel: float) -> Volume:
    """Return the volume after a Gaussian filter, its standard deviation in voxels of the volume."""
    values = ndimage.gaussian_filter(_continued(volume.values), deviation_voxel, mode="nearest")
    return Volume(values=framed(values), grid=volume.grid, hull=volume.hull)


def halved(volume: Volume) -> Volume:
    """Return the volume on a grid of half the voxel, between its voxels by cubic spline interpolation.

    With c the spline's coefficients, the value midway between voxels i and i + 1 is
    (c_i-1 + 23 c_i + 23 c_i+1 + c_i+2) / 48 (Unser, IEEE Signal Processing Magazine 16, 1999).
    """
    values = _continued(volume.values)
    for axis in (2, 1, 0):  # z last: then the largest array is laid out in order, and made only once
        known = np.moveaxis(values, axis, 0)
        c = np.empty((len(known) + 2, *known.shape[1:]), dtype=np.float32)
        ndimage.spline_filter1d(known, 3, axis=0, output=c[1:-1], mode="mirror")
        c[0], c[-1] = c[2], c[-3]
        fine = np.empty((2 * len(known) - 1, *known.shape[1:]), dtype=np.float32)
        fine[::2] = known
        between = fine[1::2]
        np.add(c[1:-2], c[2:-1], out=between)
        between *= 23
        between += c[:-3]
        between += c[3:]
        between /= 48
        values = np.moveaxis(fine, 0, axis)
    values = framed(np.ascontiguousarray(values))
    nz, ny, nx = values.shape
    grid = Grid(shape=(nz, ny, nx), voxel_mm=volume.grid.voxel_mm / 2, origin_mm=volume.grid.origin_mm)
    return Volume(values=values, grid=grid, hull=volume.hull)


def _continued(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a copy whose lowest and highest layer, zero, repeat the next: the sample may go on beyond them."""
    result = values.copy()
    result[0], result[-1] = result[1], result[-2]
    return result
