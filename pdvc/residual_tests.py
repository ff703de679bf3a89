"""Whether a residual is the noise of radiographs, reference views and flats that is expected: size and correlation."""

from __future__ import annotations

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
) -> ResidualTests:
    """Return whether the residual (step, row, column), grey levels, of a solution is the noise that is expected.

    At amplitudes (step, section, motion), voxels; `unknowns` of all steps were found.
    """
    tests = _Tests(noise_overlap(noise.smooth_px))
    sight = systematic.looked_along(slice(None), images.rays, basis, amplitude, images.voxel_mm)
    for t, rays in enumerate(images.rays):
        places = systematic.places(t, rays, basis, amplitude[t], images.voxel_mm)
        used, view = images.weight[t % len(images.weight)] > 0, mean_of_views(noise, sight.of_step(t))
        tests.add(residual[t], used, noise.step(t), view, noise.flat, places, systematic.corner)
    return tests.result(unknowns)


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
        weights = [taps(places[..., k], at[k]) for k in range(2)]

        def lagged(tap: Floats, lag: int) -> Floats:
            """Return the covariance along an axis of what is interpolated so, with the same `lag` pixels on."""
            between = np.array([[_of_lag(c, m + lag - n) for n in range(4)] for m in range(4)])
            return np.asarray(np.einsum("m...,mn,n...->...", tap, between, tap, optimize=True))

        same, following = [lagged(each, 0) for each in weights], [lagged(each, 1) for each in weights]
        pixel = np.indices(residual.shape) + np.array(corner)[:, None, None]

        def flats(shift: int) -> list[Floats]:
            """Return the covariance of a pixel with its place, moved by a shift, along each axis."""
            return [
                np.asarray(
                    sum(weights[k][m] * _of_lag(c, at[k] - 1 + m + shift - pixel[k]) for m in range(4)), dtype=float
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


def _of_lag(overlap: Floats, lag: NDArray[np.int64] | int) -> Floats:
    """Return the covariance of filtered noise at a lag of pixels along an axis; zero beyond the filter's reach."""
    return np.asarray(overlap[np.minimum(np.abs(lag), len(overlap) - 1)])
