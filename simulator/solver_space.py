"""A motion's like in the solver's space: what a solver misses of it is the solver's own fault.

`into_sections` replaces a motion by 15 sections, or another number, fixed in space, each with six rigid motions, each
the sum of the paper's seven time functions (Table 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from simulator.kinematics import Motion, SectionMotion

Floats = NDArray[np.float64]


def time_functions(force_N: Floats, angle_rad: Floats, start_step: int) -> Floats:
    """Return the seven time functions of the paper's Table 1, (step, 7), each scaled to about one."""
    t = np.arange(len(force_N)) / max(len(force_N) - 1, 1)
    ramp = np.maximum(t - start_step / max(len(force_N) - 1, 1), 0.0)
    columns = [force_N / force_N.max(), np.sin(angle_rad), np.cos(angle_rad), np.ones_like(t), t, ramp, ramp**2]
    return np.column_stack(columns)


def into_sections(motion: Motion, height_mm: Floats, time: Floats) -> SectionMotion:
    """Return the motion of sections fixed at `height_mm` that is nearest to another one.

    Each section takes the displacement and the mean rotation found at its centre (0, 0, z_j) of the current
    configuration, and each of its six histories the nearest sum of the `time` functions (step, function).
    """
    arm = 1e-3
    steps = len(time)
    centres = height_mm[:, None] * np.array([0.0, 0.0, 1.0])
    offsets = arm * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    probes = (centres[:, None] + offsets).reshape(-1, 3)
    histories = np.empty((steps, len(height_mm), 6))
    for step in range(steps):
        u = (probes - motion.inverse(probes, step)).reshape(len(height_mm), 5, 3)
        by_x, by_y = (u[:, 1] - u[:, 2]) / (2 * arm), (u[:, 3] - u[:, 4]) / (2 * arm)
        histories[step, :, :3] = u[:, 0]
        histories[step, :, 3] = by_y[:, 2]
        histories[step, :, 4] = -by_x[:, 2]
        histories[step, :, 5] = (by_x[:, 1] - by_y[:, 0]) / 2
    flat = histories.reshape(steps, -1)
    fitted = (time @ np.linalg.lstsq(time, flat, rcond=None)[0]).reshape(histories.shape)
    return SectionMotion(height_mm=height_mm, translation_mm=fitted[..., :3], rotation_rad=fitted[..., 3:])
