"""Standard deviations of the motion on the axis, as the measurement predicts them, beside its errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import beam_frame
from pdvc.measurement import Measurement
from validation.scoring.centre_line import TruePoints, centre_line

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class CentreLineDeviation:
    """What is predicted of errors on the axis, one point at each level; NaN where nothing was observed."""

    level_mm: Floats
    """Heights (level,), mm, as those of `validation.scoring.centre_line.CentreLine`."""
    std: Floats
    """Standard deviations of u (step, level, direction), voxels: across the beam, vertical, along the beam."""
    strain_std: Floats
    """Standard deviations of the strain between neighbouring levels (step, level - 1), without unit."""
    error: Floats | None
    """Measured less true u (step, level, direction), voxels; None where no truth is known."""
    strain_error: Floats | None
    """Measured less true strain (step, level - 1)."""


def centre_line_deviation(measurement: Measurement, truth: TruePoints | None = None) -> CentreLineDeviation:
    """Predict the errors at the sections or, with a truth, at material levels about a section apart."""
    centre = centre_line(measurement, truth)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(centre.measured).all(axis=2))
    rise_mm = 0.0 if centre.true is None else centre.true[..., 2] * centre.voxel_mm
    height = np.where(seen, centre.level_mm + rise_mm, centre.level_mm)
    std, strain_std = np.full(centre.measured.shape, np.nan), np.full((len(seen), len(centre.level_mm) - 1), np.nan)
    for step in np.flatnonzero(seen.any(axis=1)).tolist():
        points = np.zeros((len(centre.level_mm), 3))
        points[:, 2] = height[step]
        std[step] = measurement.turned_std(step, points)
        # known between current heights; strain refers to the distance at rest
        stretched = np.diff(height[step]) / np.diff(centre.level_mm)
        strain_std[step] = measurement.strain_std(step, height[step]) * stretched
    error, strain_error = None, None
    if centre.true is not None:
        error = (centre.measured - centre.true) @ beam_frame(measurement.recording.angle_rad).transpose(0, 2, 1)
        strain_error = centre.strain(centre.measured) - centre.strain(centre.true)
    return CentreLineDeviation(
        level_mm=centre.level_mm,
        std=np.where(seen[..., None], std, np.nan),
        strain_std=np.where(seen[:, 1:] & seen[:, :-1], strain_std, np.nan),
        error=error,
        strain_error=strain_error,
    )
