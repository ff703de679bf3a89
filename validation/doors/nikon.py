"""Scans of Nikon (X-Tek) scanners: a settings file .xtekct beside single TIFFs.

The file is of lines ``key=value`` in sections. Its frame is taken as the reader of the Core Imaging Library takes it
(CIL, ``NikonDataReader``, Apache-2.0): image k is at -(InitialAngle + k AngularStep), counter-clockwise seen from
above, so that a positive step turns the sample clockwise; and its columns run from right to left for an eye at the
source, so that images are mirrored here. ``CentreOfRotationTop`` and ``Bottom``, mm on the detector, say where the
axis is seen in its first and last row: to the left, for that eye, where they are positive. ``ObjectOffsetX`` says so
on the axis itself, and ``ObjectRoll`` how much the axis leans to the right, degrees.

Images are corrected by the scanner's own program: ``WhiteLevel`` is the beam without a sample, 0 no beam.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from pathlib import Path

import numpy as np

from validation.doors.quantities import LENGTH, in_ours
from validation.doors.refusal import refused
from validation.doors.scan import Images, Scan, constant_images
from validation.doors.tiff import read_tiff_files, tiffs_of

NEARLY_ZERO = 1e-9


def read_nikon(path: Path, given: Container[str] = ()) -> Scan:
    """Read a scan from its .xtekct; keys of the geometry that are `given` elsewhere are not looked for.

    Raises FormatError, in one line, for what is missing, unreadable, or not to be described by `pdvc.geometry`.
    """
    settings = _Settings(path)
    size = settings.whole("DetectorPixelsY"), settings.whole("DetectorPixelsX")
    images = _images(settings, size)
    angle = settings.number("InitialAngle", 0.0) + settings.number("AngularStep") * np.arange(float(images.count))
    white = settings.number("WhiteLevel", math.nan)
    known = 0 < white <= 65535
    note = f"{path}: no flats: its white level, {white:g} counts, stands for them, and 0 for the darks"
    as_seen = Scan(
        source=path,
        images=images,
        angle_deg=-angle,
        geometry=_geometry(settings, size, given),
        flats=constant_images(size, round(white)) if known else None,
        darks=constant_images(size, 0) if known else None,
        title=settings.values.get("Name", ""),
        notes=(note,) if known else (),
    )
    return as_seen.mirrored(columns=True)


class _Settings:
    """The values of a settings file under their keys."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.values = _values(path)

    def number(self, key: str, default: float | None = None) -> float:
        text = self.values.get(key, "")
        if not text and default is not None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise refused(self.path, key, "a number", repr(text) if key in self.values else "none")
        return value

    def whole(self, key: str) -> int:
        value = self.number(key)
        if value != int(value) or value < 1:
            raise refused(self.path, key, "a whole number from 1 on", f"{value:g}")
        return int(value)

    def length(self, key: str, default: float | None = None) -> float:
        return self.number(key, default) * in_ours(LENGTH, self.values.get("Units", "mm"), self.path, "Units")


def _values(path: Path) -> Mapping[str, str]:
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        raise refused(path, "", "a file .xtekct", "none") from None
    parts = (line.partition("=") for line in lines if "=" in line and line[:1] not in ";[")
    values = {key.strip(): value.strip() for key, _, value in parts}
    if not values:
        raise refused(path, "", "lines key=value, as [XTekCT] has", "none")
    return values


def _images(settings: _Settings, size: tuple[int, int]) -> Images:
    """Return the TIFFs that belong to the settings: those of its name, else all of its folder."""
    folder = settings.path.parent / settings.values.get("InputFolderName", "").replace("\\", "/")
    if not folder.is_dir():
        raise refused(settings.path, "InputFolderName", "a folder of TIFFs", f"none at {folder}")
    named = settings.values.get("Name", "") + settings.values.get("InputSeparator", "")
    files = (tiffs_of(folder, named) if named else []) or tiffs_of(folder)
    count = settings.whole("Projections")
    if len(files) != count:
        raise refused(settings.path, "Projections", f"{count} TIFFs in {folder}", len(files))
    return read_tiff_files(files, size)


def _geometry(settings: _Settings, size: tuple[int, int], given: Container[str]) -> dict[str, float]:
    """Return distances, pixel, and the detector's middle as seen from the source, by the frame of the file."""
    wide, high = settings.length("DetectorPixelSizeX"), settings.length("DetectorPixelSizeY")
    if abs(wide - high) > 1e-3 * wide:
        raise refused(settings.path, "DetectorPixelSizeY", f"square pixels, DetectorPixelSizeX = {wide:g} mm", high)
    unknown = {"DetectorOffsetX": "column_shift_mm", "DetectorOffsetY": "row_shift_mm", "ObjectTilt": "roll_deg"}
    for key, ours in unknown.items():
        # programs that read these files disagree on, or pass over, what these mean
        if ours not in given and abs(settings.number(key, 0.0)) > NEARLY_ZERO:
            raise refused(settings.path, key, f"0, or {ours} given", settings.values[key])
    to_axis, to_detector = settings.length("SrcToObject"), settings.length("SrcToDetector")
    top, bottom = (settings.length(f"CentreOfRotation{end}", 0.0) for end in ("Top", "Bottom"))
    to_left = (top + bottom) / 2
    if "ObjectOffsetX" in settings.values:
        to_left = settings.length("ObjectOffsetX") * to_detector / to_axis
    lean = -math.atan2(top - bottom, size[0] * high)
    if "ObjectRoll" in settings.values:
        lean = math.radians(settings.number("ObjectRoll"))
    # as stored, columns run from right to left: `mirrored` makes them, and these two, as the eye sees them
    return {
        "source_axis_mm": to_axis,
        "source_detector_mm": to_detector,
        "pixel_mm": wide,
        "column_shift_mm": -to_left * math.cos(lean),
        "roll_deg": math.degrees(lean),
    }
