"""A small textured sample in a small scanner, and the projector written anew in plain numpy, with S stored."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.equations import Images, linearise
from pdvc.experiment import Series
from pdvc.geometry import ConeBeam
from pdvc.history import Angle, Polynomial, time_basis
from pdvc.projection import _moved_box, project
from pdvc.rays import ray_vectors
from pdvc.sections import SectionBasis
from pdvc.volume import Grid, Hull, Volume, hull_of

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


def hull_around(values: NDArray[np.float32], grid: Grid) -> Hull:
    """Return a hull with the margin that measurements use: three voxels."""
    near = ndimage.binary_dilation(values != 0, np.ones((3, 3, 3)))
    return hull_of(near, grid, 4).grown(3 * grid.voxel_mm)


def volume_of(values: NDArray[np.float32], voxel_mm: float = VOXEL_MM) -> Volume:
    """Place an array (z, y, x) with its middle a little off the axis."""
    nz, ny, nx = values.shape
    origin = tuple(float(-(n - 1) / 2 * voxel_mm + off) for n, off in ((nx, 0.02), (ny, -0.03), (nz, 0.01)))
    grid = Grid(shape=(nz, ny, nx), voxel_mm=voxel_mm, origin_mm=origin)  # type: ignore[arg-type]
    return Volume(values=values, grid=grid, hull=hull_around(values, grid))


@cache
def textured(blur: float = 1.2) -> Volume:
    """Return an elliptical bar of 22 x 16 x 56 voxels full of texture, with soft edges, in a grid with air around."""
    shape = (64, 24, 30)
    rng = np.random.default_rng(20180704)
    z, y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in shape), indexing="ij")
    bar = (((x / 11) ** 2 + (y / 8) ** 2 < 1) & (np.abs(z) < 28)).astype(float)
    grain = ndimage.gaussian_filter(rng.normal(size=shape), blur)
    body = ndimage.gaussian_filter(bar * (1 + 0.35 * grain / grain.std()), 0.6, truncate=3)
    values = np.where(body > 1e-3, body, 0).astype(np.float32)
    return volume_of(values)


def rays_at(angle_rad: float, scanner: ConeBeam = SCANNER) -> Floats:
    """Return the rays (4, 3) of one angle, mm."""
    return ray_vectors(scanner, angle_rad).stacked()[0]


def motion(basis: SectionBasis, seed: int = 0, size: float = 1.0) -> Floats:
    """Return random amplitudes (section, motion), of standard deviation `size` voxels."""
    return np.random.default_rng(seed).normal(scale=size, size=basis.shape)


def trilinear(values: NDArray[np.float32], index: Floats) -> tuple[Floats, Floats]:
    """Return the trilinear value (...,) and its gradient (..., 3) at points (x, y, z) in voxel indices; 0 outside."""
    nz, ny, nx = values.shape
    cell = np.floor(index).astype(int)
    inside = ((cell >= 0) & (cell < np.array([nx, ny, nz]) - 1)).all(axis=-1)
    cell = np.where(inside[..., None], cell, 0)
    part = index - cell
    value, gradient = np.zeros(index.shape[:-1]), np.zeros(index.shape)
    for corner in product((0, 1), repeat=3):
        at = values[cell[..., 2] + corner[2], cell[..., 1] + corner[1], cell[..., 0] + corner[0]].astype(float)
        share = np.where(corner, part, 1 - part)
        sign = np.where(corner, 1.0, -1.0)
        value += at * share.prod(axis=-1)
        for i in range(3):
            gradient[..., i] += at * sign[i] * share[..., (i + 1) % 3] * share[..., (i + 2) % 3]
    return np.where(inside, value, 0), np.where(inside[..., None], gradient, 0)


def stored(
    volume: Volume,
    rays: Floats,
    shape: tuple[int, int],
    basis: SectionBasis,
    amplitude: Floats,
    voxel_mm: float,
    step: float = 1.0,
) -> tuple[Floats, Floats]:
    """Return P (pixel,) and all of S (pixel, unknown) of Eq. 10, from the formulas, in double precision.

    Points lie at l = (m + 1/2) step along each ray, in voxels of the volume, from where the ray passes the middle of
    the moved sample: only that middle is taken from the code under test.
    """
    grid = volume.grid
    origin = np.array(grid.origin_mm)
    maps = basis.affine(amplitude).copy() * voxel_mm / grid.voxel_mm
    maps[..., 3] += maps[..., :3] @ origin
    maps[..., :3] *= grid.voxel_mm
    middle = origin + grid.voxel_mm * _moved_box(volume, (basis.height_mm - origin[2]) / grid.voxel_mm, maps).mean(
        axis=0
    )
    row, column = np.indices(shape)
    along = rays[1] + row[..., None] * rays[2] + column[..., None] * rays[3] - rays[0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    base = rays[0] + ((middle - rays[0]) * along).sum(axis=-1, keepdims=True) * along
    half = int(np.linalg.norm(grid.shape) / step) // 2 + 20
    length = (np.arange(-half, half) + 0.5) * step * grid.voxel_mm
    x = (base[:, :, None] + length[:, None] * along[:, :, None]).reshape(-1, 3)
    u = basis.displacement(amplitude, x)
    value, gradient = trilinear(volume.values, (x - u * voxel_mm - origin) / grid.voxel_mm)
    gradient /= grid.voxel_mm  # per mm
    weight = step * grid.voxel_mm
    pixels = (shape[0] * shape[1], len(length))
    columns = []
    for j, k in product(range(basis.shape[0]), range(basis.shape[1])):
        unit = np.zeros(basis.shape)
        unit[j, k] = 1
        shown = (basis.displacement(unit, x) * voxel_mm * gradient).sum(axis=-1)
        columns.append(shown.reshape(pixels).sum(axis=1) * weight)
    return value.reshape(pixels).sum(axis=1) * weight, np.stack(columns, axis=1)


@cache
def time_functions() -> Floats:
    """Return four orthonormal time functions (function, step): sine and cosine of the angle, 1 and t."""
    record = Series(
        counts=np.zeros((STEPS, 1, 1), dtype=np.uint16),
        angle_rad=ANGLES,
        time_s=np.arange(STEPS, dtype=float),
        force_N=np.zeros(STEPS),
    )
    return time_basis((Angle(), Polynomial(degree=1)), record)


def radiographs(basis: SectionBasis, amplitude: Floats, volume: Volume | None = None) -> Images:
    """Return radiographs made by pdvc's own projector from amplitudes (step, section, motion): the inverse crime."""
    volume = volume or textured()
    rays = ray_vectors(SCANNER, ANGLES).stacked()
    grey = [project(volume, rays[t], SHAPE, basis, amplitude[t], voxel_mm=VOXEL_MM) for t in range(len(amplitude))]
    return Images(
        rays=rays,
        grey=np.stack(grey),
        weight=np.ones((1, *SHAPE), dtype=np.float32),
        volume=volume,
        systematic=None,
        voxel_mm=VOXEL_MM,
    )


def lineariser(images: Images, basis: SectionBasis):  # type: ignore[no-untyped-def]
    """Return the equations as a function of amplitudes, as solvers ask for them."""
    return lambda amplitude: linearise(images, basis, amplitude)
