"""Errors that steps have in common, found in the residual: how much more there is than noise makes.

What the model of the image misses moves with the sample: texture between voxels, edges. Over many steps it adds up
where noise averages out, long before a single residual shows it. Blocks of pixels b are independent of each other, by
and large, so that the slow part of what the data tell, with smooth functions Psi of the step and X^T L^-1 of
`pdvc.smoother`,

    z = sum_t Psi(t) (x) X^T L^-1 c(t) = sum_b z_b          has the covariance          sum_b z_b z_b^T

as of clustered data, and noise alone makes H = sum_t Psi Psi^T (x) X^T X of it. A block alone moves the amplitudes as
data X Psi H^-1 z_b would.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pdvc.projection import BlockVectors

Floats = NDArray[np.float64]

FEWEST = 2.0
"""Blocks, as if they were alike, that an unknown has to be seen in to count."""


def by_block(blocks: Sequence[BlockVectors], weighed: Floats, slow: Floats) -> Floats:
    """Return z_b (function, unknown, block).

    `blocks` of each step; `weighed` X^T L^-1 (step, unknown, unknown); `slow` Psi (function, step).
    """
    unknowns = weighed.shape[1]
    bands, columns, _ = blocks[0].values.shape
    total = np.zeros((len(slow), unknowns, bands * columns))
    for t, each in enumerate(blocks):
        size = each.values.shape[2]
        of_step = np.zeros((bands, columns, unknowns + size))
        for band, first in enumerate(each.first):
            of_step[band, :, int(first) : int(first) + size] = each.values[band]
        total += slow[:, t, None, None] * (weighed[t] @ of_step[..., :unknowns].reshape(-1, unknowns).T)
    return total


def excess(squares: Floats, expected: Floats, shape: tuple[int, int]) -> Floats:
    """Return by what blocks make the variance of amplitudes larger than noise does, at least one (motion,).

    `squares` (unknown, block) of what each block does, summed over the steps; `expected` (unknown,) the variance that
    noise makes, likewise; unknowns are of `shape` (section, motion). The solution has made the sum over n blocks
    nearly zero, which takes 1 / n of it. Ratios are of all sections together: one that few blocks see is not known
    well.
    """
    seen = squares.sum(axis=1)
    count = seen**2 / np.maximum((squares**2).sum(axis=1), 1e-300)
    told = count > FEWEST
    variance = np.where(told, seen * count / np.maximum(count - 1, 1), 0).reshape(shape).sum(axis=0)
    noise = np.where(told, expected, 0).reshape(shape).sum(axis=0)
    return np.asarray(np.maximum(variance / np.maximum(noise, 1e-300), 1.0))
