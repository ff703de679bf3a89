"""What the noise of radiographs, reference views and flats does to the equations' right-hand side.

The residual of a step holds three noises. With n_g that of its radiograph, n_f that of the reference view at its
angle, moved with the sample as e is (`pdvc.systematic`; R_t interpolates), and phi that of the mean flat, over it,

    n_rho(t) = -n_g(t) - s_t phi + R_t [n_f + s_f phi]           s = dg / dq, the slope of grey levels

n_g is drawn anew at each step. n_f is shared by all steps that look along the same view, a turn apart, and phi by
all images. The noise of h = sum_t sigma(t) (x) S(t)^T W rho(t) has therefore the covariance

    V = sum_t sigma sigma^T (x) S^T W V_g W S                                     radiographs
      + sum_v sum_tt' a_tv a_t'v sigma(t) sigma(t')^T (x) Y_t^T V_v Y_t'          reference views,  Y_t = R_t^T W S(t)
      + sum_p v_phi(p) z(p) z(p)^T                                                flats
      + b^2 w w^T,          w = sum_t sigma(t) (x) S(t)^T W R_t e                 e itself
    z(p) = sum_t sigma(t) (x) [s_f(p) Y_t(p) - s_t(p) W S(t, p)]

Filtering the radiographs first (`radiographs.smoothed`) puts G S for S here, where S meets noise: G S is taken as the
sensitivity of the volume filtered once more, which is exact in a parallel beam.

e is believed to a share b: what was left of the paths through the sample at rest is subtracted from others.
a_tv is the share of view v at step t: e is a mean over the views around the step's direction. The noise of the
reference volume itself moves with the sample: re-projected and subtracted again it cancels, and that of the reference
views takes its place. Where e is not subtracted, the re-projected volume holds at most the same noise, so that V is
then an upper bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdvc.equations import Images, joined
from pdvc.progress import Progress, silent
from pdvc.projection import Sensitivities, sensitivities
from pdvc.radiographs import noise_overlap, smoothed
from pdvc.sections import SectionBasis
from pdvc.systematic import Sight, Systematic, first_pixel, keys_weights, taps

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

SOURCES = ("radiographs", "views", "flats")
"""Where noise comes from."""
BELIEF = 0.1
"""Share of e that it may be wrong by, alike everywhere: what re-projection leaves of paths a little other than those
of the reference scan is known no better."""
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
    """Of a reference view, over the whole detector."""
    flat: Image
    """Variance of the mean flat, relative to it (row, column), over the whole detector."""
    smooth_px: float = 0.0
    """The filter that all images went through after this noise, px."""


def known_from_residual(rms: float, window: tuple[int, int], detector: tuple[int, ...], smooth_px: float) -> Noise:
    """Return what to believe where the detector's noise is unknown: the residual is noise, of views and steps alike.

    Interpolating leaves a share of a view's variance, on average over places between pixels and between views; the
    filter leaves what `noise_overlap` tells.
    """
    weights = taps(np.linspace(0, 1, 101), np.zeros(101, dtype=np.int64))
    along_an_axis = float((weights**2).sum(axis=0).mean())
    # 1 / sqrt(pi) is left by a mean over views half as wide as their spacing
    left = along_an_axis**2 / np.sqrt(np.pi)
    variance = rms**2 / noise_overlap(smooth_px)[0] ** 2 / (1 + left)

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
    """The covariance V of h."""

    parts: Mapping[str, Floats]
    """By source, `SOURCES` and ``systematic``, that of e: (function * unknown, function * unknown), or (function,
    unknown, unknown) where functions share no step."""
    own: Mapping[str, Floats]
    """The same of each step's c alone, by `SOURCES` (step, unknown, unknown)."""
    systematic: Floats
    """What one standard deviation of the subtracted systematic residual does to c (step, unknown), at all steps alike;
    zero where none is subtracted."""

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
    *,
    progress: Progress = silent,
) -> Propagated:
    """Return the covariance of h at amplitudes (step, section, motion), voxels.

    `systematic` tells which views each step looks along, whether it is subtracted or not. Costs a pass over all
    radiographs, and about as much again.
    """
    volume = replace(images.volume, values=smoothed(images.volume.values, noise.smooth_px))
    images = replace(images, volume=volume)
    apart = separate(time_functions)
    unknowns = basis.shape[0] * basis.shape[1]
    own = {name: np.empty((len(amplitude), unknowns, unknowns)) for name in SOURCES}
    pairs: dict[tuple[int, int], Floats] = {}
    believed = np.zeros((len(amplitude), unknowns))
    pile = None if apart else Pile(noise.flat.shape, time_functions, basis.shape[1])
    sight = systematic.looked_along(slice(None), images.rays, basis, amplitude, images.voxel_mm)
    held: dict[int, Sensitivities] = {}

    def add_step(t: int, field: Sensitivities) -> Sensitivities:
        """Add what the step's own noise and the flats' do; return Y, which its views' noise needs."""
        weight, image = images.weight[t % len(images.weight)], noise.step(t)
        weighted = replace(field, values=field.values * weight[..., None])
        places = systematic.places(t, images.rays[t], basis, amplitude[t], images.voxel_mm)
        moved = _spread(weighted, places, noise.flat.shape)
        view = mean_of_views(noise, sight.of_step(t))
        own["radiographs"][t] = product(weighted, weighted, image.variance, unknowns)
        own["views"][t] = product(moved, moved, view.variance, unknowns)
        if images.systematic is not None:
            one = slice(t, t + 1)
            left = systematic.registered(one, images.rays[one], basis, amplitude[one], images.voxel_mm)[0]
            believed[t] = BELIEF * adjoint(weighted, left, unknowns)
        both = [(moved, view.slope, (0, 0)), (weighted, -image.slope, systematic.corner)]
        shared = overlaid(both, noise.flat.shape)
        own["flats"][t] = product(shared, shared, noise.flat, unknowns)
        if pile is not None:
            pile.add(t, shared)
        return moved

    company = _company(sight, apart)
    for done, (t, others) in enumerate(company.items()):
        held[t] = add_step(t, _field(images, basis, amplitude, t))
        for other, shares in others.items():
            variance = np.sum([share * noise.view(view).variance for view, share in shares.items()], axis=0)
            pairs[t, other] = product(held[t], held[other], variance, unknowns)
        later = list(company.values())[done + 1 :]
        held = {step: field for step, field in held.items() if any(step in known for known in later)}
        progress("uncertainty", done + 1, len(amplitude))
    joint = {
        "radiographs": _joined(own["radiographs"], {}, time_functions),
        "views": _joined(own["views"], pairs, time_functions),
        "flats": _joined(own["flats"], {}, time_functions) if pile is None else pile.covariance(noise.flat, unknowns),
    }
    common = time_functions @ believed
    joint["systematic"] = common[:, :, None] * common[:, None] if apart else np.outer(common.ravel(), common.ravel())
    return Propagated(parts=joint, own=own, systematic=believed)


def separate(time_functions: Floats) -> bool:
    """Return whether each step has a function of its own, so that nothing joins the steps."""
    filled = time_functions != 0
    return bool((filled.sum(axis=0) <= 1).all() and (filled.sum(axis=1) <= 1).all())


def _company(sight: Sight, apart: bool) -> dict[int, dict[int, dict[int, float]]]:
    """Return the steps in the order of their views: each with the steps before it that share views with it.

    For each view that both see, the product of their shares. Where the functions are apart, no company counts.
    """
    shares = {t: sight.of_step(t) for t in range(len(sight.views))}
    order = sorted(shares, key=lambda t: (min(shares[t]), t))
    found: dict[int, dict[int, dict[int, float]]] = {}
    users: dict[int, list[int]] = {}
    for t in order:
        found[t] = {}
        for view, share in shares[t].items():
            for other in users.setdefault(view, []):
                if not apart:
                    found[t].setdefault(other, {})[view] = share * shares[other][view]
            users[view].append(t)
    return found


def mean_of_views(noise: Noise, shares: Mapping[int, float]) -> ImageNoise:
    """Return the noise of a mean over views, by their shares."""
    found = [(np.float32(share), noise.view(view)) for view, share in shares.items()]
    return ImageNoise(
        variance=np.sum([share**2 * each.variance for share, each in found], axis=0),
        slope=np.sum([share * each.slope for share, each in found], axis=0),
    )


def _field(images: Images, basis: SectionBasis, amplitude: Floats, step: int) -> Sensitivities:
    """Return the sensitivities of a step."""
    shape = (images.grey.shape[1], images.grey.shape[2])
    one = slice(step, step + 1)
    return sensitivities(images.volume, images.rays[one], shape, basis, amplitude[one], voxel_mm=images.voxel_mm)[0]


def product(one: Sensitivities, other: Sensitivities, variance: Image, unknowns: int) -> Floats:
    """Return sum_p one(p)^T v(p) other(p), (unknown, unknown), of two fields with variances v (row, column)."""
    result = np.zeros((unknowns, unknowns))
    offsets = one.first * one.motions, other.first * other.motions
    _add_product(one.values, offsets[0], other.values, offsets[1], variance, result)
    return result


def adjoint(field: Sensitivities, image: Image, unknowns: int) -> Floats:
    """Return sum_p field(p) image(p), (unknown,)."""
    of_rows = np.einsum("rck,rc->rk", field.values, image, dtype=float)
    # the last sections may have room beyond
    found = np.zeros(unknowns + field.values.shape[2])
    for first, row in zip(field.first * field.motions, of_rows, strict=True):
        found[first : first + len(row)] += row
    return found[:unknowns]


def _joined(own: Floats, pairs: Mapping[tuple[int, int], Floats], time_functions: Floats) -> Floats:
    """Return the sum over steps, and over pairs of them, of sigma(t) sigma(t')^T (x) their block.

    Pairs hold one of (t, t') and (t', t), whose block is the transpose.
    """
    if separate(time_functions):
        blocks = np.zeros((len(time_functions), *own.shape[1:]))
        for f, t in zip(*np.nonzero(time_functions), strict=True):
            blocks[f] = time_functions[f, t] ** 2 * own[t]
        return blocks
    total = joined(own, time_functions)
    if pairs:
        t, other = np.array(list(pairs)).T
        apart = joined(np.stack(list(pairs.values())), time_functions[:, t], time_functions[:, other])
        total += apart + apart.T
    return total


class Pile:
    """The sums z = sum_t sigma(t) (x) field(t) in each pixel of the detector: what a noise meets that all share."""

    def __init__(self, shape: tuple[int, ...], time_functions: Floats, motions: int) -> None:
        """Begin with nothing on a detector of `shape`, for time functions (function, step)."""
        self._shape = shape
        self._functions = time_functions.astype(np.float32)
        self._motions = motions
        self._first: dict[int, int] = {}
        self._blocks: dict[int, Image] = {}

    def add(self, step: int, field: Sensitivities) -> None:
        """Add a step's field over the detector."""
        for block in range((len(field.values) - 1) // _BLOCK_ROWS + 1):
            rows = slice(block * _BLOCK_ROWS, min((block + 1) * _BLOCK_ROWS, len(field.values)))
            z, first = self._room_for(block, field, rows)
            offset = (field.first[rows] - first) * self._motions
            _pile_up(z, field.values[rows], offset, self._functions[:, step])

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


def overlaid(fields: Sequence[tuple[Sensitivities, Image, tuple[int, int]]], shape: tuple[int, ...]) -> Sensitivities:
    """Return the sum, over a detector of `shape`, of fields times factors (row, column), from their first pixel on."""
    motions = fields[0][0].motions
    low, high = np.full(shape[0], np.iinfo(np.int64).max), np.zeros(shape[0], dtype=np.int64)
    for field, _, (row, _) in fields:
        rows = slice(row, row + len(field.values))
        low[rows] = np.minimum(low[rows], field.first)
        high[rows] = np.maximum(high[rows], field.first + field.values.shape[2] // motions)
    low, values = _blank(low, high, shape, motions)
    for field, factor, (row, column) in fields:
        first = low[row : row + len(field.values)]
        _add_to(values, field.values, (field.first - first) * motions, factor, row, column)
    return Sensitivities(values=values, first=low, motions=motions)


def _blank(
    low: NDArray[np.int64], high: NDArray[np.int64], shape: tuple[int, ...], motions: int
) -> tuple[NDArray[np.int64], Image]:
    """Return the first section of each row, and zeros for the sections from `low` to `high` (row,), 0 for none."""
    low = np.where(high > 0, low, 0)
    return low, np.zeros((*shape, max(int((high - low).max()), 1) * motions), dtype=np.float32)


def _spread(field: Sensitivities, places: Floats, shape: tuple[int, ...]) -> Sensitivities:
    """Return R^T of a field over the window: what each pixel of the detector takes part in."""
    row = np.clip(np.floor(places[..., 0]).astype(np.int64), 0, shape[0] - 2)
    top, bottom = np.maximum(row.min(axis=1) - 1, 0), np.minimum(row.max(axis=1) + 2, shape[0] - 1)
    span = field.values.shape[2] // field.motions
    low, high = np.full(shape[0], np.iinfo(np.int64).max), np.zeros(shape[0], dtype=np.int64)
    for first, start, end in zip(field.first, top, bottom, strict=True):
        low[start : end + 1] = np.minimum(low[start : end + 1], first)
        high[start : end + 1] = np.maximum(high[start : end + 1], first + span)
    low, values = _blank(low, high, shape, field.motions)
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
    """Add each pixel's values to the 4 x 4 pixels that it was interpolated from; the adjoint of `systematic._cubic`.

    One thread: neighbours add to the same pixels, and always in this order.
    """
    rows, columns = out.shape[0], out.shape[1]
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            # most carry something only inside the sample
            empty = True
            for k in range(values.shape[2]):
                if values[row, column, k] != 0:
                    empty = False
                    break
            r, c, longer = places[row, column]
            i, j = first_pixel(r, rows), first_pixel(c, columns)
            if empty or i < 0 or j < 0:
                continue
            down, right = keys_weights(r - i), keys_weights(c - j)
            for m in range(4):
                to_row = min(max(i - 1 + m, 0), rows - 1)
                # where the sections of this row of the window begin in that row of the detector
                start = offset[row, to_row]
                for n in range(4):
                    share = np.float32(longer * down[m] * right[n])
                    if share != 0:
                        to = out[to_row, min(max(j - 1 + n, 0), columns - 1)]
                        for k in range(values.shape[2]):
                            to[start + k] += share * values[row, column, k]


@njit(nogil=True, cache=True, error_model="numpy")
def _add_to(out, values, offset, factor, row0, column0):  # type: ignore[no-untyped-def]
    """Add factor(p) values(p, k) to out, which starts row0 and column0 earlier, `offset` (row,) entries on."""
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            scale = factor[row, column]
            for k in range(values.shape[2]):
                # room beyond the last section is empty
                if values[row, column, k] != 0:
                    out[row0 + row, column0 + column, offset[row] + k] += scale * values[row, column, k]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True, boundscheck=False)
def _pile_up(z, values, offset, sigma):  # type: ignore[no-untyped-def]
    """Add sigma_f values(p, k) to z (row, column, f, k)."""
    size = values.shape[2]
    for row in range(values.shape[0]):
        # unsigned: numba need not ask whether an index counts from the end
        start = np.uint32(offset[row])
        for column in range(values.shape[1]):
            # pixels in air are left out
            largest = np.float32(0)
            for k in range(size):
                largest = max(largest, abs(values[row, column, k]))
            if largest == 0:
                continue
            for f in range(len(sigma)):
                out = z[row, column, f]
                for k in range(size):
                    out[start + np.uint32(k)] += sigma[f] * values[row, column, k]
