"""What the packages of this distribution ask of the place where they run.

They have plain names. A folder or file of the same name that Python finds first hides one of them, and what an extra
would bring may be missing: both are said in one line. This package has a name that no user's folder has.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

HOME = Path(__file__).resolve().parent.parent
"""Where the packages lie side by side."""


def check_namesakes(*packages: str) -> None:
    """Raise ImportError where another folder or file hides one of our packages, or it is not there."""
    for name in packages:
        spec = find_spec(name)
        if spec is None:
            raise ImportError(f"{name}: expected the package of pdvc-bench in {HOME}, found none: install it again")
        places = list(spec.submodule_search_locations or [spec.origin or ""])
        if HOME / name not in [Path(place).resolve() for place in places]:
            raise ImportError(
                f"{name}: expected the package of pdvc-bench in {HOME}, found {' and '.join(places)}, which hides it: "
                "rename that, or start Python elsewhere"
            )


def check_extra(extra: str, *modules: str) -> None:
    """Raise ImportError where a module is missing that an extra brings."""
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise ImportError(
            f"{', '.join(missing)}: expected to be installed, found not: pip install 'pdvc-bench[{extra}]'"
        )
