"""The flat panel's faults, in the order in which they happen to the light of a frame.

1. *Correlated noise.* A photon is absorbed in one place of the scintillator, and its light, a Gaussian, spreads from
   there over the pixels: the image is blurred, and the noise with it. Of photons that fall anywhere alike, two pixels
   that are m pixels apart see in common

       c(m) = integral of tri(x - m) N(x; 0, 2 blur^2) dx        along rows and columns alike,

   with tri the box of a pixel with itself: c(i) c(j) is the covariance of their noise over its variance without blur.
   It is made by a filter h with h * h = c, whose transform is the root of that of c.
2. *Gain drift.* t seconds after the flats a pixel's gain is g (1 + d t), d normal: what flats do not correct is a
   ring in the reference volume.
3. *Non-linearity.* A signal s becomes s (1 - c s / full): c = nonlinearity (1 + spread N(0, 1)) is the share that is
   missing at the full signal, a little different from pixel to pixel. A flat-field correction leaves
   T (1 - c T) / (1 - c) of a transmission T.
4. *Zingers.* Particles that hit the panel itself: their number is Poisson, and the charge of each exponential, in one
   pixel of one frame.
5. *Saturation.* No pixel tells more than `saturation_counts`.

Clusters and lines of bad pixels see no light, as bad pixels do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import correlate1d
from scipy.special import erf

from pdvc.settings import Settings

Image = NDArray[np.float32]
NotNegative = Annotated[float, Field(ge=0)]
Few = Annotated[int, Field(ge=0, le=1000)]


class Panel(Settings):
    """Faults of the flat panel; none by default."""

    scintillator_blur_px: Annotated[float, Field(ge=0, le=50)] = 0.0
    """standard deviation of the spread of light that photons make in the scintillator, pixels"""
    gain_drift_per_hour: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """standard deviation of the change of the pixels' gain since the flats, share of it in an hour"""
    nonlinearity: Annotated[float, Field(ge=-0.2, le=0.2)] = 0.0
    """share of the signal that is missing at counts_full; half as much is missing at half of it"""
    nonlinearity_spread: Annotated[float, Field(ge=0, le=1)] = 0.0
    """standard deviation of that share from pixel to pixel, over its mean"""
    saturation_counts: Annotated[float, Field(ge=1, le=65535)] = 65535.0
    """most counts that a pixel tells, its dark level among them"""
    zingers_per_cm2_min: NotNegative = 0.0
    """particles that hit the panel itself, for each cm2 and minute"""
    zinger_counts: NotNegative = 0.0
    """mean of the counts that one such hit adds to a frame"""
    bad_clusters: Few = 0
    """discs of pixels that see no light"""
    bad_cluster_px: Annotated[float, Field(ge=0, le=100)] = 1.5
    """radius of such a disc, pixels"""
    bad_rows: Few = 0
    """rows that see no light"""
    bad_columns: Few = 0
    """columns that see no light"""


@dataclass(frozen=True, kw_only=True)
class PanelMaps:
    """What the faults of a panel are from pixel to pixel, the same for all images; each (row, column)."""

    dead: NDArray[np.bool_]
    """Pixels in clusters and lines that see no light."""
    gain_per_hour: Image
    """Change of the gain, share of it in an hour."""
    curvature: Image
    """Share of the signal that is missing at counts_full."""


def panel_maps(panel: Panel, rows: int, columns: int, rng: np.random.Generator) -> PanelMaps:
    """Draw the faults of all pixels."""
    shape = rows, columns
    drift, bend = rng.standard_normal((2, *shape), dtype=np.float32)
    dead = np.zeros(shape, dtype=np.bool_)
    row, column = np.arange(rows)[:, None], np.arange(columns)
    for i, j in rng.random((panel.bad_clusters, 2)) * shape:
        dead |= np.hypot(row + 0.5 - i, column + 0.5 - j) <= panel.bad_cluster_px
    dead[rng.permutation(rows)[: panel.bad_rows]] = True
    dead[:, rng.permutation(columns)[: panel.bad_columns]] = True
    return PanelMaps(
        dead=dead,
        gain_per_hour=np.float32(panel.gain_drift_per_hour) * drift,
        curvature=np.float32(panel.nonlinearity) * (1 + np.float32(panel.nonlinearity_spread) * bend),
    )


def covariance(blur_px: float, reach: int) -> NDArray[np.float64]:
    """Return c(m), -reach <= m <= reach, of a blur above 0.

    The second difference of the second integral of the Gaussian, x Phi(x / s) + s phi(x / s).
    """
    s = np.sqrt(2) * blur_px
    x = np.arange(-reach - 1, reach + 2) / s
    ramp = s * (x * (1 + erf(x / np.sqrt(2))) / 2 + np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi))
    return np.asarray(np.diff(ramp, 2))


@cache
def noise_filter(blur_px: float) -> NDArray[np.float64]:
    """Return h(m), -reach <= m <= reach, with h * h = c, of a blur above 0."""
    # tails of the root fall off by a constant factor from pixel to pixel, not like a Gaussian
    reach = int(np.ceil(8 * blur_px)) + 12
    transform = np.fft.rfft(np.fft.ifftshift(covariance(blur_px, reach))).real
    return np.fft.fftshift(np.fft.irfft(np.sqrt(np.maximum(transform, 0)), 2 * reach + 1))


def correlated(noise: Image, blur_px: float) -> Image:
    """Correlate the noise of photons (row, column) by the spread of their light; beyond the edge it is mirrored."""
    if blur_px == 0:
        return noise
    kernel = noise_filter(blur_px)
    across = correlate1d(noise, kernel, axis=1, mode="mirror")
    return np.asarray(correlate1d(across, kernel, axis=0, mode="mirror"), dtype=np.float32)


def zingers(
    panel: Panel, shape: tuple[int, int], pixel_mm: float, exposure_s: float, rng: np.random.Generator
) -> Image | None:
    """Draw the counts (row, column) that hits of the panel add to all frames together; None without them."""
    if panel.zingers_per_cm2_min == 0:
        return None
    area_cm2 = shape[0] * shape[1] * (pixel_mm / 10) ** 2
    count = rng.poisson(panel.zingers_per_cm2_min / 60 * area_cm2 * exposure_s)
    added = np.zeros(shape, dtype=np.float32)
    place = tuple(rng.integers(0, n, size=count) for n in shape)
    np.add.at(added, place, rng.exponential(panel.zinger_counts, size=count).astype(np.float32))
    return added
