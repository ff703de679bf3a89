"""A product and a sum rounded once, as processors have it and Python has not."""

from __future__ import annotations

from typing import Any

from numba.extending import intrinsic


def _fused(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Return the signature and the code of a b + c."""
    return c(a, b, c), lambda context, builder, signature, values: builder.fma(*values)


fused: Any = intrinsic(_fused)
"""a b + c, rounded once, in kernels whose last digits are part of what a seed stands for: the sample's motion."""
