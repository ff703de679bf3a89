"""The focal spot: as large as it is, and not where it was.

*Size*: a spot of the width s is seen through an edge of the sample as wide as

    s (M - 1)        with M = source_detector / source_axis

on the detector. The spot is Gaussian, s its full width at half maximum, and the sample small beside its distance from
the source, so that one M holds for all of it: a Gaussian blur of the transmission.

*Drift*: target and housing expand as they warm up, and the spot goes to a new place like a body that warms at a
constant power, with t the time since the flats:

    d(t) = drift (1 - exp(-t / time))
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pdvc.geometry import ConeBeam
from pdvc.settings import Settings
from simulator.detector import focal_blur_px

FWHM = 2 * math.sqrt(2 * math.log(2))
"""Full width at half maximum of a Gaussian, over its standard deviation."""


class FocalSpot(Settings):
    """The focal spot of the tube; a point that stays in its place by default."""

    size_mm: Annotated[float, Field(ge=0)] = 0.0
    """full width of the spot at half of its maximum, mm"""
    drift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """shift that the spot drifts to: across the beam to the right of the image, up, along the beam, mm"""
    drift_time_s: Annotated[float, Field(gt=0)] = 3600.0
    """time constant of the drift, s"""

    def blur_px(self, geometry: ConeBeam) -> float:
        """Return the blur of the spot on the detector, s (M - 1) / pixel, as a standard deviation in pixels."""
        return focal_blur_px(self.size_mm / FWHM, geometry)

    def shift_mm(self, time_s: float) -> NDArray[np.float64]:
        """Return the shift (3,) of the spot in the lab, along x, y and z, at a time since the flats, mm."""
        across, up, along = self.drift_mm
        return -math.expm1(-time_s / self.drift_time_s) * np.array([along, -across, up])
