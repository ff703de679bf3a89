"""Methods: named ways from an experiment to a measurement, found through the entry points of installed packages.

A package adds a method by an entry point of the group `pdvc_bench.methods`; our own methods are found in the same
way. What an entry point names is a `Method`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Literal

from pdvc.experiment import Experiment
from pdvc.measurement import Measurement

GROUP = "pdvc_bench.methods"
"""The entry-point group in which methods are looked for."""
OWN = ("pgd", "smoother", "gauss-newton", "weighted", "each-step", "classical-dvc", "spam")
"""Our own methods, in the order in which they are shown; others come after them."""

EXTRA = ("spam",)
"""Methods that need more than our own installation, and are used only where they are asked for."""

LooksAt = Literal["projections", "volumes"]
"""projections: the reference scan and a radiograph for each step; volumes: the reference and the interrupted scans."""


class MethodError(ValueError):
    """A method is unknown or cannot be used: which, and what to do."""


def _always() -> None:
    """Raise nothing: a method that needs nothing besides our own installation can always be used."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """A way to measure an experiment, under the name by which it is asked for."""

    name: str
    measure: Callable[[Experiment], Measurement]
    assumes: str
    """What it assumes, in a few sentences: reports print it."""
    looks_at: LooksAt = "projections"
    """What it uses of an experiment, which is what it costs on the machine."""
    check: Callable[[], None] = _always
    """Raises MethodError where the method cannot be used here, and says what to do."""


def method_names() -> tuple[str, ...]:
    """Return the names of all methods that installed packages offer, our own first."""
    offered = {entry.name for entry in entry_points(group=GROUP)}
    return (*(name for name in OWN if name in offered), *sorted(offered.difference(OWN)))


def default_methods() -> tuple[str, ...]:
    """Return the names of the methods that are compared unless others are asked for."""
    return tuple(name for name in method_names() if name not in EXTRA)


def find_method(name: str) -> Method:
    """Return a method by its name.

    Raises MethodError, in one line, where no package offers it, two do, or what one offers is no method.
    """
    found = entry_points(group=GROUP, name=name)
    if not found:
        raise MethodError(_unknown(name))
    if len(found) > 1:
        owners = ", ".join(sorted(_owner(entry) for entry in found))
        raise MethodError(f"method {name!r}: expected one package to offer it, found several: {owners}")
    (entry,) = found
    try:
        method = entry.load()
    except (ImportError, AttributeError) as error:
        raise MethodError(
            f"method {name!r}: expected {entry.value} of {_owner(entry)}, cannot load it: {error}"
        ) from None
    if not isinstance(method, Method):
        raise MethodError(f"method {name!r}: expected a Method at {entry.value}, found {type(method).__name__}")
    if method.name != name:
        raise MethodError(f"method {name!r}: expected a Method of this name at {entry.value}, found {method.name!r}")
    if not method.assumes.strip():
        raise MethodError(f"method {name!r}: expected {entry.value} to say what the method assumes, it does not")
    return method


def _unknown(name: str) -> str:
    names = method_names()
    if not names:
        return f"method {name!r}: no method is installed, not even those of pdvc-bench: install the package again"
    close = difflib.get_close_matches(name.lower(), names, n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return f"method: expected one of {', '.join(names)}, given {name!r}{hint}"


def _owner(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unknown package"
