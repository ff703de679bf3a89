"""How bright the beam was in each radiograph, by the air beside the sample.

A tube's output drifts, and air does not attenuate: where a pixel sees air in every radiograph,

    b = median of (I - D) / (I0 - D)          1 where the beam is that of the flats

over these pixels is the share of the beam that was there. Attenuations are then taken of b times the open beam. The
median does not mind a few pixels in which something passes; where one side is covered by the sample, the other counts.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

LEAST_COLUMNS = 2
"""Columns of air on a side that tell its brightness, at least."""
MARGIN = 0.04
"""Share of the columns beside the sample that are left out: it moves, and its edge is blurred."""
SHADE = 0.05
"""Attenuation, over the largest of all views, from which on a column is the sample's."""
APART = 0.01
"""Difference of the sides above which one of them is covered, and the brighter counts."""
BLOCKS = 8
"""Blocks of rows on each side; how they differ tells how well b is known."""
_DETAIL_PX = 5
"""Rows and columns of the median that takes single pixels out before shade is looked for."""


def air_pixels(views: Iterable[Image], bad: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Return the pixels (row, column) that see air in all views; None where there are not enough on either side.

    `views` are attenuations (row, column), all around the turn, of a beam that may have drifted.
    """
    deepest = np.zeros(bad.shape[1])
    for view in views:
        smooth = ndimage.median_filter(view, size=_DETAIL_PX, mode="nearest")
        # what is brightest is air, however bright it is
        deepest = np.maximum(deepest, smooth.max(axis=0) - np.median(smooth, axis=0).min())
    sample = np.flatnonzero(deepest > SHADE * deepest.max())
    margin = int(np.ceil(MARGIN * len(deepest)))
    air = np.zeros(bad.shape, dtype=bool)
    for side in (slice(0, max(int(sample[0]) - margin, 0)), slice(int(sample[-1]) + 1 + margin, len(deepest))):
        if side.stop - side.start >= LEAST_COLUMNS:
            air[:, side] = ~bad[:, side]
    return air if air.any() else None


def brightness(signal: Image, open_beam: Image, air: NDArray[np.bool_]) -> tuple[float, float]:
    """Return b of a radiograph and its standard deviation, from counts without the dark (row, column).

    The deviation is that of a mean over blocks of rows, which differ where the beam changes its shape, too.
    """
    middle = air.shape[1] // 2
    found = []
    for side in (slice(0, middle), slice(middle, None)):
        columns = np.flatnonzero(air[:, side].any(axis=0)) + (side.start or 0)
        if len(columns):
            part = slice(int(columns[0]), int(columns[-1]) + 1)
            ratio = np.where(air[:, part], signal[:, part] / open_beam[:, part], np.nan)
            blocks = [float(np.nanmedian(rows)) for rows in np.array_split(ratio, min(BLOCKS, len(ratio)))]
            found.append((float(np.nanmedian(ratio)), np.array(blocks)))
    levels = np.array([level for level, _ in found])
    used = [each for each in found if each[0] >= levels.max() - APART * abs(levels.max())]
    every = np.concatenate([blocks for _, blocks in used])
    return float(np.mean([level for level, _ in used])), float(every.std(ddof=1) / np.sqrt(len(every)))
