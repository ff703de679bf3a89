"""The record of a test that is followed while it runs: a file to which a line of JSON is added for each radiograph.

It is only ever added to, and each line is on the disk before the next radiograph is looked at, so that it survives
whatever happens to the process, and anything may read it meanwhile. The first line tells what the others are about;
`what` tells of each line which kind it is::

    {"what": "plan", "title": ..., "steps": 127, "height_mm": [...], "voxel_mm": 0.0107}
    {"what": "step", "step": 0, "angle_deg": ..., "time_s": ..., "displacement_voxel": [[...], ...], ...}
    {"what": "alarm", "step": 61, "alarm": "crack", "value": 9.1, "limit": 8.0, "place_mm": [0.2, null, 1.4], ...}
    {"what": "lost", "step": 4, "file": "00004.tif", "reason": "..."}
    {"what": "measurement", "file": "motion.nc", "seconds": 312.0}
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

RECORD = ".record.jsonl"
"""What the name of a record ends with, after that of the measurement file."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of a record; each kind is a subclass with its own `what`."""

    what: ClassVar[str]

    def text(self) -> str:
        """Return the line, without its end; what is not finite is null."""
        return json.dumps(_plain({"what": self.what, **asdict(self)}), allow_nan=False)

    def words(self) -> str:
        """Return the line for a reader."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class PlanLine(Line):
    """What is followed: the first line."""

    what: ClassVar[str] = "plan"
    title: str
    steps: int
    """Steps that are planned."""
    height_mm: tuple[float, ...]
    """Heights of the sections on the axis, mm."""
    voxel_mm: float
    """Voxel in which displacements are counted, mm."""

    def words(self) -> str:
        """Return the line for a reader."""
        return f"following {self.title or 'a test'}: {self.steps} steps, {len(self.height_mm)} sections"


@dataclass(frozen=True, kw_only=True)
class StepLine(Line):
    """The motion at a step, from the radiographs up to it, with standard deviations."""

    what: ClassVar[str] = "step"
    step: int
    file: str
    angle_deg: float
    time_s: float
    force_N: float
    displacement_voxel: tuple[tuple[float, float, float], ...]
    """On the axis, at each section: across the beam, vertical, along the beam."""
    displacement_std: tuple[tuple[float, float, float], ...]
    strain: tuple[float, ...]
    """Axial strain between neighbouring sections."""
    strain_std: tuple[float, ...]
    mean_strain: float
    """Between the first section and the last."""
    mean_strain_std: float
    chi2_reduced: float
    """Mean square of the residual over its expected variance: one if the motion explains the radiograph."""
    passes: int
    seconds: float
    """From when the radiograph was taken up to when its motion was known."""
    unix_s: float
    """When that was, by the clock of the machine, s since 1970."""

    def words(self) -> str:
        """Return the line for a reader."""
        strain, deviation = 100 * self.mean_strain, 100 * self.mean_strain_std
        return (
            f"step {self.step}: {self.force_N:.0f} N, mean strain {strain:.3f} ± {deviation:.3f} %, "
            f"chi2 {self.chi2_reduced:.2f}, {self.seconds:.2f} s"
        )


@dataclass(frozen=True, kw_only=True)
class AlarmLine(Line):
    """An alarm that a radiograph raised."""

    what: ClassVar[str] = "alarm"
    step: int
    alarm: str
    """Its name, as `pdvc.alarms` explains it."""
    value: float
    """What was tested."""
    limit: float
    """What it was expected to be under, or over where it is under it."""
    reason: str
    place_mm: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    """Where on the sample, as it was at rest (x, y, z), as far as it is known."""

    def words(self) -> str:
        """Return the line for a reader."""
        return f"ALARM {self.alarm}: step {self.step}: {self.reason}"


@dataclass(frozen=True, kw_only=True)
class LostLine(Line):
    """A radiograph that could not be used, and why."""

    what: ClassVar[str] = "lost"
    step: int
    """-1 where it is not known."""
    file: str
    reason: str
    left_out: bool = False
    """Whether it was looked at and shows no motion, so that the measurement of the whole test leaves it out, too."""

    def words(self) -> str:
        """Return the line for a reader."""
        return f"lost: {self.reason}"


@dataclass(frozen=True, kw_only=True)
class MeasurementLine(Line):
    """The measurement of the whole test, once it was over."""

    what: ClassVar[str] = "measurement"
    file: str
    seconds: float

    def words(self) -> str:
        """Return the line for a reader."""
        return f"measured the whole test in {self.seconds:.0f} s"


_KINDS: dict[str, type[Line]] = {
    each.what: each for each in (PlanLine, StepLine, AlarmLine, LostLine, MeasurementLine)
}


class Record:
    """A record that is being written."""

    def __init__(self, path: Path) -> None:
        """Go on with a record, or begin one; half a line, left by a process that was killed, is taken away."""
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("ab+")
        self._file.seek(0)
        whole = self._file.read()
        end = whole.rfind(b"\n") + 1
        self.lines = whole[:end].decode().splitlines()
        """All lines, as text."""
        if end < len(whole):
            self._file.truncate(end)

    def add(self, line: Line) -> None:
        """Add a line, and wait until it is on the disk."""
        self.add_text(line.text())

    def add_text(self, text: str) -> None:
        """Add a line by its text, as `Line.text` returns it."""
        self._file.write(text.encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.lines.append(text)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def record_of(file: Path) -> Path:
    """Return where the record of a test is, that is followed into a measurement file."""
    return file.with_name(file.name + RECORD)


def read_record(path: Path) -> Iterator[Line]:
    """Yield the whole lines of a record; raises ValueError where a line is none of a record."""
    for number, text in enumerate(path.read_bytes().split(b"\n")[:-1], start=1):
        yield line_of(text, f"{path}, line {number}")


def line_of(text: str | bytes, where: str) -> Line:
    """Return a line by its text; raises ValueError where it is none of a record, naming where it stands."""
    try:
        values: dict[str, Any] = json.loads(text)
        return _KINDS[values.pop("what")](**{key: _tuples(value) for key, value in values.items()})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{where}: expected a line of a record, got {text[:60]!r}: {error}") from None


def _plain(value: Any) -> Any:
    """Return a value as JSON has it."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _tuples(value: Any) -> Any:
    """Return the same as a line has it."""
    if isinstance(value, list):
        return tuple(_tuples(each) for each in value)
    return math.nan if value is None else value
