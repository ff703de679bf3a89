"""What kernels may take for granted: that their arrays do not overlap, and that no number is infinite.

A loop that reads one array at places it works out itself, and writes to another, becomes vectors only if what it
writes cannot be what it reads next. Numba does not say so of the arrays that a function is given, but can.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.compiler import Compiler

IN_ORDER = {"nnan", "ninf", "nsz"}
"""The `fastmath` of kernels: numbers are finite, zeros have no sign, but nothing is reordered, fused or approximated.

A function is compiled by itself and again within each kernel that calls it. The process that compiles runs the one
copy, later ones, which load, the other: only if both work out every sum as it is written do they have the same bits.
"""


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
