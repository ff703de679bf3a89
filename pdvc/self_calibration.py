"""Find what a scanner is from its own reference scan (Jailin et al., Meas. Sci. Technol. 29 (2018) 024003).

The scan is reconstructed with a trial correction p and projected again; what that leaves of the views,

    e(p) = P_p R_p g_p - g_p,           R reconstructs, P projects, g_p the views moved back

is made least by Gauss-Newton steps. Registering the views to a fixed volume would be biased: the volume is made of the
same views with the same p, and has taken up part of the error. So the sensitivities are those of the whole,

    J_i = [e(p + h_i) - e(p)] / h_i         a reconstruction and a projection for each parameter

and hold only what no other volume does as well. Over G_i, what the parameter does to the views by themselves,
|J_i| / |G_i| is the share of it that is seen. What a volume takes up is what a sample does that stands elsewhere:
to the right, and turned about the beam, a wave of one period in a turn; downwards, a constant. Of a drift (from -1/2
to 1/2 over the turn) and of a bend (t^2) there are left, by their Fourier series,

    1 - 6 / pi^2 = 0.63^2      and      1 - 90 / pi^4 = 0.28^2

to the right, and nearly all downwards (waves of two periods less, as opposite views agree on them). What is seen to a
share under `LEAST_SEEN` is left as told, and said. Motion that is not told from zero by `TOLD` deviations is left,
too, the least told first, as a bend is much like a wave, and a drift like another one: errors that the volume makes
otherwise, by interpolation and by its few views, would pass for it.

Standard deviations come from blocks of pixels that err independently of each other, as in `pdvc.coherent`. What the
views at theta and at theta + pi, mirrored about the axis, have in common of e is the material's: scatter, beam
hardening, a detector that leans. It is large, and turns with the sample, so that blocks do not err independently; but
a motion to the right is to the left in the mirror, and one downwards that opposite views agree on is taken up by the
volume. So where what a parameter does is mostly of the other sort, only that part of J and e tells it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.correction import (
    DIRECTIONS,
    GEOMETRY,
    MOTION,
    UNSEEN,
    Correction,
    Parameter,
    State,
    corrected,
    moved_back,
    view_motion,
)
from pdvc.experiment import Series
from pdvc.geometry import ConeBeam, nearest_angles
from pdvc.progress import Progress, silent
from pdvc.projection import project_at_rest
from pdvc.radiographs import Calibration, coarsened, grey_levels, sharpened
from pdvc.rays import ray_vectors
from pdvc.reconstruction import fdk, one_of
from pdvc.volume import Hull, Volume
from pdvc.window import reached_rows, scan_grid

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

Unlike = Callable[[Image], Image]
Sought = Literal["geometry", "motion"]
"""What is sought: the geometry alone, or the motion of the views besides."""

ROWS = (120, 240)
"""Rows of the binned views, about: first all is found at the first, then it is made better at the second."""
BLUR_PX = 1.0
"""Gaussian that binned views go through, px of theirs: interpolation errs the less, wherever it is."""
STEP_PX = 0.25
"""Step of the differences, px of the binned views."""
CONVERGED_PX = 0.005
"""Largest change of a round, px as stored, under which it was the last one."""
MOST_ROUNDS = 6
LEAST_SEEN = 0.1
"""Share of what a parameter does that has to be seen for it to be sought."""
TOLD, LEAST_PX = 4.0, 0.02
"""Deviations by which the motion of views differs from zero, or is none; and px that are seen of it at least, as the
volume errs by about so much."""
DEVIATION_PX = {"geometry": 5.0, "motion": 1.0}
"""Deviations before the data, px."""
MOSTLY = 0.5
"""Share of what a parameter does, squared, in which opposite views differ, from which on that alone tells of it."""
BLOCKS = 8
"""Blocks of views, and of rows: errors of different ones are independent."""
RENEWED_PX = 0.2
"""Change of a round from which on sensitivities are found anew in the next."""
_MARGIN_ROWS = 2


def self_calibrated(
    series: Series,
    told: ConeBeam,
    calibration: Calibration,
    hull: Hull,
    sought: Sought,
    *,
    axis_px: float = 0.0,
    progress: Progress = silent,
) -> Correction:
    """Find the correction of a full scan: of the geometry as `told`, and with ``motion`` of each view, too.

    `calibration` with the beam-hardening polynomial; `hull` encloses the sample. `axis_px` is a first guess: the
    column where the axis is seen less the one where it is due, as of `pdvc.seen_twice`.
    """
    names = (*GEOMETRY, *(MOTION if sought == "motion" else ()))
    nothing = dict.fromkeys(names, 0.0)
    scales = list(dict.fromkeys(max(1, round(told.rows / rows)) for rows in ROWS))
    scans = [_Scan(series, told, calibration, hull, scale) for scale in scales]
    coarse, fine = scans[0], scans[-1]
    before = _rms(fine.left(nothing))
    # the axis first: what else is seen is told the better
    start = coarse.settled({**nothing, "column_shift": -axis_px}, ["column_shift"], progress)
    changes = coarse.changes(start.values, names, coarse.left(start.values), progress)
    shares = coarse.shares(start.values, names, changes)
    seen = [name for name in names if shares[name] >= LEAST_SEEN]
    found = coarse.settled(start.values, seen, progress, changes[[names.index(name) for name in seen]])
    told_apart = _told_apart(found, seen, shares)
    std, rounds, values = found.std, start.rounds + found.rounds, found.values
    left = scans if len(told_apart) < len(seen) else scans[1:]
    while left:
        values = {name: value if name in told_apart else 0.0 for name, value in values.items()}
        for scan in left:
            found = scan.settled(values, told_apart, progress)
            values, rounds = found.values, rounds + found.rounds
        std = {**std, **found.std}
        # what is not told at the finer scale, either, is none
        still = _told_apart(found, told_apart, shares)
        told_apart, left = still, [fine] if len(still) < len(told_apart) else []

    def parameter(name: str) -> Parameter:
        state: State = "not observable" if name not in seen else "found" if name in told_apart else "none"
        return Parameter(
            name=name, value_px=values[name], std_px=std.get(name, np.nan), seen=shares[name], state=state
        )

    depth = hull.radius_mm() / 2 / told.source_axis_mm
    unseen = (Parameter(name=name, seen=depth * by, state="not observable") for name, by in UNSEEN.items())
    return Correction(
        parameters=(*map(parameter, names), *unseen),
        rounds=rounds,
        last_change_px=found.change_px,
        rms_before=before,
        rms_after=_rms(fine.left(values)),
    )


@dataclass(frozen=True, kw_only=True)
class _Settled:
    """Where the rounds at one scale ended."""

    values: dict[str, float]
    """Of all parameters, px."""
    std: Mapping[str, float]
    """Of those that were sought."""
    change_px: float
    rounds: int
    matrix: Floats
    """Normal matrix of those that were sought, with the prior, and the covariance of its right-hand side."""
    covariance: Floats


def _told_apart(found: _Settled, names: Sequence[str], shares: Mapping[str, float]) -> list[str]:
    """Return the geometry, and the motions that are told from zero: the least told is left out, one after the other.

    A bend is much like a wave of one period, and a drift like another one, so that what is not there hides what is.
    """
    values, left = np.array([found.values[name] for name in names]), list(range(len(names)))
    while True:
        # least squares again, with those that were left out at zero
        inverse = np.linalg.inv(found.matrix[np.ix_(left, left)])
        now = inverse @ found.matrix[left] @ values
        std = _deviations(inverse, found.covariance[np.ix_(left, left)])
        told = {
            k: min(abs(value) / size / TOLD, abs(value) * shares[names[k]] / LEAST_PX)
            for k, value, size in zip(left, now, std, strict=True)
            if names[k] not in GEOMETRY
        }
        least = min(told, key=told.__getitem__, default=None)
        if least is None or told[least] > 1:
            return [names[k] for k in left]
        left.remove(least)


class _Scan:
    """A full scan at a scale: what a correction leaves of it, and how that changes with the correction."""

    def __init__(self, series: Series, told: ConeBeam, calibration: Calibration, hull: Hull, scale: int) -> None:
        chosen = one_of(series.angle_rad, max(scale // 2, 1))
        self._told, self._hull, self._scale = told, hull, scale
        self._angle_rad, self._time_s = series.angle_rad[chosen], series.time_s[chosen]

        def view(i: int) -> Image:
            seen = coarsened(grey_levels(series.counts[i], calibration), scale)
            return np.asarray(ndimage.gaussian_filter(seen, BLUR_PX, mode="nearest"))

        # a view is read and filtered by one thread
        with ThreadPoolExecutor(numba.get_num_threads()) as pool:
            self._views = np.stack(list(pool.map(view, chosen.tolist())))
        geometry = told.binned(scale)
        self._grid = scan_grid(geometry, hull)
        rows = reached_rows(geometry, self._grid, hull)
        self._rows = slice(rows.start + _MARGIN_ROWS, rows.stop - _MARGIN_ROWS)

    def views(self, values: Mapping[str, float]) -> Image:
        """Return the views (view, row, column) moved back."""
        way = view_motion(values, self._angle_rad, self._time_s)
        if not way.any():
            return self._views
        with ThreadPoolExecutor(numba.get_num_threads()) as pool:
            return np.stack(list(pool.map(lambda view, px: moved_back(view, px, self._scale), self._views, way)))

    def left(self, values: Mapping[str, float]) -> Image:
        """Return e (view, row, column), grey levels, of the rows whose rays stay in the volume."""
        views, angle = self.views(values), self._angle_rad
        geometry = corrected(self._told, values).binned(self._scale)
        volume = Volume(
            values=fdk(lambda i: sharpened(views[i]), geometry, angle, self._grid, self._hull),
            grid=self._grid,
            hull=self._hull.around_voxels(geometry.voxel_mm),
        )
        again = project_at_rest(volume, ray_vectors(geometry, angle).stacked(), views[0].shape)
        return np.asarray((again - views)[:, self._rows])

    def _unlike(self, values: Mapping[str, float]) -> Unlike:
        """Return what takes from images (view, row, column) what opposite views, mirrored, have in common."""
        geometry = corrected(self._told, values).binned(self._scale)
        opposite = nearest_angles(self._angle_rad + np.pi, self._angle_rad)
        # the axis is in the middle of an image and of its mirror image once that is moved by
        shift = -2 * geometry.column_shift_mm / geometry.pixel_mm

        def unlike(images: Image) -> Image:
            mirrored = ndimage.shift(images[opposite, :, ::-1], (0, 0, shift), order=1, mode="nearest")
            return np.asarray((images - mirrored) / 2, dtype=np.float32)

        return unlike

    def changes(self, values: Mapping[str, float], names: Sequence[str], e: Image, progress: Progress) -> Image:
        """Return J (parameter, view, row, column), grey levels per px, at values where `left` is e."""
        step = STEP_PX * self._scale
        result = np.empty((len(names), *e.shape), dtype=np.float32)
        for k, name in enumerate(names):
            result[k] = (self.left({**values, name: values[name] + step}) - e) / step
            progress(f"self-calibration, scale {self._scale}", k + 1, len(names))
        return result

    def shares(self, values: Mapping[str, float], names: Sequence[str], changes: Image) -> dict[str, float]:
        """Return |J| / |G| of each parameter: what the volume cannot take up of what it does to the views."""
        step, here = STEP_PX * self._scale, self.views(values)
        direct = (self._moved_flat(here, name, step) - here for name in names)
        return {
            name: _rms(change) / max(_rms(by_itself[:, self._rows] / step), 1e-30)
            for name, change, by_itself in zip(names, changes, direct, strict=True)
        }

    def _moved_flat(self, views: Image, name: str, step_px: float) -> Image:
        """Return views that a parameter has moved by a step, as if the sample were flat, in the plane of the axis."""
        way = view_motion({name: step_px}, self._angle_rad, self._time_s)
        if name in GEOMETRY:
            way[:, DIRECTIONS.index(GEOMETRY[name])] = step_px
        return np.stack([moved_back(view, px, self._scale) for view, px in zip(views, way, strict=True)])

    def settled(
        self, start: Mapping[str, float], names: Sequence[str], progress: Progress, changes: Image | None = None
    ) -> _Settled:
        """Return where Gauss-Newton steps from `start` end, in some parameters; `changes` are J there, if known."""
        values, rounds, last = dict(start), 0, np.inf
        deviation = np.array([DEVIATION_PX["geometry" if name in GEOMETRY else "motion"] for name in names])
        e = self.left(values)
        while True:
            if changes is None or (rounds and last > RENEWED_PX):
                changes = self.changes(values, names, e, progress)
            now = np.array([values[name] for name in names])
            change, matrix, covariance = _change(changes, e, self._unlike(values), now, deviation)
            values |= dict(zip(names, (now + change).tolist(), strict=True))
            e, rounds, last = self.left(values), rounds + 1, float(np.abs(change).max())
            if last < CONVERGED_PX or rounds == MOST_ROUNDS:
                break
        std = _deviations(np.linalg.inv(matrix), covariance)
        return _Settled(
            values=values,
            std=dict(zip(names, std.tolist(), strict=True)),
            change_px=last,
            rounds=rounds,
            matrix=matrix,
            covariance=covariance,
        )


def _change(changes: Image, e: Image, unlike: Unlike, now: Floats, deviation: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the Gauss-Newton step (parameter,), px, from values `now`, its matrix and its right side's covariance.

    `changes` (parameter, view, row, column), `e` (view, row, column), `deviation` (parameter,) that of the prior, px.
    """
    told, scores, own = np.empty_like(changes), np.empty((BLOCKS**2, len(changes))), unlike(e)
    less = np.ones(len(changes))
    for k, change in enumerate(changes):
        told[k] = unlike(change)
        if _rms(told[k]) ** 2 > MOSTLY * _rms(change) ** 2:
            # a view and its opposite one tell the same: half as many are independent
            scores[:, k], less[k] = _scores(told[k], own), np.sqrt(2)
        else:
            told[k] = change
            scores[:, k] = _scores(change, e)
    flat = told.reshape(len(told), -1)
    matrix, gradient = (flat @ flat.T).astype(float), scores.sum(axis=0)
    covariance = (less * scores).T @ (less * scores)
    # e is no white noise: its variance is what the blocks make of it
    variance = float(np.median(np.diag(covariance) / np.diag(matrix)))
    ridge = np.diag(variance / deviation**2)
    matrix = matrix + ridge
    return -np.linalg.solve(matrix, gradient + ridge @ now), matrix, covariance + variance * ridge


def _deviations(inverse: NDArray[Any], covariance: Floats) -> Floats:
    """Return the deviations (parameter,) of a solution, by its inverse matrix and its right side's covariance."""
    return np.asarray(np.sqrt(np.diag(inverse @ covariance @ inverse)))


def _scores(change: Image, e: Image) -> Floats:
    """Return the products (block,) of a change and e, both (view, row, column)."""
    product = change * e
    blocks = (
        product[views[0] : views[-1] + 1, rows[0] : rows[-1] + 1].sum(dtype=float)
        for views in np.array_split(np.arange(e.shape[0]), BLOCKS)
        for rows in np.array_split(np.arange(e.shape[1]), BLOCKS)
    )
    return np.fromiter(blocks, dtype=float)


def _rms(image: Image) -> float:
    return float(np.sqrt(np.mean(np.square(image, dtype=float))))
