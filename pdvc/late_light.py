"""Take out of images what comes late of the light of those before: lag and afterglow, of which the panel is known.

A panel that keeps a share p of the light and gives it back with the time constant tau shows, in images that take T,

    y_n = (1 - e) x_n + e m_n,      m_n+1 = r m_n + (1 - r) x_n,      r = exp(-T / tau),      e = p (1 - r) tau / T

of the light x_n (J. H. Siewerdsen, D. A. Jaffray, Med. Phys. 26 (1999) 1624), with as many such parts as are given.
Solved for x_n, from the first image on, that is

    x_n = (y_n - sum e m_n) / (1 - sum e).

Before the first view of the reference scan the panel saw the open beam, before the test the last view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pdvc.settings import Settings

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
Counts = NDArray[np.uint16]


class LatePart(Settings):
    """Light that comes late, as it was measured on the panel: what is left of the open beam after it was cut off."""

    share: Annotated[float, Field(gt=0, lt=1)]
    """share of the light that is kept"""
    time_s: Annotated[float, Field(gt=0)]
    """time constant with which it comes, s"""

    def shown(self, image_s: float) -> tuple[float, float]:
        """Return e and r of images that take `image_s` each."""
        left = math.exp(-image_s / self.time_s)
        return self.share * (1 - left) * self.time_s / image_s, left


def image_time_s(time_s: Floats, where: str) -> float:
    """Return the time from an image to the next, s, by those of all (image,); raises ValueError where it is none."""
    found = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    if not (math.isfinite(found) and found > 0):
        raise ValueError(f"lag: expected times of the images that increase, {where}.time_s, found steps of {found} s")
    return found


def without_late_light(
    counts: Counts, dark: Image, open_beam: Image, parts: Sequence[LatePart], image_s: float, before: Image
) -> tuple[Counts, Image]:
    """Return counts (image, row, column) without the light that came late, and the last image's light.

    `dark` and `open_beam` are counts (row, column), the second without the dark; `before` is what the panel saw for
    long before the first image, a share of the open beam, as the light that is returned.
    """
    shown = [part.shown(image_s) for part in parts]
    own = np.float32(1 - sum(e for e, _ in shown))
    if own <= 0:
        raise ValueError(f"lag: expected shares that leave some of the light, got {1 - own:.3g} of it late")
    result, light = np.empty_like(counts), before
    kept = [before.astype(np.float32)] * len(parts)
    for n, image in enumerate(counts):
        light = (image - dark) / open_beam
        for (e, _), late in zip(shown, kept, strict=True):
            light = light - np.float32(e) * late
        light = light / own
        result[n] = np.rint(dark + light * open_beam).clip(0, np.iinfo(counts.dtype).max)
        kept = [np.float32(r) * late + np.float32(1 - r) * light for (_, r), late in zip(shown, kept, strict=True)]
    return result, light
