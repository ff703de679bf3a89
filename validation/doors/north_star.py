"""Scans of North Star Imaging: a project file .nsipro, a folder of radiographs, a gain and an offset image.

The file looks like XML and is none: sections ``<Result> ... </Result>``, and in them lines ``<key>value``. Its frame
is taken as MBIRJAX takes it (``mbirjax.preprocess.nsi``, BSD-3-Clause). Vectors are in mm: from the origin, which lies
on the rotation axis, to the source and to pixel (0, 0); along the axis; along the rows of the detector, to the right
for an eye at the source; and along the beam. ``clockwise`` tells how the sample turns, seen from above.

A file .nsihdr describes a reconstructed volume, and no radiographs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from validation.doors.refusal import refused
from validation.doors.scan import Counts, Images, Scan, along_frame
from validation.doors.tiff import read_tiff_files, read_tiff_stack, tiffs_of

Floats = NDArray[np.float64]

MOST_TILT_RAD = math.radians(0.5)
"""Tilt of the axis along the beam that is passed over: `pdvc.geometry` has none."""


def read_north_star(path: Path) -> Scan:
    """Read a scan from its .nsipro.

    Raises FormatError, in one line, for what is missing, unreadable, or not to be described by `pdvc.geometry`.
    """
    if path.suffix.lower() == ".nsihdr":
        raise refused(path, "", "the project of a scan, .nsipro", "the header of a reconstructed volume, .nsihdr")
    project = _Project(path)
    stored = project.whole("height pixels", "Detector"), project.whole("width pixels", "Detector")
    count = project.whole("number", "Object Radiograph")
    folder = _only_folder(path.parent)
    files = tiffs_of(folder)
    if len(files) != count:
        raise refused(path, "Object Radiograph: number", f"{count} TIFFs in {folder.name}", len(files))
    straight = _straightened(project)
    images = straight(read_tiff_files(files, stored))
    flat, dark = (_correction(path.parent, name) for name in ("gain0.tif", "offset.tif"))
    sense = -1.0 if project.truth("clockwise", "Processed") else 1.0
    return Scan(
        source=path,
        images=images,
        angle_deg=sense * project.numbers("angleStep", "Object Radiograph", 1)[0] * np.arange(count),
        geometry=_geometry(project, images.size),
        flats=None if flat is None else straight(read_tiff_stack(flat)),
        darks=None if dark is None else straight(read_tiff_stack(dark)),
        title=path.stem,
        notes=tuple(
            f"{report}: not read; where it places the detector otherwise than {path.name}: --column-shift-mm"
            for report in sorted(path.parent.glob("Geometry*.rtf"))
        ),
    )


class _Project:
    """The values of a project file, by section and key."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._lines = [line.strip() for line in path.read_text(encoding="utf-8", errors="replace").splitlines()]
        except FileNotFoundError:
            raise refused(path, "", "a file .nsipro", "none") from None

    def text(self, key: str, section: str) -> str:
        """Return the first value of a key in the first section of a name."""
        begin, end, tag = f"<{section}>", f"</{section}>", f"<{key}>"
        if begin not in self._lines or end not in self._lines:
            raise refused(self.path, section, f"a section {begin}", "none")
        inside = self._lines[self._lines.index(begin) + 1 : self._lines.index(end)]
        found = [line.removeprefix(tag) for line in inside if line.startswith(tag)]
        if not found:
            raise refused(self.path, f"{section}: {key}", "a value", "none")
        return found[0].removesuffix(f"</{key}>").strip()

    def numbers(self, key: str, section: str, count: int) -> Floats:
        text = self.text(key, section)
        try:
            values = np.array([float(part) for part in text.split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != count or not np.isfinite(values).all():
            raise refused(self.path, f"{section}: {key}", f"{count} number{'s' if count > 1 else ''}", repr(text))
        return values

    def whole(self, key: str, section: str) -> int:
        value = float(self.numbers(key, section, 1)[0])
        if value != int(value) or value < 1:
            raise refused(self.path, f"{section}: {key}", "a whole number from 1 on", f"{value:g}")
        return int(value)

    def truth(self, key: str, section: str) -> bool:
        text = self.text(key, section)
        if text not in ("True", "False"):
            raise refused(self.path, f"{section}: {key}", "True or False", repr(text))
        return text == "True"


def _straightened(project: _Project) -> Callable[[Images], Images]:
    """Return the function that flips and turns stored images as the project says: flips first, then quarter turns."""
    flips = {axis: project.truth(f"flip{axis}", "Correction") for axis in "HV"}
    turns, rest = divmod(project.numbers("rotate", "Correction", 1)[0], 90)
    if rest:
        raise refused(project.path, "Correction: rotate", "0, 90, 180 or 270 degrees", 90 * turns + rest)

    def straight(images: Images) -> Images:
        flipped = images.mirrored(columns=flips["H"], rows=flips["V"])
        size = flipped.size[::-1] if turns % 2 else flipped.size

        def read(k: int) -> Counts:
            # clockwise, as one looks at the image
            return np.ascontiguousarray(np.rot90(flipped.read(k), -int(turns)))

        return replace(flipped, size=size, read=read)

    return straight


def _geometry(project: _Project, size: tuple[int, int]) -> dict[str, float]:
    source, corner, axis, beam, right = (
        project.numbers(key, "Result", 3) for key in ("source", "reference", "axis", "normal", "horizontal")
    )
    beam, right, axis = (vector / np.linalg.norm(vector) for vector in (beam, right, axis))
    down = np.cross(beam, right)
    axis = axis if axis @ down > 0 else -axis
    tilt = math.asin(min(1.0, abs(float(axis @ beam))))
    if tilt > MOST_TILT_RAD:
        raise refused(
            project.path, "Result: axis", "an axis across the beam, within 0.5 degrees", f"{math.degrees(tilt):.2f}"
        )
    wide, high = project.numbers("pitch", "Object Radiograph", 2)
    if abs(wide - high) > 1e-3 * wide:
        raise refused(project.path, "Object Radiograph: pitch", "square pixels, mm", f"{wide:g} x {high:g}")
    to_axis, to_detector = float(-source @ beam), float((corner - source) @ beam)
    roll = math.atan2(float(axis @ right), float(axis @ down))
    # the axis, seen from a source beside it
    aside = float(source @ np.cross(axis, beam)) * to_detector / to_axis
    middle = corner - source + wide * ((size[0] - 1) / 2 * down + (size[1] - 1) / 2 * right)
    columns, rows = along_frame(float(middle @ right), float(middle @ down), roll)
    return {
        "source_axis_mm": to_axis,
        "source_detector_mm": to_detector,
        "pixel_mm": float(wide),
        "column_shift_mm": columns + aside,
        "row_shift_mm": rows,
        "roll_deg": math.degrees(roll),
    }


def _only_folder(folder: Path) -> Path:
    found = sorted(each for each in folder.glob("Radiographs*") if each.is_dir())
    if len(found) != 1:
        raise refused(folder, "", "one folder Radiographs*", ", ".join(each.name for each in found) or "none")
    return found[0]


def _correction(folder: Path, name: str) -> Path | None:
    found = sorted(folder.glob(f"*/{name}")) or sorted(folder.glob(name))
    if len(found) > 1:
        raise refused(folder, name, "one image", ", ".join(str(each) for each in found))
    return found[0] if found else None
