"""The step at which loading begins, found in the recorded force.

The force stays at a plateau F0 and then leaves it. With the scatter s of the plateau, or of the
whole record's second differences where that is larger, the first step from which the
force stays beyond F0 + 5 s marks the departure; a line through the steps that follow it meets F0 at the onset,

    F(t) = F0 + k (t - t0)          t0 < t <= t0 + some,        t0 in steps, rounded
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pdvc.robust import usual_size

Floats = NDArray[np.float64]

LEAVES = 5.0
"""Standard deviations beyond which a force has left the plateau."""
LEAST_PLATEAU = 3
"""Steps that a plateau has at least."""
_LINE = 6
"""Steps of the line that is followed back to the plateau."""


def onset(force_N: Floats) -> int | None:
    """Return the last step (counted from 0) before the force (step,), N, leaves its plateau; None where it does not.

    None also where there is no plateau of three steps to leave: nothing then tells when loading began.
    """
    steps = len(force_N)
    best, noise = None, force_noise(force_N)
    for first in range(LEAST_PLATEAU, steps - 2):
        plateau = force_N[:first]
        level = float(np.median(plateau))
        scatter = float(usual_size(plateau - level))
        scatter = max(scatter, noise, 1e-6 * float(np.abs(force_N).max()), 1e-12)
        away = np.abs(force_N[first:] - level)
        if (away[:_LINE] > LEAVES * scatter).all() and _one_sided(force_N[first:] - level):
            best = first, level
            break
    if best is None:
        return None
    first, level = best
    after = np.arange(first, min(first + _LINE, steps))
    slope, start = np.polyfit(after, force_N[after] - level, 1)
    found = round(-start / slope) if slope != 0 else first - 1
    return int(np.clip(found, 0, first - 1))


def force_noise(force_N: Floats) -> float:
    """Return the noise of a recorded force (step,), N, by second differences, from which a slope is absent.

    Their variance is sigma^2 (1 + 4 + 1).
    """
    bends = np.diff(force_N, 2)
    return float(usual_size(bends)) / np.sqrt(6) if len(bends) else 0.0


def _one_sided(away: Floats) -> bool:
    return bool((away > 0).all() or (away < 0).all())
