"""Motion and strain of material points, and at places in space, with their standard deviations.

A measurement is u(x, t) at the *current* position x. The material point X, its place during the reference scan, is now
at the x for which x - u(x, t) = X: that is found by repeating x = X + u(x, t), which closes in on it as fast as the
strain is small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.measurement import Measurement
from validation.doors.scan import Floats

CLOSE_MM = 1e-9
MOST_ROUNDS = 200


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The motion of a step, observed or not; NaN only where nothing of the step was measured."""

    measurement: Measurement
    step: int
    amplitude: Floats
    """(section, motion), voxels; sections that were not observed move as their neighbours do."""
    observed_mm: tuple[float, float]
    """Heights of the lowest and the highest section that was observed."""

    def displacement(self, current_mm: Floats) -> Floats:
        """Return u (point, 3), mm, at current positions (point, 3), mm."""
        basis = self.measurement.motion.basis
        return basis.displacement(self.amplitude, current_mm) * self.measurement.recording.voxel_mm

    def current(self, rest_mm: Floats) -> Floats:
        """Return where material points (point, 3), mm, are now.

        Raises ValueError where a motion folds the sample, so that no place is theirs.
        """
        moved = rest_mm
        for _ in range(MOST_ROUNDS):
            before, moved = moved, rest_mm + self.displacement(moved)
            if np.abs(moved - before).max(initial=0.0) < CLOSE_MM:
                return moved
        raise ValueError(f"step {self.step}: expected a place for each material point, found that the motion folds")

    def observed(self, current_mm: Floats) -> NDArray[np.bool_]:
        """Return at which current positions (point,) observed sections alone take part, the outermost not exceeded."""
        low, high = self.observed_mm
        known = np.isfinite(self.measurement.motion.displacement(self.step, current_mm)).all(axis=1)
        return np.asarray(known & (current_mm[:, 2] >= low - CLOSE_MM) & (current_mm[:, 2] <= high + CLOSE_MM))

    def deviation(self, current_mm: Floats) -> Floats:
        """Return the standard deviations of u (point, 3), mm, across the beam, vertical and along the beam."""
        return self.measurement.turned_std(self.step, current_mm) * self.measurement.recording.voxel_mm

    def strain(self, lower_mm: Floats, upper_mm: Floats) -> tuple[Floats, Floats]:
        """Return the vertical strain between pairs of current positions (pair, 3), and its standard deviation (pair,).

        As `pdvc.strain`: with s the rise of u_z over the current distance, the strain of the length at rest is
        s / (1 - s), and its deviation that of s times the derivative, 1 / (1 - s)^2.
        """
        motion, voxel_mm = self.measurement.motion, self.measurement.recording.voxel_mm
        length = upper_mm[:, 2] - lower_mm[:, 2]
        slope = (self.displacement(upper_mm) - self.displacement(lower_mm))[:, 2] / length
        pairs = len(length)
        shapes = [motion.basis.shapes(points)[:, 2].reshape(pairs, -1) for points in (lower_mm, upper_mm)]
        difference = (shapes[1] - shapes[0]) * voxel_mm / length[:, None]
        variance = ((difference @ motion.step_covariance(self.step)) * difference).sum(axis=1)
        return slope / (1 - slope), np.sqrt(np.maximum(variance, 0)) / (1 - slope) ** 2


def motion_of(measurement: Measurement, step: int) -> Motion | None:
    """Return the motion of a step; None where it was not measured."""
    motion = measurement.motion
    known = np.isfinite(motion.amplitude[step]).all(axis=1)
    if not known.any():
        return None
    height = motion.basis.height_mm
    columns = motion.amplitude[step][known].T
    filled = np.stack([np.interp(height, height[known], values) for values in columns], axis=1)
    low, high = (height[known][0], height[known][-1]) if len(height) > 1 else (-np.inf, np.inf)
    return Motion(measurement=measurement, step=step, amplitude=filled, observed_mm=(float(low), float(high)))
