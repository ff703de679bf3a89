"""The sample's surface as it moves, with displacement, strain and their standard deviations, for ParaView."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pdvc.measurement import Measurement
from pdvc.progress import Progress, silent
from validation.doors.material import Motion, motion_of
from validation.doors.surface import Surface
from validation.doors.vtu import write_pvd, write_vtu

SERIES = "motion.pvd"


def write_series(measurement: Measurement, surface: Surface, folder: Path, *, progress: Progress = silent) -> Path:
    """Write one grid for each step that was measured, and the series of them, whose path is returned.

    Points carry ``displacement_mm`` of their material, ``deviation_mm`` (its standard deviations across the beam,
    vertical and along the beam) and ``observed``; cells ``strain``, the vertical strain between their lower and upper
    edge, and ``strain_deviation``. What was not observed is NaN, and moves as what is next to it.
    """
    recording, files = measurement.recording, []
    times = recording.time_s if np.all(np.diff(recording.time_s) > 0) else np.arange(float(recording.steps))
    for step in range(recording.steps):
        motion = motion_of(measurement, step)
        if motion is not None:
            name = f"motion_{step:05d}.vtu"
            _write_step(folder / name, motion, surface)
            files.append((float(times[step]), name))
        progress("surface", step + 1, recording.steps)
    write_pvd(folder / SERIES, files)
    return folder / SERIES


def _write_step(path: Path, motion: Motion, surface: Surface) -> None:
    rest, (lower, upper) = surface.flat_mm, surface.edges_mm()
    moved, lower, upper = (motion.current(points) for points in (rest, lower, upper))
    seen = motion.observed(moved)
    strain, deviation = motion.strain(lower, upper)
    between = motion.observed(lower) & motion.observed(upper)
    write_vtu(
        path,
        moved,
        surface.quads(),
        {
            "displacement_mm": np.where(seen[:, None], moved - rest, np.nan).astype(np.float32),
            "deviation_mm": np.where(seen[:, None], motion.deviation(moved), np.nan).astype(np.float32),
            "observed": seen.astype(np.uint8),
        },
        {
            "strain": np.where(between, strain, np.nan).astype(np.float32),
            "strain_deviation": np.where(between, deviation, np.nan).astype(np.float32),
        },
    )
