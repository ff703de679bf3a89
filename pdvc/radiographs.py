"""Counts to grey levels: dark, flat, bad pixels, logarithm, beam hardening, normalisation, coarse scales.

    q = -log((I - D) / (I0 - D))                   attenuation, without unit
    g = c1 q + c2 q^2 + c3 q^3                     grey level: 0 in air, 1 at the largest attenuation

with I the counts, D the mean dark and I0 the mean flat. The noise of I follows Poisson's law and the readout:

    var I = ((I - D) / photons_per_count + readout^2) / frames
    var g = (dg/dq)^2 (var I / (I - D)^2 + var I0 / (I0 - D)^2)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.brightness import brightness
from pdvc.experiment import FLATS, Experiment, ExperimentError
from pdvc.robust import OF_MEDIAN

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

LEAST_CONTRAST = 1e-7
"""Grey levels: the smallest standard deviation that an SNR is taken of."""
LEAST_BRIGHTNESS = 0.1
"""Share of the open beam that a radiograph is corrected for, at most: below there is hardly any beam."""
IDENTITY = (1.0, 0.0, 0.0)
"""The polynomial that leaves attenuation as it is."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """What turns the counts of one detector into grey levels."""

    dark: Image
    """Mean dark (row, column), counts."""
    open_beam: Image
    """Mean flat less dark (row, column), counts."""
    bad: NDArray[np.bool_]
    """(row, column) pixels that are not to be believed."""
    polynomial: tuple[float, float, float] = IDENTITY
    """c1, c2, c3: from attenuation to grey levels."""
    air: NDArray[np.bool_] | None = None
    """(row, column) pixels that see air in every radiograph, by which its brightness is told (`pdvc.brightness`);
    None: the beam is taken to be that of the flats."""

    def with_polynomial(self, polynomial: tuple[float, float, float]) -> Calibration:
        """Return the calibration with another polynomial."""
        return replace(self, polynomial=polynomial)

    def binned(self, factor: int) -> Calibration:
        """Return the calibration of counts that were averaged over blocks of factor x factor pixels, as by `binned`.

        A block is bad where any of its pixels is: quicker than to fill them, for looking at radiographs alone.
        """
        if factor == 1:
            return self
        dark, beam, bad = (binned(image.astype(np.float32), factor) for image in (self.dark, self.open_beam, self.bad))
        air = None if self.air is None else np.asarray(binned(self.air.astype(np.float32), factor) == 1)
        return replace(self, dark=dark, open_beam=beam, bad=np.asarray(bad > 0), air=air)


def calibrate(experiment: Experiment) -> Calibration:
    """Average flats and darks, and find the bad pixels in them.

    A pixel is bad where its open beam is under a tenth of the median, or where flat or dark stands out of its
    3 x 3 neighbourhood by more than eight times the usual deviation. Raises ExperimentError where the flats
    are not brighter than the darks.
    """
    dark: Floats = np.asarray(np.mean(experiment.darks, axis=0, dtype=np.float64))
    flat: Floats = np.asarray(np.mean(experiment.flats, axis=0, dtype=np.float64))
    open_beam = np.asarray(flat - dark)
    level = float(np.median(open_beam))
    if level <= 0:
        raise ExperimentError(
            f"{FLATS}: expected more counts than the darks, found a median difference of {level:.0f}"
        )
    bad = (open_beam < 0.1 * level) | _stands_out(flat) | _stands_out(dark)
    return Calibration(
        dark=np.asarray(dark, dtype=np.float32),
        open_beam=np.where(bad, level, open_beam).astype(np.float32),
        bad=bad,
    )


def _stands_out(image: Floats) -> NDArray[np.bool_]:
    deviation = np.abs(image - ndimage.median_filter(image, size=3))
    return np.asarray(deviation > 8 * OF_MEDIAN * max(float(np.median(deviation)), 0.5))


def grey_levels(counts: NDArray[np.uint16] | Image, calibration: Calibration) -> Image:
    """Turn one radiograph (row, column) of counts into grey levels; bad pixels take their neighbours' mean."""
    _, attenuation = _attenuation(counts, calibration)
    return fill(grey_of(attenuation, calibration.polynomial), calibration.bad)


def grey_of(attenuation: NDArray[Any], polynomial: tuple[float, float, float]) -> NDArray[Any]:
    """Return g = c1 q + c2 q^2 + c3 q^3, in the precision of the attenuation q."""
    c1, c2, c3 = (attenuation.dtype.type(c) for c in polynomial)
    return np.asarray(attenuation * (c1 + attenuation * (c2 + attenuation * c3)))


def slope_of(attenuation: NDArray[Any], polynomial: tuple[float, float, float]) -> NDArray[Any]:
    """Return dg / dq at the attenuation q."""
    c1, c2, c3 = polynomial
    return np.asarray(c1 + attenuation * (2 * c2 + 3 * c3 * attenuation))


def _attenuation(counts: NDArray[np.uint16] | Image, calibration: Calibration) -> tuple[Image, Image]:
    """Return the signal of a radiograph, counts without the dark, and its attenuation (row, column)."""
    signal = np.maximum(counts.astype(np.float32) - calibration.dark, np.float32(1))
    beam = calibration.open_beam
    if calibration.air is not None:
        beam = beam * np.float32(max(brightness(signal, beam, calibration.air)[0], LEAST_BRIGHTNESS))
    return signal, np.asarray(np.log(beam / signal), dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class DetectorNoise:
    """The noise of a detector: what a mean of `frames` images holds of photons and readout."""

    photons_per_count: float
    readout_noise_counts: float
    frames: int

    def relative_variance(self, signal: Image, images: int = 1) -> Image:
        """Return var I / (I - D)^2 of a mean of `images` stored images, from I - D (row, column), counts."""
        variance = (signal / self.photons_per_count + self.readout_noise_counts**2) / (self.frames * images)
        return np.asarray(variance / signal**2, dtype=np.float32)


def detector_noise(experiment: Experiment) -> DetectorNoise | None:
    """Return the noise that the experiment's description tells of, if it does."""
    if experiment.photons_per_count is None or experiment.readout_noise_counts is None:
        return None
    return DetectorNoise(
        photons_per_count=experiment.photons_per_count,
        readout_noise_counts=experiment.readout_noise_counts,
        frames=experiment.frames,
    )


def grey_noise(counts: NDArray[np.uint16], calibration: Calibration, noise: DetectorNoise) -> tuple[Image, Image]:
    """Return the variance (row, column) of grey levels from the image's own noise, and the slope dg / dq."""
    signal, attenuation = _attenuation(counts, calibration)
    slope = slope_of(attenuation, calibration.polynomial)
    variance = slope**2 * noise.relative_variance(signal)
    # a dead pixel's counts tell neither: its neighbours' mean stands for both, as for its grey level
    of_noise, of_beam = (fill(np.asarray(each, dtype=np.float32), calibration.bad) for each in (variance, slope))
    return of_noise, of_beam


def fill(image: Image, bad: NDArray[np.bool_]) -> Image:
    """Replace bad pixels by the mean of the good pixels in the smallest square around them that has any."""
    result = image.copy()
    rows, columns = image.shape
    for row, column in np.argwhere(bad):
        for reach in range(1, max(rows, columns)):
            window = (
                slice(max(row - reach, 0), row + reach + 1),
                slice(max(column - reach, 0), column + reach + 1),
            )
            good = ~bad[window]
            if good.any():
                result[row, column] = image[window][good].mean()
                break
    return result


def coarsened(image: Image, factor: int) -> Image:
    """Filter with a Gaussian as wide as the new pixels (sigma = factor / 2), then average factor x factor.

    The paper's way to scale 2 (section 4.1); incomplete blocks at the bottom and right are dropped,
    as in ConeBeam.binned.
    """
    if factor == 1:
        return image
    return binned(ndimage.gaussian_filter(image, factor / 2, mode="nearest", truncate=3), factor)


def smoothed(image: Image, smooth_px: float) -> Image:
    """Filter with a Gaussian of this standard deviation, px.

    Bilinear interpolation errs on details of a pixel or two, and leaves less noise between pixels than on them:
    both pull at the motion. A filter takes these details from radiographs and volume alike.
    """
    return image if smooth_px == 0 else np.asarray(ndimage.gaussian_filter(image, smooth_px, mode="nearest"))


def sharpened(image: Image) -> Image:
    """Return a view (row, column) sharpened by what interpolation blurs between it and its re-projection.

    Back-projecting interpolates linearly between pixels, projecting does between voxels: each multiplies a wave of k
    cycles per pixel by sinc(k)^2. Both together are undone by the inverse of the cubic B-spline's samples,

        sinc(k)^4 is about (4 + 2 cos(2 pi k)) / 6        0.66 and 0.67 at k = 1/4

    along rows and columns: at most three times the amplitude, at k = 1/2 along an axis.
    """
    return np.asarray(ndimage.spline_filter(image, order=3, output=np.float32, mode="nearest"))


def noise_overlap(smooth_px: float) -> Floats:
    """Return the covariance (lag,) of filtered white noise, along one axis, of a pixel with those 0, 1, 2 ... further.

    At least three lags; zero from the last one on.
    """
    reach = int(4 * smooth_px + 0.5)
    impulse = np.zeros(4 * reach + 7)
    impulse[len(impulse) // 2] = 1
    kernel = impulse if smooth_px == 0 else ndimage.gaussian_filter1d(impulse, smooth_px)
    return np.array([kernel[: len(kernel) - lag] @ kernel[lag:] for lag in range(2 * reach + 3)])


def binned(image: Image, factor: int) -> Image:
    """Average blocks of factor x factor pixels."""
    rows, columns = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def snr_db(signal: Image, residual: Image, used: NDArray[np.bool_]) -> float:
    """Return 20 log10(std(signal) / std(residual)) over the used pixels, dB.

    Neither counts as less than what single precision rounds away, so that images without any contrast have one too.
    """
    contrast, left = (max(float(np.std(image[used], dtype=float)), LEAST_CONTRAST) for image in (signal, residual))
    return float(20 * np.log10(contrast / left))
