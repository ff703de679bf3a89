"""The rotation stage: what it does beside turning the sample by the angle that is recorded, in every scan.

At the recorded stage angle theta the stage has turned by

    theta + a sin(theta) + backlash (in the test) + N(0, jitter^2),

a sin(theta) being the error of an encoder disc that is off its centre. The axis wobbles, k times per turn, about the
origin, and runs out and lifts with it:

    X = exp([w]x) Rz x + e,                                         w = wobble (cos k theta, sin k theta, 0)
    e = (runout cos k theta, runout sin k theta, lift cos k theta) + N(0, shake^2)

in the lab. A wobble with k = 1 turns with the sample, and is no more than another way of mounting it. Jitter and
shake are drawn anew for each radiograph, and the same for all repetitions of a scenario. A point at the distance r
from the axis is displaced by r jitter, rms; one at height z by z wobble.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pdvc.settings import Settings

Floats = NDArray[np.float64]
NotNegative = Annotated[float, Field(ge=0)]


class RotationStage(Settings):
    """The rotation stage, in the reference scan, the test, and interrupted scans; perfect by default."""

    angle_jitter_deg: NotNegative = 0.0
    """rms error of the angle, drawn for each radiograph, degrees"""
    angle_error_deg: float = 0.0
    """amplitude of the encoder's error, once per turn, degrees"""
    backlash_deg: float = 0.0
    """angle by which the sample is turned farther in the test, after the stage was turned back, degrees"""
    wobble_deg: NotNegative = 0.0
    """tilt of the axis, whose direction goes round as often as the next key says, degrees"""
    wobbles_per_turn: Annotated[int, Field(ge=1)] = 2
    """how often wobble, run-out and lift go round in one turn"""
    runout_mm: NotNegative = 0.0
    """radius of the circle on which the axis goes round, mm"""
    lift_mm: NotNegative = 0.0
    """amplitude of the axis' motion along itself, mm"""
    shake_mm: NotNegative = 0.0
    """rms displacement along each axis of the lab, drawn for each radiograph, mm"""

    @property
    def perfect(self) -> bool:
        """Return whether the stage does nothing but turn."""
        sizes = (self.angle_jitter_deg, self.angle_error_deg, self.backlash_deg, self.wobble_deg, self.runout_mm)
        return not any((*sizes, self.lift_mm, self.shake_mm))

    def drawn(self, rng: np.random.Generator, *, in_test: bool) -> tuple[float, Floats]:
        """Draw what one radiograph has of its own: an error of the angle, rad, and a shift in the lab (3,), mm."""
        jitter, shake = rng.standard_normal(), rng.standard_normal(3)
        angle = self.angle_jitter_deg * jitter + (self.backlash_deg if in_test else 0.0)
        return float(np.deg2rad(angle)), self.shake_mm * shake

    def turned_rad(self, angle_rad: float) -> float:
        """Return the angle that the stage has turned by where the encoder tells `angle_rad`."""
        return angle_rad + float(np.deg2rad(self.angle_error_deg) * np.sin(angle_rad))

    def tilt_rad(self, angle_rad: float) -> Floats:
        """Return the rotation vector (3,) of the axis in the lab, rad."""
        phase = self.wobbles_per_turn * angle_rad
        size = float(np.deg2rad(self.wobble_deg))
        return np.array([size * np.cos(phase), size * np.sin(phase), 0.0])

    def shift_mm(self, angle_rad: float) -> Floats:
        """Return the shift (3,) of the axis in the lab, mm."""
        phase = self.wobbles_per_turn * angle_rad
        return np.array([self.runout_mm * np.cos(phase), self.runout_mm * np.sin(phase), self.lift_mm * np.cos(phase)])
