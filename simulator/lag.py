"""Lag and afterglow: images hold light of those before.

Traps in the photodiodes, and the scintillator, keep a share p of what falls on them, and give it back with the time
constant tau. An image that takes the time T and whose light is even shows the mean x of its own light, less what is
still kept at its end, and what is left of the images before:

    y_n = (1 - e) x_n + e m_n,      m_n+1 = r m_n + (1 - r) x_n,      r = exp(-T / tau),      e = p (1 - r) tau / T

so that n images after light is switched off, e r^n of it is left, all that is left sums to e / (1 - r) = p tau / T,
and what is constant is shown as it is. Two such shares add up: a quick one (lag) and a slow one (afterglow, or
ghosts).

Before the first image of the reference scan the panel saw the open beam, for long; before the test the last view of
the reference scan; and before an interrupted scan the step at which the test was held.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from threading import Lock
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pdvc.settings import Settings

Image = NDArray[np.float32]
Share = Annotated[float, Field(ge=0, lt=1)]
Time = Annotated[float, Field(gt=0)]


class Lag(Settings):
    """Light that comes late; none by default."""

    share: Share = 0.0
    """share of the light that is kept for a moment"""
    time_s: Time = 0.5
    """time constant with which it comes, s"""
    afterglow_share: Share = 0.0
    """share of the light that is kept for long"""
    afterglow_time_s: Time = 600.0
    """time constant with which that comes, s"""

    @model_validator(mode="after")
    def _something_left(self) -> Self:
        if self.share + self.afterglow_share >= 1:
            raise ValueError(
                f"share and afterglow_share that sum to less than 1, got {self.share} and {self.afterglow_share}"
            )
        return self

    @property
    def none(self) -> bool:
        """Return whether all light comes at once."""
        return self.share == self.afterglow_share == 0.0

    def parts(self, image_s: float) -> tuple[tuple[float, float], ...]:
        """Return e and r of lag and afterglow, for images that take `image_s` each."""
        found = []
        for share, time in ((self.share, self.time_s), (self.afterglow_share, self.afterglow_time_s)):
            left = math.exp(-image_s / time)
            found.append((share * (1 - left) * time / image_s, left))
        return tuple(found)


class Late:
    """The images of a stack with the light that comes late, by their numbers; for threads that ask side by side.

    What is kept is worked out from the first image on, so that an image is the same whoever asks for it, and when;
    asked in order, each image is made once.
    """

    def __init__(
        self, clear: Callable[[int], Image], before: Callable[[], Image], parts: tuple[tuple[float, float], ...]
    ) -> None:
        self._clear, self._before, self._parts = clear, before, parts
        self._made: dict[int, Future[Image]] = {}
        self._kept: dict[int, list[Image]] = {}
        self._next = 0
        self._making, self._keeping = Lock(), Lock()

    def __call__(self, index: int) -> Image:
        """Return an image (row, column), share of the open beam, with the light of those before."""
        own = self._image(index)
        with self._keeping:
            kept = self._kept_at(index)
        result = own * np.float32(1 - sum(share for share, _ in self._parts))
        for (share, _), late in zip(self._parts, kept, strict=True):
            result += np.float32(share) * late
        return result

    def _image(self, index: int) -> Image:
        """Return an image as it is without lag, made by the first who asks, and waited for by others."""
        with self._making:
            found = self._made.get(index)
            mine = found is None
            if found is None:
                found = self._made[index] = Future()
        if mine:
            try:
                found.set_result(self._clear(index))
            except BaseException as error:
                found.set_exception(error)
                raise
        return found.result()

    def _kept_at(self, index: int) -> list[Image]:
        """Return m of each part at an image, from the first image on where nobody has come so far."""
        if index < self._next and index not in self._kept:
            self._next = 0
        if self._next == 0:
            before = self._before()
            self._kept[0] = [before] * len(self._parts)
            self._next = 1
        while self._next <= index:
            image, last = self._image(self._next - 1), self._kept[self._next - 1]
            self._kept[self._next] = [
                np.float32(left) * late + np.float32(1 - left) * image
                for (_, left), late in zip(self._parts, last, strict=True)
            ]
            self._next += 1
        self._forget(index)
        return self._kept[index]

    def _forget(self, index: int, ahead: int = 16) -> None:
        """Let go of what only images long before need: threads that are that far behind begin anew."""
        for number in [n for n in self._kept if n < min(index, self._next - 1) - ahead]:
            del self._kept[number]
        with self._making:
            for number in [n for n in self._made if n < self._next - 1 - ahead]:
                del self._made[number]
