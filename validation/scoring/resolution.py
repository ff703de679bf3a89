"""Spatial resolution of the strain: how much of a strain sinusoidal in height a measurement recovers.

A sample that `simulator.ingredients.Ripple` deforms has a strain of wavelength lambda along its axis. At each of the
last steps t, least squares over the observed intervals k between material levels, in the middle at Z_k, give the sine
and the cosine of that wavelength in the measured strain and in the true one,

    eps(Z_k, t) = m(t) + a(t) sin(2 pi Z_k / lambda) + b(t) cos(2 pi Z_k / lambda)

and what is recovered is the least-squares factor between the two,

    recovered = sum_t (a a_true + b b_true) / sum_t (a_true^2 + b_true^2)

It is linear in the measured strain, so that noise alone leaves its mean at zero; an amplitude sqrt(a^2 + b^2) would
grow with it. A wave that is found elsewhere, a quarter of its length away, is not recovered. Both strains are
differences between the same levels: what differences do to a short wave is in both.

The spatial resolution is the wavelength at which a tenth of the amplitude is lost, as in the DIC Challenge 2.0 (Reu et
al., Experimental Mechanics 62, 2022, 639-654); `validation.study.resolution` finds it from several wavelengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.measurement import Measurement
from validation.scoring.centre_line import TruePoints, centre_line
from validation.scoring.interval_calibration import true_coefficients

Floats = NDArray[np.float64]

LAST_STEPS = 10
"""Steps at the end of the test, where the wave is largest, over which it is looked for."""


@dataclass(frozen=True, kw_only=True)
class StrainProfile:
    """The strain along the axis at the last steps, between all levels of the truth."""

    height_mm: Floats
    """Heights in the middle of the intervals (interval,), mm, of the material in the reference state."""
    measured: Floats
    """(step, interval), without unit; NaN where an end of the interval was not observed."""
    true: Floats
    """The same of the truth; NaN where `measured` is."""


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """Which share of a strain wave's amplitude was recovered; NaN where there is no wave, or less than one of it."""

    recovered: float
    """By the measurement."""
    recoverable: float
    """By the nearest motion to the true one that its sections and its time functions can make."""


def strain_profile(measurement: Measurement, truth: TruePoints) -> StrainProfile:
    """Return measured and true strain between neighbouring levels, at the last `LAST_STEPS` steps."""
    centre = centre_line(measurement, truth, spacing_mm=0.0)
    assert centre.true is not None
    return StrainProfile(
        height_mm=(centre.level_mm[1:] + centre.level_mm[:-1]) / 2,
        measured=centre.strain(centre.measured)[-LAST_STEPS:],
        true=centre.strain(centre.true)[-LAST_STEPS:],
    )


def recovered_share(profile: StrainProfile, wavelength_mm: float) -> float:
    """Return the share of the true wave's amplitude that the measured strain has, in phase with it.

    NaN where less than a wavelength was observed at all of the steps, or where the truth has no such wave.
    """
    known = np.isfinite(profile.measured).all(axis=0)
    height = profile.height_mm[known]
    if len(height) == 0 or np.ptp(height) < wavelength_mm:
        return math.nan
    phase = 2 * np.pi * height / wavelength_mm
    # the mean strain has its own place, as it is no part of the wave where that does not end with a whole number
    shapes = np.column_stack([np.ones_like(phase), np.sin(phase), np.cos(phase)])
    measured, true = (
        np.linalg.lstsq(shapes, strain[:, known].T, rcond=None)[0][1:] for strain in (profile.measured, profile.true)
    )
    total = float((true**2).sum())
    return float((measured * true).sum()) / total if total > 0 else math.nan


def recovery(profile: StrainProfile, measurement: Measurement, truth: TruePoints, wavelength_mm: float) -> Recovery:
    """Return how much of a strain wave is recovered, and could be with these sections and time functions.

    `profile` is the measurement's own.
    """
    motion = measurement.motion
    coefficients, _ = true_coefficients(motion.basis, motion.time_functions, measurement.recording.voxel_mm, truth)
    nearest = np.einsum("ft,fjk->tjk", motion.time_functions, coefficients)
    ideal = replace(measurement, motion=replace(motion, amplitude=nearest))
    return Recovery(
        recovered=recovered_share(profile, wavelength_mm),
        recoverable=recovered_share(strain_profile(ideal, truth), wavelength_mm),
    )
