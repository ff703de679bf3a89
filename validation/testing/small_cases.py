"""Small cases to test with: experiments of a few dozen radiographs, and radiographs made by pdvc's own projector.

`SmallExperiment` goes the whole way: a scenario is simulated and measured from its counts, each in a fraction of a
second. `ProjectedCase` has no simulator, no counts and no noise: a textured volume is moved by known amplitudes and
projected by `pdvc.projection.project`, so that a solver must give them back almost exactly.

Both are described by a few plain values, and made when they are first asked for. `validation.testing.strategies`
draws them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.equations import Equations, Images, linearise
from pdvc.experiment import Experiment, Series, read_experiment
from pdvc.gauss_newton import GaussNewton
from pdvc.geometry import ConeBeam
from pdvc.history import PAPER, Angle, Polynomial, Ramp, time_basis
from pdvc.measurement import Measurement
from pdvc.options import MeasureOptions, StageOptions
from pdvc.pgd import Pgd
from pdvc.projection import project
from pdvc.protocol import measure
from pdvc.rays import ray_vectors
from pdvc.sections import RIGID, SectionBasis, names_of
from pdvc.volume import Grid, Hull, Volume, hull_of
from simulator.scanner import simulate
from simulator.scenario import Scenario
from simulator.truth import Truth, read_truth

Floats = NDArray[np.float64]

_SMALL = """{
    "name": "small-case",
    "title": "In situ tension of cast iron, small enough for a test",
    "discarded_rows": 12,
    "graphite": {"mean_diameter_mm": 0.35, "smallest_diameter_mm": 0.2, "largest_diameter_mm": 0.6, "gap_mm": 0.02},
    "geometry": {"pixel_mm": 3.6, "rows": 76, "columns": 44},
    "acquisition": {"reference_views": 40, "test_steps": 18, "steps_per_turn": 10, "subpixels": 2},
    "loading": {"plateau_steps": 10, "stroke_mm_per_s": 0.018, "necking_steps": 3}
}"""


def small_scenario(changes: Mapping[str, Any] | None = None) -> Scenario:
    """Return the paper's test seen twelve times coarser: 40 views, one turn at constant load, 8 steps of loading.

    A voxel is 0.129 mm, the sample some ten voxels thick, a nodule three. `changes` are values by dotted key, as
    ``{"seed": 3, "geometry.rows": 60}``. Raises SettingsError where a key or a value is none of a scenario's.
    """
    values = json.loads(_SMALL)
    for key, value in (changes or {}).items():
        *path, last = key.split(".")
        table = values
        for part in path:
            table = table.setdefault(part, {})
        table[last] = value
    return Scenario.parse(values, where="small_scenario")


def small_options(scenario: Scenario) -> MeasureOptions:
    """Return a protocol that measures a small scenario: four sections, Table 1 with its kink at the start of loading.

    Direct solves are repeated until a change is below a thousandth of a voxel. Rows are left out as the scenario says:
    with the usual tenth of so few, rays of the used ones would leave the volume through its top and bottom.
    """
    return MeasureOptions(
        discard_rows=scenario.discarded_rows,
        sections=4,
        section_motions=names_of(RIGID),
        time=(*PAPER[:3], Ramp(start=scenario.loading.plateau_steps, powers=(1, 2))),
        rigid=(StageOptions(scale=2, solver=Pgd(most_modes=3, passes_per_mode=6)),),
        deformation=(StageOptions(scale=1, solver=GaussNewton(most_passes=8, least_change_voxel=1e-3)),),
    )


@dataclass(frozen=True)
class SmallExperiment:
    """A small scenario; what follows from it is made once and kept for the next who asks."""

    scenario: Scenario

    @property
    def experiment(self) -> Experiment:
        """Return what the simulated scanner hands over, in memory."""
        return _simulated(self.scenario)[0]

    @property
    def truth(self) -> Truth:
        """Return the true motion."""
        return _simulated(self.scenario)[1]

    @property
    def options(self) -> MeasureOptions:
        """Return the options of `measurement`: `small_options`."""
        return small_options(self.scenario)

    @property
    def measurement(self) -> Measurement:
        """Return what `pdvc.protocol.measure` makes of the experiment."""
        return _measured(self.scenario)

    def __repr__(self) -> str:
        """Tell how the scenario differs from `small_scenario()`; evaluates to an equal one."""
        usual = dict(_leaves(json.loads(small_scenario().model_dump_json())))
        here = dict(_leaves(json.loads(self.scenario.model_dump_json())))
        return f"SmallExperiment(small_scenario({ {k: v for k, v in here.items() if v != usual[k]} }))"


def _leaves(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


@lru_cache(maxsize=8)
def _simulated(scenario: Scenario) -> tuple[Experiment, Truth]:
    with TemporaryDirectory() as name:
        folder = Path(name)
        simulate(scenario, folder, workers=1)
        opened, truth = read_experiment(folder), read_truth(folder)

        def loaded(series: Series) -> Series:
            return replace(series, counts=np.array(series.counts))

        experiment = replace(
            opened,
            reference=loaded(opened.reference),
            test=loaded(opened.test),
            flats=np.array(opened.flats),
            darks=np.array(opened.darks),
            interrupted=tuple(replace(scan, series=loaded(scan.series)) for scan in opened.interrupted),
        )
    return experiment, truth


@lru_cache(maxsize=8)
def _measured(scenario: Scenario) -> Measurement:
    return measure(_simulated(scenario)[0], small_options(scenario))


@lru_cache(maxsize=8)
def textured_volume(shape: tuple[int, int, int], voxel_mm: float, *, blur_voxel: float = 1.2, seed: int = 0) -> Volume:
    """Return an elliptical bar full of texture, with soft edges, in a grid (z, y, x) with air around.

    The bar's half axes are 4 voxels short of the grid's; its middle lies a little off the axis. Texture is white
    noise blurred by a Gaussian of standard deviation `blur_voxel`, a third of the bar's mean in standard deviation.
    """
    z, y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in shape), indexing="ij")
    half_z, half_y, half_x = (n / 2 - 4 for n in shape)
    bar = (((x / half_x) ** 2 + (y / half_y) ** 2 < 1) & (np.abs(z) < half_z)).astype(float)
    grain = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), blur_voxel)
    body = ndimage.gaussian_filter(bar * (1 + 0.35 * grain / grain.std()), 0.6, truncate=3)
    return placed_volume(np.where(body > 1e-3, body, 0).astype(np.float32), voxel_mm)


def placed_volume(values: NDArray[np.float32], voxel_mm: float) -> Volume:
    """Place an array (z, y, x), grey levels per mm, with its middle a little off the axis, in its hull."""
    nz, ny, nx = values.shape
    x, y, z = (-(n - 1) / 2 * voxel_mm + off * voxel_mm for n, off in ((nx, 0.4), (ny, -0.6), (nz, 0.2)))
    grid = Grid(shape=(nz, ny, nx), voxel_mm=voxel_mm, origin_mm=(x, y, z))
    return Volume(values=values, grid=grid, hull=hull_around(values, grid))


def hull_around(values: NDArray[np.float32], grid: Grid) -> Hull:
    """Return the hull of all voxels that are not zero, with the margin that measurements use: three voxels."""
    near = ndimage.binary_dilation(values != 0, np.ones((3, 3, 3)))
    return hull_of(near, grid, 4).grown(3 * grid.voxel_mm)


@dataclass(frozen=True, eq=False)
class ProjectedCase:
    """A textured bar, a scanner, and a motion that is known; radiographs follow by pdvc's own projector.

    The voxel of the volume is the scanner's. Time functions are sine and cosine of the angle, 1 and t: four.
    """

    scanner: ConeBeam
    sections: SectionBasis
    angle_rad: Floats
    """Stage angle (step,), rad."""
    coefficients: Floats
    """True amplitudes (function, section, motion), voxels."""
    seed: int = 0
    """Of the texture."""

    @cached_property
    def time_functions(self) -> Floats:
        """Return the orthonormal time functions (function, step)."""
        steps = len(self.angle_rad)
        blank = np.zeros((steps, 1, 1), dtype=np.uint16)
        record = Series(
            counts=blank, angle_rad=self.angle_rad, time_s=np.arange(steps, dtype=float), force_N=np.zeros(steps)
        )
        return time_basis((Angle(), Polynomial(degree=1)), record)

    @property
    def amplitude(self) -> Floats:
        """Return the true amplitudes (step, section, motion), voxels."""
        return np.asarray(np.einsum("ft,fjk->tjk", self.time_functions, self.coefficients))

    @property
    def volume(self) -> Volume:
        """Return the bar: as high as the detector and 18 voxels more, three fifths as wide, half as deep."""
        rows, columns = self.scanner.rows, self.scanner.columns
        shape = (rows + 18, columns // 2 + 4, 3 * columns // 5 + 8)
        return textured_volume(shape, self.scanner.voxel_mm, seed=self.seed)

    @cached_property
    def images(self) -> Images:
        """Return the radiographs of the moved bar, without noise, every pixel of weight one."""
        shape = (self.scanner.rows, self.scanner.columns)
        rays, volume, voxel_mm = (
            ray_vectors(self.scanner, self.angle_rad).stacked(),
            self.volume,
            self.scanner.voxel_mm,
        )
        return Images(
            rays=rays,
            grey=project(volume, rays, shape, self.sections, self.amplitude, voxel_mm=voxel_mm),
            weight=np.ones((1, *shape), dtype=np.float32),
            volume=volume,
            systematic=None,
            voxel_mm=voxel_mm,
        )

    def equations(self, amplitude: Floats) -> Equations:
        """Return the equations at trial amplitudes (step, section, motion), voxels: what solvers ask for."""
        return linearise(self.images, self.sections, amplitude)
