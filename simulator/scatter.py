"""Scatter: what the sample takes from the beam and sends on to other pixels.

In single scattering the share of the beam that is scattered in the sample and leaves it again goes as T q, with the
transmission T and the attenuation q = -ln T: q is how much is met, and T what is left on the way. On a detector far
away it arrives spread out,

    I = T + k G_w * (T q),

with a Gaussian G_w of the width w and the sum 1. Behind a sample that is wide beside w and attenuates evenly by q, the
ratio of scattered to primary radiation is therefore k q. Of k, Monte Carlo computations tell the size, and what a
large gap between sample and detector does to it.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import gaussian_filter

from pdvc.settings import Settings

Image = NDArray[np.float32]


class Scatter(Settings):
    """Scattered radiation; none by default."""

    ratio: Annotated[float, Field(ge=0, le=10)] = 0.0
    """scattered over primary radiation behind a wide sample, for each unit of its attenuation -ln T"""
    width_mm: Annotated[float, Field(gt=0)] = 60.0
    """standard deviation of the Gaussian over which it is spread, on the detector, mm"""

    def on(self, image: Image, pixel_mm: float) -> Image:
        """Return primary and scattered radiation of an image (row, column), both in shares of the open beam.

        Beyond the edges of the image the sample is taken to go on as it is there.
        """
        if self.ratio == 0:
            return image
        # no light, no attenuation to take the logarithm of: the limit of T ln T is 0
        lost = -image * np.log(np.maximum(image, np.float32(1e-30)))
        spread = gaussian_filter(np.maximum(lost, 0), self.width_mm / pixel_mm, mode="nearest")
        scattered: Image = image + np.float32(self.ratio) * spread
        return scattered
