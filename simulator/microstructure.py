"""Graphite nodules: spheres in the matrix that neither touch each other nor the surface.

Defaults describe ferritic nodular cast iron (EN-GJS-400). Its volume fraction follows from the carbon:
3.5 wt% C, all of it graphite of 2.2 g/cm3 in a ferrite of 7.7 g/cm3, makes
(3.5 / 2.2) / (3.5 / 2.2 + 96.5 / 7.7) = 0.113. The mean diameter makes some 150 nodules per mm2 of section
(count per area = count per volume x mean diameter), within the 100 to 200 usual for this iron. Particles
below 5 um are inclusions rather than nodules (Pedersen and Tiedje, Materials Characterization 59 (2008)
1111-1121).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Annotated, Self

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pdvc.settings import Settings
from simulator.specimen import Specimen, area_mm2, depth_mm, turn

Positive = Annotated[float, Field(gt=0)]

_PASSES = 400


class Graphite(Settings):
    """The nodules: how much graphite, and of what sizes."""

    volume_fraction: Annotated[float, Field(ge=0, le=0.25)] = 0.11
    """volume of the nodules over that of the region that holds them"""
    mean_diameter_mm: Positive = 0.032
    """mean of the lognormal law of diameters before it is cut off, mm"""
    diameter_spread: Annotated[float, Field(ge=0)] = 0.35
    """standard deviation of the diameters over their mean, before the cut"""
    smallest_diameter_mm: Positive = 0.008
    """diameters below are not drawn, mm"""
    largest_diameter_mm: Positive = 0.09
    """diameters above are not drawn, mm"""
    gap_mm: Annotated[float, Field(ge=0)] = 0.002
    """least matrix between two nodules, and between a nodule and the surface, mm"""

    @model_validator(mode="after")
    def _mean_between_limits(self) -> Self:
        if not self.smallest_diameter_mm <= self.mean_diameter_mm <= self.largest_diameter_mm:
            raise ValueError(
                f"mean_diameter_mm between smallest_diameter_mm = {self.smallest_diameter_mm} mm and "
                f"largest_diameter_mm = {self.largest_diameter_mm} mm, got {self.mean_diameter_mm} mm"
            )
        return self


@dataclass(frozen=True, kw_only=True)
class Nodules:
    """The nodules as spheres in the sample frame, ordered from the bottom up."""

    centre_mm: NDArray[np.float64]
    """Centres (n, 3), mm."""
    radius_mm: NDArray[np.float64]
    """Radii (n,), mm."""

    def __len__(self) -> int:
        return len(self.radius_mm)


def place(graphite: Graphite, specimen: Specimen, rng: np.random.Generator, half_height_mm: float) -> Nodules:
    """Fill the specimen between -half_height and +half_height with nodules that do not touch.

    Random sequential addition, large ones first (in runs of like size): a uniformly drawn centre is kept if
    the sphere lies wholly in the region and at least `gap_mm` from the surface and from every sphere already
    there. Radii are drawn until their volume is that of the wanted fraction, so that the fraction is met to
    within one nodule.
    Raises ValueError where the wanted graphite does not fit.
    """
    half_height = min(half_height_mm, specimen.length_mm / 2)
    radius = _radii(graphite, _volume_mm3(specimen, half_height), rng)
    box = np.array([*_half_box(specimen), half_height])
    # clashes lie in the next cell at most: no cell is narrower than the largest distance that clashes
    pitch = max(2 * float(radius.max(initial=0.0)) + graphite.gap_mm, 0.01)
    shape = np.ceil(2 * box / pitch).astype(np.int64)
    first = np.full(tuple(shape), -1, dtype=np.int64)
    following = np.full(len(radius), -1, dtype=np.int64)
    centre = np.zeros((len(radius), 3))
    for waiting in _by_size(len(radius)):
        for _ in range(_PASSES):
            r = radius[waiting]
            candidate = rng.uniform(-1.0, 1.0, (len(waiting), 3)) * box
            fits = depth_mm(specimen, turn(specimen, candidate)) >= r + graphite.gap_mm
            fits &= np.abs(candidate[:, 2]) <= half_height - r
            _add(candidate, waiting, fits, graphite.gap_mm, box, pitch, first, following, centre, radius)
            waiting = waiting[~fits]
            if not len(waiting):
                break
        else:
            raise ValueError(
                f"graphite.volume_fraction: expected one that fits with gap_mm = {graphite.gap_mm} mm, got "
                f"{graphite.volume_fraction}: {len(waiting)} nodules of {2 * radius[waiting[-1]]:.3g} mm or "
                "more found no place"
            )
    order = np.argsort(centre[:, 2], kind="stable")
    return Nodules(centre_mm=turn(specimen, centre[order]), radius_mm=radius[order])


@numba.njit(cache=True, nogil=True)
def _add(candidate, index, fits, gap, box, pitch, first, following, centre, radius):  # type: ignore[no-untyped-def]
    """Keep each candidate that touches no nodule so far; clears `fits` for the others.

    `first[cell]` and `following[nodule]` chain the nodules of each cell of the grid; -1 ends a chain.
    """
    nx, ny, nz = first.shape
    for k in range(len(index)):
        if not fits[k]:
            continue
        x, y, z = candidate[k, 0], candidate[k, 1], candidate[k, 2]
        r = radius[index[k]] + gap
        ix = min(int((x + box[0]) / pitch), nx - 1)
        iy = min(int((y + box[1]) / pitch), ny - 1)
        iz = min(int((z + box[2]) / pitch), nz - 1)
        for jx in range(max(ix - 1, 0), min(ix + 2, nx)):
            for jy in range(max(iy - 1, 0), min(iy + 2, ny)):
                for jz in range(max(iz - 1, 0), min(iz + 2, nz)):
                    other = first[jx, jy, jz]
                    while other >= 0 and fits[k]:
                        dx, dy, dz = centre[other, 0] - x, centre[other, 1] - y, centre[other, 2] - z
                        if dx * dx + dy * dy + dz * dz < (r + radius[other]) ** 2:
                            fits[k] = False
                        other = following[other]
        if fits[k]:
            centre[index[k]] = candidate[k]
            following[index[k]] = first[ix, iy, iz]
            first[ix, iy, iz] = index[k]


def _by_size(count: int) -> list[NDArray[np.int64]]:
    """Split the nodules, largest first, into runs that double in length: a run waits for the one before."""
    ends = [0, *(64 << k for k in range(64) if 64 << k < count), count]
    return [np.arange(low, high) for low, high in itertools.pairwise(ends) if high > low]


def _radii(graphite: Graphite, volume_mm3: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw radii of the cut lognormal law until their volume is the wanted one; largest first, mm."""
    wanted = graphite.volume_fraction * volume_mm3
    sigma = np.sqrt(np.log1p(graphite.diameter_spread**2))
    mu = np.log(graphite.mean_diameter_mm) - sigma**2 / 2
    drawn: list[NDArray[np.float64]] = []
    total = 0.0
    while total < wanted:
        d = rng.lognormal(mu, sigma, 4096)
        d = d[(d >= graphite.smallest_diameter_mm) & (d <= graphite.largest_diameter_mm)]
        drawn.append(d)
        total += float(np.sum(np.pi / 6 * d**3))
    diameters = np.concatenate([*drawn, np.empty(0)])
    summed = np.cumsum(np.pi / 6 * diameters**3)
    count = int(np.searchsorted(summed, wanted)) if wanted > 0 else 0
    return np.sort(diameters[:count])[::-1] / 2


def _volume_mm3(specimen: Specimen, half_height_mm: float) -> float:
    z = np.linspace(-half_height_mm, half_height_mm, 4001)
    return float(np.trapezoid(area_mm2(specimen, z), z))


def _half_box(specimen: Specimen) -> tuple[float, float]:
    half_x = specimen.grip_width_mm if specimen.thinned != "y" else specimen.width_mm
    half_y = specimen.grip_width_mm if specimen.thinned != "x" else specimen.thickness_mm
    return half_x / 2, half_y / 2
