"""The detector's fixed pattern: what the noise of the flats leaves in all radiographs alike, found in all of them.

The mean of a few flats has a noise phi relative to the open beam, and s phi, s = dg / dq, is in the grey levels of
every radiograph and every reference view. The sample moves, the pattern does not: with R_t what moves a reference view
with the sample (`pdvc.systematic`), a step's residual holds

    rho(t) = ... - s phi + R_t [s phi]                  -> rho(t) + psi - R_t psi    with psi taken from all images

The mean over the steps tells psi, as R_t takes it to another place at each step, and each ray's own noise is averaged
out. Against the prior that the flats tell, of variance v_psi, and with v the noise of a residual, of T steps,

    psi <- psi - v_psi / (v_psi + v / T)  mean_t [rho(t) + psi - R_t psi]

What is so slow over the detector that R_t hardly changes it is not found, and hardly in the residual. An error of the
motion leaves a mean residual, too, alike in all directions along the beam: smooth over pixels, as edges and texture
pass by, where the flats' noise is white. So only what is left above a Gaussian of some pixels is taken for it; the
motion would else stay where it was when psi was found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.equations import Images
from pdvc.noise import ImageNoise, Noise
from pdvc.radiographs import noise_overlap
from pdvc.sections import SectionBasis
from pdvc.systematic import Systematic

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

ROUNDS = 2
"""Times that psi is improved: a third one changed nothing."""
SMOOTH_PX = 3.0
"""Standard deviation of the Gaussian whose mean around a pixel is no pattern."""
MOST = 4.0
"""Standard deviations of the flats' noise that psi is held within: more is a misfit, not the flats' noise."""


@dataclass(frozen=True, kw_only=True)
class Pattern:
    """What all images of a detector have in common."""

    grey: Image
    """psi (row, column), grey levels, over the whole detector; zero outside the window."""
    left: Image
    """Share of the flats' variance that is left once psi is taken away (row, column); one outside the window."""


def fixed_pattern(
    images: Images, systematic: Systematic, basis: SectionBasis, amplitude: Floats, noise: Noise, residual: Image
) -> Pattern:
    """Return the pattern that a residual (step, row, column) shows, at amplitudes (step, section, motion), voxels."""
    steps, window = len(residual), systematic.window
    own, slope = np.zeros(systematic.shape), np.zeros(systematic.shape)
    for t in range(steps):
        image = noise.step(t)
        own += image.variance / steps
        slope += image.slope / steps
    share, most = _weighed(systematic, noise, own, slope, steps)
    grey = np.zeros(systematic.detector, dtype=np.float32)
    mean = residual.mean(axis=0, dtype=float)
    for _ in range(ROUNDS):
        moved = _mean_moved(images, systematic, basis, amplitude, grey)
        grey[window] = np.clip(_fine(grey[window] - share * (mean + grey[window] - moved)), -most, most)
    return Pattern(grey=grey, left=_left(systematic, share))


class GrowingPattern:
    """The pattern as far as the radiographs so far tell it, each of them without what those before it told.

    With psi_t what was taken from the images of a step, its residual is rho(t) + psi_t - R_t psi_t, so that the mean
    of residual - psi_t over the steps is minus psi, but for what R_t still moves.
    """

    def __init__(self, systematic: Systematic, noise: Noise) -> None:
        """Begin with no radiograph."""
        self._systematic, self._noise = systematic, noise
        self.steps = 0
        self.sums = np.zeros((3, *systematic.shape))
        """Of psi_t - residual, of the radiographs' variance, and of dg / dq, over the steps (3, row, column)."""

    def add(self, residual: Image, taken: Image, image: ImageNoise) -> None:
        """Take in a residual (row, column), what was taken from its images (the same), and its radiograph's noise."""
        self.steps += 1
        self.sums += np.stack([taken - residual, image.variance, image.slope])

    def found(self) -> Pattern:
        """Return what is known now."""
        grey = np.zeros(self._systematic.detector, dtype=np.float32)
        if not self.steps:
            return Pattern(grey=grey, left=np.ones_like(grey))
        mean, own, slope = self.sums / self.steps
        share, most = _weighed(self._systematic, self._noise, own, slope, self.steps)
        grey[self._systematic.window] = np.clip(_fine(share * mean), -most, most)
        return Pattern(grey=grey, left=_left(self._systematic, share))


def _weighed(systematic: Systematic, noise: Noise, own: Floats, slope: Floats, steps: int) -> tuple[Floats, Floats]:
    """Return the share v_psi / (v_psi + v / T) and the most that psi may be (row, column), grey levels.

    From the mean variance of radiographs, unfiltered, and the mean slope dg / dq, both (row, column).
    """
    kept = noise_overlap(noise.smooth_px)[0] ** 2
    prior = kept * slope**2 * noise.flat[systematic.window]
    # a reference view has at most as much noise as a radiograph
    return 1 - left_of_flats(prior, 2 * kept * own, steps), MOST * np.sqrt(prior)


def _left(systematic: Systematic, share: Floats) -> Image:
    """Return the share of the flats' variance that is left (row, column), over the whole detector."""
    left = np.ones(systematic.detector, dtype=np.float32)
    # of white noise, the Gaussian's mean keeps 1 / (4 pi sigma^2)
    left[systematic.window] = 1 - share * (1 - 1 / (4 * np.pi * SMOOTH_PX**2))
    return left


def _fine(image: Floats) -> Floats:
    """Return what an image holds above its mean around each pixel."""
    return np.asarray(image - ndimage.gaussian_filter(image, SMOOTH_PX, mode="nearest"))


def left_of_flats(prior: Floats, own: Floats, steps: int) -> Floats:
    """Return the share of the flats' variance that is left, v / T over v_psi + v / T.

    From v_psi and the variance v of a residual of `steps` steps, both grey levels squared.
    """
    each = own / steps
    return np.asarray(np.divide(each, prior + each, out=np.ones_like(each), where=prior + each > 0))


def _mean_moved(images: Images, systematic: Systematic, basis: SectionBasis, amplitude: Floats, grey: Image) -> Floats:
    """Return the mean over the steps of R_t psi (row, column) over the window."""
    alike = replace(systematic, left=lambda _: grey)
    total = np.zeros(systematic.shape)
    for t in range(len(amplitude)):
        one = slice(t, t + 1)
        total += alike.registered(one, images.rays[one], basis, amplitude[one], images.voxel_mm)[0]
    return total / len(amplitude)
