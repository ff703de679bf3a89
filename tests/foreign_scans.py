"""Scans of a marker as other programs would write them: each format's own frame, written out anew in plain numpy.

The marker is a blob that absorbs nothing and shines instead: its centre in an image is found to a thousandth of a
pixel, and tells whether the image, its angle and the geometry were understood.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import tifffile
from numpy.typing import NDArray

from pdvc.geometry import ConeBeam
from pdvc.rays import ray_vectors

Floats = NDArray[np.float64]

TO_AXIS_MM, TO_DETECTOR_MM, PIXEL_MM = 30.0, 300.0, 0.5
ROWS, COLUMNS, VIEWS = 46, 38, 12
MARKER = np.array([0.31, -0.42, 0.55])
"""Right of the axis, along the beam, and up, at angle 0, as an eye at the source sees it, mm."""
FLAT, DARK = 50_000, 300


@dataclass(frozen=True)
class Written:
    """A scan that was written, and the marker in the frame of `pdvc.geometry`."""

    path: Path
    marker_mm: Floats


def blob(row: float, column: float, shape: tuple[int, int] = (ROWS, COLUMNS)) -> NDArray[np.uint16]:
    """Return an image with a blob of 1.2 px about a place."""
    rows, columns = np.indices(shape)
    assert 5 < row < shape[0] - 6
    assert 5 < column < shape[1] - 6
    return np.round(DARK + 20_000 * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / 2 / 1.2**2)).astype(
        np.uint16
    )


def centre(image: NDArray[np.uint16]) -> tuple[float, float]:
    """Return the place of the blob."""
    weight = np.maximum(image.astype(float) - DARK, 0)
    rows, columns = np.indices(image.shape)
    return float((weight * rows).sum() / weight.sum()), float((weight * columns).sum() / weight.sum())


def expected_centres(geometry: ConeBeam, angle_rad: Floats, marker_mm: Floats) -> Floats:
    """Return where a marker is seen (image, 2), rows and columns, by the frame of `pdvc.geometry`."""
    rays = ray_vectors(geometry, angle_rad)
    places = []
    for source, corner, row, column in rays.stacked():
        # source + t (marker - source) = corner + r row + c column
        _, r, c = np.linalg.solve(np.stack([marker_mm - source, -row, -column], axis=1), corner - source)
        places.append((r, c))
    return np.array(places)


def turn(axis: Floats, degrees: float) -> Floats:
    """Return the matrix of a right-handed turn about an axis."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def write_nikon(folder: Path, *, roll_deg: float = 0.8, offset_mm: float = 0.4, **changes: object) -> Written:
    """Write a Nikon scan in CIL's frame: x to the right, y along the beam, z up; pixel (0, 0) at the top right."""
    step, initial, name = 30.0, 7.0, "bar"
    lean = np.deg2rad(roll_deg)
    axis, right = np.array([np.sin(lean), 0, np.cos(lean)]), np.array([np.cos(lean), 0, -np.sin(lean)])
    beam = np.array([0.0, 1.0, 0.0])
    on_axis = np.array([-offset_mm * TO_AXIS_MM / TO_DETECTOR_MM, TO_AXIS_MM, 0])
    for k in range(VIEWS):
        at_zero = MARKER[0] * right + MARKER[1] * beam + MARKER[2] * axis
        # the sample turns counter-clockwise by CIL's angle
        place = on_axis + turn(axis, -step * k - initial + 180) @ at_zero
        x, _, z = place * TO_DETECTOR_MM / place[1]
        image = blob((ROWS - 1) / 2 - z / PIXEL_MM, (COLUMNS - 1) / 2 - x / PIXEL_MM)
        tifffile.imwrite(folder / f"{name}_{k + 1:04d}.tif", image)
    shift = np.tan(-lean) * ROWS * PIXEL_MM / 2
    values: dict[str, object] = {
        "Name": name, "InputSeparator": "_", "InputFolderName": "", "Units": "mm",
        "SrcToObject": TO_AXIS_MM, "SrcToDetector": TO_DETECTOR_MM,
        "DetectorPixelsX": COLUMNS, "DetectorPixelsY": ROWS,
        "DetectorPixelSizeX": PIXEL_MM, "DetectorPixelSizeY": PIXEL_MM,
        "CentreOfRotationTop": offset_mm + shift, "CentreOfRotationBottom": offset_mm - shift,
        "WhiteLevel": 60000.0, "Projections": VIEWS, "InitialAngle": initial, "AngularStep": step, **changes,
    }  # fmt: skip
    lines = [f"{key}={value}" for key, value in values.items() if value is not None]
    path = folder / "bar.xtekct"
    path.write_text("\n".join(["[XTekCT]", *lines, "[Xrays]", "XraykV=160", ""]))
    # CIL's angle has half a turn more than ours
    return Written(path, np.array([-MARKER[1], MARKER[0], MARKER[2]]))


def write_north_star(
    folder: Path,
    *,
    roll_deg: float = 0.7,
    clockwise: bool = True,
    flips: tuple[bool, bool] = (False, False),
    rotate: int = 0,
    changes: tuple[tuple[str, str], ...] = (),
) -> Written:
    """Write a North Star scan: x to the right, y up, z towards the source; images as stored before flips and turns."""
    step, aside = 30.0, 0.02
    lean = np.deg2rad(roll_deg)
    right, down = np.array([np.cos(lean), np.sin(-lean), 0]), np.array([-np.sin(lean), -np.cos(lean), 0])
    source = np.array([aside, 0.1, TO_AXIS_MM])
    middle = np.array([0.9, -0.4, TO_AXIS_MM - TO_DETECTOR_MM])
    corner = middle - PIXEL_MM * ((COLUMNS - 1) / 2 * right + (ROWS - 1) / 2 * down)
    (folder / "Radiographs").mkdir()
    (folder / "Corrections").mkdir()

    def stored(image: NDArray[np.uint16]) -> NDArray[np.uint16]:
        before = np.rot90(image, rotate // 90)
        return before[:: -1 if flips[1] else 1, :: -1 if flips[0] else 1]

    for k in range(VIEWS):
        sense = -1 if clockwise else 1
        place = turn(np.array([0.0, 1.0, 0.0]), sense * step * k) @ np.array([MARKER[0], MARKER[2], -MARKER[1]])
        towards = np.stack([place - source, -PIXEL_MM * down, -PIXEL_MM * right], axis=1)
        _, row, column = np.linalg.solve(towards, corner - source)
        tifffile.imwrite(folder / "Radiographs" / f"rad{k:05d}.tif", stored(blob(row, column)))
    tifffile.imwrite(folder / "Corrections" / "gain0.tif", stored(np.full((ROWS, COLUMNS), FLAT, np.uint16)))
    tifffile.imwrite(folder / "Corrections" / "offset.tif", stored(np.full((ROWS, COLUMNS), DARK, np.uint16)))
    height, width = (COLUMNS, ROWS) if rotate % 180 else (ROWS, COLUMNS)

    def vector(values: Floats) -> str:
        return " ".join(f"{value:.9f}" for value in values)

    text = f"""<North Star Imaging Project>
<CT Project Configuration>
  <Rotation range>360
</CT Project Configuration>
<Detector>
  <width pixels>{width}
  <height pixels>{height}
</Detector>
<Object Radiograph>
  <pitch>{PIXEL_MM} {PIXEL_MM}
  <number>{VIEWS}
  <angleStep>{step}
</Object Radiograph>
<Correction>
  <rotate>{rotate}
  <flipH>{flips[0]}
  <flipV>{flips[1]}
</Correction>
<Processed>
  <clockwise>{clockwise}
</Processed>
<Result>
  <source>{vector(source)}
  <reference>{vector(corner)}
  <axis>0.0 1.0 0.0
  <normal>0.0 0.0 -1.0
  <horizontal>{vector(right)}
</Result>
"""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "bar.nsipro"
    path.write_text(text)
    # our origin is at the height of the source
    return Written(path, np.array([MARKER[1], -MARKER[0], MARKER[2] - source[1]]))


def write_nexus(
    path: Path,
    *,
    flips: tuple[bool, bool] = (False, False),
    old: bool = False,
    esrf: bool = False,
    radians: bool = False,
) -> Written:
    """Write an NXtomo file in the frame of NeXus: x to the left, y up, z along the beam; lengths in m."""
    step, axis_column, axis_row = 30.0, 17.25, 23.75
    keys = np.array([2, 1, 1, *[0] * VIEWS, 3])
    frames = [np.full((ROWS, COLUMNS), value, np.uint16) for value in (DARK, FLAT, FLAT)]
    for k in range(VIEWS):
        place = turn(np.array([0.0, 1.0, 0.0]), step * k + 11) @ np.array([-MARKER[0], MARKER[2], MARKER[1]])
        x, y, _ = place * TO_DETECTOR_MM / (TO_AXIS_MM + place[2])
        frames.append(blob(axis_row - y / PIXEL_MM, axis_column - x / PIXEL_MM))
    frames.append(np.zeros((ROWS, COLUMNS), np.uint16))
    order = (slice(None), slice(None, None, -1 if flips[1] else 1), slice(None, None, -1 if flips[0] else 1))
    angle = np.where(keys == 0, step * (np.arange(len(keys)) - 3) + 11, 0)
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry0000")
        entry.attrs["NX_class"] = "NXentry"
        entry["definition"] = "NXtomo"
        entry["instrument/detector/data"] = np.array(frames)[order]
        entry["instrument/detector/image_key"] = keys
        entry["sample/rotation_angle"] = np.deg2rad(angle) if radians else angle
        entry["sample/rotation_angle"].attrs["units"] = "rad" if radians else "degree"
        column = COLUMNS - 1 - axis_column if flips[0] else axis_column
        entry["instrument/detector/x_rotation_axis_pixel_position"] = column
        entry["instrument/detector/y_rotation_axis_pixel_position"] = ROWS - 1 - axis_row if flips[1] else axis_row
        for name, value in (
            ("detector/x_pixel_size", PIXEL_MM),
            ("detector/y_pixel_size", PIXEL_MM),
            ("detector/distance", TO_DETECTOR_MM - TO_AXIS_MM),
            ("source/distance", -TO_AXIS_MM),
        ):
            entry[f"instrument/{name}"] = value * 1e-3
            entry[f"instrument/{name}"].attrs["units"] = "m"
        # up and across: of NeXus, or of the files that nxtomo wrote before its version 2.0
        axes = ([0, 0, 1], [0, 1, 0]) if esrf else ([0, 1, 0], [1, 0, 0])
        if esrf:
            entry.attrs["version"] = 1.5
        for name, axis, flip in zip(("x", "y"), axes, flips, strict=True):
            if old:
                entry[f"instrument/detector/{name}_flipped"] = flip
            else:
                place = f"instrument/detector/transformations/flip_{name}"
                entry[place] = 180.0 * flip
                entry[place].attrs.update({"transformation_type": "rotation", "vector": axis, "units": "deg"})
    return Written(path, np.array([MARKER[1], -MARKER[0], MARKER[2]]))


def write_single_tiffs(folder: Path, forces: bool = True) -> Written:
    """Write single TIFFs and their table, in the frame of docs/folder.md, its lines in no order of steps."""
    lines = []
    marker = np.array([MARKER[1], -MARKER[0], MARKER[2]])
    for k in range(VIEWS):
        x, y, z = turn(np.array([0.0, 0.0, 1.0]), 30.0 * k + 5) @ marker
        scale = TO_DETECTOR_MM / (TO_AXIS_MM + x) / PIXEL_MM
        tifffile.imwrite(folder / f"r{k}.tif", blob((ROWS - 1) / 2 - z * scale, (COLUMNS - 1) / 2 - y * scale))
        force = f",{0.25 + 0.01 * k}" if forces else ""
        lines.append(f"{k},r{k}.tif,{30.0 * k + 5},{2.0 * k + 1}{force}")
    header = "step,file,angle_deg,time_s" + (",force_kN" if forces else "")
    (folder / "radiographs.csv").write_text("\n".join([header, *lines[::-1], ""]))
    return Written(folder, marker)
