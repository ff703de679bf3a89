"""The case that is timed: the built-in scenarios' scanner and sample, with a made-up texture instead of a scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.beam_hardening import SLAB_VOXELS
from pdvc.geometry import ConeBeam
from pdvc.projection import project
from pdvc.rays import ray_vectors
from pdvc.reconstruction import seen_half_height_mm
from pdvc.sections import CONTRACTION, RIGID, SectionBasis
from pdvc.volume import Grid, Hull, Volume, hull_of
from simulator.scenario import Scenario, load_scenario
from simulator.specimen import Specimen, depth_mm

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

COARSE = 4
"""The hull is found on voxels this many times larger, as pdvc.protocol does at full size."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A textured volume of a scenario's sample, and the detector windows that look at it."""

    scenario: Scenario
    geometry: ConeBeam
    """The whole detector."""
    corner: tuple[int, int]
    """Rows and columns that a measurement leaves out on each side."""
    volume: Volume
    sample: Hull
    """Encloses the sample, as a measurement finds it: what is reconstructed."""

    @property
    def window(self) -> ConeBeam:
        """Return the part of the detector that a measurement uses."""
        rows, columns = self.corner
        return self.geometry.cropped(rows, self.geometry.rows - rows, columns, self.geometry.columns - columns)

    def basis(self, sections: int = 15, motions: int = 6) -> SectionBasis:
        """Return sections over the used height, with the paper's motions and, for 7, contraction."""
        low, high = self.sample.box_mm()
        reach = self.scenario.view_mm
        return SectionBasis(
            height_mm=np.linspace(-reach, reach, sections) if sections > 1 else np.zeros(1),
            radius_mm=float(np.hypot(*(high - low)[:2]) / 4),
            motions=(*RIGID, CONTRACTION)[:motions],
        )

    def rays(self, window: ConeBeam, angle_rad: float | Floats) -> Floats:
        """Return the rays (step, 4, 3) of a window at stage angles, mm."""
        return ray_vectors(window, angle_rad).stacked()

    def project(self, window: ConeBeam, angle_rad: float) -> Image:
        """Return one radiograph (row, column) of the sample at rest, by pdvc's projector."""
        still = self.basis(1)
        return project(
            self.volume,
            self.rays(window, angle_rad),
            (window.rows, window.columns),
            still,
            np.zeros((1, *still.shape)),
            voxel_mm=self.volume.grid.voxel_mm,
        )[0]


def case(name: str = "jailin2018", rows: int | None = None) -> Case:
    """Return the case of a built-in scenario, or the same made coarser until the detector has about `rows` rows."""
    scenario = load_scenario(name)
    geometry = scenario.geometry.cone_beam()
    if rows is not None and rows < geometry.rows:
        geometry = _resampled(geometry, rows)
    voxel = geometry.voxel_mm
    coarse = max(1, round(geometry.rows / 240))
    sample = _hull(scenario.specimen, geometry, voxel * coarse)
    low, high = sample.box_mm()
    radius = float(np.hypot(*np.maximum(np.abs(low), np.abs(high))[:2]))
    reach = seen_half_height_mm(geometry, radius)
    low, high = low - 2 * voxel, high + 2 * voxel
    low[2], high[2] = max(low[2], -reach), min(high[2], reach)
    grid = Grid.around(low, high, voxel)
    return Case(
        scenario=scenario,
        geometry=geometry,
        corner=(round(geometry.rows * 100 / 954), round(geometry.columns * 60 / 432)),
        volume=Volume(values=_textured(scenario.specimen, grid), grid=grid, hull=sample.grown(3 * voxel)),
        sample=sample,
    )


def amplitude(basis: SectionBasis, size_voxel: float, seed: int = 0) -> Floats:
    """Return smooth amplitudes (section, motion) of about this size, voxels: a trial motion."""
    rng = np.random.default_rng(seed)
    along = np.linspace(-1, 1, basis.shape[0])[:, None]
    start, slope = rng.uniform(-1, 1, (2, 1, basis.shape[1]))
    return np.asarray(size_voxel * (start + slope * along))


def _resampled(geometry: ConeBeam, rows: int) -> ConeBeam:
    """Return a geometry of the same field of view with another number of pixels."""
    factor = geometry.rows / rows
    return ConeBeam(
        source_axis_mm=geometry.source_axis_mm,
        source_detector_mm=geometry.source_detector_mm,
        pixel_mm=geometry.pixel_mm * factor,
        rows=rows,
        columns=round(geometry.columns / factor),
    )


def _points(grid: Grid, k: int) -> Floats:
    """Return the voxel centres (point, 3) of a layer, mm."""
    x, y, z = (grid.origin_mm[i] + grid.voxel_mm * np.arange(grid.shape[2 - i]) for i in range(3))
    return np.stack([np.tile(x, len(y)), np.repeat(y, len(x)), np.full(len(x) * len(y), z[k])], axis=-1)


def _hull(specimen: Specimen, geometry: ConeBeam, voxel_mm: float) -> Hull:
    """Return the hull of the sample as pdvc.beam_hardening would find it on voxels of this size."""
    radius = (geometry.columns / 2 - 1) * geometry.voxel_mm
    height = seen_half_height_mm(geometry, radius)
    grid = Grid.around(np.array([-radius, -radius, -height]), np.array([radius, radius, height]), voxel_mm)
    inside = np.stack([depth_mm(specimen, _points(grid, k)) > 0 for k in range(grid.shape[0])]).reshape(grid.shape)
    return hull_of(inside, grid, SLAB_VOXELS).grown(2 * voxel_mm)


def _textured(specimen: Specimen, grid: Grid, seed: int = 0) -> Image:
    """Return the sample's attenuation, 0.5 to 1.5 grey levels per mm, with blobs about eight voxels wide."""
    from scipy import ndimage

    rng = np.random.default_rng(seed)
    tile = ndimage.gaussian_filter(rng.standard_normal((96, 96, 96)).astype(np.float32), 2.0, mode="wrap")
    tile = 1 + np.clip(tile / (4 * tile.std()), -0.5, 0.5)
    values = np.zeros(grid.shape, dtype=np.float32)
    rows, columns = np.arange(grid.shape[1]) % 96, np.arange(grid.shape[2]) % 96
    for k in range(1, grid.shape[0] - 1):
        # the surface passes from 0 to 1 over two voxels, as a scan would show it
        part = np.clip(0.5 + depth_mm(specimen, _points(grid, k)) / (2 * grid.voxel_mm), 0, 1).reshape(grid.shape[1:])
        values[k] = part * tile[k % 96][np.ix_(rows, columns)]
    values[:, [0, -1]] = 0
    values[:, :, [0, -1]] = 0
    return values
