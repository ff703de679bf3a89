"""Geometry files, by the ending of their name: .xml is RTK's, .csv holds ASTRA's vectors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from numpy.typing import ArrayLike

from pdvc.geometry import ConeBeam
from validation.doors.astra import read_cone_vec, write_cone_vec
from validation.doors.refusal import refused
from validation.doors.rtk import read_rtk, write_rtk
from validation.doors.scan import Floats


class _Kind(NamedTuple):
    read: Callable[[Path], tuple[dict[str, float], Floats]]
    write: Callable[[Path, ConeBeam, ArrayLike], None]


_KINDS = {".xml": _Kind(read_rtk, write_rtk), ".csv": _Kind(read_cone_vec, write_cone_vec)}


def read_geometry(path: Path) -> tuple[dict[str, float], Floats]:
    """Return what a file tells of the geometry, by its keys, mm and degrees, and the stage angles, degrees."""
    return _kind(path).read(path)


def write_geometry(path: Path, geometry: ConeBeam, angle_rad: ArrayLike) -> None:
    """Write a geometry at stage angles (angle,), rad."""
    _kind(path).write(path, geometry, angle_rad)


def _kind(path: Path) -> _Kind:
    kind = _KINDS.get(path.suffix.lower())
    if kind is None:
        raise refused(path, "", "a geometry file, .xml of RTK or .csv of ASTRA's vectors", path.suffix or "no ending")
    return kind
