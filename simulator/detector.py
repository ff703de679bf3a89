"""The detector: from transmission to 16-bit counts, in the physical order.

For a transmission T at sub-pixel centres, n averaged frames and the pixel maps gain, beam and bad:

    I = area mean over the pixel of (T blurred by the point spread)
    N ~ Poisson(n * photons * beam * I)                      photons of all frames together
    counts = gain N / (n photons_per_count) + readout / sqrt(n) * normal + dark
    stored = counts rounded, and clipped to 0 .. 65535.

What a real tube and panel add to this order is told in `simulator.open_beam` and `simulator.panel`; it comes with the
`Conditions` of an image.

The mean of n frames of Poisson(m) is Poisson(n m) / n, and the mean of n readouts of deviation s is one
readout of deviation s / sqrt(n): drawing the mean at once changes nothing. "Photons" are independent quanta;
for an energy-integrating scintillator they are the number that gives the same signal-to-noise ratio.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Self

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pdvc.geometry import ConeBeam
from pdvc.settings import Settings
from simulator.open_beam import OpenBeam
from simulator.panel import Panel, PanelMaps, correlated, panel_maps, zingers

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, lt=1)]

_FULL_SCALE = 65535


class Detector(Settings):
    """A flat panel. The default noise is 0.5 % of the open beam in the mean of 5 frames."""

    photons_per_pixel: Positive = 8000.0
    """photons detected in one pixel of the open beam during one frame"""
    frames: Annotated[int, Field(ge=1)] = 5
    """frames averaged into each stored image"""
    flats: Annotated[int, Field(ge=1)] = 2
    """images stored without the sample"""
    darks: Annotated[int, Field(ge=1)] = 1
    """images stored without X-rays"""
    counts_full: Positive = 40000.0
    """counts of the open beam above the dark level"""
    dark_counts: NotNegative = 800.0
    """level without X-rays, counts"""
    readout_noise_counts: NotNegative = 30.0
    """standard deviation of the readout of one frame, counts"""
    gain_spread: Annotated[float, Field(ge=0, le=0.2)] = 0.02
    """standard deviation of the pixels' gain over its mean"""
    bad_pixel_fraction: Share = 2e-4
    """share of pixels that are dead (half of them) or saturated (the other half)"""
    blur_px: NotNegative = 0.35
    """standard deviation of the Gaussian point spread of scintillator and focal spot, pixels"""
    beam_falloff: Share = 0.05
    """loss of beam from the centre of the image to its corners, share of the centre"""

    @model_validator(mode="after")
    def _open_beam_below_full_scale(self) -> Self:
        highest = self.dark_counts + self.counts_full * (1 + 4 * self.gain_spread)
        if highest > _FULL_SCALE:
            raise ValueError(
                f"dark_counts + counts_full (1 + 4 gain_spread) of at most {_FULL_SCALE}, got {highest:.6g}"
            )
        return self

    @property
    def photons_per_count(self) -> float:
        """Return the detected photons that make one count of one frame, at gain 1."""
        return self.photons_per_pixel / self.counts_full


@dataclass(frozen=True, kw_only=True)
class DetectorMaps:
    """What differs from pixel to pixel and is the same for all images; each (rows, columns)."""

    gain: NDArray[np.float32]
    """Counts per photon over the mean of all pixels."""
    beam: NDArray[np.float32]
    """Photons of the open beam over those at the centre of the image."""
    dead: NDArray[np.bool_]
    """Pixels that see no light."""
    hot: NDArray[np.bool_]
    """Pixels that are always saturated."""
    faults: PanelMaps | None = None
    """What the faults of the panel are from pixel to pixel; None of a panel without faults."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What an image is taken with beside the detector, and when; without imperfections by default."""

    beam: OpenBeam = field(default_factory=OpenBeam)
    panel: Panel = field(default_factory=Panel)
    pixel_mm: float = 1.0
    """Pitch of the pixels, mm."""
    time_s: float = 0.0
    """Time since the flats, s."""
    exposure_s: float = 1.0
    """Time that all frames take together, s."""


IDEAL = Conditions()


def detector_maps(detector: Detector, rows: int, columns: int, rng: np.random.Generator) -> DetectorMaps:
    """Draw the pixels' gains (normal, cut at 4 deviations) and the bad pixels, and lay out the beam."""
    shape = rows, columns
    gain = 1 + detector.gain_spread * np.clip(rng.standard_normal(shape), -4, 4)
    lot = rng.random(shape)
    # the numbers -1 .. 1 are the edges of the image; corners are at distance sqrt(2)
    y, x = (np.linspace(-1, 1, n)[:, None] if n > 1 else np.zeros((1, 1)) for n in shape)
    return DetectorMaps(
        gain=gain.astype(np.float32),
        beam=(1 - detector.beam_falloff * (y**2 + x.T**2) / 2).astype(np.float32),
        dead=lot < detector.bad_pixel_fraction / 2,
        hot=lot > 1 - detector.bad_pixel_fraction / 2,
    )


def faulty(maps: DetectorMaps, panel: Panel, rng: np.random.Generator) -> DetectorMaps:
    """Draw the faults of a panel, and add them to what differs from pixel to pixel."""
    if panel == Panel():
        return maps
    rows, columns = maps.gain.shape
    faults = panel_maps(panel, rows, columns, rng)
    return replace(maps, dead=maps.dead | faults.dead, faults=faults)


def focal_blur_px(focal_spot_mm: float, geometry: ConeBeam) -> float:
    """Return the blur of a Gaussian focal spot, f (M - 1) / pixel, as a standard deviation in pixels.

    The focal spot is given by its standard deviation, mm; add the blur to others by squares into `blur_px`.
    """
    return focal_spot_mm * (geometry.magnification - 1) / geometry.pixel_mm


def expose(
    transmission: NDArray[np.float32],
    detector: Detector,
    maps: DetectorMaps,
    subpixels: int,
    rng: np.random.Generator,
) -> NDArray[np.uint16]:
    """Make one stored image from the transmission at sub-pixel centres, (rows, columns) x subpixels.

    Returns counts (rows, columns): the mean of `frames` frames, in the order of the module's head.
    """
    return record(seen(transmission, detector, maps, subpixels), detector, maps, rng)


def seen(
    transmission: NDArray[np.float32], detector: Detector, maps: DetectorMaps, subpixels: int
) -> NDArray[np.float32]:
    """Return I (rows, columns), the share of the open beam in each pixel: all of an image that has no noise.

    It depends on no setting of the detector but `blur_px`.
    """
    wanted = (maps.gain.shape[0] * subpixels, maps.gain.shape[1] * subpixels)
    if transmission.shape != wanted:
        raise ValueError(f"transmission: expected shape {wanted}, got {transmission.shape}")
    return pixel_means(transmission, subpixels, detector.blur_px)


def record(
    image: NDArray[np.float32],
    detector: Detector,
    maps: DetectorMaps,
    rng: np.random.Generator,
    conditions: Conditions = IDEAL,
) -> NDArray[np.uint16]:
    """Make one stored image, counts (rows, columns), from what its pixels see, as `seen` returns it."""
    # of their own, so that photons and readout stay the same whatever else happens
    of_tube, of_hits = rng.spawn(2)
    photons = _photons(image, detector, maps) * detector.frames
    light = conditions.beam.light(conditions.time_s, detector.frames, image.shape[1], of_tube)
    if light is not None:
        photons *= light
    detected = rng.poisson(photons).astype(np.float32)
    if conditions.panel.scintillator_blur_px > 0:
        detected = photons + correlated(detected - photons, conditions.panel.scintillator_blur_px)
    counts = _counts(detected / np.float32(detector.frames), detector, maps, conditions.time_s)
    deviation = detector.readout_noise_counts / math.sqrt(detector.frames)
    counts += np.float32(deviation) * rng.standard_normal(counts.shape, dtype=np.float32)
    hits = zingers(conditions.panel, counts.shape, conditions.pixel_mm, conditions.exposure_s, of_hits)
    if hits is not None:
        counts += hits / np.float32(detector.frames)
    return _stored(counts, maps, int(conditions.panel.saturation_counts))


def expose_flat(
    detector: Detector, maps: DetectorMaps, rng: np.random.Generator, conditions: Conditions = IDEAL
) -> NDArray[np.uint16]:
    """Make one stored image (rows, columns) without the sample."""
    image = seen(np.ones(maps.gain.shape, dtype=np.float32), detector, maps, 1)
    return record(image, detector, maps, rng, conditions)


def expose_dark(
    detector: Detector, maps: DetectorMaps, rng: np.random.Generator, conditions: Conditions = IDEAL
) -> NDArray[np.uint16]:
    """Make one stored image (rows, columns) without X-rays."""
    image = seen(np.zeros(maps.gain.shape, dtype=np.float32), detector, maps, 1)
    return record(image, detector, maps, rng, conditions)


def expected(
    transmission: NDArray[np.float32], detector: Detector, maps: DetectorMaps, subpixels: int
) -> NDArray[np.float32]:
    """Return the noise-free counts (rows, columns) of an image, bad pixels too, neither rounded nor clipped."""
    counts = _counts(_photons(seen(transmission, detector, maps, subpixels), detector, maps), detector, maps)
    return np.where(maps.hot, np.float32(_FULL_SCALE), counts)


def pixel_means(image: NDArray[np.float32], subpixels: int, blur_px: float) -> NDArray[np.float32]:
    """Blur an image by a Gaussian and take the mean over each pixel, in one separable pass.

    The kernel is the Gaussian, sampled at sub-pixels to 5 deviations and of sum 1, convolved with the pixel's
    box; beyond its edges the image goes on with its edge values. A deviation below half a sub-pixel is blurred
    too little: take more sub-pixels. From (rows, columns) x subpixels to (rows, columns).
    """
    if image.shape[0] % subpixels or image.shape[1] % subpixels:
        raise ValueError(f"image: expected whole pixels of {subpixels} x {subpixels}, got shape {image.shape}")
    sigma = blur_px * subpixels
    # below a twentieth of a sub-pixel the neighbours' weight is less than 1e-80
    reach = math.ceil(5 * sigma) if sigma > 0.05 else 0
    gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2) if reach else np.ones(1)
    kernel = np.convolve(gauss / gauss.sum(), np.full(subpixels, 1 / subpixels)).astype(np.float32)
    across = _down_columns(np.ascontiguousarray(image), kernel, subpixels, reach)
    return np.asarray(_down_rows(across, kernel, subpixels, reach))


def _photons(image: NDArray[np.float32], detector: Detector, maps: DetectorMaps) -> NDArray[np.float32]:
    """Return the photons expected in each pixel during one frame."""
    photons: NDArray[np.float32] = np.float32(detector.photons_per_pixel) * maps.beam * image
    return photons


def _counts(
    photons: NDArray[np.float32], detector: Detector, maps: DetectorMaps, time_s: float = 0.0
) -> NDArray[np.float32]:
    lit = np.where(maps.dead, np.float32(0), photons * maps.gain)
    if maps.faults is not None:
        lit *= 1 + maps.faults.gain_per_hour * np.float32(time_s / 3600)
        lit *= 1 - maps.faults.curvature * (lit / np.float32(detector.photons_per_pixel))
    counts = lit / detector.photons_per_count + detector.dark_counts
    return counts.astype(np.float32, copy=False)


def _stored(counts: NDArray[np.float32], maps: DetectorMaps, most: int) -> NDArray[np.uint16]:
    rounded = np.clip(np.rint(counts), 0, most).astype(np.uint16)
    rounded[maps.hot] = most
    return rounded


@numba.njit(cache=True, nogil=True)
def _down_columns(image, kernel, step, reach):  # type: ignore[no-untyped-def]
    rows, columns = image.shape
    result = np.zeros((rows, columns // step), dtype=np.float32)
    for i in range(rows):
        for j in range(result.shape[1]):
            start = j * step - reach
            total = np.float32(0.0)
            if start >= 0 and start + len(kernel) <= columns:
                for k in range(len(kernel)):
                    total += kernel[k] * image[i, start + k]
            else:
                for k in range(len(kernel)):
                    total += kernel[k] * image[i, min(max(start + k, 0), columns - 1)]
            result[i, j] = total
    return result


@numba.njit(cache=True, nogil=True)
def _down_rows(image, kernel, step, reach):  # type: ignore[no-untyped-def]
    rows, columns = image.shape
    result = np.zeros((rows // step, columns), dtype=np.float32)
    for i in range(result.shape[0]):
        for k in range(len(kernel)):
            source = min(max(i * step - reach + k, 0), rows - 1)
            for j in range(columns):
                result[i, j] += kernel[k] * image[source, j]
    return result
