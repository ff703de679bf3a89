"""One series of radiographs as a file of another program tells of it, in the frame of `pdvc.geometry`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from validation.doors.refusal import refused

Floats = NDArray[np.float64]
Counts = NDArray[np.uint16]


@dataclass(frozen=True, kw_only=True)
class Images:
    """Images of counts, all of one size, each read when it is asked for."""

    count: int
    size: tuple[int, int]
    """Rows and columns."""
    read: Callable[[int], Counts]
    """Return an image (row, column) by its place."""

    def mirrored(self, *, columns: bool, rows: bool) -> Images:
        """Return the same images with the order of their columns, of their rows, or of both reversed."""
        order = (slice(None, None, -1 if rows else 1), slice(None, None, -1 if columns else 1))
        return replace(self, read=lambda k: np.ascontiguousarray(self.read(k)[order]))


def constant_images(size: tuple[int, int], value: int) -> Images:
    """Return one image of one value, for a detector whose counts were corrected by its own program."""
    return Images(count=1, size=size, read=lambda _: np.full(size, value, dtype=np.uint16))


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What a table tells of each radiograph of a series; None where it tells nothing."""

    angle_deg: Floats | None = None
    time_s: Floats | None = None
    force_N: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A series of radiographs with all that its file tells; None, or no entry, where it tells nothing.

    Images are as an eye at the source sees them, row 0 at the top; angles grow counter-clockwise seen from above.
    """

    source: Path
    """The file it was read from, for errors."""
    images: Images
    angle_deg: Floats | None = None
    """Stage angles (image,), degrees."""
    time_s: Floats | None = None
    """Middle of each exposure (image,), s."""
    force_N: Floats | None = None
    """Axial force (image,), N."""
    geometry: Mapping[str, float] = field(default_factory=dict)
    """What is known of `pdvc.experiment.GeometryEntry`, but rows and columns: mm, degrees."""
    flats: Images | None = None
    darks: Images | None = None
    title: str = ""
    notes: tuple[str, ...] = ()
    """What was taken for granted, one line each, for the user to confirm."""

    def __post_init__(self) -> None:
        for key in ("angle_deg", "time_s", "force_N"):
            values = getattr(self, key)
            if values is not None and len(values) != self.images.count:
                raise refused(self.source, key, f"{self.images.count} numbers, one for each radiograph", len(values))
            if values is not None and not np.isfinite(values).all():
                place = int(np.flatnonzero(~np.isfinite(values))[0])
                raise refused(self.source, key, "finite numbers", f"{values[place]} at radiograph {place}")

    def mirrored(self, *, columns: bool = False, rows: bool = False) -> Scan:
        """Return the scan with all images mirrored, and with the geometry that they have then."""
        turned = {
            "column_shift_mm": -1.0 if columns else 1.0,
            "row_shift_mm": -1.0 if rows else 1.0,
            "roll_deg": -1.0 if columns != rows else 1.0,
        }
        return replace(
            self,
            images=self.images.mirrored(columns=columns, rows=rows),
            flats=None if self.flats is None else self.flats.mirrored(columns=columns, rows=rows),
            darks=None if self.darks is None else self.darks.mirrored(columns=columns, rows=rows),
            geometry={key: value * turned.get(key, 1.0) for key, value in self.geometry.items()},
        )

    def told(self, recorded: Recorded) -> Scan:
        """Return the scan with what a table tells in place of what the scan itself does."""
        return replace(
            self,
            angle_deg=self.angle_deg if recorded.angle_deg is None else recorded.angle_deg,
            time_s=self.time_s if recorded.time_s is None else recorded.time_s,
            force_N=self.force_N if recorded.force_N is None else recorded.force_N,
        )

    def turned_back(self) -> Scan:
        """Return the scan of a stage that turns the other way."""
        return replace(self, angle_deg=None if self.angle_deg is None else -self.angle_deg)


def along_pixels(column_shift: float, row_shift: float, roll_rad: float) -> tuple[float, float]:
    """Return a shift along e_c and e_r as one along the rolled detector's columns and rows, in the same unit."""
    c, s = math.cos(roll_rad), math.sin(roll_rad)
    return c * column_shift + s * row_shift, -s * column_shift + c * row_shift


def along_frame(columns: float, rows: float, roll_rad: float) -> tuple[float, float]:
    """Return a shift along the rolled detector's columns and rows as one along e_c and e_r: `along_pixels` undone."""
    return along_pixels(columns, rows, -roll_rad)
