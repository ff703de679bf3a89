"""Tables as text: columns with a name and a unit, as testing machines and laboratories write them.

The first line names the columns: ``time_s``, ``Time [s]`` or ``Time (s)``. The units may also stand in the second
line, in brackets. Columns are apart by comma, semicolon or tabulator; where it is not a comma, numbers may have one.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from validation.doors.quantities import Units, in_ours
from validation.doors.refusal import refused

Floats = NDArray[np.float64]

_NAMED = re.compile(r"^(?P<name>.+?)\s*(?:[\[(]\s*(?P<unit>[^\])]*?)\s*[\])]|_(?P<suffix>[^\W_]+))$")
_BRACKETED = re.compile(r"^[\[(]\s*(?P<unit>[^\])]*?)\s*[\])]$")


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of a table: its header, the name and unit in it, and its fields as text."""

    header: str
    name: str
    """In small letters, without the unit."""
    unit: str
    """Empty where none is told."""
    fields: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A table as text."""

    path: Path
    columns: tuple[Column, ...]
    lines: tuple[int, ...]
    """Line of the file in which each row stands, counted from 1."""
    comma: bool
    """Whether numbers may have a decimal comma."""

    def has(self, *names: str) -> bool:
        """Return whether there is a column of one of some names."""
        return any(column.name in names for column in self.columns)

    def column(self, names: Sequence[str]) -> Column:
        """Return the column that has one of some names, or one as its header; raises FormatError unless one has."""
        wanted = {name.lower() for name in names}
        found = [each for each in self.columns if each.name in wanted or each.header.lower() in wanted]
        if len(found) != 1:
            headers = ", ".join(each.header for each in (found or self.columns))
            expected = f"one column {' or '.join(names)}"
            raise refused(self.path, "line 1", expected, headers if not found else f"{len(found)}: {headers}")
        return found[0]

    def numbers(self, names: Sequence[str], units: Units) -> Floats:
        """Return a column (row,) in mm, s, N or degrees; raises FormatError for another unit, or what is no number."""
        column = self.column(names)
        factor = in_ours(units, column.unit, self.path, f"column {column.header!r}")
        values = []
        for line, text in zip(self.lines, column.fields, strict=True):
            try:
                value = float(text.replace(",", ".") if self.comma else text)
            except ValueError:
                value = np.nan
            if not np.isfinite(value):
                raise refused(self.path, f"line {line}: {column.header}", "a number", repr(text))
            values.append(value * factor)
        return np.array(values)

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a column as text."""
        return self.column([name]).fields


def read_table(path: Path) -> TextTable:
    """Read a table; raises FormatError, in one line, where there is none or its rows do not fit its first line."""
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except FileNotFoundError:
        raise refused(path, "", "a table", "none") from None
    except UnicodeDecodeError as error:
        raise refused(path, "", "a table in UTF-8", error) from None
    if not lines:
        raise refused(path, "line 1", "names of columns", "an empty file")
    apart = max(",;\t", key=lines[0].count)
    try:
        rows = [[text.strip() for text in row] for row in csv.reader(lines, delimiter=apart, skipinitialspace=True)]
    except csv.Error as error:
        raise refused(path, "", "a table", error) from None
    headers, body = rows[0], [(line, row) for line, row in enumerate(rows[1:], 2) if any(row)]
    for line, row in body:
        if len(row) != len(headers):
            raise refused(path, f"line {line}", f"{len(headers)} fields, as line 1 has", len(row))
    units = [_BRACKETED.match(text) for text in body[0][1]] if body else []
    if any(units) and all(unit or not text for unit, text in zip(units, body[0][1], strict=True)):
        del body[0]
    else:
        units = [None] * len(headers)
    if not body:
        raise refused(path, "", "rows of numbers below the names of columns", "none")
    fields = zip(*(row for _, row in body), strict=True)
    return TextTable(
        path=path,
        columns=tuple(_column(*each) for each in zip(headers, units, fields, strict=True)),
        lines=tuple(line for line, _ in body),
        comma=apart != ",",
    )


def _column(header: str, below: re.Match[str] | None, fields: tuple[str, ...]) -> Column:
    """Return a column, its unit from the line below its header or from the header itself."""
    found = None if below else _NAMED.match(header)
    if found is None:
        return Column(header=header, name=header.lower(), unit=below["unit"] if below else "", fields=fields)
    unit = found["unit"] if found["unit"] is not None else found["suffix"]
    return Column(header=header, name=found["name"].strip().lower(), unit=unit, fields=fields)
