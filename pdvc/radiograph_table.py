"""The table of radiographs that arrive one by one, radiographs.csv: read while it grows, and written line by line.

The first line is ``step,file,angle_deg,time_s,force_N``. Then each radiograph has a line: its place in the planned
test, counted from 0; its TIFF, relative to the folder of the table; stage angle in degrees, time in s, force in N.
Lines come in any order of steps. A last line without its line break is still being written, and does not count yet.
"""

from __future__ import annotations

import codecs
import csv
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import numpy as np

from pdvc.stacks import ExperimentError

TABLE = "radiographs.csv"
COLUMNS = ("step", "file", "angle_deg", "time_s", "force_N")
HEADER = ",".join(COLUMNS)
LARGEST = 1e9
"""Size that no recorded number exceeds, as in experiment.toml."""
NO_STEP = -1
"""Step of a line that tells none of the test."""


@dataclass(frozen=True, kw_only=True)
class Line:
    """What the table tells of a radiograph."""

    step: int
    """Step of the test, counted from 0."""
    file: str
    """The TIFF, relative to the folder of the table."""
    angle_rad: float
    time_s: float
    force_N: float


@dataclass(frozen=True, kw_only=True)
class WrongLine:
    """A line of the table that cannot be used."""

    step: int
    """Step of the test, counted from 0; `NO_STEP` where the line tells none."""
    reason: str
    """Where, what was expected and what was found, in one line."""


class RadiographTable:
    """The table of a test of so many steps, which grows: each line is handed out once, as soon as it is whole."""

    def __init__(self, path: Path, steps: int) -> None:
        self._path = path
        self._steps = steps
        self._named: set[int] = set()
        """Steps of the lines that were handed out."""
        self._lines = 0
        """Lines that were handed out, with the first one, of names."""
        self._taken = 0
        """Bytes of these lines."""
        self._seen = 0
        """Bytes that were there, those of half a line included."""

    def appended(self) -> list[Line | WrongLine]:
        """Return the lines that became whole since this was last asked; only what was appended is read.

        A line is wrong, too, where a right one had its step. Empty lines are passed over; a table that is not there
        has none.

        Raises ExperimentError, in one line, where there is no folder, the first line is another or the table became
        shorter; OSError where it cannot be read.
        """
        size = self._size()
        if size < self._seen:
            raise ExperimentError(
                f"{self._path}: expected a table that only grows, found {self._seen}, then {size} bytes"
            )
        if size == self._seen:
            return []
        with self._path.open("rb") as table:
            table.seek(self._taken)
            content = table.read()
        *whole, half = content.split(b"\n")
        numbered = list(enumerate(whole, self._lines + 1))
        if whole and not self._lines:
            self._check_first(numbered.pop(0)[1])
        self._seen = self._taken + len(content)
        self._taken = self._seen - len(half)
        self._lines += len(whole)
        return [self._line(number, text) for number, text in numbered if text.strip()]

    def _size(self) -> int:
        try:
            return self._path.stat().st_size
        except (FileNotFoundError, NotADirectoryError):
            folder = self._path.parent
            if not folder.is_dir():
                found = "a file" if folder.exists() else "none"
                raise ExperimentError(f"{folder}: expected a folder of radiographs, found {found}") from None
            return 0

    def _check_first(self, text: bytes) -> None:
        # some programs begin a text with a byte-order mark
        found = text.removeprefix(codecs.BOM_UTF8).decode(errors="replace").strip()
        if found != HEADER:
            raise ExperimentError(f"{self._path}: expected the first line {HEADER}, found {_shown(found)}")

    def _line(self, number: int, text: bytes) -> Line | WrongLine:
        step = NO_STEP
        try:
            fields = _fields(text)
            step = _step(fields["step"], self._steps)
            if step in self._named:
                raise ExperimentError(f"step: expected a line for each step, found {step} again")
            line = Line(
                step=step,
                file=_inside(fields["file"]),
                angle_rad=float(np.deg2rad(_number("angle_deg", fields))),
                time_s=_number("time_s", fields),
                force_N=_number("force_N", fields),
            )
        except ExperimentError as error:
            return WrongLine(step=step, reason=f"{self._path}: line {number}: {error}")
        self._named.add(step)
        return line


def begin_table(path: Path) -> None:
    """Write the first line of a table; raises ExperimentError, in one line, where there is a table already."""
    try:
        with path.open("xb") as table:
            table.write(f"{HEADER}\n".encode())
    except FileExistsError:
        raise ExperimentError(f"{path}: expected a folder without a table, found one") from None


def append_line(path: Path, line: Line) -> None:
    """Append a line to a table, with all digits: an angle comes back within 1e-15 of its size, the rest as it is."""
    numbers = (float(np.rad2deg(line.angle_rad)), float(line.time_s), float(line.force_N))
    with path.open("ab") as table:
        table.write(f"{line.step},{line.file},{','.join(map(repr, numbers))}\n".encode())


def _fields(text: bytes) -> dict[str, str]:
    try:
        (values,) = csv.reader([text.decode().strip()], skipinitialspace=True)
    except (UnicodeDecodeError, csv.Error) as error:
        raise ExperimentError(f"expected {HEADER} in UTF-8, found {_shown(str(text))}: {error}") from None
    if len(values) != len(COLUMNS):
        raise ExperimentError(f"expected {HEADER}, found {len(values)} fields, {_shown(text.decode().strip())}")
    return {name: value.strip() for name, value in zip(COLUMNS, values, strict=True)}


def _step(text: str, steps: int) -> int:
    try:
        step = int(text)
    except ValueError:
        step = NO_STEP
    if not 0 <= step < steps:
        raise ExperimentError(f"step: expected a whole number, 0 to {steps - 1}, found {_shown(text)}")
    return step


def _inside(file: str) -> str:
    """Return the name of a file, which must stay within the folder on every system: the rules of Windows hold all."""
    path = PureWindowsPath(file)
    if not path.name or path.anchor or ".." in path.parts or not file.isprintable():
        raise ExperimentError(f"file: expected a name within the folder, found {_shown(file)}")
    return file


def _number(name: str, fields: dict[str, str]) -> float:
    try:
        value = float(fields[name])
    except ValueError:
        value = np.nan
    if not abs(value) <= LARGEST:
        raise ExperimentError(f"{name}: expected a number of size up to {LARGEST:g}, found {_shown(fields[name])}")
    return value


def _shown(text: str) -> str:
    """Return what a table holds as it fits into a line of text."""
    return repr(text if len(text) < 80 else text[:77] + "...")
