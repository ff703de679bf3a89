"""What the noise of radiographs, reference views and flats does to the equations' right-hand side.

The residual of a step holds three noises. With n_g that of its radiograph, n_f that of the reference view at its
angle, moved with the sample as e is (`pdvc.systematic`; R_t interpolates), and phi that of the mean flat, over it,

    n_rho(t) = -n_g(t) - s_t phi + R_t [n_f + s_f phi]           s = dg / dq, the slope of grey levels

n_g is drawn anew at each step. n_f is shared by all steps that look along the same view, a turn apart, and phi by
all images. The noise of h = sum_t sigma(t) (x) S(t)^T W rho(t) has therefore the covariance

    V = sum_t sigma sigma^T (x) S^T W V_g W S                                     radiographs
      + sum_v sum_tt' a_tv a_t'v sigma(t) sigma(t')^T (x) Y_t^T V_v Y_t'          reference views,  Y_t = R_t^T W S(t)
      + sum_p v_phi(p) z(p) z(p)^T                                                flats
    z(p) = sum_t sigma(t) (x) [s_f(p) Y_t(p) - s_t(p) W S(t, p)]

Filtering the radiographs first (`radiographs.smoothed`) puts G S for S here, where S meets noise: G S is taken as the
sensitivity of the volume filtered once more, which is exact in a parallel beam.

with a_tv the share of view v at step t. The noise of the reference volume itself moves with the sample: re-projected
and subtracted again it cancels, and that of the reference views takes its place. Where e is not subtracted, the
re-projected volume holds at most the same noise, so that V is then an upper bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdvc.equations import Images
from pdvc.measurement import ResidualTests
from pdvc.progress import Progress, silent
from pdvc.projection import Sensitivities, sensitivities
from pdvc.radiographs import noise_overlap, smoothed
from pdvc.sections import SectionBasis
from pdvc.systematic import Systematic

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

_BLOCK_ROWS = 16


@dataclass(frozen=True, kw_only=True)
class ImageNoise:
    """The noise of one image, in grey levels."""

    variance: Image
    """Its own, of photons and readout (row, column)."""
    slope: Image
    """dg / dq: grey levels for a relative error of the open beam (row, column)."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """The noise of all images of one scale; images are asked for one at a time."""

    step: Callable[[int], ImageNoise]
    """Of a step's radiograph, over the window."""
    view: Callable[[int], ImageNoise]
    """Of a reference view, over the whole detector; numbered as `Systematic.fields`."""
    flat: Image
    """Variance of the mean flat, relative to it (row, column), over the whole detector."""
    smooth_px: float = 0.0
    """The filter that all images went through after this noise, px."""


def known_from_residual(rms: float, window: tuple[int, int], detector: tuple[int, ...], smooth_px: float) -> Noise:
    """Return what to believe where the detector's noise is unknown: the residual is noise, of views and steps alike.

    Interpolating a view leaves (2/3)^2 of its variance on average, the filter what `noise_overlap` tells.
    """
    variance = rms**2 / noise_overlap(smooth_px)[0] ** 2 / (1 + 4 / 9)

    def uniform(shape: tuple[int, ...]) -> ImageNoise:
        return ImageNoise(variance=np.full(shape, variance, np.float32), slope=np.zeros(shape, np.float32))

    return Noise(
        step=lambda t: uniform(window),
        view=lambda v: uniform(detector),
        flat=np.zeros(detector, dtype=np.float32),
        smooth_px=smooth_px,
    )


@dataclass(frozen=True, kw_only=True)
class Propagated:
    """The covariance V of h, and whether the residual is that noise."""

    parts: Mapping[str, Floats]
    """By source, ``radiographs``, ``views`` and ``flats``: (function * unknown, function * unknown), or (function,
    unknown, unknown) where functions share no step."""
    tests: ResidualTests
    """Whether the residual is that noise."""

    @property
    def covariance(self) -> Floats:
        """Return V, of all sources together."""
        return np.asarray(sum(self.parts.values()))


def propagate(
    images: Images,
    systematic: Systematic,
    basis: SectionBasis,
    amplitude: Floats,
    time_functions: Floats,
    noise: Noise,
    residual: Image,
    *,
    progress: Progress = silent,
) -> Propagated:
    """Return the covariance of h at amplitudes (step, section, motion), voxels, and tests of the residual there.

    `systematic` tells which views each step looks along, whether it is subtracted or not. `residual` (step, row,
    column), grey levels, is tested only. Costs a pass over all radiographs, and about as much again.
    """
    volume = replace(images.volume, values=smoothed(images.volume.values, noise.smooth_px))
    images = replace(images, volume=volume)
    apart = separate(time_functions)
    unknowns = basis.shape[0] * basis.shape[1]
    own: dict[tuple[int, int], Floats] = {}
    pairs: dict[tuple[int, int], Floats] = {}
    static = np.zeros((len(time_functions), unknowns, unknowns)) if apart else None
    pile = Pile(noise.flat.shape, time_functions, basis.shape[1])
    tests = _Tests(noise_overlap(noise.smooth_px))
    users, last_use = _users(systematic)
    held: dict[int, Sensitivities] = {}
    done = 0

    def add_step(t: int, field: Sensitivities) -> Sensitivities:
        """Add what the step's own noise and the flats' do; return Y, which its views' noise needs."""
        weight, image = images.weight[t % len(images.weight)], noise.step(t)
        weighted = replace(field, values=field.values * weight[..., None])
        own[t, t] = product(weighted, weighted, image.variance, unknowns)
        places = systematic.places(images.rays[t], basis, amplitude[t], images.voxel_mm)
        moved = _spread(weighted, places, noise.flat.shape)
        view = _between(noise, systematic, t)
        here = pile if static is None else Pile(noise.flat.shape, np.ones((1, len(amplitude))), basis.shape[1])
        here.add(t, moved, view.slope, (0, 0))
        here.add(t, weighted, -image.slope, systematic.corner)
        if static is not None:
            static[time_functions[:, t] != 0] += here.covariance(noise.flat, unknowns)
        tests.add(residual[t], weight > 0, image, view, noise.flat, places, systematic.corner)
        return moved

    for view in sorted(users):
        wanted = [t for t in users[view] if t not in held]
        for t, field in _fields(images, basis, amplitude, wanted):
            held[t] = add_step(t, field)
            done += 1
            progress("uncertainty", done, len(amplitude))
        variance = noise.view(view).variance
        for i, t in enumerate(users[view]):
            for other in users[view][: i + 1]:
                if t == other or not apart:
                    share = _share(systematic, t, view) * _share(systematic, other, view)
                    _add(pairs, (t, other), product(held[t], held[other], share * variance, unknowns))
        for t in users[view]:
            if last_use[t] == view:
                del held[t]
    flats = pile.covariance(noise.flat, unknowns) if static is None else _scaled(static, time_functions)
    return Propagated(
        parts={
            "radiographs": _joined(own, time_functions, apart),
            "views": _joined(pairs, time_functions, apart),
            "flats": flats,
        },
        tests=tests.result(time_functions.shape[0] * unknowns),
    )


def separate(time_functions: Floats) -> bool:
    """Return whether each step has a function of its own, so that nothing joins the steps."""
    filled = time_functions != 0
    return bool((filled.sum(axis=0) <= 1).all() and (filled.sum(axis=1) <= 1).all())


def _users(systematic: Systematic) -> tuple[dict[int, list[int]], dict[int, int]]:
    """Return the steps that use each view, and the last view that each step uses."""
    users: dict[int, list[int]] = {}
    for t in range(len(systematic.first)):
        for view in np.unique([systematic.first[t], systematic.second[t]]).tolist():
            if _share(systematic, t, view) > 0:
                users.setdefault(view, []).append(t)
    return users, {t: view for view in sorted(users) for t in users[view]}


def _share(systematic: Systematic, step: int, view: int) -> float:
    share = float(systematic.share[step])
    found: float = (1 - share) * (systematic.first[step] == view) + share * (systematic.second[step] == view)
    return found


def _between(noise: Noise, systematic: Systematic, step: int) -> ImageNoise:
    """Return the noise of what is interpolated between the views that a step looks along."""
    views = {int(systematic.first[step]), int(systematic.second[step])}
    shares = {view: np.float32(_share(systematic, step, view)) for view in views}
    found = {view: noise.view(view) for view in views if shares[view] > 0}
    return ImageNoise(
        variance=np.sum([shares[v] ** 2 * each.variance for v, each in found.items()], axis=0),
        slope=np.sum([shares[v] * each.slope for v, each in found.items()], axis=0),
    )


def _fields(
    images: Images, basis: SectionBasis, amplitude: Floats, wanted: list[int]
) -> Iterator[tuple[int, Sensitivities]]:
    """Yield the sensitivities of the wanted steps."""
    if not wanted:
        return
    shape = (images.grey.shape[1], images.grey.shape[2])
    found = sensitivities(
        images.volume, images.rays[wanted], shape, basis, amplitude[wanted], voxel_mm=images.voxel_mm
    )
    yield from zip(wanted, found, strict=True)


def _add(pairs: dict[tuple[int, int], Floats], key: tuple[int, int], block: Floats) -> None:
    pairs[key] = pairs[key] + block if key in pairs else block


def product(one: Sensitivities, other: Sensitivities, variance: Image, unknowns: int) -> Floats:
    """Return sum_p one(p)^T v(p) other(p), (unknown, unknown), of two fields with variances v (row, column)."""
    result = np.zeros((unknowns, unknowns))
    offsets = one.first * one.motions, other.first * other.motions
    _add_product(one.values, offsets[0], other.values, offsets[1], variance, result)
    return result


def _joined(pairs: dict[tuple[int, int], Floats], time_functions: Floats, apart: bool) -> Floats:
    """Return the sum over pairs of steps of sigma(t) sigma(t')^T (x) their block."""
    functions = len(time_functions)
    unknowns = len(next(iter(pairs.values())))
    if apart:
        blocks = np.zeros((functions, unknowns, unknowns))
        for f, t in zip(*np.nonzero(time_functions), strict=True):
            blocks[f] = time_functions[f, t] ** 2 * pairs[t, t]
        return blocks
    total = np.zeros((functions * unknowns, functions * unknowns))
    for same in (True, False):
        chosen = [key for key in pairs if (key[0] == key[1]) == same]
        if not chosen:
            continue
        t, other = np.array(chosen).T
        shares = (time_functions[:, None, t] * time_functions[None, :, other]).reshape(-1, len(chosen))
        sums = shares @ np.stack([pairs[key] for key in chosen]).reshape(len(chosen), -1)
        matrix = sums.reshape(functions, functions, unknowns, unknowns).transpose(0, 2, 1, 3).reshape(total.shape)
        total += matrix if same else matrix + matrix.T
    return total


def _scaled(blocks: Floats, time_functions: Floats) -> Floats:
    """Return the blocks (function, unknown, unknown) times the square of the one value of each function."""
    return np.asarray(blocks * (time_functions**2).sum(axis=1)[:, None, None])


class Pile:
    """The sums z = sum_t sigma(t) (x) field(t) in each pixel of the detector: what a noise meets that all share."""

    def __init__(self, shape: tuple[int, ...], time_functions: Floats, motions: int) -> None:
        """Begin with nothing on a detector of `shape`, for time functions (function, step)."""
        self._shape = shape
        self._functions = time_functions.astype(np.float32)
        self._motions = motions
        self._first: dict[int, int] = {}
        self._blocks: dict[int, Image] = {}

    def add(self, step: int, field: Sensitivities, factor: Image, corner: tuple[int, int]) -> None:
        """Add factor (row, column) times a step's field, whose first pixel is `corner` on the detector."""
        rows = len(field.values)
        for block in range(corner[0] // _BLOCK_ROWS, (corner[0] + rows - 1) // _BLOCK_ROWS + 1):
            low = max(block * _BLOCK_ROWS, corner[0])
            high = min((block + 1) * _BLOCK_ROWS, corner[0] + rows)
            inside = slice(low - corner[0], high - corner[0])
            z, first = self._room_for(block, field, inside)
            _pile_up(
                z,
                low - block * _BLOCK_ROWS,
                corner[1],
                field.values[inside],
                (field.first[inside] - first) * self._motions,
                factor[inside],
                self._functions[:, step],
            )

    def _room_for(self, block: int, field: Sensitivities, rows: slice) -> tuple[Image, int]:
        """Return a block of pixels (row, column, function, section * motion), wide enough, and its first section."""
        span = field.values.shape[2] // self._motions
        low, high = int(field.first[rows].min()), int(field.first[rows].max()) + span
        if block not in self._blocks:
            shape = (_BLOCK_ROWS, self._shape[1], len(self._functions), (high - low) * self._motions)
            self._blocks[block], self._first[block] = np.zeros(shape, dtype=np.float32), low
        z, first = self._blocks[block], self._first[block]
        below, above = max(first - low, 0), max(high - first - z.shape[3] // self._motions, 0)
        if below or above:
            z = np.pad(z, ((0, 0),) * 3 + ((below * self._motions, above * self._motions),))
            self._blocks[block], self._first[block] = z, first - below
        return self._blocks[block], self._first[block]

    def covariance(self, variance: Image, unknowns: int) -> Floats:
        """Return sum_p v(p) z(p) z(p)^T (function * unknown, function * unknown)."""
        functions = len(self._functions)
        total = np.zeros((functions, unknowns, functions, unknowns))
        for block, z in self._blocks.items():
            rows = slice(block * _BLOCK_ROWS, min((block + 1) * _BLOCK_ROWS, self._shape[0]))
            flat = (z[: rows.stop - rows.start] * np.sqrt(variance[rows])[..., None, None]).reshape(-1, z[0, 0].size)
            product = (flat.T @ flat).reshape(functions, z.shape[3], functions, z.shape[3])
            i = self._first[block] * self._motions
            size = min(z.shape[3], unknowns - i)
            total[:, i : i + size, :, i : i + size] += product[:, :size, :, :size]
        return total.reshape(functions * unknowns, functions * unknowns)


class _Tests:
    """The sums that tell whether the residual is the noise that is expected."""

    def __init__(self, overlap: Floats) -> None:
        self._overlap = overlap
        self._chi2, self._pixels = 0.0, 0
        self._seen, self._expected, self._pairs = np.zeros(2), np.zeros(2), np.zeros(2)

    def add(
        self,
        residual: Image,
        used: NDArray[np.bool_],
        image: ImageNoise,
        view: ImageNoise,
        flat: Image,
        places: Floats,
        corner: tuple[int, int],
    ) -> None:
        """Add a step: its radiograph's noise over the window, its views' and the flats' over the detector.

        Noise varies little from pixel to pixel, so that it is taken from the pixel above and left of a place.
        """
        c = self._overlap
        at = [np.clip(places[..., k].astype(int), 0, flat.shape[k] - 2) for k in range(2)]
        a, b = (places[..., k] - at[k] for k in range(2))
        # interpolated between two pixels whose noise overlaps: variance along an axis, and covariance with the next
        same = [((1 - x) ** 2 + x**2) * c[0] + 2 * x * (1 - x) * c[1] for x in (a, b)]
        following = [((1 - x) ** 2 + x**2) * c[1] + x * (1 - x) * (c[0] + c[2]) for x in (a, b)]
        pixel = np.indices(residual.shape) + np.array(corner)[:, None, None]

        def flats(shift: int) -> tuple[Floats, Floats]:
            """Return the covariance of a pixel with its place, moved by a shift, along each axis."""
            lags = [np.minimum(np.abs(at[k] + n + shift - pixel[k]), len(c) - 1) for k in range(2) for n in range(2)]
            return (1 - a) * c[lags[0]] + a * c[lags[1]], (1 - b) * c[lags[2]] + b * c[lags[3]]

        (down, across), before, after = flats(0), flats(-1), flats(1)
        here = flat[pixel[0], pixel[1]]
        there, slope = flat[at[0], at[1]], view.slope[at[0], at[1]]
        known = image.variance + image.slope**2 * here
        moved = view.variance[at[0], at[1]] + slope**2 * there
        # the flats are the same in both
        twice = 2 * image.slope * slope * np.sqrt(here * there)
        variance = c[0] ** 2 * known + same[0] * same[1] * moved - twice * down * across
        white = np.where(used, residual / np.sqrt(variance), 0)
        self._chi2 += float((white**2).sum())
        self._pixels += int(used.sum())
        shared = (
            c[1] * c[0] * known + following[0] * same[1] * moved - twice * (before[0] + after[0]) / 2 * across,
            c[0] * c[1] * known + same[0] * following[1] * moved - twice * down * (before[1] + after[1]) / 2,
        )
        for axis in range(2):
            first, second = [slice(None)] * 2, [slice(None)] * 2
            first[axis], second[axis] = slice(None, -1), slice(1, None)
            pairs = used[tuple(first)] & used[tuple(second)]
            self._seen[axis] += float((white[tuple(first)] * white[tuple(second)]).sum())
            self._expected[axis] += float((shared[axis] / variance)[tuple(first)][pairs].sum())
            self._pairs[axis] += int(pairs.sum())

    def result(self, unknowns: int) -> ResidualTests:
        """Return the tests, of a solution with so many unknowns."""
        pairs, mean_square = np.maximum(self._pairs, 1), max(self._chi2 / max(self._pixels, 1), 1e-300)
        seen, expected = self._seen / pairs / mean_square, self._expected / pairs
        return ResidualTests(
            chi2_reduced=self._chi2 / max(self._pixels - unknowns, 1),
            lag1_row=float(seen[0]),
            lag1_column=float(seen[1]),
            lag1_row_expected=float(expected[0]),
            lag1_column_expected=float(expected[1]),
        )


def _spread(field: Sensitivities, places: Floats, shape: tuple[int, ...]) -> Sensitivities:
    """Return R^T of a field over the window: what each pixel of the detector takes part in."""
    row = np.clip(np.floor(places[..., 0]).astype(np.int64), 0, shape[0] - 2)
    top, bottom = row.min(axis=1), row.max(axis=1) + 1
    span = field.values.shape[2] // field.motions
    low, high = np.full(shape[0], np.iinfo(np.int64).max), np.zeros(shape[0], dtype=np.int64)
    for first, start, end in zip(field.first, top, bottom, strict=True):
        low[start : end + 1] = np.minimum(low[start : end + 1], first)
        high[start : end + 1] = np.maximum(high[start : end + 1], first + span)
    low = np.where(high > 0, low, 0)
    values = np.zeros((*shape, max(int((high - low).max()), 1) * field.motions), dtype=np.float32)
    _scatter(field.values, (field.first[:, None] - low) * field.motions, places, values)
    return Sensitivities(values=values, first=low, motions=field.motions)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True, boundscheck=False)
def _add_product(one, first, other, second, variance, out):  # type: ignore[no-untyped-def]
    """Add v one^T other of each pixel to `out`; `first` and `second` (row,) are where a row's values belong there.

    A row may have room for sections beyond the last: these are left out.
    """
    for row in range(one.shape[0]):
        # the pixels of a row share their sections: they are added up in a small matrix of their own, in double
        # precision, which is added to its place in the large one when the row is done
        i0, j0 = first[row], second[row]
        height, width = min(one.shape[2], out.shape[0] - i0), min(other.shape[2], out.shape[1] - j0)
        part = np.zeros((height, width))
        for column in range(one.shape[1]):
            for i in range(height):
                w = variance[row, column] * one[row, column, i]
                # most are zero: air, and sections of the row that this ray does not meet
                if w != 0:
                    for j in range(width):
                        part[i, j] += w * other[row, column, j]
        for i in range(height):
            for j in range(width):
                out[i0 + i, j0 + j] += part[i, j]


@njit(nogil=True, cache=True, error_model="numpy")
def _scatter(values, offset, places, out):  # type: ignore[no-untyped-def]
    """Add each pixel's values to the four pixels that it was interpolated from; the adjoint of `_bilinear`.

    One thread: neighbours add to the same pixels, and always in this order.
    """
    rows, columns = out.shape[0], out.shape[1]
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            r, c = places[row, column]
            # limits and shares as in `systematic._bilinear`, or it would not be the adjoint
            if r < -0.01 or r > rows - 0.99 or c < -0.01 or c > columns - 0.99:
                continue
            i, j = min(max(int(r), 0), rows - 2), min(max(int(c), 0), columns - 2)
            a, b = r - i, c - j
            for di in range(2):
                for dj in range(2):
                    share = np.float32((a if di else 1 - a) * (b if dj else 1 - b))
                    # where the sections of this row of the window begin in that row of the detector
                    start = offset[row, i + di]
                    for k in range(values.shape[2]):
                        out[i + di, j + dj, start + k] += share * values[row, column, k]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True, boundscheck=False)
def _pile_up(z, row0, column0, values, offset, factor, sigma):  # type: ignore[no-untyped-def]
    """Add sigma_f factor(p) values(p, k) to z (row, column, f, k), which starts row0 and column0 earlier."""
    size = values.shape[2]
    scaled = np.empty(size, dtype=np.float32)
    for row in range(values.shape[0]):
        # unsigned: numba need not ask whether an index counts from the end
        start = np.uint32(offset[row])
        for column in range(values.shape[1]):
            # the product that all functions share is taken once, and pixels in air are left out
            largest = np.float32(0)
            for k in range(size):
                scaled[k] = factor[row, column] * values[row, column, k]
                largest = max(largest, abs(scaled[k]))
            if largest == 0:
                continue
            for f in range(len(sigma)):
                out = z[row0 + row, column0 + column, f]
                for k in range(size):
                    out[start + np.uint32(k)] += sigma[f] * scaled[k]
