"""Displacement and strain as one table, for material points and for places in space: CSV, or Parquet.

Each row is a point at a step. In rows of ``material`` coordinates the point at rest, X, is the same at all steps; in
rows of ``spatial`` ones its current place, x, is. Both places are told in all rows, x = X + u.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.measurement import Measurement
from pdvc.whole import write_whole
from validation.doors.material import Motion, motion_of
from validation.doors.quantities import LENGTH
from validation.doors.scan import Floats
from validation.doors.tables import read_table

MATERIAL, SPATIAL = "material", "spatial"
Columns = dict[str, NDArray[Any]]


def default_points(measurement: Measurement) -> tuple[Floats, float]:
    """Return points (point, 3), mm, midway between sections, on the axis and around it, and a section's height, mm."""
    height, radius = measurement.motion.basis.height_mm, measurement.motion.basis.radius_mm
    middles, gauge = height, radius
    if len(height) > 1:
        middles, gauge = (height[1:] + height[:-1]) / 2, float(np.diff(height).mean())
    around = radius * np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
    return np.array([[x, y, z] for z in middles for x, y in around]), gauge


def read_points(path: Path) -> Floats:
    """Read points (point, 3), mm, from the columns x, y and z of a table."""
    table = read_table(path)
    return np.stack([table.numbers([axis], LENGTH) for axis in "xyz"], axis=1)


def motion_table(measurement: Measurement, points_mm: Floats, gauge_mm: float) -> Columns:
    """Return the columns (row,): both coordinates, all steps that were measured, all points.

    The strain is the vertical one over `gauge_mm` above and below the point, half of it each way, of the length at
    rest. NaN where the point, or an end of the gauge, is outside the observed sections.
    """
    parts = list(_steps(measurement, points_mm, gauge_mm))
    if not parts:
        raise ValueError("motion: expected at least one step that was measured, found none")
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _steps(measurement: Measurement, points_mm: Floats, gauge_mm: float) -> Iterator[Columns]:
    half = np.array([0.0, 0.0, gauge_mm / 2])
    recording = measurement.recording
    for coordinates in (MATERIAL, SPATIAL):
        for step in range(recording.steps):
            motion = motion_of(measurement, step)
            if motion is None:
                continue
            lower, current, upper = points_mm - half, points_mm, points_mm + half
            rest = current - motion.displacement(current)
            if coordinates == MATERIAL:
                rest = points_mm
                lower, current, upper = (motion.current(each) for each in (lower, current, upper))
            yield {
                "coordinates": np.full(len(points_mm), coordinates),
                "step": np.full(len(points_mm), step),
                "point": np.arange(len(points_mm)),
                "time_s": np.full(len(points_mm), recording.time_s[step]),
                "force_N": np.full(len(points_mm), recording.force_N[step]),
                "angle_deg": np.full(len(points_mm), np.rad2deg(recording.angle_rad[step])),
                **_of_points(motion, rest, current, (lower, upper)),
            }


def _of_points(motion: Motion, rest: Floats, current: Floats, ends: tuple[Floats, Floats]) -> Columns:
    """Return what is told of points, at rest and now, and of gauges about them, by their current ends (point, 3)."""
    seen = motion.observed(current)
    u = np.where(seen[:, None], motion.displacement(current), np.nan)
    deviation = np.where(seen[:, None], motion.deviation(current), np.nan)
    strain, of_strain = motion.strain(*ends)
    between = motion.observed(ends[0]) & motion.observed(ends[1])
    return {
        **{f"rest_{axis}_mm": rest[:, k] for k, axis in enumerate("xyz")},
        **{f"{axis}_mm": current[:, k] for k, axis in enumerate("xyz")},
        **{f"u_{axis}_mm": u[:, k] for k, axis in enumerate("xyz")},
        **{f"std_{name}_mm": deviation[:, k] for k, name in enumerate(("across", "vertical", "along"))},
        "strain": np.where(between, strain, np.nan),
        "strain_std": np.where(between, of_strain, np.nan),
    }


def write_csv(path: Path, columns: Columns) -> None:
    """Write a table as text, numbers with all digits, NaN as nothing."""
    texts = [[_text(value) for value in values.tolist()] for values in columns.values()]
    rows = [",".join(row) for row in zip(*texts, strict=True)]
    write_whole(path, "\n".join([",".join(columns), *rows, ""]).encode())


def check_parquet() -> None:
    """Raise ImportError, naming the extra, where what Parquet needs is not installed."""
    from pdvc_bench import check_extra

    check_extra("parquet", "pyarrow")


def write_parquet(path: Path, columns: Columns) -> None:
    """Write a table as Parquet, NaN as null; `check_parquet` first tells whether it can be."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    sink = pa.BufferOutputStream()
    parquet.write_table(table, sink)
    write_whole(path, memoryview(sink.getvalue()))


def _text(value: Any) -> str:
    return "" if value != value else value if isinstance(value, str) else repr(value)
