"""Records read from TOML: frozen, strict, with units, and with errors that name the key."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, ClassVar, Self

import tomlkit
from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, PydanticKnownError, core_schema

PLUGINS = "pdvc_bench.plugins"
"""Entry points of modules that offer further time functions, solvers and section motions when they are loaded."""
LARGEST = 1e15
"""Size that no number of a record exceeds, whatever its unit: squares and products of such numbers are finite."""


class SettingsError(ValueError):
    """A key of a file is wrong: which, what was expected there and what was given."""


class Settings(BaseModel):
    """A record that a user writes: unknown keys and wrong types are refused.

    Fields carry their unit in the name (``_mm``, ``_s``, ``_N``, ``_deg``) and a one-line description,
    which `template` prints as a comment.
    """

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )

    @classmethod
    def parse(cls, values: dict[str, Any], *, where: str) -> Self:
        """Build the record from plain values; `where` names the source in errors.

        Raises SettingsError, in one line, that names each wrong key, what was expected and what was given.
        """
        huge = [
            f"{key}: expected a number of size below {LARGEST:g}, given {_short(number)}"
            for key, number in _huge(values)
        ]
        if huge:
            raise SettingsError(f"{where}: " + "; ".join(huge))
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


class Choice(Settings):
    """A record that TOML chooses among others of its family by its `kind`.

    A family is a direct subclass; its own subclasses are its kinds, offered to TOML as soon as they are defined. A
    field of the family's type takes any of them.
    """

    kind: str

    _kinds: ClassVar[dict[str, type[Choice]]]

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        if cls._is_family():
            cls._kinds = {}
            return
        kind = cls.model_fields["kind"].default
        if not isinstance(kind, str):  # what several kinds have in common, and no kind itself
            return
        known = cls._kinds.setdefault(kind, cls)
        # the same one again is a notebook's cell, or a module, that was run twice
        if (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(f"kind {kind!r}: expected one record of this kind, found {known} and {cls}")
        cls._kinds[kind] = cls

    @classmethod
    def kinds(cls) -> tuple[type[Self], ...]:
        """Return the records of this family that are offered, in the order in which they were defined."""
        return tuple(cls._kinds.values())  # type: ignore[arg-type]  # a family holds its own

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        if not cls._is_family():
            return handler(source)
        return core_schema.no_info_plain_validator_function(
            cls._chosen, serialization=core_schema.plain_serializer_function_ser_schema(BaseModel.model_dump)
        )

    @classmethod
    def _is_family(cls) -> bool:
        """Return whether this is a direct subclass of Choice; Choice itself is asked before it has a name."""
        return cls.__mro__.index(Settings) == 2

    @classmethod
    def _chosen(cls, value: Any) -> Self:
        if isinstance(value, cls):
            return value
        if not isinstance(value, dict):
            kinds = " or ".join(repr(name) for name in sorted(cls._kinds))
            raise PydanticCustomError("choice", "a table with the kind {kinds}", {"kinds": kinds})
        if "kind" not in value:
            raise PydanticKnownError("union_tag_not_found", {"discriminator": "'kind'"})
        name = str(value["kind"])
        if name not in cls._kinds:
            load_plugins()
        kind = cls._kinds.get(name)
        if kind is None:
            expected = ", ".join(repr(name) for name in sorted(cls._kinds))
            context = {"discriminator": "'kind'", "tag": name, "expected_tags": expected}
            raise PydanticKnownError("union_tag_invalid", context)
        # strict validation takes a list for a tuple only from JSON
        return kind.model_validate_json(json.dumps(value, default=str))  # type: ignore[return-value]


@cache
def load_plugins() -> None:
    """Import what installed packages announce as the entry points `pdvc_bench.plugins`: modules with further kinds.

    Done only where a name is asked for that nothing loaded so far offers. Raises SettingsError where one cannot be
    loaded.
    """
    for entry in entry_points(group=PLUGINS):
        try:
            entry.load()
        except Exception as error:  # a package of somebody else may fail in any way
            owner = entry.dist.name if entry.dist is not None else "an unknown package"
            raise SettingsError(f"plug-in {entry.value} of {owner}: cannot be loaded: {error}") from error


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file, with or without a byte-order mark, into plain values.

    Raises SettingsError where it is missing or no TOML.
    """
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise SettingsError(f"{path}: expected a TOML file, found none") from None
    except IsADirectoryError:
        raise SettingsError(f"{path}: expected a TOML file, found a folder") from None
    except RecursionError:
        raise SettingsError(f"{path}: not valid TOML: too many brackets within each other") from None
    # a number of thousands of digits is a plain ValueError
    except ValueError as error:
        raise SettingsError(f"{path}: not valid TOML: {error}") from None


def _huge(values: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """Yield key and value of all numbers that are finite and too large to compute with."""
    if isinstance(values, dict):
        for name, part in values.items():
            yield from _huge(part, f"{key}.{name}" if key else name)
    elif isinstance(values, list | tuple):
        for place, part in enumerate(values):
            yield from _huge(part, f"{key}.{place}" if key else str(place))
    # a seed may be any whole number that 64 bits hold
    elif (isinstance(values, float) and LARGEST <= abs(values) < math.inf) or (
        isinstance(values, int) and not -(2**63) <= values < 2**63
    ):
        yield key, values


def _explain(detail: ErrorDetails) -> str:
    key = ".".join(str(part) for part in detail["loc"]) or "(top level)"
    if detail["type"] == "extra_forbidden":
        return f"{key}: unknown key"
    if detail["type"] == "missing":
        return f"{key}: missing"
    context = detail.get("ctx", {})
    if detail["type"] == "union_tag_invalid":
        return f"{key}: unknown kind {_short(detail['input']['kind'])}, expected {context['expected_tags']}"
    if detail["type"] == "union_tag_not_found":
        return f"{key}: kind: missing"
    expected = detail["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    if isinstance(detail["input"], dict) and detail["type"] == "value_error":
        # of several keys together: the message tells which, and what they are
        return f"{key}: expected {expected}"
    return f"{key}: expected {expected}, given {_short(detail['input'])}"


def _short(value: object) -> str:
    """Return a value as it fits into a line of text."""
    if isinstance(value, dict):
        return f"a table of {len(value)} keys"
    if isinstance(value, list) and any(isinstance(each, dict) for each in value):
        return f"a list of {len(value)} tables"
    # whole numbers of thousands of digits have no text
    text = f"a number of {value.bit_length()} bits" if isinstance(value, int) and abs(value) >= 2**64 else repr(value)
    return text if len(text) < 80 else text[:77] + "..."


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
