"""The images of scale 1 without the detector's fixed pattern, and the noise that is left in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.noise import Noise, known_from_residual
from pdvc.pattern import Pattern, fixed_pattern
from pdvc.preparation import Prepared, noise_of
from pdvc.sections import SectionBasis
from pdvc.setup import Setup

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

Keep = Callable[[Callable[[], Pattern]], Pattern]


@dataclass(frozen=True, kw_only=True)
class Cleared:
    """Images of scale 1."""

    prepared: Prepared
    left: Image | None = None
    """Share of the flats' variance that is left (row, column); None: no pattern was taken from them."""

    def noise(self, setup: Setup, rms: Callable[[], float]) -> Noise:
        """Return the noise of all images; where the detector's is not stated, what a residual's rms tells."""
        systematic = self.prepared.systematic
        noise = noise_of(setup, systematic) or known_from_residual(
            rms(), systematic.shape, systematic.detector, setup.options.smooth_px
        )
        return noise if self.left is None else replace(noise, flat=noise.flat * self.left)


def without_pattern(
    setup: Setup,
    fine: Prepared,
    basis: SectionBasis,
    amplitude: Floats,
    residual: Callable[[], Image],
    keep: Keep = lambda made: made(),
) -> Cleared:
    """Take the detector's pattern from all images of scale 1, if the options say so and noise is known.

    At amplitudes (step, section, motion), voxels, whose residual (step, row, column) is asked for where it is needed;
    `keep` may find in a store what it would make.
    """
    noise = noise_of(setup, fine.systematic)
    if not setup.options.remove_pattern or noise is None:
        return Cleared(prepared=fine)
    known: Noise = noise
    pattern = keep(lambda: fixed_pattern(fine.images, fine.systematic, basis, amplitude, known, residual()))
    return Cleared(prepared=fine.without(pattern.grey), left=pattern.left)
