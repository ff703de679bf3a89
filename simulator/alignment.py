"""Where source, detector and sample stand during one exposure, and the sample as the detector sees it.

A pinhole image on any plane is, in the frame of that plane, one of a detector that faces the source: with the unit
vectors of columns u and rows v, the normal n = u x v, the source S and the middle D of the detector, the recipe is

    L = n . (D - S)      column_shift = u . (D - S)      row_shift = v . (D - S)      X' = (n, -u, -v) . (X - S)

and no kernel has to know of a tilt. X = Q x + p places a point x of the sample in the lab.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.geometry import ConeBeam
from simulator.focal_spot import FocalSpot
from simulator.kinematics import rotation_matrix
from simulator.misalignment import Misalignment
from simulator.radiography import Body
from simulator.sample import placed
from simulator.stage import RotationStage

Floats = NDArray[np.float64]
COLUMN, ROW = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
"""e_c and e_r of `pdvc.geometry` at stage angle 0: the lab's own."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """What one radiograph has of its own, apart from angle and load."""

    time_s: float = 0.0
    """Time since the flats, s."""
    angle_error_rad: float = 0.0
    """By how much farther the stage has turned than it tells, drawn for this radiograph, rad."""
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift of the sample in the lab, drawn for this radiograph, mm."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Source, detector and sample in the lab, whose x is the recorded beam, and z up; vectors (3,), mm."""

    source_mm: Floats
    detector_mm: Floats
    """Middle of the detector."""
    column: Floats
    """Direction of growing columns, of length 1."""
    row: Floats
    """Direction of growing rows, of length 1."""
    turn: Floats
    """Q (3, 3), which turns the sample into the lab."""
    shift_mm: Floats
    """p, where the sample's origin is in the lab."""

    def in_sample_frame(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return source, middle of the detector, and directions of columns and rows as the sample sees them."""
        back = self.turn.T
        return (
            back @ (self.source_mm - self.shift_mm),
            back @ (self.detector_mm - self.shift_mm),
            back @ self.column,
            back @ self.row,
        )

    def seen(self, body: Body, pixels: ConeBeam) -> tuple[Body, ConeBeam]:
        """Return sample and scanner in the frame of the detector, for `path_lengths` at angle 0.

        Of `pixels` their pitch and number hold, and the distance to the axis, which is as good as any.
        """
        frame = np.stack([np.cross(self.column, self.row), -self.column, -self.row])
        distance, across, up = frame @ (self.detector_mm - self.source_mm)
        scanner = replace(
            pixels,
            source_detector_mm=float(distance),
            column_shift_mm=-float(across),
            row_shift_mm=-float(up),
            roll_rad=0.0,
        )
        matrix, from_source = frame @ self.turn, frame @ (self.shift_mm - self.source_mm)
        place = from_source - np.array([pixels.source_axis_mm, 0.0, 0.0])
        return placed(body, matrix, place), scanner


@dataclass(frozen=True, kw_only=True)
class Aligner:
    """The true scanner: how it stands at any angle and time."""

    recorded: ConeBeam
    misalignment: Misalignment = field(default_factory=Misalignment)
    stage: RotationStage = field(default_factory=RotationStage)
    spot: FocalSpot = field(default_factory=FocalSpot)

    @property
    def plain(self) -> bool:
        """Return whether `true_geometry`, the recorded angle and the lean of the axis say all."""
        return self.misalignment.faces_the_axis and self.stage.perfect and not any(self.spot.drift_mm)

    def at(self, angle_rad: float, moment: Moment) -> Alignment:
        """Return where all stands while the stage tells an angle, rad."""
        wrong, scanner = self.misalignment, self.misalignment.true_geometry(self.recorded)
        c, s = math.cos(scanner.roll_rad), math.sin(scanner.roll_rad)
        faces = rotation_matrix(np.array([0.0, 0.0, math.radians(wrong.slant_deg)])) @ rotation_matrix(
            np.array([0.0, math.radians(wrong.tilt_deg), 0.0])
        )
        turned = self.stage.turned_rad(angle_rad) + moment.angle_error_rad
        turn = (
            rotation_matrix(math.radians(wrong.lean_deg) * COLUMN)
            @ rotation_matrix(self.stage.tilt_rad(angle_rad))
            @ rotation_matrix(np.array([0.0, 0.0, turned]))
        )
        middle = scanner.column_shift_mm * COLUMN + scanner.row_shift_mm * ROW
        middle[0] = scanner.source_detector_mm - scanner.source_axis_mm
        return Alignment(
            source_mm=np.array([-scanner.source_axis_mm, 0.0, 0.0]) + self.spot.shift_mm(moment.time_s),
            detector_mm=middle,
            column=faces @ (c * COLUMN + s * ROW),
            row=faces @ (c * ROW - s * COLUMN),
            turn=turn,
            shift_mm=wrong.axis_across_mm * COLUMN + self.stage.shift_mm(angle_rad) + np.array(moment.shift_mm),
        )
