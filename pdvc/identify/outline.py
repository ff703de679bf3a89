"""Areas of a sample's sections, from its reconstructed volume.

In each slice the outline is where the grey level falls through half of the matrix's, seen from the middle in many
directions. Inclusions at the surface dent it, so that in each direction the radius follows the median of its
neighbours along z, and then a parabola over some slices, with all that is far from it held near it. The area is
int r^2 / 2 over the directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.signal import savgol_filter

from pdvc.identify.beam import Profile
from pdvc.robust import usual_size
from pdvc.volume import Volume

Floats = NDArray[np.float64]

DIRECTIONS = 240
RADIAL_VOXEL = 0.25
"""Distance of the places along a direction, voxels."""
MEDIAN_MM, PARABOLA_MM = 0.45, 1.3
"""Heights over which radii follow their median, and a parabola."""
LEAST_SLICES = 5
SURROUNDED = 0.8
"""Share of the directions in which a slice's middle is surrounded by matrix, at least."""
HELD = 1.25
"""Deviations, times the usual size, that a radius is held within."""
INNER = 0.8
"""Share of the radius within which the mean grey level is that of the sample's inside."""
_ROUNDS = 6
_LEVELS = 200


@dataclass(frozen=True, kw_only=True)
class Outline:
    """Where a sample ends in its volume."""

    height_mm: Floats
    """(slice,), mm."""
    radius_mm: Floats
    """(slice, direction), mm."""
    level: float
    """Mean grey level of the inside, inclusions and all, per mm."""
    sharpness: float
    """By what share of the matrix's level grey levels fall within a voxel across a face, the median of all faces."""


def outline_of(volume: Volume, low_mm: float, high_mm: float) -> Outline:
    """Return the outline between two heights.

    Raises ValueError where no sample is found there, or it does not surround the middle of its slices.
    """
    grid = volume.grid
    z = grid.origin_mm[2] + grid.voxel_mm * np.arange(grid.shape[0])
    chosen = np.flatnonzero((z >= low_mm) & (z <= high_mm))
    values = volume.values[chosen]
    if not len(chosen) or not values.max() > 0:
        raise ValueError(f"volume: expected a sample between {low_mm:.4g} and {high_mm:.4g} mm, found none")
    level = matrix_level(values)
    middle: tuple[float, ...] = ndimage.center_of_mass((values > level / 2).any(axis=0))
    share = np.stack([around(each, middle) for each in values]) / level
    radius = np.stack([radii(each) for each in share])
    whole = np.isfinite(radius).mean(axis=1) > SURROUNDED
    # rays through its cut ends may leave slices there without a sample
    first, last = int(whole.argmax()), len(whole) - int(whole[::-1].argmax())
    if not whole[first:last].all() or last - first < LEAST_SLICES:
        raise ValueError("volume: expected a sample around the middle of each slice, found air there")
    # an inclusion from the middle to the surface is a dent, too
    followed = _followed(np.nan_to_num(radius[first:last]), grid.voxel_mm)
    inside = [_inside(each, radius) for each, radius in zip(share[first:last], followed, strict=True)]
    return Outline(
        height_mm=np.asarray(z[chosen][first:last]),
        radius_mm=followed * grid.voxel_mm,
        level=level * float(np.mean(inside)),
        sharpness=float(np.median([falls(*each) for each in zip(share[first:last], followed, strict=True)])),
    )


def directions_rad() -> Floats:
    """Return the angles of the directions, from x to y (direction,), rad."""
    return np.asarray(2 * np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS)


def around(values: NDArray[np.float32], middle: tuple[float, ...]) -> Floats:
    """Return the values of a slice (y, x) along all directions from a place (y, x) in voxels (direction, place)."""
    along, angle = np.arange(0, np.hypot(*values.shape) / 2, RADIAL_VOXEL), directions_rad()
    places = [centre + np.outer(turned(angle), along) for centre, turned in zip(middle, (np.sin, np.cos), strict=True)]
    return np.asarray(ndimage.map_coordinates(values, places, order=1))


def falls(share: Floats, radius: Floats) -> Floats:
    """Return what shares of the level (direction, place) fall by in the voxel about radii (direction,), voxels."""
    places = np.arange(len(radius))

    def at(away: Floats) -> Floats:
        return np.asarray(ndimage.map_coordinates(share, [places, away / RADIAL_VOXEL], order=1))

    return at(radius - 0.5) - at(radius + 0.5)


def _inside(share: Floats, radius: Floats) -> float:
    """Return the mean of shares (direction, place) over the inside of radii (direction,), voxels, far from faces."""
    along = RADIAL_VOXEL * np.arange(share.shape[1])
    area = along * (along < INNER * radius[:, None])
    return float((share * area).sum() / area.sum())


def areas_of(radius_mm: Floats) -> tuple[Floats, Floats]:
    """Return the areas, mm2, and perimeters, mm, of outlines (slice, direction) of radii, mm."""
    step = 2 * np.pi / radius_mm.shape[1]
    slope = (np.roll(radius_mm, -1, axis=1) - np.roll(radius_mm, 1, axis=1)) / (2 * step)
    return (radius_mm**2).sum(axis=1) * step / 2, np.hypot(radius_mm, slope).sum(axis=1) * step


def profile_of(height_mm: Floats, area_mm2: Floats, heights: int = 201) -> Profile:
    """Return a profile of equally spaced heights from areas at others."""
    z = np.linspace(height_mm[0], height_mm[-1], heights)
    return Profile(height_mm=z, area_mm2=np.interp(z, height_mm, area_mm2))


def matrix_level(values: NDArray[np.float32]) -> float:
    """Return the most frequent grey level of what is no air."""
    rough = np.percentile(values[values > 0.25 * values.max()], 75)
    count, edge = np.histogram(values[values > 0.65 * rough], _LEVELS)
    place = int(count.argmax())
    return float(edge[place] + edge[place + 1]) / 2


def radii(share: Floats) -> Floats:
    """Return where shares of the matrix's level (direction, place) last fall through a half, voxels."""
    above = share > 0.5
    last = share.shape[1] - 1 - np.argmax(above[:, ::-1], axis=1)
    found = above.any(axis=1) & (last < share.shape[1] - 1)
    rows, next_ = np.arange(len(share)), np.minimum(last + 1, share.shape[1] - 1)
    inner, outer = share[rows, last], share[rows, next_]
    part = (inner - 0.5) / np.maximum(inner - outer, 1e-6)
    return np.asarray(np.where(found, (last + part) * RADIAL_VOXEL, np.nan))


def _followed(radius: Floats, voxel_mm: float) -> Floats:
    """Return radii (slice, direction), voxels, smooth along z, dents left out."""

    def odd(length_mm: float) -> int:
        return min(2 * max(round(length_mm / voxel_mm / 2), 1) + 1, (len(radius) - 1) // 2 * 2 + 1)

    fit = ndimage.median_filter(radius, size=(odd(MEDIAN_MM), 1), mode="nearest")
    window = odd(PARABOLA_MM)
    if window < 5:
        return np.asarray(fit)
    for _ in range(_ROUNDS):
        held = HELD * float(usual_size(radius - fit))
        fit = savgol_filter(np.clip(radius, fit - held, fit + held), window, 2, axis=0, mode="interp")
    return np.asarray(fit)
