"""Whether a residual is the noise of radiographs, reference views and flats that is expected: size and correlation."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce

import numba
import numpy as np
from numpy.typing import NDArray

from pdvc.equations import Images
from pdvc.measurement import ResidualTests
from pdvc.noise import ImageNoise, Noise, mean_of_views
from pdvc.radiographs import noise_overlap
from pdvc.sections import SectionBasis
from pdvc.systematic import Systematic, taps

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


def residual_tests(
    images: Images,
    systematic: Systematic,
    basis: SectionBasis,
    amplitude: Floats,
    noise: Noise,
    residual: Image,
    unknowns: int,
    see: Callable[[int, Image], None] = lambda _step, _white: None,
) -> ResidualTests:
    """Return whether the residual (step, row, column), grey levels, of a solution is the noise that is expected.

    At amplitudes (step, section, motion), voxels; `unknowns` of all steps were found. `see` is shown the residual of
    each step over its standard deviation, zero where it is not used, one step after the other.
    """
    overlap = noise_overlap(noise.smooth_px)
    sight = systematic.looked_along(slice(None), images.rays, basis, amplitude, images.voxel_mm)

    def of_step(t: int) -> tuple[Image, _Sums]:
        places = systematic.places(t, images.rays[t], basis, amplitude[t], images.voxel_mm)
        used, view = images.weight[t % len(images.weight)] > 0, mean_of_views(noise, sight.of_step(t))
        return _sums(overlap, residual[t], used, noise.step(t), view, noise.flat, places, systematic.corner)

    found = []
    # a step is one thread's work; sums are added in order, whichever is ready first
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        for t, (white, sums) in enumerate(pool.map(of_step, range(len(residual)))):
            see(t, white)
            found.append(sums)
    return reduce(_Sums.__add__, found).result(unknowns)


@dataclass(frozen=True, kw_only=True)
class _Sums:
    """The sums over pixels that tell whether a residual is the noise that is expected."""

    chi2: float
    pixels: int
    seen: Floats
    """Products of neighbours down and across (2,), each over its standard deviation."""
    expected: Floats
    """What noise makes of them (2,)."""
    pairs: Floats
    """Number of neighbours (2,)."""

    def __add__(self, other: _Sums) -> _Sums:
        """Return the sums over both."""
        return _Sums(
            chi2=self.chi2 + other.chi2,
            pixels=self.pixels + other.pixels,
            seen=self.seen + other.seen,
            expected=self.expected + other.expected,
            pairs=self.pairs + other.pairs,
        )

    def result(self, unknowns: int) -> ResidualTests:
        """Return the tests, of a solution with so many unknowns."""
        pairs, mean_square = np.maximum(self.pairs, 1), max(self.chi2 / max(self.pixels, 1), 1e-300)
        seen, expected = self.seen / pairs / mean_square, self.expected / pairs
        return ResidualTests(
            chi2_reduced=self.chi2 / max(self.pixels - unknowns, 1),
            lag1_row=float(seen[0]),
            lag1_column=float(seen[1]),
            lag1_row_expected=float(expected[0]),
            lag1_column_expected=float(expected[1]),
        )


def _sums(
    overlap: Floats,
    residual: Image,
    used: NDArray[np.bool_],
    image: ImageNoise,
    view: ImageNoise,
    flat: Image,
    places: Floats,
    corner: tuple[int, int],
) -> tuple[Image, _Sums]:
    """Return the residual of a step over its standard deviation, and its sums.

    Its radiograph's noise is given over the window, its views' and the flats' over the detector.

    Noise varies little from pixel to pixel, so that it is taken from the pixel above and left of a place.
    """
    at = [np.clip(places[..., k].astype(int), 0, flat.shape[k] - 2) for k in range(2)]
    weights = [taps(places[..., k], at[k]) for k in range(2)]

    same, following = ([_lagged(overlap, each, lag) for each in weights] for lag in (0, 1))
    pixel = np.indices(residual.shape) + np.array(corner)[:, None, None]

    def flats(shift: int) -> list[Floats]:
        """Return the covariance of a pixel with its place, moved by a shift, along each axis."""
        return [
            np.asarray(
                sum(weights[k][m] * _of_lag(overlap, at[k] - 1 + m + shift - pixel[k]) for m in range(4)), dtype=float
            )
            for k in range(2)
        ]

    (down, across), before, after = flats(0), flats(-1), flats(1)
    here = flat[pixel[0], pixel[1]]
    there, slope = flat[at[0], at[1]], view.slope[at[0], at[1]]
    known = image.variance + image.slope**2 * here
    moved = view.variance[at[0], at[1]] + slope**2 * there
    # the flats are the same in both
    twice = 2 * image.slope * slope * np.sqrt(here * there)
    variance = overlap[0] ** 2 * known + same[0] * same[1] * moved - twice * down * across
    white = np.where(used, residual / np.sqrt(variance), 0)
    shared = (
        overlap[1] * overlap[0] * known + following[0] * same[1] * moved - twice * (before[0] + after[0]) / 2 * across,
        overlap[0] * overlap[1] * known + same[0] * following[1] * moved - twice * down * (before[1] + after[1]) / 2,
    )
    seen, expected, pairs = np.zeros(2), np.zeros(2), np.zeros(2)
    for axis in range(2):
        first, second = [slice(None)] * 2, [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        both = used[tuple(first)] & used[tuple(second)]
        seen[axis] = float((white[tuple(first)] * white[tuple(second)]).sum())
        expected[axis] = float((shared[axis] / variance)[tuple(first)][both].sum())
        pairs[axis] = int(both.sum())

    total = _Sums(chi2=float((white**2).sum()), pixels=int(used.sum()), seen=seen, expected=expected, pairs=pairs)
    return white.astype(np.float32), total


def _lagged(overlap: Floats, tap: Floats, lag: int) -> Floats:
    """Return the covariance along an axis of what four taps (4, ...) make of noise, with the same `lag` pixels on."""
    total = np.zeros(tap.shape[1:])
    for apart in range(4):
        # of pixels `apart` from each other, each before and after the other
        product = (tap[: 4 - apart] * tap[apart:]).sum(axis=0)
        lags = {lag + apart, lag - apart}
        total += sum(float(_of_lag(overlap, each)) for each in lags) * product
    return total


def _of_lag(overlap: Floats, lag: NDArray[np.int64] | int) -> Floats:
    """Return the covariance of filtered noise at a lag of pixels along an axis; zero beyond the filter's reach."""
    return np.asarray(overlap[np.minimum(np.abs(lag), len(overlap) - 1)])
