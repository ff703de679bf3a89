"""Where a test that is followed leaves what others read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pdvc.record import RECORD, Line, PlanLine, read_record, record_of

LATEST, ALARMS = "latest.json", "alarms"
"""In the folder of pictures: of which step the newest are, and the folder of those of alarms."""


@dataclass(frozen=True, kw_only=True)
class Places:
    """The files of a test that is followed into a measurement file."""

    file: Path
    """The measurement, once the test is over."""

    @property
    def record(self) -> Path:
        """Return where its record is."""
        return record_of(self.file)

    @property
    def pictures(self) -> Path:
        """Return the folder of its pictures, as `validation.view.pictures` writes it."""
        return self.file.with_name(self.file.name + ".pictures")


def find_places(named: Path) -> Places:
    """Return the places of a test by the name of its measurement, or of its record.

    Raises ValueError in one line where there is no record, or what is there is none.
    """
    places = Places(file=named.with_name(named.name.removesuffix(RECORD)))
    if not places.record.is_file():
        raise ValueError(
            f"{places.record}: expected the record of a test, found none: give live and this command the same FILE"
        )
    first = next(iter(read_record(places.record)), None)
    if not isinstance(first, PlanLine):
        found = "no whole line" if first is None else f"a line of kind {first.what}"
        raise ValueError(f"{places.record}: expected the record of a test, which begins with a plan, found {found}")
    check_words(first, f"{places.record}, line 1")
    return places


def check_words(line: Line, where: str) -> None:
    """Raise ValueError in one line, naming where it stands, where a line of a record holds values of another kind."""
    try:
        line.words()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: expected a line of a record, of kind {line.what}: {error}") from None
