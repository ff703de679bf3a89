"""Warped projection, residual and projected sensitivities of radiographs, reduced as they are found.

For each step, with F the reference volume, u the trial motion and a ray x(s) from the source to pixel r,

    P[F~](r)  = int F(x - u(x)) ds                              grey levels
    rho(r)    = P[F~](r) - g(r)                                 Eq. 2
    S_i(r)    = int Phi_i(x) . grad F(x - u(x)) ds              Eq. 10, grey levels per voxel
    B_ij      = sum_r w(r) S_i(r) S_j(r)                        Eq. 11
    c_i       = sum_r w(r) S_i(r) rho(r)

so that chi2 = sum_r w rho^2 is lowered by the solution of B da = c. Neither S nor the warped volume is stored:
each ray is walked once, and its sensitivities are added into B and c and forgotten.

This room turns millimetres into indices of the volume, says which sections each band of rows can meet, and adds the
bands in order; the rays are walked in `pdvc.walk`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.sections import SectionBasis
from pdvc.volume import Hull, Volume
from pdvc.walk import BAND_ROWS, BLOCK_COLUMNS, Scene, Steps, Sums, walk_bands

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

_NOWHERE = np.float32(-1e6)
_FARTHEST = 2.0
"""Distances from the axis to the source within which a moved sample is followed."""


@dataclass(frozen=True, kw_only=True)
class BlockVectors:
    """c of a step, of each block of `BAND_ROWS` x `BLOCK_COLUMNS` pixels by itself."""

    values: Floats
    """(band of rows, block, unknown): unknowns count from the band's first; those beyond the last are zero."""
    first: NDArray[np.int64]
    """(band,) the first unknown of a band."""


@dataclass(frozen=True, kw_only=True)
class StepEquations:
    """What radiographs say about the section amplitudes of their steps."""

    matrix: Floats
    """B (step, section * motion, section * motion), (grey level / voxel)^2."""
    vector: Floats
    """c (step, section * motion), grey level^2 / voxel."""
    chi2: Floats
    """Weighted sum of squared residuals (step,), grey level^2."""
    residual: Image
    """rho (step, row, column), grey levels, in every pixel of the window, whatever its weight."""
    blocks: list[BlockVectors]
    """c of each step, block by block."""


def normal_equations(
    volume: Volume,
    rays: Floats,
    basis: SectionBasis,
    amplitude: Floats,
    target: Image,
    weight: Image,
    *,
    voxel_mm: float,
) -> StepEquations:
    """Compare radiographs with the moved volume, and return their normal equations.

    `rays` (step, 4, 3) in mm as of RayVectors.stacked, for the window that `target` (step, row, column) covers;
    `amplitude` (step, section, motion) in voxels of `voxel_mm`; `weight` (step, row, column), or (1, row, column)
    for all steps, zero for unused pixels. A step that takes the sample out of the scanner has an infinite chi2, so
    that no solver goes there. Raises ValueError for amplitudes that are not finite or of another shape.
    """
    return _walk(volume, rays, basis, amplitude, target, weight, voxel_mm, True, tried=True)


@dataclass(frozen=True, kw_only=True)
class Sensitivities:
    """S_i of every pixel of one step, for the sections that its row may touch: the others' are zero."""

    values: Image
    """S (row, section of the row * motion, column), grey levels per voxel."""
    first: NDArray[np.int64]
    """(row,) the section that `values` starts with; sections beyond the last are zero."""
    motions: int
    """Motions of a section."""


def sensitivities(
    volume: Volume,
    rays: Floats,
    shape: tuple[int, int],
    basis: SectionBasis,
    amplitude: Floats,
    *,
    voxel_mm: float,
) -> list[Sensitivities]:
    """Return S of each step: what `normal_equations` forgets, and what noise is propagated with.

    Arguments as of `project`. A step at the paper's size takes 20 MB.
    """
    blank = np.zeros((len(rays), *shape), dtype=np.float32)
    fields: list[Sensitivities] = []
    _walk(volume, rays, basis, amplitude, blank, blank[:1], voxel_mm, True, fields)
    return fields


def project(
    volume: Volume,
    rays: Floats,
    shape: tuple[int, int],
    basis: SectionBasis,
    amplitude: Floats,
    *,
    voxel_mm: float,
) -> Image:
    """Return the radiographs P[F~] (step, row, column), grey levels, of the moved volume; arguments as above."""
    blank = np.zeros((len(rays), *shape), dtype=np.float32)
    return _walk(volume, rays, basis, amplitude, blank, blank[:1], voxel_mm, False).residual


def project_at_rest(volume: Volume, rays: Floats, shape: tuple[int, int]) -> Image:
    """Return the radiographs P[F] (step, row, column), grey levels, of the volume where it is."""
    still = SectionBasis(height_mm=np.zeros(1), radius_mm=1.0)
    nothing = np.zeros((len(rays), *still.shape))
    return project(volume, rays, shape, still, nothing, voxel_mm=volume.grid.voxel_mm)


def _walk(
    volume: Volume,
    rays: Floats,
    basis: SectionBasis,
    amplitude: Floats,
    target: Image,
    weight: Image,
    voxel_mm: float,
    with_sensitivities: bool,
    fields: list[Sensitivities] | None = None,
    tried: bool = False,
) -> StepEquations:
    """Prepare the steps in index coordinates of the volume, walk their rays, and add the bands in order.

    Where `fields` is a list, the sensitivities of each step are appended to it. Where motions are only `tried`, one
    that leaves the scanner is as bad as can be; else it is refused.
    """
    steps, motions = len(rays), basis.shape[1]
    if amplitude.shape != (steps, *basis.shape) or not np.isfinite(amplitude).all():
        raise ValueError(f"amplitude: expected finite {(steps, *basis.shape)}, got {amplitude.shape}")
    grid = volume.grid
    origin = np.array(grid.origin_mm)
    index_rays = rays / grid.voxel_mm
    # source and corner are places, the ways to the next row and column are not
    index_rays[:, :2] -= origin / grid.voxel_mm
    scene = _scene(volume, basis, voxel_mm)
    maps = _indexed(basis.affine(amplitude), origin, grid.voxel_mm) * (voxel_mm / grid.voxel_mm)
    boxes = np.stack([_moved_box(volume, scene.heights, each) for each in maps])
    astray = _astray(boxes, index_rays)
    if astray.any():
        if not tried:
            raise ValueError(f"amplitude: expected the sample in the beam, got it outside in {astray.sum()} steps")
        at_rest = np.where(astray[:, None, None], 0, amplitude)
        found = _walk(volume, rays, basis, at_rest, target, weight, voxel_mm, with_sensitivities, tried=True)
        return replace(found, chi2=np.where(astray, np.inf, found.chi2))
    bands = [_band_sections(index_rays[t], target.shape[1:], scene.heights, boxes[t]) for t in range(steps)]
    low = np.stack([lowest for lowest, _ in bands])
    # sections beyond those that a band can meet are left out of its matrix, which is summed over all its pixels
    size = max(span for _, span in bands) * motions if with_sensitivities else 0
    sums = Sums(
        matrices=np.zeros((*low.shape, size, size)),
        vectors=np.zeros((*low.shape, -(-target.shape[2] // BLOCK_COLUMNS), size)),
        chi2=np.zeros(low.shape),
        residual=np.empty(target.shape, dtype=np.float32),
        kept=np.zeros(
            (*target.shape[:2], size, target.shape[2]) if fields is not None else (steps, 0, 0, 0), dtype=np.float32
        ),
    )
    of_steps = Steps(box=boxes, rays=index_rays, maps=maps, target=target, weight=weight, low=low)
    walk_bands(scene, of_steps, sums, with_sensitivities)
    if fields is not None:
        first = low[:, np.arange(target.shape[1]) // BAND_ROWS]
        fields.extend(Sensitivities(values=sums.kept[t], first=first[t], motions=motions) for t in range(steps))
    return _joined(sums, low * motions, basis.shape[0] * motions if with_sensitivities else 0)


def _scene(volume: Volume, basis: SectionBasis, voxel_mm: float) -> Scene:
    """Return volume, hull and sections in voxel indices; unit amplitudes are a voxel of `voxel_mm`."""
    grid = volume.grid
    origin = np.array(grid.origin_mm)
    place, support = _hull_in_index(volume)
    patterns = _indexed(basis.patterns(), origin, grid.voxel_mm) * (voxel_mm / grid.voxel_mm)
    return Scene(
        volume=volume.values.reshape(-1),
        shape=np.array(grid.shape, dtype=np.int64),
        place=place,
        support=support,
        heights=(basis.height_mm - origin[2]) / grid.voxel_mm,
        patterns=np.ascontiguousarray(patterns.reshape(*basis.shape, 12)),
        voxel_mm=grid.voxel_mm,
        phase=volume.phase,
    )


def _joined(sums: Sums, first: NDArray[np.int64], unknowns: int) -> StepEquations:
    """Add the bands of each step, in order; `first` (step, band) are their first unknowns. No unknowns: no B, no c."""
    steps, size = len(first), sums.vectors.shape[3]
    matrix, vector = np.zeros((steps, unknowns, unknowns)), np.zeros((steps, unknowns))
    for t, band in np.ndindex(first.shape if unknowns else (0, 0)):
        count = min(size, unknowns - int(first[t, band]))
        here = slice(int(first[t, band]), int(first[t, band]) + count)
        matrix[t, here, here] += sums.matrices[t, band, :count, :count]
        vector[t, here] += sums.vectors[t, band, :, :count].sum(axis=0)
    matrix += np.tril(matrix, -1).transpose(0, 2, 1)
    return StepEquations(
        matrix=matrix,
        vector=vector,
        chi2=sums.chi2.sum(axis=1),
        residual=sums.residual,
        blocks=[BlockVectors(values=sums.vectors[t], first=first[t]) for t in range(steps)],
    )


def _indexed(affine: Floats, origin_mm: Floats, voxel_mm: float) -> Floats:
    """Turn affine maps (..., 3, 4) of x in mm into the same maps of voxel indices."""
    result = affine.copy()
    result[..., 3] += affine[..., :3] @ origin_mm
    result[..., :3] *= voxel_mm
    return result


def _hull_in_index(volume: Volume) -> tuple[Floats, Image]:
    """Return (bottom, height) of the hull's slabs and its supports, in voxel indices; empty slabs far outside."""
    grid, hull = volume.grid, volume.hull
    origin = np.array(grid.origin_mm)
    place = np.array([(hull.z_mm - origin[2]) / grid.voxel_mm, hull.slab_mm / grid.voxel_mm])
    support = (hull.support_mm - Hull.normals() @ origin[:2]) / grid.voxel_mm
    return place, np.where(np.isfinite(support), support, _NOWHERE).astype(np.float32)


def _moved_box(volume: Volume, heights: Floats, maps: Floats) -> Floats:
    """Return a box (2, 3), in voxel indices, that holds the hull wherever u takes it.

    x = X + u(x): bounding u over the hull's box, enlarged once by that bound, bounds the moved hull.
    """
    low, high = volume.hull.box_mm()
    origin = np.array(volume.grid.origin_mm)
    start = np.array([low - origin, high - origin]) / volume.grid.voxel_mm
    box = start
    for _ in range(2):
        x, y = np.repeat(box[:, 0], 2), np.tile(box[:, 1], 2)
        z = np.concatenate([heights, box[:, 2]])
        corners = np.stack(np.broadcast_arrays(x[:, None], y[:, None], z), axis=-1).reshape(-1, 3)
        moved = np.tensordot(maps[..., :3], corners, axes=(2, 1)) + maps[..., 3, None]
        box = np.array(
            [
                start[0] + np.minimum(moved.min(axis=(0, 2)), 0) - 1,
                start[1] + np.maximum(moved.max(axis=(0, 2)), 0) + 1,
            ]
        )
    return box


def _astray(boxes: Floats, rays: Floats) -> NDArray[np.bool_]:
    """Return which steps (step,) are taken so far that sums in single precision mean nothing."""
    most = _FARTHEST * float(np.linalg.norm(rays[:, 0], axis=1).max())
    return np.asarray(~(np.abs(boxes).max(axis=(1, 2)) <= most))


def _band_sections(
    rays: Floats, shape: tuple[int, ...], heights: Floats, box: Floats
) -> tuple[NDArray[np.int64], int]:
    """Return each band's lowest section, and the largest number of sections that any band touches."""
    rows, columns = shape
    bands = -(-rows // BAND_ROWS)
    first = np.arange(bands) * BAND_ROWS
    row = np.stack([first, np.minimum(first + BAND_ROWS, rows) - 1])[..., None]
    column = np.arange(columns)
    slope = [rays[1, i] + row * rays[2, i] + column * rays[3, i] - rays[0, i] for i in range(3)]
    rise = slope[2] / np.hypot(slope[0], slope[1])
    near = np.hypot(*(box.mean(axis=0)[:2] - rays[0, :2]))
    reach = np.linalg.norm(box[1, :2] - box[0, :2]) / 2 + 1
    # every point of the box is, seen from above, between these two distances from the source
    z = rays[0, 2] + np.stack([rise * max(near - reach, 0.0), rise * (near + reach)])
    low = np.searchsorted(heights, z.min(axis=(0, 1, 3)) - 1, side="right") - 1
    high = np.searchsorted(heights, z.max(axis=(0, 1, 3)) + 1, side="left")
    low = np.clip(low, 0, len(heights) - 1)
    high = np.clip(high, low, len(heights) - 1)
    return low, int((high - low).max()) + 1
