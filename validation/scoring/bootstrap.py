"""Intervals from a few repetitions, by the bootstrap."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

LEAST_REPETITIONS = 3
"""Fewer give no interval."""
LEVEL = 0.95
_RESAMPLES = 4000
_SEED = 20180704


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A number and its interval; NaN where it is not known."""

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def half_width(self) -> float:
        """Return half the width of the interval."""
        return (self.high - self.low) / 2


def mean(values: Floats) -> Floats:
    """Return the mean over the last axis."""
    return np.asarray(values.mean(axis=-1))


def rms(values: Floats) -> Floats:
    """Return the root of the mean square over the last axis."""
    return np.asarray(np.sqrt((values**2).mean(axis=-1)))


def bootstrapped(values: ArrayLike, statistic: Callable[[Floats], Floats] = mean) -> Estimate:
    """Return a statistic of repetitions (repetition,) with its 95 % percentile-bootstrap interval.

    Values that are NaN are left out. The resamples are the same at every call: same values, same interval. With a
    handful of repetitions such an interval is too narrow: of three it covers the truth some three times in four.
    """
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    if not len(known):
        return Estimate(value=math.nan)
    value = float(statistic(known))
    if len(known) < LEAST_REPETITIONS:
        return Estimate(value=value)
    chosen = np.random.default_rng(_SEED).integers(len(known), size=(_RESAMPLES, len(known)))
    low, high = np.quantile(statistic(known[chosen]), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(value=value, low=float(low), high=float(high))
