"""Look at an experiment folder before anything is measured: what was found, what is proposed, what it will take."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from pdvc.compilation import compile_kernels
from pdvc.data_checks import doubts_of_data, doubts_of_time, usable
from pdvc.equations import memory_bytes
from pdvc.examination import Examination
from pdvc.experiment import Experiment
from pdvc.options import DEFAULT, MeasureOptions
from pdvc.progress import Progress, silent
from pdvc.projection import normal_equations
from pdvc.rays import ray_vectors
from pdvc.setup import Setup, set_up
from pdvc.verdict import Doubt
from pdvc.volume import Volume
from pdvc.window import scan_grid


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """What a measurement is expected to take on this machine, to about a factor of two."""

    seconds: float
    memory_gib: float
    unknowns: int


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """What a folder holds, and what measuring it with the given options would do."""

    found: Examination
    window: tuple[int, int, int, int]
    """Proposed rows and columns: row_from, row_to, column_from, column_to."""
    cost: Forecast
    doubts: tuple[Doubt, ...]


def inspect(experiment: Experiment, options: MeasureOptions = DEFAULT, *, progress: Progress = silent) -> Inspection:
    """Examine an experiment, outline the sample coarsely, and work out window and cost.

    Raises ValueError, in one line, where the data cannot be used.
    """
    found = usable(experiment, progress=progress)
    started = time.perf_counter()
    setup = set_up(experiment, options, progress=progress)
    outlining = time.perf_counter() - started
    return Inspection(
        found=found,
        window=setup.window,
        cost=_cost(setup, outlining, progress),
        doubts=(*doubts_of_data(found, experiment), *doubts_of_time(setup.options.time, experiment.test)),
    )


def _cost(setup: Setup, outlining_s: float, progress: Progress) -> Forecast:
    """Time one radiograph on a volume as large as that of scale 1, and count passes, voxels and pixels."""
    experiment, geometry, window, basis = setup.experiment, setup.geometry, setup.window, setup.sections
    steps, hull = len(experiment.test), setup.outline.hull
    compile_kernels(progress=progress)
    grid = scan_grid(geometry, hull)
    volume = Volume(values=np.ones(grid.shape, dtype=np.float32), grid=grid, hull=hull)
    rays = ray_vectors(geometry.cropped(*window), experiment.test.angle_rad[:1]).stacked()
    target = np.zeros((1, window[1] - window[0], window[3] - window[2]), dtype=np.float32)
    started = time.perf_counter()
    normal_equations(
        volume, rays, basis, np.zeros((1, *basis.shape)), target, np.ones_like(target), voxel_mm=grid.voxel_mm
    )
    pass_s = steps * (time.perf_counter() - started)
    # two residual fields, and what propagating the noise takes
    stages = (*setup.options.rigid, *setup.options.deformation)
    # at a coarser scale rays are fewer and shorter
    passes = sum(stage.solver.passes / stage.scale**2 for stage in stages) + 3
    voxels, reference = float(np.prod(grid.shape)), experiment.reference.counts
    # the outline took two coarse reconstructions of some 150 views; scale 1 has more of both
    rows = min(geometry.rows, 240)
    finer = (geometry.rows / rows) ** 3 * len(reference) / min(len(reference), 150)
    time_functions = setup.options.deformation[-1].solver.functions(setup.time_functions())
    pixels = float(geometry.rows * geometry.columns)
    memory = 8 * voxels + 4 * pixels * len(reference) / 2 + 24 * steps * target.size
    memory += memory_bytes(time_functions, basis)
    return Forecast(
        seconds=pass_s * passes + outlining_s * (1 + finer / 2),
        memory_gib=memory / 2**30 + 0.3,
        unknowns=len(time_functions) * basis.shape[0] * basis.shape[1],
    )
