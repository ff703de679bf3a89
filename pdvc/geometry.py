"""Cone-beam geometry as a value, and the one definition of the frame that the whole project quotes.

Frame
-----
Right-handed and fixed to the sample; lengths in mm::

                 z (rotation axis, up)
                 |
                 |        row 0 at the top
     source *- - O - - - - - - - - [detector]      column 0 at the left, seen from the source
                /         beam
               /

The origin O lies on the rotation axis, in the plane that holds the source and is normal to the axis.
At stage angle 0 the source is at (-source_axis_mm, 0, 0), the beam points along +x, detector rows run
along -z (row 0 is the top row) and detector columns along -y (to the right for an eye at the source).

The stage turns the sample by +theta about +z: counter-clockwise, seen from above. In the sample frame
everything else turns by -theta: with c = cos(theta), s = sin(theta),

    beam   e_b(theta) = ( c, -s, 0)      from the source to the detector
    column e_c(theta) = (-s, -c, 0)      towards the right of the image
    row    e_r        = ( 0,  0, -1)     towards the bottom of the image

so that source(theta) = -source_axis_mm * e_b(theta). Pixel and voxel *centres* carry the values.
Volumes are indexed (z, y, x), radiographs (step, row, column).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, kw_only=True)
class ConeBeam:
    """The fixed part of a cone-beam scanner: distances, detector and its place; angles come apart."""

    source_axis_mm: float
    """Distance from the source to the rotation axis, mm."""
    source_detector_mm: float
    """Distance from the source to the detector plane, mm."""
    pixel_mm: float
    """Pitch of the square detector pixels, mm."""
    rows: int
    """Number of detector rows."""
    columns: int
    """Number of detector columns."""
    column_shift_mm: float = 0.0
    """Detector centre along the column direction (to the right), mm, from the source-axis line."""
    row_shift_mm: float = 0.0
    """Detector centre along the row direction (downwards), mm, from the source-axis line."""
    roll_rad: float = 0.0
    """Detector turned in its own plane, rad: from the column direction towards the row direction."""

    def __post_init__(self) -> None:
        for name in ("source_axis_mm", "source_detector_mm", "pixel_mm"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"geometry.{name}: expected a positive length in mm, got {value}")
        if self.source_detector_mm <= self.source_axis_mm:
            raise ValueError(
                f"geometry.source_detector_mm: expected more than source_axis_mm = {self.source_axis_mm} mm, "
                f"got {self.source_detector_mm} mm"
            )
        for name in ("rows", "columns"):
            value = getattr(self, name)
            if value < 1:
                raise ValueError(f"geometry.{name}: expected at least 1 pixel, got {value}")
        for name in ("column_shift_mm", "row_shift_mm", "roll_rad"):
            value = getattr(self, name)
            if not math.isfinite(value):
                raise ValueError(f"geometry.{name}: expected a finite number, got {value}")

    @property
    def magnification(self) -> float:
        """Return source-detector over source-axis distance, without unit."""
        return self.source_detector_mm / self.source_axis_mm

    @property
    def voxel_mm(self) -> float:
        """Return the pixel pitch seen at the rotation axis, mm: the natural voxel."""
        return self.pixel_mm / self.magnification

    def binned(self, factor: int) -> ConeBeam:
        """Return the geometry whose pixels are factor x factor of these, incomplete edge blocks dropped.

        Blocks start at row 0 and column 0, so that a dropped last row or column moves the centre.
        """
        if factor < 1 or factor > min(self.rows, self.columns):
            raise ValueError(
                f"binning factor: expected 1 to {min(self.rows, self.columns)} for a detector of "
                f"{self.rows} x {self.columns} px, got {factor}"
            )
        rows, columns = self.rows // factor, self.columns // factor
        return replace(
            self.cropped(0, rows * factor, 0, columns * factor),
            pixel_mm=self.pixel_mm * factor,
            rows=rows,
            columns=columns,
        )

    def cropped(self, row_from: int, row_to: int, column_from: int, column_to: int) -> ConeBeam:
        """Return the geometry of the detector window [row_from, row_to) x [column_from, column_to)."""
        if not (0 <= row_from < row_to <= self.rows and 0 <= column_from < column_to <= self.columns):
            raise ValueError(
                f"window: expected a part of {self.rows} x {self.columns} px, "
                f"got rows {row_from}:{row_to}, columns {column_from}:{column_to}"
            )
        along_columns = ((column_from + column_to) - self.columns) / 2 * self.pixel_mm
        along_rows = ((row_from + row_to) - self.rows) / 2 * self.pixel_mm
        c, s = math.cos(self.roll_rad), math.sin(self.roll_rad)
        return replace(
            self,
            rows=row_to - row_from,
            columns=column_to - column_from,
            column_shift_mm=self.column_shift_mm + c * along_columns - s * along_rows,
            row_shift_mm=self.row_shift_mm + s * along_columns + c * along_rows,
        )


def within_half_turn(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return angles less their whole turns, rad: from -pi up to pi."""
    return np.asarray((np.asarray(angle_rad, dtype=float) + np.pi) % (2 * np.pi) - np.pi)


def nearest_angles(angle_rad: NDArray[np.float64], among_rad: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return which (angle,) of some angles, over the turn's end too, each angle is nearest to."""
    return np.asarray(np.abs(within_half_turn(angle_rad[:, None] - among_rad)).argmin(axis=1))


def gaps_rad(turned_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gaps (angle,) from each of the increasing angles of a turn to the next, over the turn's end too."""
    return np.diff(np.append(turned_rad, turned_rad[0] + 2 * np.pi))
