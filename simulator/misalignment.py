"""Where source, rotation axis and detector really stand: what the true scanner has beyond the recorded geometry.

The recorded geometry (`pdvc.geometry`) is what experiment.toml tells; the measurement is not told the rest. In the
lab at stage angle 0, with x along the recorded beam, y to the left of the image and z up, source S, middle D of the
detector and its directions of columns u and rows v are

    S = (-R, 0, 0)                           u = T (cos r e_c + sin r e_r)
    D = (L - R, -column_shift, -row_shift)   v = T (cos r e_r - sin r e_c)

with R, L, shifts and roll r each the recorded value plus the error here, e_c = (0, -1, 0), e_r = (0, 0, -1), and the
turn T = Rz(slant) Ry(tilt) of a detector that does not face the source. A point x of the sample is at

    X = lean . Rz(theta) x + axis_across e_c

so that an axis beside the centre of the detector is a shift of the sample, in the lab, at every angle alike.
"""

from __future__ import annotations

import math
from dataclasses import replace

from pdvc.geometry import ConeBeam
from pdvc.settings import Settings


class Misalignment(Settings):
    """What the true scanner has beyond the recorded geometry, which the measurement is not told."""

    source_axis_mm: float = 0.0
    """added to the distance from the source to the axis, mm"""
    source_detector_mm: float = 0.0
    """added to the distance from the source to the detector, mm"""
    column_shift_mm: float = 0.0
    """added to the detector's shift to the right, mm"""
    row_shift_mm: float = 0.0
    """added to the detector's shift downwards, mm"""
    roll_deg: float = 0.0
    """added to the detector's turn in its plane, degrees"""
    tilt_deg: float = 0.0
    """turn of the detector about the horizontal: its top leans away from the source, degrees"""
    slant_deg: float = 0.0
    """turn of the detector about the vertical (its skew): its right side moves away from the source, degrees"""
    axis_across_mm: float = 0.0
    """shift of the rotation axis across the beam, to the right of the image, mm"""
    lean_deg: float = 0.0
    """turn of the rotation axis about the horizontal across the beam (e_c), degrees"""

    def true_geometry(self, recorded: ConeBeam) -> ConeBeam:
        """Return the geometry with which the radiographs are made, but for tilt, slant, and the axis' place.

        Raises ValueError where no scanner can be like that.
        """
        return replace(
            recorded,
            source_axis_mm=recorded.source_axis_mm + self.source_axis_mm,
            source_detector_mm=recorded.source_detector_mm + self.source_detector_mm,
            column_shift_mm=recorded.column_shift_mm + self.column_shift_mm,
            row_shift_mm=recorded.row_shift_mm + self.row_shift_mm,
            roll_rad=recorded.roll_rad + math.radians(self.roll_deg),
        )

    @property
    def faces_the_axis(self) -> bool:
        """Return whether the detector is normal to the beam through the axis, so that `true_geometry` says all."""
        return self.tilt_deg == self.slant_deg == self.axis_across_mm == 0.0
