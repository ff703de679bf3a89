"""Displacement and strain where a user asks for them, with standard deviations, in mm and with names for the axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from pdvc.deviations import BEAM, beam_frame
from pdvc.measurement import Measurement

Floats = NDArray[np.float64]


def displacement(measurement: Measurement, points_mm: ArrayLike, steps: Sequence[int] | None = None) -> xr.Dataset:
    """Return u, mm, at points of the *current* configuration, with its standard deviations.

    `points_mm` (point, 3), mm: x, y, z in the sample's frame (`pdvc.geometry`); `steps` all unless given. In the
    dataset ``displacement`` (step, point, component) is along x, y, z; ``turned`` (step, point, direction) is across
    the beam, vertical and along the beam of each step, and ``deviation`` are the standard deviations of that. NaN
    where no observed section takes part. Raises ValueError for points of another shape.
    """
    points, chosen = np.asarray(points_mm, dtype=float), _steps(measurement, steps)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points_mm: expected (point, 3), got an array of shape {points.shape}")
    motion, voxel_mm = measurement.motion, measurement.recording.voxel_mm
    moved = np.stack([motion.displacement(step, points) for step in chosen]) * voxel_mm
    frame = beam_frame(measurement.recording.angle_rad[chosen])
    deviation = np.stack([measurement.turned_std(step, points) for step in chosen]) * voxel_mm
    unit = {"units": "mm"}
    return xr.Dataset(
        {
            "displacement": (("step", "point", "component"), moved, unit),
            "turned": (("step", "point", "direction"), moved @ frame.transpose(0, 2, 1), unit),
            "deviation": (("step", "point", "direction"), np.where(np.isnan(moved), np.nan, deviation), unit),
        },
        coords={
            "component": ["x", "y", "z"],
            "direction": list(BEAM),
            **{axis: ("point", points[:, k], unit) for k, axis in enumerate("xyz")},
            **_of_steps(measurement, chosen),
        },
        attrs={"title": measurement.recording.title, "verdict": measurement.verdict.word},
    )


def strain(
    measurement: Measurement, heights_mm: ArrayLike | None = None, steps: Sequence[int] | None = None
) -> xr.Dataset:
    """Return the axial strain between heights on the axis, of the length at rest, with its standard deviation.

    `heights_mm` (height,), increasing, mm, of the *current* configuration; those of the sections unless given. With s
    the rise of u_z over the current distance, the strain of the length at rest is s / (1 - s). In the dataset
    ``strain`` and ``deviation`` are (step, interval), without unit; NaN where no observed section takes part.
    """
    basis = measurement.motion.basis
    heights = np.asarray(basis.height_mm if heights_mm is None else heights_mm, dtype=float)
    chosen = _steps(measurement, steps)
    if heights.ndim != 1 or len(heights) < 2 or np.any(np.diff(heights) <= 0):
        raise ValueError(f"heights_mm: expected two or more, increasing, got {heights.tolist()}")
    points = np.zeros((len(heights), 3))
    points[:, 2] = heights
    rise = np.stack([measurement.motion.displacement(step, points)[:, 2] for step in chosen])
    slope = np.diff(rise, axis=1) * measurement.recording.voxel_mm / np.diff(heights)
    of_slope = np.stack([measurement.strain_std(step, heights) for step in chosen])
    return xr.Dataset(
        {
            "strain": (("step", "interval"), slope / (1 - slope)),
            # the derivative of s / (1 - s)
            "deviation": (("step", "interval"), np.where(np.isnan(slope), np.nan, of_slope) / (1 - slope) ** 2),
        },
        coords={
            "z": ("interval", (heights[1:] + heights[:-1]) / 2, {"units": "mm"}),
            **_of_steps(measurement, chosen),
        },
        attrs={"title": measurement.recording.title, "verdict": measurement.verdict.word},
    )


def _steps(measurement: Measurement, steps: Sequence[int] | None) -> list[int]:
    count = measurement.recording.steps
    chosen = list(range(count)) if steps is None else [int(step) for step in steps]
    wrong = [step for step in chosen if not 0 <= step < count]
    if wrong or not chosen:
        raise ValueError(f"steps: expected some of 0 to {count - 1}, got {steps}")
    return chosen


def _of_steps(measurement: Measurement, chosen: list[int]) -> dict[str, object]:
    recording = measurement.recording
    return {
        "step": chosen,
        "time": ("step", recording.time_s[chosen], {"units": "s"}),
        "force": ("step", recording.force_N[chosen], {"units": "N"}),
    }
