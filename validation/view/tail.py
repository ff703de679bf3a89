"""The lines of a record as they are added: each once, whole, with a mark from which another reader can go on."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Added:
    """A line that was added to a record."""

    text: str
    mark: str
    """Where it stands and what it is like: start, end, checksum."""


class Tail:
    """Reads what is added to a record, from its beginning or after a mark."""

    def __init__(self, path: Path) -> None:
        self._path, self._offset = path, 0

    def resume(self, mark: str) -> bool:
        """Go on after a line by its mark; return whether the line is still there, and begin anew where it is not."""
        try:
            start, end, checksum = (int(part) for part in mark.split("-"))
            with self._path.open("rb") as file:
                file.seek(start)
                line = file.read(end - start)
        except (ValueError, OSError):
            return False
        if not line.endswith(b"\n") or zlib.crc32(line) != checksum:
            return False
        self._offset = end
        return True

    def shrunk(self) -> bool:
        """Return whether the record is another one than it was, which is shorter; it is then read from its beginning.

        Half a line that is taken away makes no difference.
        """
        try:
            shorter = self._path.stat().st_size < self._offset
        except FileNotFoundError:
            shorter = self._offset > 0
        if shorter:
            self._offset = 0
        return shorter

    def added(self) -> list[Added]:
        """Return the lines that were added since this was last asked; a line without its end waits."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                *lines, _ = file.read().split(b"\n")
        except FileNotFoundError:
            return []
        result = []
        for line in lines:
            start, self._offset = self._offset, self._offset + len(line) + 1
            checksum = zlib.crc32(line + b"\n")
            result.append(Added(text=line.decode(errors="replace"), mark=f"{start}-{self._offset}-{checksum}"))
        return result
