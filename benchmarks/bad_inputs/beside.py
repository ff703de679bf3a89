"""What can lie beside the experiment of a test that runs: radiographs that arrive, a record, what others use."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import tifffile
from filelock import FileLock
from numpy.typing import NDArray

from benchmarks.bad_inputs.record import Change, Folder
from pdvc.experiment import TEST
from pdvc.incoming import IncomingWriter
from pdvc.lock import HOLDER, LOCK
from pdvc.radiograph_table import HEADER, TABLE
from pdvc.record import Line, record_of

Counts = NDArray[np.uint16]
PORT = 18231
"""A port that is taken while a page is to be shown there."""
HOLDS = "process 4711 on another-machine since 2026-11-27 09:30:00 (pdvc-bench prepare experiment --work ready)"
"""What a folder in use says of who uses it."""


def arriving(*lines: str, first: str = HEADER, good: int = 0) -> Change:
    """Return the change that makes the folder in which radiographs arrive: so many good ones, then lines."""

    def change(folder: Folder) -> None:
        writer, test, counts = IncomingWriter(folder.beside / "arriving"), folder.description()["test"], None
        for step in range(good):
            counts = folder.counts(TEST) if counts is None else counts
            recorded = (np.deg2rad(test["angle_deg"][step]), test["time_s"][step], test["force_N"][step])
            writer.write(step, counts[step], *recorded)
        table = folder.beside / "arriving" / TABLE
        whole = table.read_text(encoding="utf-8").replace(HEADER, first) + "".join(f"{line}\n" for line in lines)
        table.write_text(whole, encoding="utf-8")

    return change


def one_tiff(write: Callable[[Path, Counts], object]) -> Change:
    """Return the change in which one radiograph arrives, its TIFF written by `write` from counts (row, column)."""

    def change(folder: Folder) -> None:
        arriving("0,0.tif,0,0,250")(folder)
        write(folder.beside / "arriving" / "0.tif", folder.counts(TEST)[0])

    return change


def half(path: Path, counts: Counts) -> None:
    """Write half of a TIFF."""
    tifffile.imwrite(path, counts)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def written(name: str, content: bytes = b"") -> Change:
    """Return the change that writes a file beside the experiment."""

    def change(folder: Folder) -> None:
        (folder.beside / name).write_bytes(content)

    return change


def record(*lines: Line | bytes) -> Change:
    """Return the change that writes the record of `motion.nc`."""
    texts = (line if isinstance(line, bytes) else line.text().encode() + b"\n" for line in lines)
    return written(record_of(Path("motion.nc")).name, b"".join(texts))


def folder_named(name: str) -> Change:
    """Return the change that makes an empty folder beside the experiment."""
    return lambda folder: (folder.beside / name).mkdir()


@contextmanager
def work_in_use(place: Path) -> Iterator[None]:
    """Hold what prepare has kept, as another command does."""
    with FileLock(place / "ready" / LOCK):
        (place / "ready" / HOLDER).write_text(HOLDS, encoding="utf-8")
        yield


@contextmanager
def port_in_use(_: Path) -> Iterator[None]:
    """Take the port of this machine, unless another program has it."""
    with socket.socket() as taken:
        with suppress(OSError):
            taken.bind(("127.0.0.1", PORT))
            taken.listen()
        yield
