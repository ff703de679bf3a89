"""A crack: a flat spheroid of air that opens in the matrix while the sample is loaded, for tests of what warns of it.

At rest it is the spheroid of the radius R in its plane and of the half opening h along its normal n,

    { c + x :  |x - (x . n) n|^2 / R^2 + (x . n)^2 / h^2 <= 1 },

with material coordinates c: it is carried along and deformed with the matrix around it, as a nodule is. h grows step
by step, from 0 before the first step to half of the full opening, and stays there.

It takes the place of matrix and does nothing else: the force, and the motion of the sample, are those of a sample
without it. The air is seen, not its cause. Graphite keeps clear of it: nodules that the fully opened crack would meet
are left out, in the reference scan too, so that the sample is the same one in all radiographs.
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pdvc.settings import Settings
from simulator.microstructure import Nodules

Floats = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0)]
Vector = tuple[float, float, float]


class Crack(Settings):
    """A crack that opens; by default there is none, as its opening is 0."""

    opening_mm: Annotated[float, Field(ge=0)] = 0.0
    """full opening in the middle, along the crack's normal, mm; 0: no crack"""
    radius_mm: Positive = 0.3
    """radius in the crack's plane, mm"""
    centre_mm: Vector = (0.0, 0.0, 0.0)
    """middle (x, y, z) in the sample at rest, mm"""
    tilt_deg: float = 0.0
    """angle of the crack's normal from z, degrees"""
    direction_deg: float = 0.0
    """horizontal direction towards which the normal leans, from x towards y, degrees"""
    first_step: Annotated[int, Field(ge=0)] = 90
    """first step, counted from 0, at which the crack is open"""
    opening_steps: Annotated[int, Field(ge=1)] = 10
    """steps in which it opens, by the same amount each; 1: at once"""

    def opened_mm(self, step: int) -> float:
        """Return the opening in the middle at a step, along the normal in the sample at rest, mm."""
        return self.opening_mm * min(max((step - self.first_step + 1) / self.opening_steps, 0.0), 1.0)


NONE = Crack()
"""No crack."""


def spheroids(crack: Crack, opened_mm: float) -> tuple[Floats, Floats]:
    """Return centres (n, 3) and shapes (n, 3, 3), mm, of a crack in the sample at rest; n = 0 while it is closed.

    The crack is {centre + A s, |s| <= 1}, with the shape A = (R e_1, R e_2, h n) by columns.
    """
    if opened_mm == 0.0:
        return np.zeros((0, 3)), np.zeros((0, 3, 3))
    shape = _axes(crack) * np.array([crack.radius_mm, crack.radius_mm, opened_mm / 2])
    return np.array([crack.centre_mm]), shape[None]


def keep_clear(nodules: Nodules, crack: Crack, gap_mm: float) -> Nodules:
    """Return the nodules that are at least `gap_mm` away from the fully opened crack; all of them where there is none.

    The distance is that to the flat cylinder about the crack, which is never more than to the crack itself.
    """
    if crack.opening_mm == 0.0:
        return nodules
    x, y, z = ((nodules.centre_mm - np.array(crack.centre_mm)) @ _axes(crack)).T
    beside = np.maximum(np.hypot(x, y) - crack.radius_mm, 0.0)
    above = np.maximum(np.abs(z) - crack.opening_mm / 2, 0.0)
    clear = np.hypot(beside, above) >= nodules.radius_mm + gap_mm
    return Nodules(centre_mm=nodules.centre_mm[clear], radius_mm=nodules.radius_mm[clear])


def outline_mm(crack: Crack) -> Floats:
    """Return points (n, 3) all over the surface of the fully opened crack in the sample at rest, mm.

    They are a degree apart around the normal, where a chord between neighbours stays within 4e-5 R of the surface.
    """
    around = np.deg2rad(np.arange(360.0))
    up = np.deg2rad(np.linspace(-90.0, 90.0, 37))[:, None]
    sphere = np.stack(
        np.broadcast_arrays(np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), axis=-1
    )
    size = np.array([crack.radius_mm, crack.radius_mm, crack.opening_mm / 2])
    return np.asarray(np.array(crack.centre_mm) + (sphere.reshape(-1, 3) * size) @ _axes(crack).T)


def _axes(crack: Crack) -> Floats:
    """Return the matrix whose columns are two directions in the crack's plane and its normal."""
    tilt, lean = math.radians(crack.tilt_deg), math.radians(crack.direction_deg)
    c, s = math.cos(lean), math.sin(lean)
    down = [c * math.cos(tilt), s * math.cos(tilt), -math.sin(tilt)]
    normal = [c * math.sin(tilt), s * math.sin(tilt), math.cos(tilt)]
    return np.array([down, [-s, c, 0.0], normal]).T
