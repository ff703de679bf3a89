"""What is said of a file of another program that cannot be used: one line, of the same form for every format."""

from __future__ import annotations

from pathlib import Path


class FormatError(ValueError):
    """A file of another program cannot be used: which, which key, what was expected and what was found."""


def refused(path: Path | str, key: str, expected: str, found: object) -> FormatError:
    """Return the error ``path: key: expected ..., found ...``; `key` may be empty."""
    text = " ".join(str(found).split())
    place = f"{path}: {key}" if key else str(path)
    return FormatError(f"{place}: expected {expected}, found {text if len(text) < 120 else text[:117] + '...'}")
