"""What may be concluded from a measurement: a word, and every doubt that was found, with its figure and its remedy.

Also why each stage of it ended.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np

Word = Literal["trusted", "doubtful", "failed"]

STEPS_NAMED = 8
"""Steps that a text names before it says how many more there are."""


class Stop(StrEnum):
    """Why a stage ended; `stop_reason` says it in words and numbers."""

    CONVERGED = "converged"
    """The last change was under its limit."""
    NO_GAIN = "no-gain"
    """Nothing lowers the residual further."""
    SMALL_GAIN = "small-gain"
    """The last mode lowered it by less than was asked for."""
    NOISE_LEVEL = "noise-level"
    """The residual is as small as the noise."""
    MOST = "most"
    """As many modes were found as were asked for."""
    UNFINISHED = "unfinished"
    """The solution still moved when the last pass allowed was done."""


@dataclass(frozen=True, kw_only=True)
class Doubt:
    """One finding that speaks against a measurement."""

    name: str
    """A short name for machines, of small letters and hyphens: docs/verdict.md lists them all."""
    figure: str
    """The number that tripped it, beside what is due, with units."""
    advice: str
    """What to look at or to do."""
    steps: tuple[int, ...] = ()
    """Steps, counted from 0, that it concerns; none: the whole measurement."""
    fatal: bool = False
    """Whether nothing of the measurement is to be believed."""

    def __str__(self) -> str:
        where = f" (step {listed(self.steps)})" if self.steps else ""
        return f"{self.name}: {self.figure}{where}; {self.advice}"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The doubts about a measurement; none of them: it is trusted as far as anything here can tell."""

    doubts: tuple[Doubt, ...] = ()

    @property
    def word(self) -> Word:
        """Return `failed` where a doubt is fatal, `doubtful` where there is any, else `trusted`."""
        if any(doubt.fatal for doubt in self.doubts):
            return "failed"
        return "doubtful" if self.doubts else "trusted"

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the doubts, each once, in the order found."""
        return tuple(dict.fromkeys(doubt.name for doubt in self.doubts))

    def of_step(self, step: int) -> tuple[str, ...]:
        """Return the names of the doubts that concern this step by itself."""
        return tuple(dict.fromkeys(doubt.name for doubt in self.doubts if step in doubt.steps))


class NotMeasuredError(ValueError):
    """Nothing could be measured: why, and what spoke against the data before."""


@contextmanager
def explained_by(doubts: Sequence[Doubt]) -> Iterator[None]:
    """Raise NotMeasuredError in place of a ValueError, or of numbers that overflow: told with the doubts before."""
    try:
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            yield
    except FloatingPointError as error:
        told = f"motion: expected numbers that can be computed with, found {error}"
        raise NotMeasuredError(f"{told}{_before(doubts)}") from error
    except ValueError as error:
        raise NotMeasuredError(f"{error}{_before(doubts)}") from error


def _before(doubts: Sequence[Doubt]) -> str:
    return f"; what speaks against the data: {'; '.join(map(str, doubts))}" if doubts else ""


UNCHECKED = Verdict(
    doubts=(
        Doubt(
            name="not-checked",
            figure="nothing was checked: the method that measured does not say",
            advice="look at the residual fields yourself",
        ),
    )
)
"""Of a measurement that was made elsewhere."""


def listed(steps: Iterable[int]) -> str:
    """Return step numbers as text, the first few named."""
    every = list(steps)
    named = ", ".join(str(step) for step in every[:STEPS_NAMED])
    return named if len(every) <= STEPS_NAMED else f"{named} and {len(every) - STEPS_NAMED} more"
