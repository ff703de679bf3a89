"""Rays of the scanner in the sample frame: where the source and each pixel are, at each angle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdvc.geometry import ConeBeam

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RayVectors:
    """The vectors that span the rays at each angle: pixel (r, c) is at corner + r row + c column."""

    source_mm: Floats
    """Source (angle, 3), mm."""
    corner_mm: Floats
    """Centre of pixel (0, 0) (angle, 3), mm."""
    row_mm: Floats
    """From one row to the next (angle, 3), mm."""
    column_mm: Floats
    """From one column to the next (angle, 3), mm."""

    def stacked(self) -> Floats:
        """Return the four vectors as (angle, 4, 3): source, corner, row, column."""
        return np.stack([self.source_mm, self.corner_mm, self.row_mm, self.column_mm], axis=1)


def directions(angle_rad: ArrayLike) -> tuple[Floats, Floats]:
    """Return the beam and column directions e_b, e_c (angle, 3) of the frame, at stage angles in rad."""
    angle = np.atleast_1d(np.asarray(angle_rad, dtype=float))
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.stack([c, -s, zero], axis=-1), np.stack([-s, -c, zero], axis=-1)


def ray_vectors(geometry: ConeBeam, angle_rad: ArrayLike) -> RayVectors:
    """Return the rays of a geometry at stage angles (angle,), in rad, in the sample frame."""
    beam, across = directions(angle_rad)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), beam.shape)
    c, s = np.cos(geometry.roll_rad), np.sin(geometry.roll_rad)
    column = (c * across + s * down) * geometry.pixel_mm
    row = (-s * across + c * down) * geometry.pixel_mm
    centre = (
        beam * (geometry.source_detector_mm - geometry.source_axis_mm)
        + across * geometry.column_shift_mm
        + down * geometry.row_shift_mm
    )
    corner = centre - row * (geometry.rows - 1) / 2 - column * (geometry.columns - 1) / 2
    return RayVectors(source_mm=-geometry.source_axis_mm * beam, corner_mm=corner, row_mm=row, column_mm=column)
