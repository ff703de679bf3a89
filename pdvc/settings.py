"""Records read from TOML: frozen, strict, with units, and with errors that name the key."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any, Self

import tomlkit
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails


class SettingsError(ValueError):
    """Say which key of which file is wrong, what was expected there and what was given."""


class Settings(BaseModel):
    """Be the base of every record that a user writes: unknown keys and wrong types are refused.

    Fields carry their unit in the name (``_mm``, ``_s``, ``_N``, ``_deg``) and a one-line description,
    which `template` prints as a comment.
    """

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )

    @classmethod
    def parse(cls, values: dict[str, Any], *, where: str) -> Self:
        """Build the record from plain values; `where` names the source in errors.

        Raises SettingsError with one line for each wrong key.
        """
        try:
            # strict validation takes a list for a tuple only from JSON
            return cls.model_validate_json(json.dumps(values, default=str))
        except ValidationError as error:
            lines = [_explain(detail) for detail in error.errors()]
            raise SettingsError(f"{where}: " + "; ".join(lines)) from None

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the record from a TOML file."""
        return cls.parse(read_toml(path), where=str(path))

    def template(self) -> str:
        """Return the record as TOML with each field's description beside it."""
        document = tomlkit.document()
        _fill(document, self)
        return tomlkit.dumps(document)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file into plain values; raises SettingsError where it is missing or no TOML."""
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except FileNotFoundError:
        raise SettingsError(f"{path}: expected a TOML file, found none") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not valid TOML: {error}") from None


def _explain(detail: ErrorDetails) -> str:
    key = ".".join(str(part) for part in detail["loc"]) or "(top level)"
    if detail["type"] == "extra_forbidden":
        return f"{key}: unknown key"
    if detail["type"] == "missing":
        return f"{key}: missing"
    expected = detail["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    given = repr(detail["input"])
    return f"{key}: expected {expected}, given {given if len(given) < 80 else given[:77] + '...'}"


def _fill(table: Any, record: Settings) -> None:
    nested: list[tuple[str, Any, str | None]] = []
    for name, field in type(record).model_fields.items():
        value = getattr(record, name)
        if isinstance(value, Settings) or (isinstance(value, tuple) and value and isinstance(value[0], Settings)):
            nested.append((name, value, field.description))
        elif value is None:
            table.add(tomlkit.comment(f"{name} =  # {' '.join((field.description or '').split())}"))
        else:
            item = tomlkit.item(list(value) if isinstance(value, tuple) else value)
            if field.description:
                item.comment(" ".join(field.description.split()))
            table.add(name, item)
    for name, value, description in nested:
        if isinstance(value, tuple):
            array = tomlkit.aot()
            for part in value:
                inner = tomlkit.table()
                _fill(inner, part)
                array.append(inner)
            table.add(name, array)
            continue
        inner = tomlkit.table()
        if description:
            inner.comment(" ".join(description.split()))
        _fill(inner, value)
        table.add(name, inner)
