"""How far inside the faces of a sample appear in its volume, and with that the areas of its sections.

A pixel shows the mean of intensities, q = -ln <exp(-a)>, which is less than <a> where the attenuation a differs within
it. A face seen edge-on, behind which a jumps from nothing, appears inside of where it is by

    1/2 coth(a / 2) - 1 / a  pixels,          a / 12 where a is small, 0.08 at a = 1

and by more where the detector blurs, which it does before a logarithm is taken, too. In a volume all views take part
that look along a face more or less. So the outline that was found is taken for that of a prism, whose radiographs are
worked out pixel by pixel, reconstructed with the same geometry and at the same angles, and outlined: what this moved
the faces by is given back.

The detector's blur, a Gaussian, is what makes grey levels of the prism fall as steeply at its faces as in the volume.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.geometry import ConeBeam
from pdvc.identify.outline import Outline, areas_of, around, directions_rad, falls, radii
from pdvc.radiographs import grey_of, sharpened, smoothed
from pdvc.rays import directions
from pdvc.reconstruction import fdk
from pdvc.volume import DIRECTIONS, Grid, Hull

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

SUBPIXELS = 16
"""Rays across a pixel."""
BLURS_PX = (0.0, 0.5, 1.0)
"""Blurs at which the fall of grey levels is worked out; between them it goes with the blur's square."""
_ROWS, _LAYERS = 9, 3
_MARGIN_VOXEL = 4.0
_DOUBLINGS = 30
_CURVE_POINTS = 2000


@dataclass(frozen=True, kw_only=True)
class Scan:
    """How a volume was made."""

    geometry: ConeBeam
    angle_rad: Floats
    """Of the views (view,), rad."""
    polynomial: tuple[float, float, float]
    """c1, c2, c3: from attenuation to grey levels."""
    smooth_px: float = 0.0
    """Filter of the radiographs, px."""
    sharpen: bool = False
    """Whether radiographs are sharpened by what interpolation blurs."""


def areas_between_faces(outline: Outline, scan: Scan) -> Floats:
    """Return the areas of an outline's slices (slice,), mm2, as they are once faces are where they belong.

    The blur is found at the smallest section; what faces move by, there and at both ends.
    """
    area, perimeter = areas_of(outline.radius_mm)
    smallest = int(area.argmin())
    blur_px = blur_of(outline.radius_mm[smallest], outline, scan)
    chosen = np.unique([0, smallest, len(area) - 1])
    moved = []
    for k in chosen:
        radius, _ = appearance(outline.radius_mm[k], outline.level, scan, blur_px)
        moved.append((area[k] - areas_of(radius[None])[0][0]) / perimeter[k])
    return np.asarray(area + perimeter * np.interp(outline.height_mm, outline.height_mm[chosen], moved))


def blur_of(radius_mm: Floats, outline: Outline, scan: Scan) -> float:
    """Return the detector's blur, px, by which a section of radii (direction,), mm, looks as sharp as the outline."""
    sharpness = [appearance(radius_mm, outline.level, scan, blur)[1] for blur in BLURS_PX]
    square = np.interp(-outline.sharpness, -np.array(sharpness), np.square(BLURS_PX))
    return float(np.sqrt(square))


def appearance(radius_mm: Floats, level: float, scan: Scan, blur_px: float) -> tuple[Floats, float]:
    """Return the radii (direction,), mm, and the sharpness that a prism has in a volume.

    Of given radii (direction,), mm, and of one grey level inside, per mm.
    """
    geometry = replace(scan.geometry, rows=_ROWS, row_shift_mm=0.0, roll_rad=0.0)
    angle = directions_rad()
    corner = radius_mm[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    lines = seen_by_pixels(level * paths_mm(corner, geometry, scan.angle_rad), scan, blur_px)

    def view(i: int) -> Image:
        image = smoothed(np.tile(lines[i], (_ROWS, 1)), scan.smooth_px)
        return sharpened(image) if scan.sharpen else image

    voxel = geometry.voxel_mm
    reach = float(radius_mm.max()) + _MARGIN_VOXEL * voxel
    box = np.array([reach, reach, _LAYERS * voxel])
    hull = Hull(z_mm=-2 * box[2], slab_mm=4 * box[2], support_mm=np.full((1, DIRECTIONS), reach - 2 * voxel))
    grid = Grid.around(-box, box, voxel)
    values = fdk(view, geometry, scan.angle_rad, grid, hull)
    middle = tuple(-origin / voxel for origin in (grid.origin_mm[1], grid.origin_mm[0]))
    share = around(values[grid.shape[0] // 2], middle) / level
    found = radii(share)
    return found * voxel, float(np.median(falls(share, found)))


def paths_mm(corner_mm: Floats, geometry: ConeBeam, angle_rad: Floats) -> Floats:
    """Return the paths of a level detector line's rays through a polygon (view, ray), mm, `SUBPIXELS` rays a pixel.

    Corners (corner, 2) in turn: x, y in the sample frame, mm. Along a side, 1 / depth is linear in the place on the
    detector; each side adds its distance from the source or takes it away, as it is behind or before.
    """
    beam, across = (each[:, :2] for each in directions(angle_rad))
    distance, rays = geometry.source_detector_mm, geometry.columns * SUBPIXELS
    depth = geometry.source_axis_mm + corner_mm @ beam.T
    pitch = geometry.pixel_mm / SUBPIXELS
    place = (distance * (corner_mm @ across.T) / depth - geometry.column_shift_mm) / pitch + (rays - 1) / 2
    first = np.clip(np.ceil(place), 0, rays).astype(int)
    depth_2, place_2, first_2 = (np.roll(each, -1, axis=0) for each in (depth, place, first))
    count = np.abs(first_2 - first).ravel()
    side = np.repeat(np.arange(count.size), count)
    ray = np.minimum(first, first_2).ravel()[side] + np.arange(len(side)) - np.repeat(np.cumsum(count) - count, count)
    share = (ray - place.ravel()[side]) / (place_2 - place).ravel()[side]
    inverse = 1 / depth.ravel()[side] + share * (1 / depth_2 - 1 / depth).ravel()[side]
    slant = np.hypot(1.0, ((ray - (rays - 1) / 2) * pitch + geometry.column_shift_mm) / distance)
    signed = np.sign(first_2 - first).ravel()[side] * slant / inverse
    view = np.broadcast_to(np.arange(len(angle_rad)), depth.shape).ravel()[side]
    total = np.bincount(view * rays + ray, weights=signed, minlength=rays * len(angle_rad))
    return np.abs(total).reshape(len(angle_rad), rays)


def seen_by_pixels(grey: Floats, scan: Scan, blur_px: float) -> Image:
    """Return the grey levels of pixels (view, column) whose rays alone would show some (view, ray)."""
    attenuation = _attenuation(grey, scan.polynomial)
    intensity = np.exp(-attenuation)
    if blur_px > 0:
        intensity = ndimage.gaussian_filter1d(intensity, blur_px * SUBPIXELS, axis=1, mode="nearest")
    pixels = -np.log(intensity.reshape(len(grey), -1, SUBPIXELS).mean(axis=2))
    return np.asarray(grey_of(pixels, scan.polynomial), dtype=np.float32)


def _attenuation(grey: Floats, polynomial: tuple[float, float, float]) -> Floats:
    """Return the attenuations that a rising polynomial makes grey levels of."""
    most, highest = float(grey.max()), 1.0
    for _ in range(_DOUBLINGS):
        if grey_of(np.array(highest), polynomial) >= most:
            break
        highest *= 2
    curve = np.linspace(0.0, highest, _CURVE_POINTS)
    return np.interp(grey, np.maximum.accumulate(grey_of(curve, polynomial)), curve)
