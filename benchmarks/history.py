"""Keep what was timed, so that a loss is seen: benchmarks/results/history.csv.

Machines differ, and one machine does from hour to hour: kept is a time over another one of the same run, that of the
program it is compared with, or else of a yardstick, a million trilinear gathers by scipy on one thread.
"""

from __future__ import annotations

import csv
import subprocess
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, fields
from datetime import date
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy import ndimage

from benchmarks.timing import machine

FILE = Path(__file__).parent / "results" / "history.csv"
YARDSTICK = "yardstick"
LAST = 5
"""Earlier runs that a time is compared with, at most: their median."""
LOSS = 0.1
"""Share more than that median from which on a time is called a loss."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One time of one run."""

    day: str
    commit: str
    """Short hash; with a + where files were changed since."""
    machine: str
    stage: str
    size: str
    threads: int
    seconds: float
    compared: str
    """With what."""
    ratio: float
    """The time over that of what it is compared with."""

    @property
    def key(self) -> tuple[str, str, int, str]:
        """Return what entries of the same thing have in common."""
        return self.stage, self.size, self.threads, self.compared


def yardstick() -> Callable[[], Any]:
    """Return a job that says how fast the machine is just now."""
    rng = np.random.default_rng(0)
    volume = rng.random((200, 100, 100), dtype=np.float32)
    places = rng.random((3, 1_000_000)) * np.array([[198.0], [98.0], [98.0]])
    return lambda: ndimage.map_coordinates(volume, places, order=1)


def commit() -> str:
    """Return the commit that is timed, or nothing outside a repository."""
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty=+", "--exclude=*"],
            cwd=FILE.parent.parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return found.stdout.strip()


def entry(stage: str, size: str, threads: int, seconds: float, compared: str, its: float) -> Entry:
    """Return what was timed just now."""
    return Entry(
        day=date.today().isoformat(),
        commit=commit(),
        machine=machine(),
        stage=stage,
        size=size,
        threads=threads,
        seconds=round(seconds, 6),
        compared=compared,
        ratio=round(seconds / its, 5),
    )


def read(path: Path = FILE) -> list[Entry]:
    """Return all entries, in the order in which they were added."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        kinds = {"threads": int, "seconds": float, "ratio": float}
        return [Entry(**{k: kinds.get(k, str)(v) for k, v in row.items()}) for row in csv.DictReader(file)]


def add(entries: Iterable[Entry], path: Path = FILE) -> None:
    """Add entries to the file."""
    new = not path.exists()
    path.parent.mkdir(exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Entry)])
        if new:
            writer.writeheader()
        writer.writerows(asdict(each) for each in entries)


def losses(entries: Iterable[Entry], before: Iterable[Entry]) -> list[str]:
    """Return a line for each entry that is slower than the median of the last ones before by more than a tenth."""
    earlier: dict[tuple[str, str, int, str], list[float]] = {}
    for each in before:
        earlier.setdefault(each.key, []).append(each.ratio)
    found: list[str] = []
    for each in entries:
        last = earlier.get(each.key, [])[-LAST:]
        if last and each.ratio > (1 + LOSS) * median(last):
            found.append(
                f"slower by {each.ratio / median(last) - 1:.0%} than the median of {len(last)} before: {each.stage}, "
                f"{each.size}, {each.threads} thread(s): {each.ratio:.3g} of {each.compared}, was {median(last):.3g}"
            )
    return found
