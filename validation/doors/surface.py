"""The surface of the sample at rest, as rings of points from the bottom up: what is moved to be looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.measurement import Measurement
from pdvc.volume import Hull
from validation.doors.scan import Floats

RINGS_PER_SECTION = 4
AROUND = 32
"""Points of a ring."""


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Rings of points, joined by quadrilaterals to a tube."""

    points_mm: Floats
    """(ring, place around, 3), at rest; rings from the bottom up, places counter-clockwise seen from above."""

    @property
    def flat_mm(self) -> Floats:
        """Return the points as (point, 3), ring after ring."""
        return self.points_mm.reshape(-1, 3)

    def quads(self) -> NDArray[np.int64]:
        """Return the four points of each cell (cell, 4), counter-clockwise for an eye outside."""
        rings, around = self.points_mm.shape[:2]
        ring, place = np.indices((rings - 1, around)).reshape(2, -1)
        beside = (place + 1) % around
        below, above = ring * around, (ring + 1) * around
        return np.stack((below + place, below + beside, above + beside, above + place), axis=1)

    def edges_mm(self) -> tuple[Floats, Floats]:
        """Return the middles of the lower and the upper edge of each cell (cell, 3)."""
        middle = (self.points_mm + np.roll(self.points_mm, -1, axis=1)) / 2
        return middle[:-1].reshape(-1, 3), middle[1:].reshape(-1, 3)


def surface_of(measurement: Measurement, hull: Hull | None = None) -> Surface:
    """Return the surface between the outermost observed sections: the sample's outline, or a round bar.

    Without the outline, which a measurement does not hold, the bar is as thick as the sample's section is from corner
    to corner.
    """
    basis = measurement.motion.basis
    seen = basis.height_mm[measurement.motion.observed]
    if len(seen) < 2:
        raise ValueError(f"surface: expected at least 2 observed sections, found {len(seen)}")
    height = np.linspace(seen[0], seen[-1], (len(seen) - 1) * RINGS_PER_SECTION + 1)
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    # half of half a diagonal is a section's radius: `pdvc.setup`
    middle, radius = np.zeros((len(height), 2)), np.full((len(height), AROUND), 2 * basis.radius_mm)
    if hull is not None:
        middle, radius = _outline(hull, height, angle)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    across = middle[:, None] + radius[..., None] * around
    up = np.broadcast_to(height[:, None, None], (*radius.shape, 1))
    return Surface(points_mm=np.concatenate([across, up], axis=2))


def _outline(hull: Hull, height_mm: Floats, angle_rad: Floats) -> tuple[Floats, Floats]:
    """Return the middle (ring, 2) of the hull at heights (ring,), and its reach from there (ring, angle), mm."""
    filled = np.flatnonzero(np.isfinite(hull.support_mm).all(axis=1))
    slab = np.clip(np.floor((height_mm - hull.z_mm) / hull.slab_mm).astype(int), filled[0], filled[-1])
    support, normals = hull.support_mm[slab], Hull.normals()
    opposite = len(normals) // 2
    quarter = opposite // 2
    middle = np.stack([support[:, k] - support[:, k + opposite] for k in (0, quarter)], axis=1) / 2
    left = support - middle @ normals.T
    towards = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1) @ normals.T
    # along a direction the nearest of the half-planes that it runs into
    reach = np.where(towards > 1e-9, left[:, None] / np.maximum(towards, 1e-9), np.inf)
    return middle, reach.min(axis=2)
