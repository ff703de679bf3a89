"""Units in which other programs write lengths, times, forces and angles, and what they are in mm, s, N and degrees."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from validation.doors.refusal import refused

Units = Mapping[str, float]

LENGTH: Units = {
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1.0),
    **dict.fromkeys(("m", "meter", "metre"), 1e3),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), 10.0),
    **dict.fromkeys(("um", "µm", "μm", "micron", "micrometer", "micrometre"), 1e-3),
}
"""mm in one unit."""
TIME: Units = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    "ms": 1e-3,
    "min": 60.0,
    "h": 3600.0,
}
"""s in one unit."""
FORCE: Units = {**dict.fromkeys(("N", "newton"), 1.0), "kN": 1e3, "mN": 1e-3}
"""N in one unit."""
ANGLE: Units = {
    **dict.fromkeys(("deg", "degree", "degrees", "°"), 1.0),
    **dict.fromkeys(("rad", "radian", "radians"), math.degrees(1.0)),
}
"""Degrees in one unit."""


def in_ours(units: Units, unit: str, path: Path, key: str) -> float:
    """Return what one `unit` is in mm, s, N or degrees; raises FormatError where it is none of `units`."""
    if unit not in units:
        raise refused(path, key, f"a unit, one of {', '.join(units)}", repr(unit))
    return units[unit]
