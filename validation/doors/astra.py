"""Geometry as ASTRA's ``cone_vec`` vectors, and back: the mapping of docs/frame.md; ASTRA itself is not needed.

The twelve numbers of a radiograph are source, middle of the detector, the vector u from pixel (row 0, column 0) to
(row 0, column 1), and the vector v from there to (row 1, column 0), in the frame of the sample, mm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pdvc.geometry import ConeBeam
from pdvc.rays import directions, ray_vectors
from pdvc.whole import write_whole
from validation.doors.quantities import LENGTH
from validation.doors.refusal import refused
from validation.doors.scan import Floats
from validation.doors.tables import read_table

COLUMNS = tuple(f"{name}_{axis}_mm" for name in ("source", "detector", "u", "v") for axis in "xyz")
"""Names of the twelve numbers in a file."""
NEARLY = 1e-6
"""Share of a length by which views may differ, and the beam may miss the axis: what rounding leaves."""


def cone_vec(geometry: ConeBeam, angle_rad: ArrayLike) -> Floats:
    """Return the vectors (angle, 12), mm, of a geometry at stage angles (angle,), rad."""
    rays = ray_vectors(geometry, angle_rad)
    middle = rays.corner_mm + rays.row_mm * (geometry.rows - 1) / 2 + rays.column_mm * (geometry.columns - 1) / 2
    return np.hstack([rays.source_mm, middle, rays.column_mm, rays.row_mm])


def from_cone_vec(vectors: Floats, path: Path | str = "cone_vec") -> tuple[dict[str, float], Floats]:
    """Return the geometry of vectors (angle, 12), mm, by its keys, and the stage angles (angle,): mm and degrees.

    Raises FormatError, in one line, for views that are not those of a stage that turns about z in front of a detector
    that stands still, as `pdvc.geometry` describes it: `path` names them.
    """
    source, middle, along_columns, along_rows = (vectors[:, k : k + 3] for k in (0, 3, 6, 9))
    beam = np.cross(along_columns, along_rows)
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    if np.any(_dots(middle - source, beam) <= 0):
        expected = "u to the right and v downwards for an eye at the source"
        raise refused(path, "u, v", expected, "u to the left or v upwards")
    angle = np.unwrap(np.arctan2(-beam[:, 1], beam[:, 0]))
    level, across = directions(angle)
    down = np.array([0.0, 0.0, -1.0])
    beyond = _dots(middle - source, level)
    off = np.abs(np.stack([beam[:, 2], _dots(source, across) / beyond, source[:, 2] / beyond]))
    if off.max() > NEARLY:
        expected = "a beam through the z axis, level and normal to the detector"
        raise refused(path, "source", expected, f"one that is {off.max():.2g} off")
    found = {
        "source_axis_mm": -_dots(source, level),
        "source_detector_mm": beyond,
        "pixel_mm": np.linalg.norm(along_columns, axis=1),
        "column_shift_mm": _dots(middle, across),
        "row_shift_mm": middle @ down,
        "roll_deg": np.rad2deg(np.arctan2(along_columns @ down, _dots(along_columns, across))),
    }
    high = np.linalg.norm(along_rows, axis=1)
    if (
        np.abs(high - found["pixel_mm"]).max() > NEARLY * high.max()
        or np.abs(_dots(along_columns, along_rows)).max() > NEARLY * high.max() ** 2
    ):
        raise refused(path, "u, v", "square pixels", f"|u| = {found['pixel_mm'][0]:g}, |v| = {high[0]:g} mm")
    for key, values in found.items():
        if np.ptp(values) > NEARLY * max(1.0, float(beyond.max())):
            raise refused(path, key, "the same for all views", f"{values.min():g} to {values.max():g}")
    return {key: float(values.mean()) for key, values in found.items()}, np.rad2deg(angle)


def write_cone_vec(path: Path, geometry: ConeBeam, angle_rad: ArrayLike) -> None:
    """Write the vectors as a table with a line for each angle."""
    rows = (",".join(map(repr, row)) for row in cone_vec(geometry, angle_rad).tolist())
    write_whole(path, "\n".join([",".join(COLUMNS), *rows, ""]).encode())


def read_cone_vec(path: Path) -> tuple[dict[str, float], Floats]:
    """Read vectors from a table; returns what `from_cone_vec` does, and raises FormatError as it does."""
    table = read_table(path)
    vectors = np.stack([table.numbers([name.removesuffix("_mm")], LENGTH) for name in COLUMNS], axis=1)
    return from_cone_vec(vectors, path)


def _dots(first: Floats, second: Floats) -> Floats:
    return np.asarray((first * second).sum(axis=1))
