"""Kernels whose arrays do not overlap, and are known not to.

A loop that reads one array at places it works out itself, and writes to another, becomes vectors only if what it
writes cannot be what it reads next. Numba does not say so of the arrays that a function is given, but can.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.compiler import Compiler


class _Apart(Compiler):
    """Numba's own passes, in the knowledge that arrays given to the function do not overlap."""

    def define_pipelines(self) -> Any:
        """Return numba's own passes."""
        self.state.flags.noalias = True
        return super().define_pipelines()  # type: ignore[no-untyped-call]


def apart(**options: Any) -> Callable[..., Any]:
    """Return the decorator of a kernel that writes to no array that overlaps another one it is given.

    `options` are numba's, beside those that all kernels have.
    """
    return njit(nogil=True, cache=True, error_model="numpy", pipeline_class=_Apart, **options)  # type: ignore[no-any-return]
