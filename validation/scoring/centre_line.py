"""Motion of the material on the rotation axis, measured and true, for the history figures and the strain.

The measured u is a function of the *current* position x. A material point X that moved to x = X + U(X, t)
is therefore asked for at x, and what comes back is compared with U(X, t).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import points_on_axis
from pdvc.measurement import Measurement, MeasurementError

Floats = NDArray[np.float64]


class TruePoints(Protocol):
    """What is asked for the true motion of material points."""

    @property
    def point_mm(self) -> Floats:
        """Return the reference positions X (point, 3), mm."""

    @property
    def displacement_mm(self) -> Floats:
        """Return U(X, t) (step, point, 3), mm."""


@dataclass(frozen=True, kw_only=True)
class CentreLine:
    """The motion of points on the axis, one at each level; NaN where it was not observed."""

    level_mm: Floats
    """Heights (level,), increasing: of the material in the reference state where a truth is known, else of
    the sections."""
    measured: Floats
    """u (step, level, 3), voxels."""
    true: Floats | None
    """U (step, level, 3), voxels; NaN where `measured` is, so that both are averaged over the same points."""
    voxel_mm: float

    @property
    def always_observed(self) -> NDArray[np.bool_]:
        """Return the levels (level,) that are observed at every step at which any is."""
        observed: NDArray[np.bool_] = np.asarray(np.isfinite(self.measured).all(axis=2))
        return np.asarray(observed[observed.any(axis=1)].all(axis=0))

    def translation(self, displacement: Floats) -> Floats:
        """Return the mean over the levels that are always observed (step, 3), voxels.

        A level that comes or goes would make the mean jump.
        """
        always = self.always_observed
        return nan_mean(displacement[:, always] if always.any() else displacement, axis=1)

    def stretch(self, displacement: Floats) -> Floats:
        """Return u_z without its mean over the levels (step, level), voxels.

        On the axis a small rotation moves nothing vertically, so that the mean is all of the rigid motion.
        """
        return np.asarray(displacement[..., 2] - self.translation(displacement)[:, None, 2])

    def strain(self, displacement: Floats) -> Floats:
        """Return the engineering strain between neighbouring levels (step, level - 1), without unit."""
        return np.diff(displacement[..., 2] * self.voxel_mm, axis=1) / np.diff(self.level_mm)


def measured_at(measurement: Measurement, points_mm: Floats) -> Floats:
    """Evaluate u at current positions (step, point, 3), mm; returns (step, point, 3), voxels.

    NaN for points outside the observed sections, and for those whose motion an unobserved section shares.
    """
    amplitude = np.where(measurement.motion.observed[:, None], measurement.motion.amplitude, np.nan)
    lowest, highest = observed_range(measurement)
    result = np.empty(points_mm.shape)
    for step, points in enumerate(points_mm):
        result[step] = measurement.motion.basis.displacement(amplitude[step], points)
        result[step, (points[:, 2] < lowest) | (points[:, 2] > highest)] = np.nan
    return result


def observed_range(measurement: Measurement) -> tuple[float, float]:
    """Return the heights of the lowest and the highest observed section, mm."""
    heights = measurement.motion.basis.height_mm[measurement.motion.observed]
    if len(heights) == 0:
        raise MeasurementError("measurement: expected at least one observed section, found none")
    if len(measurement.motion.basis.height_mm) == 1:
        return -np.inf, np.inf
    return float(heights[0]), float(heights[-1])


def current_positions(truth: TruePoints) -> Floats:
    """Return x = X + U(X, t) (step, point, 3), mm."""
    return np.asarray(truth.point_mm[None] + truth.displacement_mm)


def centre_line(
    measurement: Measurement, truth: TruePoints | None = None, *, spacing_mm: float | None = None
) -> CentreLine:
    """Follow the axis through the test: material levels about a section apart, or the sections themselves.

    With a truth, levels may also be `spacing_mm` apart: the same for measurements with different sections.
    """
    if truth is None:
        return _at_sections(measurement)
    chosen = points_on_axis(truth.point_mm, _section_spacing(measurement) if spacing_mm is None else spacing_mm)
    true = truth.displacement_mm[:, chosen]
    measured = measured_at(measurement, truth.point_mm[chosen][None] + true)
    return CentreLine(
        level_mm=truth.point_mm[chosen, 2],
        measured=measured,
        true=np.where(np.isfinite(measured), true / measurement.recording.voxel_mm, np.nan),
        voxel_mm=measurement.recording.voxel_mm,
    )


def _at_sections(measurement: Measurement) -> CentreLine:
    height = measurement.motion.basis.height_mm
    points = np.zeros((len(measurement.recording.angle_rad), len(height), 3))
    points[..., 2] = height
    return CentreLine(
        level_mm=height,
        measured=measured_at(measurement, points),
        true=None,
        voxel_mm=measurement.recording.voxel_mm,
    )


def _section_spacing(measurement: Measurement) -> float:
    height = measurement.motion.basis.height_mm
    return float(np.mean(np.diff(height))) if len(height) > 1 else 0.0


def nan_mean(values: Floats, axis: int | None = None) -> Floats:
    """Average what is a number; NaN, without a warning, where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
