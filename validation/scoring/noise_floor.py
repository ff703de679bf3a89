"""The noise floor as a laboratory has it, without a truth: how much the measured motion scatters at constant load.

The test begins at the load of the reference scan. Until the load rises nothing deforms, so that whatever is measured
beyond a rigid motion is an error. Rigid motion is real, as the stage may wobble, and is taken off at each step. On the
axis of the sample it is a shift and, horizontally, a slope along z. What remains at heights evenly spread over the
observed sections, r (step, level), is given across the beam, vertically and along the beam, in directions that turn
with the beam, as scores are. Both numbers are those of the iDICs guide (*A Good Practices Guide for Digital Image
Correlation*, 2018, 10.32720/idics/gpg.ed1), averaged as squares:

    temporal^2 = mean over levels of the variance of r over steps
    spatial^2  = mean over steps of the variance of r over levels

What they cannot see:

- an error that moves the sample as one, such as a motion along the beam that all sections share;
- in `temporal`, what stays the same over the turn. An error that is fixed in the sample turns with respect to the beam
  and is seen; a constant vertical one is not. `spatial` holds it, unless it is rigid;
- errors that grow with motion and strain: interpolation, and what the sections cannot follow;
- noise that the time functions do not pass on. Over n steps they allow `histories` different histories; where these
  are fewer than n, the floor is that of the smoothed motion, not of one radiograph. With one function for each step
  (`pdvc.history.Steps`, the method each-step) it is that of each radiograph alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import points_on_axis
from pdvc.measurement import Measurement
from pdvc.onset import force_noise
from validation.scoring.centre_line import TruePoints, measured_at
from validation.scoring.scores import Directions

Floats = NDArray[np.float64]

LEAST_STEPS = 5
"""Fewer steps give no standard deviation worth the name."""
LEVELS_PER_SECTION = 4
"""Of the sections alone, the scatter would be too large: between two of them part of it averages out."""
FEW_SIGMA = 5.0
"""A force further than this from the level before it, in standard deviations, ends the constant load."""


@dataclass(frozen=True, kw_only=True)
class TrueError:
    """The error of material points on the axis, over the steps of a noise floor, rigid motion included."""

    scatter_voxel: Directions
    """Deviation of each point's error from its mean over the steps, rms."""
    rms_voxel: Directions
    """All of the error, rms."""
    level_mm: Floats
    """Heights of the points (level,), mm."""
    scatter_by_level: Floats
    """`scatter_voxel` of each level (level, direction)."""


@dataclass(frozen=True, kw_only=True)
class NoiseFloor:
    """The scatter of the measured motion over the first steps, at constant load, beyond rigid motion."""

    steps: int
    """Steps that were measured before the load rises."""
    histories: int
    """Independent histories that the time functions allow over these steps."""
    temporal_voxel: Directions
    spatial_voxel: Directions
    level_mm: Floats
    """Heights on the axis (level,), mm."""
    temporal_by_level: Floats
    """`temporal_voxel` of each level (level, direction), voxels; NaN where a section was not observed."""
    true: TrueError | None
    """None where no truth is known."""


def constant_load_steps(force_N: Floats) -> int:
    """Return for how many steps, from the first, the measured force (step,) stays at its level.

    Each force is compared with the mean of those before it. The standard deviation of the noise comes from the second
    differences of the whole record, which a steady ramp does not change, by their median, which the start of the
    ramp does not. Where no force was recorded, all zeros, no step is known to be at constant load: 0.
    """
    force = np.asarray(force_N, dtype=float)
    if not force.any():
        return 0
    noise = max(force_noise(force), 1e-9 * float(np.abs(force).max()))
    count = 1
    while count < len(force):
        away = abs(force[count] - force[:count].mean())
        if away > FEW_SIGMA * noise * math.sqrt(1 + 1 / count):
            break
        count += 1
    return count


def noise_floor(measurement: Measurement, truth: TruePoints | None = None) -> NoiseFloor | None:
    """Return the scatter over the first steps, at constant load.

    None where fewer than `LEAST_STEPS` of them were measured.
    """
    measured: NDArray[np.bool_] = np.asarray(np.isfinite(measurement.motion.amplitude).any(axis=(1, 2)))
    steps = np.flatnonzero(measured[: constant_load_steps(measurement.recording.force_N)])
    if len(steps) < LEAST_STEPS:
        return None
    heights = measurement.motion.basis.height_mm[measurement.motion.observed]
    levels = np.linspace(heights[0], heights[-1], LEVELS_PER_SECTION * (len(heights) - 1) + 1)
    points = np.zeros((len(measured), len(levels), 3))
    points[..., 2] = levels
    u = measured_at(measurement, points)[steps]
    seen = np.isfinite(u).all(axis=(0, 2))
    rest = np.full_like(u, np.nan)
    rest[:, seen] = without_rigid_motion(u[:, seen], levels[seen])
    turning = _turning_with_the_beam(rest, measurement.recording.angle_rad[steps])
    over_steps = turning.var(axis=0, ddof=1)
    over_levels = turning[:, seen].var(axis=1)
    return NoiseFloor(
        steps=len(steps),
        histories=_histories(measurement.motion.time_functions[:, steps]),
        temporal_voxel=_directions(np.sqrt(over_steps[seen].mean(axis=0))),
        spatial_voxel=_directions(np.sqrt(over_levels.mean(axis=0))),
        level_mm=levels,
        temporal_by_level=np.sqrt(over_steps),
        true=None if truth is None else _true_error(measurement, truth, steps),
    )


def without_rigid_motion(displacement: Floats, level_mm: Floats) -> Floats:
    """Return displacements on the axis (step, level, 3) less the nearest shift and small rotation of each step."""
    z = level_mm - level_mm.mean()
    rest = displacement - displacement.mean(axis=1, keepdims=True)
    slope = np.einsum("l,tlk->tk", z, rest) / max(float(z @ z), 1e-300)
    slope[:, 2] = 0  # a rotation moves nothing along the axis
    return np.asarray(rest - slope[:, None] * z[:, None])


def _turning_with_the_beam(vectors: Floats, angle_rad: Floats) -> Floats:
    """Return vectors (step, level, 3) as components across the beam, vertical and along the beam."""
    c, s = np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([-s * x - c * y, z, c * x - s * y], axis=-1)


def _histories(time_functions: Floats) -> int:
    """Return how many independent histories functions (function, step) allow, to a hundredth of the largest."""
    sizes = np.linalg.svd(time_functions, compute_uv=False)
    return int((sizes > 0.01 * sizes[0]).sum()) if sizes[0] > 0 else 0


def _true_error(measurement: Measurement, truth: TruePoints, steps: NDArray[np.intp]) -> TrueError:
    chosen = points_on_axis(truth.point_mm, 0.0)
    true = truth.displacement_mm[:, chosen]
    error = (measured_at(measurement, truth.point_mm[chosen] + true) - true / measurement.recording.voxel_mm)[steps]
    always = np.isfinite(error).all(axis=(0, 2))
    turning = _turning_with_the_beam(error[:, always], measurement.recording.angle_rad[steps])
    variance = turning.var(axis=0, ddof=1)
    return TrueError(
        scatter_voxel=_directions(np.sqrt(variance.mean(axis=0))),
        rms_voxel=_directions(np.sqrt((turning**2).mean(axis=(0, 1)))),
        level_mm=truth.point_mm[chosen[always], 2],
        scatter_by_level=np.sqrt(variance),
    )


def _directions(values: Floats) -> Directions:
    across, vertical, along = (float(value) for value in values)
    return Directions(across_beam=across, vertical=vertical, along_beam=along)
