"""The deviation of values of which a few may be far off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution about zero over the median size of its values."""


def usual_size(values: Floats, axis: int | None = None) -> Floats:
    """Return the standard deviation about zero of normal values by the median of their sizes, over an axis or all."""
    return np.asarray(OF_MEDIAN * np.median(np.abs(values), axis=axis))
