"""A plain implementation of the paper's step: warp the volume, project each Phi_i . grad F, store S, multiply."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from pdvc.projection import project
from pdvc.sections import SectionBasis
from pdvc.volume import Volume

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


def normal_equations(
    volume: Volume, rays: Floats, basis: SectionBasis, amplitude: Floats, target: Image, voxel_mm: float
) -> tuple[Floats, Floats, int]:
    """Return B, c and the bytes of the stored S of one step; uniform weights.

    The warped volume and its gradient (central differences) are stored, and one sensitivity volume after the other
    is projected by pdvc's own projector, each only as high as its section's hat function.
    """
    grid = volume.grid
    z, y, x = (grid.origin_mm[2 - i] + grid.voxel_mm * np.arange(grid.shape[i]) for i in range(3))
    points = np.stack([a.ravel() for a in np.meshgrid(z, y, x, indexing="ij")][::-1], axis=-1)
    moved = points - basis.displacement(amplitude, points) * voxel_mm
    index = ((moved - np.array(grid.origin_mm)) / grid.voxel_mm).T[::-1]

    def at_moved(values: Image) -> Image:
        sampled = ndimage.map_coordinates(values, index, order=1, mode="constant", output=np.float32)
        return np.asarray(sampled.reshape(grid.shape))

    warped = at_moved(volume.values)
    gradient = [at_moved(part) for part in np.gradient(volume.values)[::-1]]  # x, y, z, per voxel of this grid
    still = SectionBasis(height_mm=np.zeros(1), radius_mm=1.0)
    hull = volume.hull.grown((2 + float(np.abs(amplitude).max()) * 3) * voxel_mm)

    def projected(values: Image, first: int) -> Image:
        """Project the layers of a volume from `first` on."""
        x0, y0, z0 = grid.origin_mm
        part = replace(grid, shape=values.shape, origin_mm=(x0, y0, z0 + first * grid.voxel_mm))
        at_rest = np.zeros((1, *still.shape))
        volume = Volume(values=values, grid=part, hull=hull)
        return project(volume, rays[None], target.shape, still, at_rest, voxel_mm=voxel_mm)[0]

    residual = (projected(warped, 0) - target).ravel().astype(float)
    weights = basis.weights(z)
    layers = points.reshape(*grid.shape, 3)
    columns = []
    for j in range(basis.shape[0]):
        reached = np.flatnonzero(weights[:, j])
        # one empty layer at either end, so that interpolation ends in air there too
        first, last = max(reached[0] - 1, 0), min(reached[-1] + 2, len(z))
        hat = weights[first:last, j, None, None] * (voxel_mm / grid.voxel_mm)
        for pattern in basis.patterns()[j]:
            motion = layers[first:last] @ pattern[:, :3].T + pattern[:, 3]
            field = hat * sum(motion[..., i] * gradient[i][first:last] for i in range(3))
            columns.append(sparse.csc_array(projected(field.astype(np.float32), first).reshape(-1, 1), dtype=float))
    stored = sparse.hstack(columns, format="csc")
    size = stored.data.nbytes + stored.indices.nbytes + stored.indptr.nbytes
    return (stored.T @ stored).toarray(), stored.T @ residual, size


def by_differences(
    volume: Volume, rays: Floats, basis: SectionBasis, amplitude: Floats, target: Image, voxel_mm: float
) -> tuple[Floats, Floats]:
    """Return B and c from S by central differences of the projection: slow, but no other gradient than its own."""
    step = 0.05

    def projected(trial: Floats) -> Floats:
        image = project(volume, rays[None], target.shape, basis, trial[None], voxel_mm=voxel_mm)[0]
        return image.ravel().astype(float)

    columns = []
    for index in np.ndindex(basis.shape):
        change = np.zeros(basis.shape)
        change[index] = step
        columns.append((projected(amplitude - change) - projected(amplitude + change)) / (2 * step))
    stored = np.stack(columns, axis=1)
    return stored.T @ stored, stored.T @ (projected(amplitude) - target.ravel())
