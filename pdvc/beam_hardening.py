"""Beam-hardening polynomial and hull, both from a coarse reconstruction of the reference views themselves.

A polychromatic beam loses its soft part first, so that attenuation q grows less than the path length L through the
sample. With the sample's outline found in a coarse volume, L is known for every ray. Nodules and photons scatter q,
and not L: q is fitted to L by least squares, and the curve is turned round,

    q ~ a1 L + a2 L^2 + a3 L^3 + (b1 + b2 L) D        L ~ c1 q + c2 q^2 + c3 q^3     (third order, as in section 4.1)

(fitted to q, L would come out flatter than it is). Divided by its largest value in the reference views L gives grey
levels from 0 to 1. The outline of an uncorrected volume is off, so that outline and fit are repeated until they stay.

D is the path through what is seen to be lighter inside, nodules or pores. Where it makes up another share of long
paths than of short ones, as nodules that stay clear of the faces do, the curve of all rays is not that of a section
which becomes thinner as a whole: D is left out once it is fitted.

L is as exact as the faces are. A voxel at a face counts by the share that the sample takes of it, which the grey level
over that behind the face tells. But a pixel shows the mean of intensities: covered to a share c, with the attenuation
a of a path along the face behind it, it shows s = -ln(1 - c (1 - exp(-a))) / a < c, which is turned round,

    c = (1 - exp(-a s)) / (1 - exp(-a)).

Where n x n pixels are averaged after their logarithm this happens in a strip n times as narrow: a / n stands for a,
which moves a face alike as long as a is small (a / 12 of a pixel).

The slope counts most: as a stretched section becomes thinner, grey levels follow dL/dq, and where these fall by
another share than lengths do the sample seems to contract, or to move along the beam.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.geometry import ConeBeam
from pdvc.progress import Progress, silent
from pdvc.projection import project_at_rest
from pdvc.radiographs import grey_of
from pdvc.rays import ray_vectors
from pdvc.reconstruction import fdk, seen_half_height_mm
from pdvc.volume import Grid, Hull, Volume, framed, hull_of

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

SLAB_VOXELS = 4
"""Height of the hull's slabs in voxels of the coarse volume."""
_FIT_VIEWS = 24
_DEEP = 0.25
"""Share of the longest path from which on rays count."""
_ALIKE = 0.8
"""Least share of a path that its neighbours in the row have to have: a pixel that an edge covers in part shows less
than the attenuation of its mean path."""
_FEWEST = 1000
"""Pixels away from edges that are enough."""
_LIGHT = 0.5
"""Share of the sample's grey level below which a voxel inside holds something lighter."""
_SKIN = 2
"""Voxels behind those of a face that tell the level there."""
_CURVE_POINTS = 200
_ROUNDS = 8
"""Times that outline and polynomial are found in turn, at most."""
_SETTLED = 5e-4
"""Change of the path of half the largest attenuation, over that of the largest, that ends the rounds."""


@dataclass(frozen=True, kw_only=True)
class Outline:
    """What the coarse reconstruction tells."""

    hull: Hull
    """Encloses the sample, with a margin of two coarse voxels."""
    polynomial: tuple[float, float, float]
    """c1, c2, c3: from attenuation to grey levels, 1 at the largest attenuation."""


@dataclass(frozen=True, kw_only=True)
class _Sample:
    """The sample in a coarse volume."""

    inside: NDArray[np.bool_]
    """Its voxels (z, y, x): above half its level, pores and graphite filled."""
    values: NDArray[np.float32]
    """Grey levels (z, y, x), per mm."""
    level: float
    """Its own."""

    @property
    def core(self) -> NDArray[np.bool_]:
        """Return the voxels (z, y, x) behind those of its faces."""
        return np.asarray(ndimage.binary_erosion(self.inside))

    @property
    def lighter(self) -> NDArray[np.bool_]:
        """Return the voxels (z, y, x) of what is lighter inside: nodules, pores."""
        return np.asarray(self.core & (self.values < _LIGHT * self.level))

    def share(self, attenuation: float) -> NDArray[np.float32]:
        """Return the share of each voxel (z, y, x) that the sample takes, for the attenuation along its faces."""
        core = self.core
        rim = ndimage.binary_dilation(self.inside) & ~core
        skin = core & ~ndimage.binary_erosion(core, iterations=_SKIN)
        level = float(np.median(self.values[skin])) if skin.any() else self.level
        result = core.astype(np.float32)
        result[rim] = np.expm1(-attenuation / level * self.values[rim]) / np.expm1(-attenuation)
        return result


def find_outline(
    view: Callable[[int], Image],
    geometry: ConeBeam,
    angle_rad: Floats,
    polynomial: tuple[float, float, float] | None,
    *,
    binned: int = 1,
    progress: Progress = silent,
) -> Outline:
    """Reconstruct coarsely, outline the sample and fit the polynomial, unless one is given.

    `view(i)` returns the attenuation (row, column) of coarse view i, without unit; `geometry` is theirs, and `binned`
    the pixels along an axis that were averaged into one of theirs after their logarithm.
    A given polynomial is only scaled, so that the largest attenuation becomes 1. Raises ValueError where it falls
    somewhere: then grey levels do not tell attenuations.
    """
    views = [view(i) for i in range(len(angle_rad))]
    if polynomial is not None:
        _check_rising(polynomial, max(float(np.percentile(image, 99.9)) for image in views))
    grid = _whole_grid(geometry)
    fitted = polynomial or (1.0, 0.0, 0.0)
    deepest = max(float(image.max()) for image in views)
    for _ in range(_ROUNDS):
        sample = _sample(views, geometry, angle_rad, grid, fitted, progress)
        if polynomial is not None:
            break
        before, fitted = fitted, _fit(views, geometry, angle_rad, grid, sample, binned)
        if abs(_half(deepest, fitted) - _half(deepest, before)) < _SETTLED:
            break
    largest = max(float(grey_of(image, fitted).max()) for image in views)
    hull = hull_of(sample.inside, grid, SLAB_VOXELS).grown(2 * grid.voxel_mm)
    c1, c2, c3 = (c / largest for c in fitted)
    return Outline(hull=hull, polynomial=(c1, c2, c3))


def _half(attenuation: float, polynomial: tuple[float, float, float]) -> float:
    """Return the path of half an attenuation over that of the whole: the curve's bend, whatever its scale."""
    half, whole = grey_of(np.array([attenuation / 2, attenuation], dtype=np.float32), polynomial)
    return float(half / whole)


def _check_rising(polynomial: tuple[float, float, float], most: float) -> None:
    c1, c2, c3 = polynomial
    q = np.linspace(0, max(most, 0.0), 100)
    falls = np.flatnonzero(c1 + 2 * c2 * q + 3 * c3 * q**2 <= 0)
    if len(falls):
        raise ValueError(
            f"beam_hardening: expected grey levels that rise with attenuation up to {most:.3g}, the largest here, got "
            f"{list(polynomial)}, which falls at {q[falls[0]]:.3g}"
        )


def _whole_grid(geometry: ConeBeam) -> Grid:
    radius = (geometry.columns / 2 - 1) * geometry.voxel_mm - abs(geometry.column_shift_mm) / geometry.magnification
    height = seen_half_height_mm(geometry, radius)
    if radius <= 0 or height <= 0:
        raise ValueError(
            "geometry: expected a detector that sees the rotation axis and the plane of the source, found shifts of "
            f"{geometry.column_shift_mm:.4g} and {geometry.row_shift_mm:.4g} mm, a detector of {geometry.rows} x "
            f"{geometry.columns} px of {geometry.pixel_mm:.4g} mm, the axis {geometry.source_axis_mm:.4g} mm away"
        )
    return Grid.around(np.array([-radius, -radius, -height]), np.array([radius, radius, height]), geometry.voxel_mm)


def _sample(
    views: list[Image],
    geometry: ConeBeam,
    angle_rad: Floats,
    grid: Grid,
    polynomial: tuple[float, float, float],
    progress: Progress,
) -> _Sample:
    """Return the sample as a volume shows it."""
    everywhere = hull_of(np.ones(grid.shape, dtype=bool), grid, grid.shape[0])
    values = fdk(
        lambda i: grey_of(views[i], polynomial),
        geometry,
        angle_rad,
        grid,
        everywhere,
        progress=progress,
        task="outline",
    )
    level = _sample_level(values)
    inside = ndimage.binary_fill_holes(values > 0.5 * level)
    labels, count = ndimage.label(inside)
    if count == 0:
        raise ValueError("radiographs of a full scan: expected a sample, found only air")
    sizes = np.bincount(labels.ravel())[1:]
    if sizes.max() < 0.5 * sizes.sum():
        raise ValueError(
            "radiographs of a full scan: expected a sample, found only air: "
            f"{count} scattered parts, the largest with {sizes.max() / sizes.sum():.0%} of their volume"
        )
    return _Sample(inside=np.asarray(labels == 1 + int(sizes.argmax())), values=values, level=level)


def _sample_level(values: NDArray[np.float32]) -> float:
    """Return the sample's grey level per mm: the mean above the threshold that Otsu's method finds."""
    counts, edges = np.histogram(values, bins=256, range=(0.0, float(np.percentile(values, 99.9))))
    centres = (edges[1:] + edges[:-1]) / 2
    below, above = np.cumsum(counts), np.cumsum(counts[::-1])[::-1]
    mean_below = np.cumsum(counts * centres) / np.maximum(below, 1)
    mean_above = np.cumsum((counts * centres)[::-1])[::-1] / np.maximum(above, 1)
    between = below[:-1] * above[1:] * (mean_below[:-1] - mean_above[1:]) ** 2
    split = int(np.argmax(between))
    return float(mean_above[split + 1])


def _fit(
    views: list[Image], geometry: ConeBeam, angle_rad: Floats, grid: Grid, sample: _Sample, binned: int
) -> tuple[float, float, float]:
    """Return path length, mm, as a polynomial of attenuation, from the middle rows of some views."""
    hull = hull_of(sample.inside, grid, SLAB_VOXELS).grown(2 * grid.voxel_mm)
    middle = slice(geometry.rows // 5, geometry.rows - geometry.rows // 5)
    window = geometry.cropped(middle.start, middle.stop, 0, geometry.columns)
    chosen = np.unique(np.linspace(0, len(angle_rad) - 1, _FIT_VIEWS).astype(int))
    seen = np.stack([views[i][middle] for i in chosen])
    # half of the largest attenuation, or more, is that of a path along a face
    along_a_face = float(np.median(seen[seen > seen.max() / 2]))
    rays = ray_vectors(window, angle_rad[chosen]).stacked()

    def paths(share: NDArray[np.float32]) -> Image:
        """Return the paths (view, row, column), mm, through voxels (z, y, x), each by its share."""
        volume = Volume(values=framed(share), grid=grid, hull=hull)
        return project_at_rest(volume, rays, (window.rows, window.columns))

    length = paths(sample.share(along_a_face / binned))
    lighter = paths(sample.lighter.astype(np.float32))
    deep = length > _DEEP * length.max()
    alike = ndimage.minimum_filter1d(length, 3) >= _ALIKE * ndimage.maximum_filter1d(length, 3)
    # a sample of a few pixels is all edge
    used = deep & alike if np.count_nonzero(deep & alike) >= _FEWEST else deep
    path, light, powers = length[used].astype(float), lighter[used].astype(float), np.arange(1, 4)
    shapes = np.column_stack([path[:, None] ** powers, light, light * path])
    a = np.linalg.lstsq(shapes, seen[used].astype(float), rcond=None)[0][:3]
    longest = float(length.max())
    curve = np.linspace(_DEEP * longest, longest, _CURVE_POINTS)
    c1, c2, c3 = np.linalg.lstsq((curve[:, None] ** powers @ a)[:, None] ** powers, curve, rcond=None)[0]
    return float(c1), float(c2), float(c3)
