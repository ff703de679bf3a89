"""A folder into which a scanner writes radiographs one by one: read while it grows, and written.

It is readable, and written, without this software::

    radiographs.csv      a line for each radiograph, appended once its exposure is over: `pdvc.radiograph_table`
    *.tif                uint16 counts (row, column): one image each, named in the table

A TIFF may come after its line, and grow while it is looked at; it counts once all that it says is there.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import tifffile
from numpy.typing import NDArray

from pdvc.experiment import Series
from pdvc.radiograph_table import TABLE, Line, RadiographTable, append_line, begin_table
from pdvc.stacks import ExperimentError, UnfinishedError, read_radiograph
from pdvc.whole import write_whole


@dataclass(frozen=True, kw_only=True)
class Arrival:
    """A radiograph that is there completely, with what was recorded with it."""

    step: int
    """Step of the test, counted from 0."""
    file: str
    """The TIFF, as the table names it."""
    angle_rad: float
    time_s: float
    force_N: float
    counts: NDArray[np.uint16]
    """Counts (row, column), in memory."""

    @classmethod
    def of(cls, series: Series, step: int, counts: NDArray[np.uint16] | None = None) -> Self:
        """Return the radiograph of a step of a series that came from no folder, or other counts in its place."""
        return cls(
            step=step,
            file="",
            angle_rad=float(series.angle_rad[step]),
            time_s=float(series.time_s[step]),
            force_N=float(series.force_N[step]),
            counts=np.array(series.counts[step] if counts is None else counts),
        )


def series_of(arrivals: Sequence[Arrival]) -> Series:
    """Return the series of some radiographs, at least one."""
    return Series(
        counts=np.stack([each.counts for each in arrivals]),
        angle_rad=np.array([each.angle_rad for each in arrivals]),
        time_s=np.array([each.time_s for each in arrivals]),
        force_N=np.array([each.force_N for each in arrivals]),
    )


@dataclass(frozen=True, kw_only=True)
class Unreadable:
    """A radiograph that was given up, or a line of the table that was skipped."""

    step: int
    """Step of the test, counted from 0; -1 where a line tells none."""
    file: str
    """The TIFF, as the table names it; the table where one of its lines is wrong."""
    reason: str
    """Which file, what was expected and what was found, in one line."""


@dataclass(frozen=True, kw_only=True)
class _Awaited:
    """A radiograph whose line was read, and whose TIFF is not known to be whole."""

    line: Line
    since_s: float
    """Time at which its line was first seen, or the TIFF last found of another length."""
    length: int | None = None
    """Bytes of the TIFF when it was last looked at; None where there was none."""


class Incoming:
    """The radiographs of a test that arrive in a folder, each handed out once.

    `size`: rows and columns of a radiograph, px. `steps`: of the planned test. `patience_s`: how long a TIFF that is
    not whole is awaited after its line, or after it last grew. `done`: steps handed out in an earlier run, and not
    handed out again. `clock`: seconds since any time.
    """

    def __init__(
        self,
        folder: Path,
        size: tuple[int, int],
        steps: int,
        *,
        patience_s: float = 10.0,
        done: Iterable[int] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder = folder
        self._size = size
        self._patience_s = patience_s
        self._done = frozenset(done)
        self._clock = clock
        self._table = RadiographTable(folder / TABLE, steps)
        self._awaited: dict[int, _Awaited] = {}

    def look(self) -> tuple[list[Arrival], list[Unreadable]]:
        """Return what has arrived completely since this was last asked, in the order of steps, and what is given up.

        A TIFF that is not there, shorter than it says or not to be opened is tried again each time, and given up once
        it was awaited for `patience_s`; one of another size or type at once. A wrong line is skipped: a right one for
        its step may follow.

        Raises ExperimentError, in one line, where there is no folder, the first line of the table is another or the
        table became shorter; OSError where the table cannot be read.
        """
        now_s = self._clock()
        given_up = self._read_table(now_s)
        arrived = []
        for step in sorted(self._awaited):
            found = self._try(self._awaited.pop(step), now_s)
            if isinstance(found, _Awaited):
                self._awaited[step] = found
            elif isinstance(found, Arrival):
                arrived.append(found)
            else:
                given_up.append(found)
        return arrived, given_up

    def _read_table(self, now_s: float) -> list[Unreadable]:
        """Await the radiographs of the lines that were appended; return the wrong lines."""
        wrong = []
        for line in self._table.appended():
            if not isinstance(line, Line):
                wrong.append(Unreadable(step=line.step, file=TABLE, reason=line.reason))
            elif line.step not in self._done:
                self._awaited[line.step] = _Awaited(line=line, since_s=now_s)
        return wrong

    def _try(self, awaited: _Awaited, now_s: float) -> Arrival | Unreadable | _Awaited:
        line = awaited.line
        path = self._folder / line.file
        # before it is opened: what comes meanwhile is growth the next time
        length = _length(path)
        if length != awaited.length:
            awaited = replace(awaited, length=length, since_s=now_s)
        try:
            counts = read_radiograph(path, self._size)
        except UnfinishedError as error:
            if now_s - awaited.since_s < self._patience_s:
                return awaited
            reason = f"{error}; given up after {self._patience_s:g} s without a change"
            return Unreadable(step=line.step, file=line.file, reason=reason)
        except ExperimentError as error:
            return Unreadable(step=line.step, file=line.file, reason=str(error))
        return Arrival(
            step=line.step,
            file=line.file,
            angle_rad=line.angle_rad,
            time_s=line.time_s,
            force_N=line.force_N,
            counts=counts,
        )


def check_arriving(folder: Path) -> None:
    """Raise ExperimentError, in one line, where radiographs cannot arrive: no folder, or another table than theirs."""
    RadiographTable(folder / TABLE, 0).appended()


class IncomingWriter:
    """Write radiographs into a folder as a scanner does: each TIFF whole, then its line.

    Makes the folder where there is none. Raises ExperimentError, in one line, where it holds a table already, or a
    file has its name.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise ExperimentError(f"{folder}: expected a folder, or none yet, found a file") from None
        begin_table(folder / TABLE)

    def write(self, step: int, counts: NDArray[np.uint16], angle_rad: float, time_s: float, force_N: float) -> None:
        """Write the radiograph of a step as NNNNN.tif, counts (row, column) of either byte order, and its line.

        Raises ValueError for other counts, and OSError where the disk takes no more.
        """
        file = f"{step:05d}.tif"
        write_whole(self._folder / file, _tiff(counts))
        line = Line(step=step, file=file, angle_rad=angle_rad, time_s=time_s, force_N=force_N)
        append_line(self._folder / TABLE, line)


def _length(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except OSError:
        return None


def _tiff(counts: NDArray[np.uint16]) -> memoryview:
    """Return a TIFF of one image of counts (row, column)."""
    if counts.ndim != 2 or counts.dtype.newbyteorder("=") != np.uint16:
        raise ValueError(f"expected uint16 counts (row, column), given {counts.dtype} of shape {counts.shape}")
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, counts)
    return buffer.getbuffer()
