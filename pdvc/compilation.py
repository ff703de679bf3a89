"""Compile the kernels before they are needed, so that the wait is shown as what it is.

Numba keeps compiled kernels on disk beside the package (or in NUMBA_CACHE_DIR): only the first use of an
installation compiles, later ones load.
"""

from __future__ import annotations

import numpy as np

from pdvc.equations import Images
from pdvc.geometry import ConeBeam
from pdvc.noise import known_from_residual, propagate
from pdvc.progress import Progress, silent
from pdvc.projection import normal_equations, project
from pdvc.rays import ray_vectors
from pdvc.reconstruction import fdk
from pdvc.sections import SectionBasis
from pdvc.systematic import Systematic
from pdvc.volume import Grid, Volume, hull_of
from pdvc.volume_equations import VolumePair, compare

TASK = "load or compile kernels"


def compile_kernels(*, progress: Progress = silent) -> None:
    """Call every kernel once on a few voxels."""
    geometry = ConeBeam(source_axis_mm=20, source_detector_mm=40, pixel_mm=0.2, rows=6, columns=8)
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    grid = Grid(shape=(6, 5, 7), voxel_mm=0.1, origin_mm=(-0.3, -0.2, -0.25))
    hull = hull_of(np.ones(grid.shape, dtype=bool), grid, 2)
    views = np.ones((len(angle), geometry.rows, geometry.columns), dtype=np.float32)
    progress(TASK, 0, 3)
    volume = Volume(values=fdk(lambda i: views[i], geometry, angle, grid, hull), grid=grid, hull=hull)
    progress(TASK, 1, 3)
    basis = SectionBasis(height_mm=np.array([-0.2, 0.2]), radius_mm=0.2)
    rays, still = ray_vectors(geometry, angle[:1]).stacked(), np.zeros((1, *basis.shape))
    normal_equations(volume, rays, basis, still, views[:1], views[:1], voxel_mm=0.1)
    project(volume, rays, (geometry.rows, geometry.columns), basis, still, voxel_mm=0.1)
    progress(TASK, 2, 3)
    shape = (geometry.rows, geometry.columns)
    systematic = Systematic(
        left=lambda i: views[i],
        view_rad=angle,
        step_rad=angle[:1],
        corner=(0, 0),
        shape=shape,
        detector=shape,
        width_rad=0.1,
    )
    systematic.registered(slice(0, 1), rays, basis, still, 0.1)
    images = Images(
        rays=rays, grey=views[:1], weight=views[:1], volume=volume, systematic=systematic, voxel_mm=grid.voxel_mm
    )
    propagate(images, systematic, basis, still, np.ones((1, 1)), known_from_residual(1.0, shape, shape, 0))
    progress(TASK, 3, 3)


def compile_comparison() -> None:
    """Call the kernel of volume correlation once on a few voxels."""
    grid = Grid(shape=(4, 3, 3), voxel_mm=1.0, origin_mm=(0.0, 0.0, 0.0))
    used = np.ones(grid.shape, dtype=bool)
    volume = Volume(values=np.zeros(grid.shape, dtype=np.float32), grid=grid, hull=hull_of(used, grid, 2))
    basis = SectionBasis(height_mm=np.zeros(1), radius_mm=1.0)
    pair = VolumePair(reference=volume, deformed=volume, used=used, voxel_mm=1.0)
    compare(pair, basis, np.zeros(basis.shape))
