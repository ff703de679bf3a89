"""What each step of a test shows, side by side: radiograph, residual, and profiles over the height with 95 % bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import beam_frame
from pdvc.experiment import Experiment
from pdvc.measurement import Measurement
from pdvc.radiographs import Calibration, Image, calibrate, grey_levels
from validation.report.figures import scale_limit
from validation.report.pictures import of_volumes, selected_steps
from validation.scoring.centre_line import TruePoints, centre_line
from validation.scoring.deviations import centre_line_deviation
from validation.view.state import HALF_95

Floats = NDArray[np.float64]

USUAL = 0.98
"""Share of the bands that the axis of a profile holds whole: a few, where little is known, would take it all up."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A quantity over the height of the axis, at each step; NaN where it was not observed."""

    name: str
    unit: str
    height_mm: Floats
    """(level,), mm: of the sections, or with a truth of the material at rest."""
    value: Floats
    """(step, level), in the unit."""
    half: Floats
    """Half of the 95 % interval (step, level)."""
    true: Floats | None
    """(step, level); None where no truth is known."""

    @property
    def limits(self) -> tuple[float, float]:
        """Return what an axis has to hold that is the same for all steps."""
        known = self.value[np.isfinite(self.value)]
        if not known.size:
            return -1.0, 1.0
        halves = self.half[np.isfinite(self.half)]
        room = float(np.quantile(halves, USUAL)) if halves.size else 0.0
        low, high = float(known.min()) - room, float(known.max()) + room
        margin = 0.04 * (high - low) or 1.0
        return low - margin, high + margin


@dataclass(frozen=True, kw_only=True)
class Steps:
    """The steps of a measurement with the radiographs of its experiment."""

    measurement: Measurement
    experiment: Experiment
    truth: TruePoints | None = None

    def __post_init__(self) -> None:
        if of_volumes(self.measurement):
            raise ValueError(
                "measurement: expected residuals of radiographs, found none: volumes were compared, and no radiograph "
                "has a residual"
            )
        measured, found = self.measurement.recording.steps, len(self.experiment.test)
        if measured != found:
            raise ValueError(f"experiment: expected {measured} radiographs of a test, as were measured, found {found}")
        rows, columns = self.shape
        _, bottom, _, right = self.measurement.recording.window
        if bottom > rows or right > columns:
            raise ValueError(
                f"experiment: expected radiographs of {bottom} x {right} px at least, of which a part was used, "
                f"found {rows} x {columns} px"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of a radiograph."""
        rows, columns = self.experiment.test.counts.shape[1:]
        return int(rows), int(columns)

    @cached_property
    def _calibration(self) -> Calibration:
        return calibrate(self.experiment)

    @cached_property
    def _largest(self) -> float:
        shown = selected_steps(self.measurement.recording.steps)
        return max(float(np.quantile(self._grey(step), 0.9995)) for step in shown)

    def _grey(self, step: int) -> Image:
        return grey_levels(self.experiment.test.counts[step], self._calibration)

    def radiograph(self, step: int) -> Image:
        """Return the attenuation of a step (row, column), over the largest of the test: air 0, densest 1."""
        return np.asarray(self._grey(step) / np.float32(self._largest), dtype=np.float32)

    def residual(self, step: int) -> Image | None:
        """Return what the motion leaves unexplained in the used pixels (row, column), grey levels; None if unknown."""
        field = self.measurement.fit.residual_final[step]
        return np.nan_to_num(field) if np.isfinite(field).any() else None

    @cached_property
    def limit(self) -> float:
        """Return the grey level at which the scale of all residuals ends."""
        steps = selected_steps(self.measurement.recording.steps)
        return scale_limit(list(self.measurement.fit.residual_final[steps]))

    def words(self, step: int) -> str:
        """Return which step it is, its angle and its force."""
        recording = self.measurement.recording
        degrees = (np.rad2deg(recording.angle_rad[step]) + 180) % 360 - 180
        return f"step {step}, {degrees:.1f}°, {recording.force_N[step]:.0f} N"

    @cached_property
    def profiles(self) -> Sequence[Profile]:
        """Return displacements in three directions, voxels, and the axial strain, %, on the axis."""
        centre = centre_line(self.measurement, self.truth)
        deviation = centre_line_deviation(self.measurement, self.truth)
        turn = beam_frame(self.measurement.recording.angle_rad).transpose(0, 2, 1)
        moved, true = centre.measured @ turn, None if centre.true is None else centre.true @ turn
        names = ("across the beam", "vertical", "along the beam")
        found = [
            Profile(
                name=name,
                unit="voxel",
                height_mm=centre.level_mm,
                value=moved[..., k],
                half=HALF_95 * deviation.std[..., k],
                true=None if true is None else true[..., k],
            )
            for k, name in enumerate(names)
        ]
        strain = Profile(
            name="axial strain",
            unit="%",
            height_mm=(centre.level_mm[1:] + centre.level_mm[:-1]) / 2,
            value=100 * centre.strain(centre.measured),
            half=100 * HALF_95 * deviation.strain_std,
            true=None if centre.true is None else 100 * centre.strain(centre.true),
        )
        return (*found, strain)
