"""The open beam: how much light falls on each pixel, and how it changes from frame to frame and hour to hour.

With t the time since the flats, and x from -1 to 1 across the columns, a frame has the light

    light(t, x) = (1 + drift t) (1 + tilt t x) (1 + N(0, current^2))

of that of the flats. A drift alone adds -ln(1 + drift t) to every pixel's attenuation; the current's error of a mean
of n frames is 1 / sqrt(n) of that of one.

*Heel*: X-rays are born at a depth below the surface of the target, and leave through it. Towards the anode, by the
angle psi from the middle of the beam, which leaves the surface at the angle alpha, they cross more of it:

    heel(psi) = exp(-mu d (1 / sin(alpha - psi) - 1 / sin(alpha)))

with mu d the attenuation of the target over the mean depth. That the beam gets harder with it is left out. Flats and
radiographs have the same heel: only noise is not even.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pdvc.geometry import ConeBeam
from pdvc.settings import Settings

Image = NDArray[np.float32]


class OpenBeam(Settings):
    """The light of the tube; constant by default."""

    current_spread: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """standard deviation of the tube's light from frame to frame, over its mean"""
    drift_per_hour: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """change of the light since the flats, share of it in an hour"""
    tilt_per_hour: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """change of the light at the right edge of the image, share of it in an hour; the left edge changes oppositely"""
    target_attenuation: Annotated[float, Field(ge=0, le=10)] = 0.0
    """attenuation of the target over the depth at which X-rays are born, mu d; 0: no heel effect"""
    anode_deg: Annotated[float, Field(gt=0, le=90)] = 20.0
    """angle between the surface of the target and the middle of the beam, degrees"""
    heel_deg: float = 90.0
    """direction of the anode in the image, from the right towards the bottom, degrees"""

    def heel(self, scanner: ConeBeam) -> Image | None:
        """Return the light of each pixel (row, column) over that in the middle of the beam; None without heel effect.

        Raises ValueError where pixels see the target from below its surface.
        """
        if self.target_attenuation == 0:
            return None
        x, y = (_from_middle(n) * scanner.pixel_mm for n in (scanner.columns, scanner.rows))
        direction = math.radians(self.heel_deg)
        psi = np.arctan2(x * math.cos(direction) + y[:, None] * math.sin(direction), scanner.source_detector_mm)
        leaving = math.radians(self.anode_deg) - psi
        if leaving.min() <= 0:
            raise ValueError(
                f"scanner.open_beam.anode_deg above {math.degrees(psi.max()):.4g} degrees, the beam's half opening "
                f"towards the anode, got {self.anode_deg} degrees"
            )
        more = 1 / np.sin(leaving) - 1 / math.sin(math.radians(self.anode_deg))
        heel: Image = np.exp(-self.target_attenuation * more).astype(np.float32)
        return heel

    def light(self, time_s: float, frames: int, columns: int, rng: np.random.Generator) -> Image | None:
        """Draw the light of an image over that of the flats, (column,); None where it is the same."""
        if not (self.current_spread or self.drift_per_hour or self.tilt_per_hour):
            return None
        hours = time_s / 3600
        current = 1 + self.current_spread / math.sqrt(frames) * rng.standard_normal()
        x = _from_middle(columns) / max((columns - 1) / 2, 1)
        even = (1 + self.drift_per_hour * hours) * current
        light: Image = (even * (1 + self.tilt_per_hour * hours * x)).astype(np.float32)
        return light


def _from_middle(count: int) -> NDArray[np.float64]:
    """Return the numbers of pixels counted from the middle of a row of them (count,)."""
    return np.arange(count, dtype=np.float64) - (count - 1) / 2
