"""A plain implementation of the paper's step: warp the volume, project each Phi_i . grad F, store S, multiply."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from pdvc.projection import project
from pdvc.sections import SectionBasis
from pdvc.volume import Hull, Volume

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

    def projected(values: Image, bound: Hull) -> Image:
        part = Volume(values=values, grid=grid, hull=bound)
        return project(part, rays, target.shape, still, np.zeros(still.shape), voxel_mm=voxel_mm)

    residual = (projected(warped, hull) - target).ravel().astype(float)
    weights = basis.weights(z)
    columns = []
    for j in range(basis.shape[0]):
        within = np.flatnonzero(weights[:, j])
        low, high = z[within[0]] - grid.voxel_mm, z[within[-1]] + grid.voxel_mm
        bottoms = hull.z_mm + hull.slab_mm * np.arange(len(hull.support_mm))
        used = (bottoms < high) & (bottoms + hull.slab_mm > low)
        bound = Hull(
            z_mm=hull.z_mm, slab_mm=hull.slab_mm, support_mm=np.where(used[:, None], hull.support_mm, -np.inf)
        )
        for pattern in basis.patterns()[j]:
            motion = points @ pattern[:, :3].T + pattern[:, 3]
            field = sum(motion[:, i].reshape(grid.shape) * gradient[i] for i in range(3))
            field = np.asarray(weights[:, j, None, None] * field * (voxel_mm / grid.voxel_mm), dtype=np.float32)
            columns.append(sparse.csc_array(projected(field, bound).reshape(-1, 1), dtype=float))
    stored = sparse.hstack(columns, format="csc")
    size = stored.data.nbytes + stored.indices.nbytes + stored.indptr.nbytes
    return (stored.T @ stored).toarray(), stored.T @ residual, size
