"""A small textured sample in a small scanner, a blob in closed form, and the projector written anew in plain numpy."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdvc.equations import Images, linearise
from pdvc.experiment import Series
from pdvc.geometry import ConeBeam
from pdvc.history import Angle, Polynomial, time_basis
from pdvc.projection import project
from pdvc.rays import ray_vectors
from pdvc.sections import SectionBasis
from pdvc.volume import Grid, Volume
from validation.testing.small_cases import hull_around, placed_volume, textured_volume

Floats = NDArray[np.float64]

VOXEL_MM = 0.05
SCANNER = ConeBeam(
    source_axis_mm=30.0,
    source_detector_mm=300.0,
    pixel_mm=0.5,
    rows=46,
    columns=38,
    column_shift_mm=0.3,
    row_shift_mm=-0.2,
    roll_rad=0.02,
)
SHAPE = (SCANNER.rows, SCANNER.columns)
SECTIONS = SectionBasis(height_mm=VOXEL_MM * np.array([-24.0, -7.0, 9.0, 25.0]), radius_mm=10 * VOXEL_MM)
ONE = SectionBasis(height_mm=np.array([0.1]), radius_mm=10 * VOXEL_MM)
STEPS = 24
ANGLES = np.linspace(0.3, 0.3 + 4 * np.pi, STEPS, endpoint=False)


def volume_of(values: NDArray[np.float32], voxel_mm: float = VOXEL_MM) -> Volume:
    """Place an array (z, y, x) with its middle a little off the axis."""
    return placed_volume(values, voxel_mm)


def textured(blur: float = 1.2) -> Volume:
    """Return an elliptical bar of 22 x 16 x 56 voxels full of texture, with soft edges, in a grid with air around."""
    return textured_volume((64, 24, 30), VOXEL_MM, blur_voxel=blur, seed=20180704)


def rays_at(angle_rad: float, scanner: ConeBeam = SCANNER) -> Floats:
    """Return the rays (4, 3) of one angle, mm."""
    return ray_vectors(scanner, angle_rad).stacked()[0]


def motion(basis: SectionBasis, seed: int = 0, size: float = 1.0) -> Floats:
    """Return random amplitudes (section, motion), of standard deviation `size` voxels."""
    return np.random.default_rng(seed).normal(scale=size, size=basis.shape)


def trilinear(values: NDArray[np.float32], index: Floats) -> Floats:
    """Return the trilinear value (...,) at points (x, y, z) in voxel indices; 0 outside."""
    nz, ny, nx = values.shape
    cell = np.floor(index).astype(int)
    inside = ((cell >= 0) & (cell < np.array([nx, ny, nz]) - 1)).all(axis=-1)
    cell = np.where(inside[..., None], cell, 0)
    part = index - cell
    value = np.zeros(index.shape[:-1])
    for corner in product((0, 1), repeat=3):
        at = values[cell[..., 2] + corner[2], cell[..., 1] + corner[1], cell[..., 0] + corner[0]]
        value += at.astype(float) * np.where(corner, part, 1 - part).prod(axis=-1)
    return np.where(inside, value, 0)


def plane_sums(
    volume: Volume, rays: Floats, shape: tuple[int, int], basis: SectionBasis, amplitude: Floats, voxel_mm: float
) -> Floats:
    """Return P (pixel,) in plain numpy and double precision: Joseph's sums over the planes of voxels.

    The ray x(l) passes plane k of the moved volume where coordinate m of x - u(x) is that of the plane, m being x or
    y, whichever the ray follows more. There F is interpolated, and counts for the length dl from plane to plane.
    """
    grid, origin = volume.grid, np.array(volume.grid.origin_mm)
    row, column = (index.ravel()[:, None] for index in np.indices(shape))
    along = rays[1] + row * rays[2] + column * rays[3] - rays[0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    axis = np.where(np.abs(along[:, 0]) >= np.abs(along[:, 1]), 0, 1)
    planes = np.arange(max(grid.shape[1:]))
    real = planes < np.where(axis == 0, grid.shape[2], grid.shape[1])[:, None]
    slope = np.take_along_axis(along, axis[:, None], 1) / grid.voxel_mm

    def was(length: Floats) -> Floats:
        """Return x - u(x) in voxel indices, for lengths (pixel, plane)."""
        x = rays[0] + length[..., None] * along[:, None]
        u = basis.displacement(amplitude, x.reshape(-1, 3)).reshape(x.shape)
        return (x - u * voxel_mm - origin) / grid.voxel_mm

    def coordinate(length: Floats) -> Floats:
        return np.take_along_axis(was(length), axis[:, None, None], 2)[..., 0]

    start = np.take_along_axis(rays[0][None] - origin, axis[:, None], 1) / grid.voxel_mm
    length = (planes - start) / slope
    for _ in range(8):
        length -= (coordinate(length) - planes) / slope
    nudge = 1e-4 * grid.voxel_mm
    spacing = 2 * nudge / np.abs(coordinate(length + nudge) - coordinate(length - nudge))
    value = trilinear(volume.values, was(length) + 1e-9)
    return np.asarray(np.where(real, value * spacing, 0).sum(axis=1))


def stored(
    volume: Volume, rays: Floats, shape: tuple[int, int], basis: SectionBasis, amplitude: Floats, voxel_mm: float
) -> tuple[Floats, Floats]:
    """Return P (pixel,) and all of S = -dP/da (pixel, unknown), by central differences of `plane_sums`."""

    def shifted(j: int, k: int, change: float) -> Floats:
        trial = amplitude.copy()
        trial[j, k] += change
        return plane_sums(volume, rays, shape, basis, trial, voxel_mm)

    change = 1e-3
    columns = [
        (shifted(j, k, -change) - shifted(j, k, change)) / (2 * change)
        for j, k in product(range(basis.shape[0]), range(basis.shape[1]))
    ]
    return plane_sums(volume, rays, shape, basis, amplitude, voxel_mm), np.stack(columns, axis=1)


@cache
def series() -> Series:
    """Return what was recorded with the steps: their angles and times, and no force."""
    return Series(
        counts=np.zeros((STEPS, 1, 1), dtype=np.uint16),
        angle_rad=ANGLES,
        time_s=np.arange(STEPS, dtype=float),
        force_N=np.zeros(STEPS),
    )


@cache
def time_functions() -> Floats:
    """Return four orthonormal time functions (function, step): sine and cosine of the angle, 1 and t."""
    return time_basis((Angle(), Polynomial(degree=1)), series())


def radiographs(basis: SectionBasis, amplitude: Floats, volume: Volume | None = None) -> Images:
    """Return radiographs made by pdvc's own projector from amplitudes (step, section, motion): the inverse crime."""
    volume = volume or textured()
    rays = ray_vectors(SCANNER, ANGLES).stacked()
    steps = len(amplitude)
    return Images(
        rays=rays[:steps],
        grey=project(volume, rays[:steps], SHAPE, basis, amplitude, voxel_mm=VOXEL_MM),
        weight=np.ones((1, *SHAPE), dtype=np.float32),
        volume=volume,
        systematic=None,
        voxel_mm=VOXEL_MM,
    )


def lineariser(images: Images, basis: SectionBasis):  # type: ignore[no-untyped-def]
    """Return the equations as a function of amplitudes, as solvers ask for them."""
    return lambda amplitude: linearise(images, basis, amplitude)


# A volume in closed form

BLOB_CENTRE = np.array([0.11, -0.07, 0.05])
BLOB_SHAPE = np.array([[40.0, 9.0, 0.0], [9.0, 70.0, -12.0], [0.0, -12.0, 30.0]])
"""Inverse covariance of the blob, 1 / mm^2."""


def pixel_directions(rays: Floats, shape: tuple[int, int]) -> Floats:
    """Return the unit vectors (row, column, 3) from the source to the pixels."""
    row, column = np.indices(shape)
    d = rays[1] + row[..., None] * rays[2] + column[..., None] * rays[3] - rays[0]
    return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))


def blob_values(points: Floats) -> Floats:
    """Return F(x) (...,) at points (..., 3), mm."""
    away = points - BLOB_CENTRE
    return np.asarray(np.exp(-0.5 * np.einsum("...a,ab,...b->...", away, BLOB_SHAPE, away)))


def blob_gradients(points: Floats) -> Floats:
    """Return grad F (..., 3) at points (..., 3), 1 / mm."""
    return np.asarray(-((points - BLOB_CENTRE) @ BLOB_SHAPE) * blob_values(points)[..., None])


def blob(voxel_mm: float) -> Volume:
    """Return a volume of F(x) = exp(-(x - c)^T A (x - c) / 2), reaching to where it is below single precision."""
    count = np.round(np.array([2.2, 1.5, 1.8]) / voxel_mm).astype(int)
    grid = Grid(
        shape=tuple(int(n) for n in count),
        voxel_mm=voxel_mm,
        origin_mm=tuple(float(-(n - 1) / 2 * voxel_mm) for n in count[::-1]),
    )
    z, y, x = np.meshgrid(
        *(o + voxel_mm * np.arange(n) for o, n in zip(grid.origin_mm[::-1], count, strict=True)), indexing="ij"
    )
    values = blob_values(np.stack([x, y, z], axis=-1)).astype(np.float32)
    for axis in range(3):
        np.moveaxis(values, axis, 0)[[0, -1]] = 0
    return Volume(values=values, grid=grid, hull=hull_around(values, grid))


def blob_integrals(rays: Floats, shape: tuple[int, int], shift_mm: ArrayLike = (0.0, 0.0, 0.0)) -> Floats:
    """Return the exact line integrals (row, column) of the blob, moved by a shift."""
    d = pixel_directions(rays, shape)
    p = rays[0] - BLOB_CENTRE - np.asarray(shift_mm)
    dd = np.einsum("...a,ab,...b->...", d, BLOB_SHAPE, d)
    pd = np.einsum("a,ab,...b->...", p, BLOB_SHAPE, d)
    return np.asarray(np.sqrt(2 * np.pi / dd) * np.exp(-0.5 * (p @ BLOB_SHAPE @ p - pd**2 / dd)))
