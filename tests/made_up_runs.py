"""Runs that take no time, for the tests of what hands them out; workers import this module."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from validation.batch.engine import Part, Result, Scalar


def note(folder: Path, line: str) -> None:
    """Add a line to the diary of what was done, whichever process did it."""
    with (folder / "diary").open("a") as diary:
        diary.write(line + "\n")


@dataclass(frozen=True)
class Ingredient:
    """A part: a file that holds the letter of its group."""

    group: str
    diary: Path

    @property
    def name(self) -> str:
        return f"ingredient-{self.group}"

    def needs(self) -> tuple[Part, ...]:
        return ()

    def make(self, shared: Path) -> None:
        if not (shared / self.name).exists():
            note(self.diary, f"made {self.group}")
            (shared / self.name).write_text(self.group)


@dataclass(frozen=True)
class Sum:
    """A run: adds its number to what its group has, or does what goes wrong in life."""

    group: str
    number: int
    diary: Path
    fate: str = ""

    @property
    def key(self) -> str:
        return f"{self.group}{self.number}"

    @property
    def columns(self) -> Mapping[str, Scalar]:
        return {"group": self.group, "number": self.number}

    @property
    def score_columns(self) -> Mapping[str, type]:
        return {"total": int, "text": str, "half": float}

    def parts(self) -> tuple[Part, ...]:
        return (Ingredient(self.group, self.diary),)

    def carry_out(self, shared: Path) -> Result:
        note(self.diary, f"began {self.key}")
        if self.fate == "raises":
            raise ValueError("expected another number,\n  got this one")
        if self.fate.startswith("errno "):
            number = int(self.fate.removeprefix("errno "))
            raise OSError(number, os.strerror(number), "/data/full")
        if self.fate == "kills" or (self.fate == "kills once" and not self._killed()):
            os.kill(os.getpid(), signal.SIGKILL)
        self.parts()[0].make(shared)
        total = ord((shared / self.parts()[0].name).read_text()) + self.number
        return Result(
            scores={"total": total, "text": f"{total}", "half": total / 2}, arrays={"total": np.array([total])}
        )

    def _killed(self) -> bool:
        killed = (self.diary / f"killed {self.key}").exists()
        (self.diary / f"killed {self.key}").touch()
        return killed
