"""How long work reports itself, without printing: a callback that the command line draws."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """What is told what is being done, and how far it is."""

    def __call__(self, task: str, done: int, total: int) -> None:
        """Take note that `done` of `total` parts of `task` are finished."""


def silent(task: str, done: int, total: int) -> None:
    """Take no note."""
