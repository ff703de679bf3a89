"""Geometry as RTK's ``ThreeDCircularProjectionGeometry``, and back: parameters, matrices and its XML file.

The mapping of docs/frame.md; RTK itself is not needed. With capital letters for RTK's coordinates, (X, Y, Z) =
(y, z, x), and the gantry stands at 180 degrees less the stage angle. Pixel and size of the detector are not part of
it: they belong to RTK's images.
"""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from pdvc.geometry import ConeBeam, within_half_turn
from pdvc.whole import write_whole
from validation.doors.refusal import refused
from validation.doors.scan import Floats

ROOT = "RTKThreeDCircularGeometry"
VERSION = "3"
OF_ALL = (
    "SourceToIsocenterDistance",
    "SourceToDetectorDistance",
    "ProjectionOffsetX",
    "ProjectionOffsetY",
    "InPlaneAngle",
)
"""Parameters that all projections have in common, in mm and degrees."""
NONE_HERE = ("SourceOffsetX", "SourceOffsetY", "OutOfPlaneAngle", "RadiusCylindricalDetector")
"""Parameters that `pdvc.geometry` does not have: they must be 0."""
GANTRY = "GantryAngle"
NEARLY = 1e-6
LARGEST_MISMATCH = 1e-3
"""Difference of a matrix from its parameters that RTK itself takes."""


def rtk_parameters(geometry: ConeBeam, angle_rad: ArrayLike) -> tuple[dict[str, float], Floats]:
    """Return what all projections have in common, by its parameters, and gantry angles (angle,): mm and degrees."""
    c, s = math.cos(geometry.roll_rad), math.sin(geometry.roll_rad)
    right, down = geometry.column_shift_mm, geometry.row_shift_mm
    common = (geometry.source_axis_mm, geometry.source_detector_mm, c * right + s * down, s * right - c * down)
    gantry = np.mod(180.0 - np.rad2deg(np.asarray(angle_rad, dtype=float)), 360.0)
    return dict(zip(OF_ALL, (*common, -math.degrees(geometry.roll_rad)), strict=True)), np.atleast_1d(gantry)


def from_rtk_parameters(common: dict[str, float], gantry_deg: Floats) -> tuple[dict[str, float], Floats]:
    """Return the geometry by its keys but ``pixel_mm``, mm and degrees, and stage angles (angle,), degrees."""
    roll = float(within_half_turn(-math.radians(common["InPlaneAngle"])))
    c, s = math.cos(roll), math.sin(roll)
    across, up = common["ProjectionOffsetX"], common["ProjectionOffsetY"]
    return {
        "source_axis_mm": common["SourceToIsocenterDistance"],
        "source_detector_mm": common["SourceToDetectorDistance"],
        "column_shift_mm": c * across + s * up,
        "row_shift_mm": s * across - c * up,
        "roll_deg": math.degrees(roll),
    }, np.unwrap(180.0 - gantry_deg, period=360.0)


def rtk_matrices(common: dict[str, float], gantry_deg: Floats) -> Floats:
    """Return the projection matrices (angle, 3, 4): from (X, Y, Z, 1), mm, to w (x, y, 1) on the detector, mm."""
    to_axis, to_detector, across, up, in_plane = (common[key] for key in OF_ALL)
    shift = np.array([[1.0, 0.0, -across], [0.0, 1.0, -up], [0.0, 0.0, 1.0]])
    magnify = np.array([[-to_detector, 0, 0, 0], [0, -to_detector, 0, 0], [0, 0, 1, -to_axis]])
    c, s = math.cos(math.radians(-in_plane)), math.sin(math.radians(-in_plane))
    result = np.empty((len(gantry_deg), 3, 4))
    for k, gantry in enumerate(np.deg2rad(-gantry_deg)):
        about_z = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        cos, sin = math.cos(gantry), math.sin(gantry)
        about_y = np.array([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0], [0, 0, 0, 1.0]])
        result[k] = shift @ magnify @ about_z @ about_y
    return result


def write_rtk(path: Path, geometry: ConeBeam, angle_rad: ArrayLike) -> None:
    """Write the geometry as RTK's XML, version 3, with the matrix of each projection."""
    common, gantry = rtk_parameters(geometry, angle_rad)
    lines = ['<?xml version="1.0"?>', "<!DOCTYPE RTKGEOMETRY>", f'<{ROOT} version="{VERSION}">']
    lines += [f"  <{key}>{value!r}</{key}>" for key, value in common.items() if value]
    for angle, matrix in zip(gantry.tolist(), rtk_matrices(common, gantry).tolist(), strict=True):
        rows = ["      " + " ".join(map(repr, row)) for row in matrix]
        lines += ["  <Projection>", f"    <{GANTRY}>{angle!r}</{GANTRY}>", "    <Matrix>", *rows, "    </Matrix>"]
        lines.append("  </Projection>")
    write_whole(path, "\n".join([*lines, f"</{ROOT}>", ""]).encode())


def read_rtk(path: Path) -> tuple[dict[str, float], Floats]:
    """Read RTK's XML; returns what `from_rtk_parameters` does.

    Raises FormatError, in one line, where it is none, where projections differ in more than their gantry angle, have a
    tilt or a source offset, or where a matrix is not that of its parameters.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except FileNotFoundError:
        raise refused(path, "", "a geometry of RTK, XML", "none") from None
    except ElementTree.ParseError as error:
        raise refused(path, "", "a geometry of RTK, XML", error) from None
    if root.tag != ROOT or root.get("version") not in ("2", VERSION):
        raise refused(
            path, "", f"<{ROOT}> of version 2 or {VERSION}", f"<{root.tag}> of version {root.get('version')}"
        )
    projections = root.findall("Projection")
    if not projections:
        raise refused(path, "Projection", "at least one", "none")
    told = {
        key: np.array([_number(path, key, one, root) for one in projections]) for key in (*OF_ALL, *NONE_HERE, GANTRY)
    }
    for key in NONE_HERE:
        if np.any(np.abs(told[key]) > NEARLY):
            raise refused(path, key, "0", told[key][np.abs(told[key]).argmax()])
    for key in OF_ALL:
        if np.ptp(told[key]) > NEARLY * max(1.0, float(np.abs(told[key]).max())):
            raise refused(path, key, "the same for all projections", f"{told[key].min():g} to {told[key].max():g}")
    common = {key: float(told[key].mean()) for key in OF_ALL}
    _check_matrices(path, projections, rtk_matrices(common, told[GANTRY]))
    return from_rtk_parameters(common, told[GANTRY])


def _number(path: Path, key: str, projection: ElementTree.Element, root: ElementTree.Element) -> float:
    """Return a parameter of a projection: its own, or that of all, or 0."""
    found = projection.findtext(key, root.findtext(key, "0"))
    try:
        value = float(found)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise refused(path, key, "a number", repr(found))
    return value


def _check_matrices(path: Path, projections: list[ElementTree.Element], expected: Floats) -> None:
    for place, (projection, matrix) in enumerate(zip(projections, expected, strict=True)):
        text = projection.findtext("Matrix")
        if text is None:
            continue
        try:
            found = np.array(text.split(), dtype=float).reshape(3, 4)
        except ValueError:
            raise refused(path, f"Projection {place}: Matrix", "3 x 4 numbers", repr(text)) from None
        worst = float(np.abs(found - matrix).max())
        if not worst <= LARGEST_MISMATCH:
            raise refused(path, f"Projection {place}: Matrix", "that of its parameters", f"numbers {worst:.2g} off")
