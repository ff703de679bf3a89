"""What a full scan tells of its own geometry: every ray in the plane of the source is seen twice in a turn.

With beta the stage angle, gamma the angle of a pixel's ray to the source-axis line, and the frame of `pdvc.geometry`,

    q(beta, gamma) = q(beta + pi + 2 gamma, -gamma)                 attenuation; gamma > 0 to the right

so that a scan agrees with its own mirror image, half a turn and twice the fan angle later. Looking for the factor f by
which 2 gamma has to be multiplied, and for the column c about which to mirror, tests what nothing else shows before a
measurement ends: f = 1 where angles and distances are right, f = -1 where the stage turned the other way, f = 10 where
pixels are ten times as large as stated; c off the middle where the axis is not where it is said to be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from pdvc.experiment import Series
from pdvc.geometry import ConeBeam, gaps_rad
from pdvc.radiographs import Calibration, binned, grey_levels

Floats = NDArray[np.float64]

COLUMNS = 110
"""Radiographs are binned to about this many columns."""
ROWS_SHARE = 12
"""One of so many rows, to each side of the plane of the source, takes part: there opposite rays nearly coincide."""
NEAR_ROWS, ALL_ROWS = 13, 81
"""Rows, at most, that the fan angle is fitted on, and that the plane of the source is looked for in."""
LEAST_VIEWS = 16
LARGEST_FACTOR = 4.0
PLANE_ROWS = 0.4
"""Share of the rows, to each side of the middle, in which the plane of the source is looked for."""
_ALIKE_ROWS = 2.0
"""Neighbouring rows that see the same texture, about: fewer are independent than there are."""


@dataclass(frozen=True, kw_only=True)
class SeenTwice:
    """What a scan's agreement with its mirror image tells."""

    factor: float
    """f: fan angle seen over fan angle stated; 1 is due, -1 where the stage turned the other way."""
    factor_std: float
    axis_px: float
    """Column where the axis is seen, less the one where the geometry says it is, px as stored."""
    plane_px: float | None
    """Row where opposite views fit best, less the one where the geometry has the source, px as stored; None where the
    rows do not tell."""
    plane_std_px: float
    mismatch: float
    """rms difference at the best f and c, attenuation."""
    mismatch_reversed: float
    """The same with the best factor of the other sign."""
    curve: Floats
    """(2, n): factors tried, and the rms difference with each, for a figure."""


def seen_twice(series: Series, geometry: ConeBeam, calibration: Calibration) -> SeenTwice | None:
    """Compare a full scan with its mirror image; None where it is no whole turn of at least sixteen views.

    Looks at the rows next to the plane of the source, where the law is exact; the farther from that plane, the worse
    opposite views fit, which tells where it is.
    """
    angle = np.mod(series.angle_rad, 2 * np.pi)
    order = np.argsort(angle, kind="stable")
    if len(series) < LEAST_VIEWS or gaps_rad(angle[order]).max() > 3 * np.pi / LEAST_VIEWS:
        return None
    bins = max(1, round(geometry.columns / COLUMNS))
    coarse = geometry.binned(bins)
    middle = (coarse.rows - 1) / 2 - coarse.row_shift_mm / coarse.pixel_mm
    reach = max(2, coarse.rows // ROWS_SHARE)
    low = int(np.clip(round(middle) - reach, 0, max(coarse.rows - 2 * reach - 1, 0)))
    near = _some(low, min(low + 2 * reach, coarse.rows - 1), NEAR_ROWS)
    half = int(PLANE_ROWS * coarse.rows)
    all_over = _some((coarse.rows - 1) // 2 - half, coarse.rows // 2 + half, ALL_ROWS)
    few = calibration.binned(bins)
    rows = np.union1d(near, all_over)
    views = np.stack([grey_levels(binned(series.counts[k], bins), few)[rows] for k in order]).astype(float)
    views = _on_equal_angles(views, angle[order])
    found = _compared(_Mirror(views[:, np.isin(rows, near)], coarse), bins)
    plane = _plane(_Mirror(views[:, np.isin(rows, all_over)], coarse), all_over, found.axis_px / bins)
    if plane is None:
        return found
    return replace(found, plane_px=(plane[0] - middle) * bins, plane_std_px=plane[1] * bins)


def _some(first: int, last: int, most: int) -> NDArray[np.int64]:
    """Return rows from the first to the last, at most so many of them, evenly spread."""
    return np.unique(np.round(np.linspace(first, last, min(most, last - first + 1))).astype(np.int64))


def _plane(mirror: _Mirror, rows: NDArray[np.int64], axis_px: float) -> tuple[float, float] | None:
    """Return the row about which opposite views fit best, and its deviation, by a parabola through the mismatch."""
    if len(rows) < 8:
        return None
    squares = min((mirror.squares(sign, axis_px) for sign in (1.0, -1.0)), key=np.median)
    middle, span = rows.mean(), float(np.ptp(rows))
    (bend, slope, _), covariance = np.polyfit(rows - middle, squares, 2, cov=True)
    if bend <= 0 or abs(slope / (2 * bend)) > 1.25 * span:
        return None
    way = np.array([slope / (2 * bend**2), -1 / (2 * bend), 0.0])
    deviation = float(np.sqrt(max(way @ covariance @ way, 0.0) * _ALIKE_ROWS))
    return float(middle - slope / (2 * bend)), deviation


def _on_equal_angles(views: Floats, angle_rad: Floats) -> Floats:
    """Return views (view, row, column) at as many equal angles of the turn, interpolated where they are not."""
    count = len(views)
    wanted = angle_rad[0] + 2 * np.pi * np.arange(count) / count
    if np.abs(wanted - angle_rad).max() < 0.02 * np.pi / count:
        return views
    known = np.concatenate([angle_rad, [angle_rad[0] + 2 * np.pi]])
    after = np.clip(np.searchsorted(known, wanted, side="right"), 1, count)
    share = (wanted - known[after - 1]) / np.maximum(known[after] - known[after - 1], 1e-12)
    share = share[:, None, None]
    return np.asarray((1 - share) * views[after - 1] + share * views[after % count])


class _Mirror:
    """Work out how a scan differs from its mirror image, for a factor f and an offset c of the axis, px."""

    def __init__(self, views: Floats, geometry: ConeBeam) -> None:
        self._views = views
        self._spectrum = np.fft.rfft(views, axis=0)
        self._geometry = geometry
        self.column = np.arange(geometry.columns, dtype=float)
        self.middle = (geometry.columns - 1) / 2 - geometry.column_shift_mm / geometry.pixel_mm

    def turned(self, factor: float, axis_px: float) -> Floats:
        """Return each column's history, half a turn and f times its 2 gamma later."""
        geometry = self._geometry
        off = (self.column - self.middle - axis_px) * geometry.pixel_mm
        gamma = np.arctan2(off, geometry.source_detector_mm)
        shift = np.pi - 2 * factor * gamma  # these are the mirror columns, at -gamma
        k = np.arange(len(self._spectrum))
        turn = np.exp(1j * k[:, None] * shift)
        return np.fft.irfft(self._spectrum * turn[:, None, :], n=len(self._views), axis=0)

    def square(self, factor: float, axis_px: float) -> float:
        """Return the mean square difference."""
        return float((self._difference(factor, axis_px) ** 2).mean())

    def squares(self, factor: float, axis_px: float) -> Floats:
        """Return the mean square difference of each row."""
        return np.asarray((self._difference(factor, axis_px) ** 2).mean(axis=(0, 2)))

    def _difference(self, factor: float, axis_px: float) -> Floats:
        turned = self.turned(factor, axis_px)
        mirrored = 2 * (self.middle + axis_px) - self.column
        low = np.floor(mirrored)
        inside = (low >= 0) & (low < len(self.column) - 1)
        at, share = low[inside].astype(int), (mirrored - low)[inside]
        other = turned[..., at] * (1 - share) + turned[..., at + 1] * share
        return np.asarray(other - self._views[..., inside])


def _deviation(mirror: _Mirror, factor: float, axis_px: float) -> float:
    """Return the standard deviation of f from what leaving out each row makes of it (jackknife)."""
    step = 0.25
    low, here, high = (mirror.squares(factor + k * step, axis_px) for k in (-1, 0, 1))

    def without_each(squares: Floats) -> Floats:
        return np.asarray(squares.sum() - squares)

    bend = without_each(high + low - 2 * here)
    found = -step * without_each(high - low) / (2 * np.where(bend > 0, bend, np.nan))
    if not np.isfinite(found).all():
        return LARGEST_FACTOR
    rows = len(found)
    return float(np.sqrt((rows - 1) / rows * ((found - found.mean()) ** 2).sum() * _ALIKE_ROWS))


def _compared(mirror: _Mirror, bins: int) -> SeenTwice:
    reach = len(mirror.column) // 8
    offsets = np.arange(-reach, reach + 0.5)
    axis = float(min(offsets, key=lambda c: mirror.square(0.0, c)))

    def best(low: float, high: float, axis_px: float) -> tuple[float, float]:
        grid = np.linspace(low, high, 17)
        squares = [mirror.square(f, axis_px) for f in grid]
        k = int(np.argmin(squares))
        ends = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
        found = optimize.minimize_scalar(
            lambda f: mirror.square(f, axis_px), bounds=ends, method="bounded", options={"xatol": 0.01}
        )
        return float(found.x), float(found.fun)

    def nearer(factor: float, axis_px: float) -> float:
        ends = (axis_px - 1, axis_px + 1)
        return float(optimize.minimize_scalar(lambda c: mirror.square(factor, c), bounds=ends, method="bounded").x)

    for _ in range(2):
        factor = min(best(0, LARGEST_FACTOR, axis), best(-LARGEST_FACTOR, 0, axis), key=lambda found: found[1])[0]
        axis = nearer(factor, axis)
    square = mirror.square(factor, axis)
    reversed_square = best(-LARGEST_FACTOR, 0, axis)[1] if factor > 0 else best(0, LARGEST_FACTOR, axis)[1]
    return SeenTwice(
        factor=factor,
        factor_std=_deviation(mirror, factor, axis),
        axis_px=axis * bins,
        plane_px=None,
        plane_std_px=float("nan"),
        mismatch=float(np.sqrt(square)),
        mismatch_reversed=float(np.sqrt(reversed_square)),
        curve=np.array([[f, np.sqrt(mirror.square(f, axis))] for f in np.linspace(-3, 3, 25)]).T,
    )
