"""Pixels of single radiographs that show something else than the sample: zingers, bad lines, debris that passes by.

Of the residual rho at the motion that was found, what is usual in a pixel over the steps, and in a step over the
pixels, are both told by medians, which a few outliers do not move,

    s(r, t) = max( usual over t of rho(r, t), the same around r, usual over r of rho(r, t) )

so that neither edges, where the model of the image errs at all steps, nor a step whose motion is not found yet count.
Where |rho| > `limit` s, the pixel is an outlier at that step, with those next to it, which filters have mixed it with.
A step with many of them is one where something else is wrong, and keeps all its pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.robust import usual_size

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

MOST = 0.15
"""Share of a step's pixels that may be outliers."""
ROUNDS, SETTLED = 3, 0.1
"""Times that a motion is found without outliers, at most; share of them that may still change."""
_AROUND_PX = 5
"""Pixels of the median of what is usual around one."""


def unchanged(found: NDArray[np.bool_], before: NDArray[np.bool_]) -> bool:
    """Return whether outliers are by and large those that were left out before."""
    return int((found ^ before).sum()) <= SETTLED * int(found.sum())


def outliers(residual: Image, limit: float) -> NDArray[np.bool_]:
    """Return which pixels are outliers (step, row, column), of residual fields of that shape."""
    size = np.abs(residual, dtype=float)
    of_pixel = usual_size(size, axis=0)
    of_pixel = np.maximum(of_pixel, ndimage.median_filter(of_pixel, size=_AROUND_PX, mode="nearest"))
    of_step = usual_size(size.reshape(len(size), -1), axis=1)
    beyond = size > limit * np.maximum(of_pixel, of_step[:, None, None])
    near = ndimage.binary_dilation(beyond, np.ones((1, 3, 3)))
    near[near.mean(axis=(1, 2)) > MOST] = False
    return np.asarray(near)
