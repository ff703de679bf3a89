"""Digests of values: two that differ in anything, whatever it prints as, have different digests.

Kept results are found again by the digest of all that they depend on (`pdvc.store`), so that nothing may be left out:
arrays count with every element, numbers with every bit, records with every field, and the software with its own text.
"""

from __future__ import annotations

import hashlib
import inspect
import platform
import struct
import types
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

COMPUTING = ("numpy", "scipy", "numba")
"""The libraries that results depend on, to the last digit."""
COMMON = ("abc", "builtins", "pydantic", "typing")
"""Of these all there is belongs to the version of Python, or of a library."""
OWN = ("pdvc", "simulator", "validation")
"""The packages whose text counts as a whole, as `software`."""
_AT_ONCE = 1 << 24
"""Bytes of an array that are read at a time: a memory map is streamed."""


def digest(*values: Any) -> str:
    """Return a text of 32 hexadecimal digits for values: numbers, texts, arrays, records, and tuples or maps of these.

    Raises TypeError for anything else, rather than to digest what it happens to print as.
    """
    found = hashlib.sha256()
    _add(found, values)
    return found.hexdigest()[:32]


@cache
def software(*packages: str) -> str:
    """Return a digest of this package's version, the source text of some of its packages, and the libraries."""
    texts = {name: version(name) for name in ("pdvc-bench", *COMPUTING)}
    texts["Python"] = platform.python_version()
    for package in packages:
        texts |= dict(_sources(files(package), package))
    return digest(texts)


def _sources(folder: Traversable, name: str) -> list[tuple[str, str]]:
    found = []
    for each in folder.iterdir():
        path = f"{name}/{each.name}"
        if each.is_dir():
            found += _sources(each, path)
        elif each.name.endswith((".py", ".toml", ".csv")):
            found.append((path, each.read_text(encoding="utf-8")))
    return found


def _add(found: Any, value: Any) -> None:
    """Add a value, its kind first, so that no two values are spelt alike."""
    if isinstance(value, np.ndarray):
        _head(found, "array", f"{value.dtype.str} {value.shape}")
        rows = max(1, _AT_ONCE // max(1, value[:1].nbytes)) if value.ndim else 1
        parts = range(0, len(value), rows) if value.ndim else ()
        for start in parts:
            found.update(np.ascontiguousarray(value[start : start + rows]).data)
        if not value.ndim:
            found.update(value.tobytes())
    elif isinstance(value, BaseModel):
        _add_record(found, value, type(value).model_fields)
    elif is_dataclass(value) and not isinstance(value, type):
        _add_record(found, value, [each.name for each in fields(value)])
    elif isinstance(value, Mapping):
        _head(found, "map", str(len(value)))
        for key in sorted(value):
            _add(found, key)
            _add(found, value[key])
    elif isinstance(value, tuple | list):
        _head(found, "sequence", str(len(value)))
        for each in value:
            _add(found, each)
    elif isinstance(value, bool | np.bool_) or value is None:
        _head(found, "constant", str(value))
    elif isinstance(value, int | np.integer):
        _head(found, "integer", str(int(value)))
    elif isinstance(value, float | np.floating):
        _head(found, "number", "")
        found.update(struct.pack("<d", float(value)))
    elif isinstance(value, str):
        _head(found, "text", value)
    else:
        raise TypeError(f"digest: expected numbers, texts, arrays or records of these, got {type(value).__name__}")


def _add_record(found: Any, record: Any, names: Any) -> None:
    _head(found, "record", type(record).__qualname__)
    if type(record).__module__.partition(".")[0] not in OWN:
        # what a user's own kind of time function, or solver, does is part of what it is
        kind: type = type(record)
        _head(found, "code", source_of(kind))
    for name in names:
        _add(found, name)
        _add(found, getattr(record, name))


@cache
def source_of(kind: Callable[..., Any] | type) -> str:
    """Return the text of the file that defines a class or a function, or its compiled code where there is no file.

    Of a class also the files of those that it is derived from, but not of what all these import.
    """
    if not isinstance(kind, type):
        return _text(kind)
    theirs = [each for each in kind.__mro__ if each.__module__.partition(".")[0] not in (*OWN, *COMMON)]
    return "\n".join(_text(each) for each in theirs)


def _text(thing: Any) -> str:
    try:
        path = inspect.getsourcefile(inspect.unwrap(thing))
    except TypeError:
        path = None
    if path is not None and Path(path).is_file():
        return Path(path).read_text(encoding="utf-8")
    parts = vars(thing).values() if isinstance(thing, type) else [thing]
    codes = [getattr(inspect.unwrap(getattr(part, "fget", part)), "__code__", None) for part in map(_bare, parts)]
    return "\n".join(_compiled(code) for code in codes if code is not None)


def _bare(part: Any) -> Any:
    return part.__func__ if isinstance(part, classmethod | staticmethod) else part


def _compiled(code: types.CodeType) -> str:
    """Return all that a function's code says, and that of the functions within it."""
    consts = [_compiled(each) if isinstance(each, types.CodeType) else repr(each) for each in code.co_consts]
    return f"{code.co_name} {code.co_names} {code.co_varnames} {code.co_code.hex()} {consts}"


def _head(found: Any, kind: str, text: str) -> None:
    for part in (kind, text):
        spelt = part.encode("utf-8")
        found.update(len(spelt).to_bytes(8, "little") + spelt)
