"""Whether the uncertainties of a measurement are those of its errors, where the truth is known.

With e an error, s the standard deviation that the measurement gives it (`pdvc.uncertainty`), and z = e / s:

- coverage: the share of |z| below 0.674, 1.645 and 1.960, where 50, 90 and 95 % are due;
- z rms: 1 is due; what is more says by which factor the interval is too small;
- CRPS, the continuous ranked probability score of the stated normal distribution: with Phi and phi the standard normal
  distribution and density, s [z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi)], in the unit of the error and lower where it
  is better. An interval that is wide for nothing loses by it, as one that is too narrow does;
- the same by phase: at the plateau, over the first steps of loading, and after these. Errors of the model come and go
  with what the sample does, noise does not;
- NEES, the normalised estimation error squared: d^T C^-1 d, with d the error of all coefficients of observed sections
  and C their covariance. It follows chi-square with as many degrees of freedom if C is right.

The errors of one measurement hang together: hundreds of points share a few sections, and all steps some time
functions. One measurement therefore tells little; its numbers are to be averaged over many noise draws.

NEES needs true coefficients: those that come nearest to the true motion at the material points. Where the true motion
is not in the basis' span, d lacks what no coefficients could follow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, special

from pdvc.deviations import Quantities
from pdvc.measurement import Measurement
from pdvc.onset import onset
from pdvc.sections import SectionBasis
from validation.scoring.centre_line import TruePoints, current_positions
from validation.scoring.deviations import centre_line_deviation

Floats = NDArray[np.float64]

LEVELS = (0.50, 0.90, 0.95)
ONSET_STEPS = 10
"""Steps that count as the onset of loading: slack is taken up, and histories have a corner."""


@dataclass(frozen=True, kw_only=True)
class Phase:
    """What some of the steps show."""

    z_rms: Quantities
    coverage_95: Quantities


@dataclass(frozen=True, kw_only=True)
class Phases:
    """The parts of a test, by its force; where that has no onset all steps are one plateau, and the others NaN."""

    plateau: Phase
    onset: Phase
    loading: Phase


@dataclass(frozen=True, kw_only=True)
class IntervalCalibration:
    """What one measurement shows of its uncertainties."""

    predicted: Quantities
    """rms over points and steps of the standard deviations: voxels, and strain without unit"""
    z_rms: Quantities
    coverage_50: Quantities
    coverage_90: Quantities
    coverage_95: Quantities
    crps: Quantities
    """continuous ranked probability score, mean over points and steps: voxels, and strain without unit"""
    phases: Phases
    nees: float
    """normalised estimation error squared of all observed coefficients"""
    nees_unknowns: int
    """its degrees of freedom"""


def interval_calibration(measurement: Measurement, truth: TruePoints, errors: Floats) -> IntervalCalibration:
    """Compare errors (step, point, direction), voxels, at the points of the truth with what was predicted for them."""
    positions = current_positions(truth)
    deviations = np.stack([measurement.turned_std(step, x) for step, x in enumerate(positions)])
    deviations[np.isnan(errors)] = np.nan
    centre = centre_line_deviation(measurement, truth)
    assert centre.strain_error is not None
    groups = [(errors[..., k], deviations[..., k]) for k in range(3)] + [(centre.strain_error, centre.strain_std)]
    scores = [_z(error, deviation) for error, deviation in groups]
    nees, unknowns = _nees(measurement, truth)
    coverage = {level: _covered(scores, level) for level in LEVELS}
    return IntervalCalibration(
        predicted=_each([math.sqrt(_mean(d[np.isfinite(d)] ** 2)) for _, d in groups]),
        z_rms=_z_rms(scores),
        coverage_50=coverage[0.50],
        coverage_90=coverage[0.90],
        coverage_95=coverage[0.95],
        crps=_each([_mean(crps(error, deviation)) for error, deviation in groups]),
        phases=_phases(groups, phase_steps(measurement.recording.force_N)),
        nees=nees,
        nees_unknowns=unknowns,
    )


def crps(error: Floats, deviation: Floats) -> Floats:
    """Return the continuous ranked probability score of normal distributions, where both are known (number,)."""
    known = np.isfinite(error) & (deviation > 0)
    z, spread = error[known] / deviation[known], deviation[known]
    density = np.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
    score = z * (2 * special.ndtr(z) - 1) + 2 * density - 1 / math.sqrt(math.pi)
    return np.asarray(spread * score)


def phase_steps(force_N: Floats) -> dict[str, NDArray[np.bool_]]:
    """Return which steps (step,) belong to each phase of a test."""
    step, found = np.arange(len(force_N)), onset(force_N)
    last = len(force_N) if found is None else found
    plateau, begun = step <= last, step <= last + ONSET_STEPS
    return {"plateau": plateau, "onset": begun & ~plateau, "loading": ~begun}


def _phases(groups: Sequence[tuple[Floats, Floats]], steps: Mapping[str, NDArray[np.bool_]]) -> Phases:
    found = {}
    for name, here in steps.items():
        scores = [_z(error[here], deviation[here]) for error, deviation in groups]
        found[name] = Phase(z_rms=_z_rms(scores), coverage_95=_covered(scores, 0.95))
    return Phases(**found)


def _each(values: Sequence[float]) -> Quantities:
    across, vertical, along, of_strain = values
    return Quantities(across_beam=across, vertical=vertical, along_beam=along, strain=of_strain)


def _z_rms(scores: Sequence[Floats]) -> Quantities:
    return _each([math.sqrt(_mean(z**2)) for z in scores])


def _covered(scores: Sequence[Floats], level: float) -> Quantities:
    half = float(special.ndtri((1 + level) / 2))
    return _each([_mean(np.abs(z) < half) for z in scores])


def true_coefficients(
    basis: SectionBasis, time_functions: Floats, voxel_mm: float, truth: TruePoints
) -> tuple[Floats, Floats]:
    """Return the coefficients (function, section, motion), voxels, nearest to the true motion.

    Also the rms distance (3,) in x, y, z, voxels, of what they make from the true motion, at the points between the
    lowest and the highest section: zero where the motion is in the basis' span.
    """
    positions, true = current_positions(truth), truth.displacement_mm / voxel_mm
    inside = (positions[..., 2] >= basis.height_mm[0]) & (positions[..., 2] <= basis.height_mm[-1])
    amplitude = np.empty((len(positions), *basis.shape))
    for step, (x, here) in enumerate(zip(positions, inside, strict=True)):
        shapes = basis.shapes(x[here]).reshape(3 * int(here.sum()), -1)
        amplitude[step] = linalg.lstsq(shapes, true[step, here].ravel(), cond=1e-9, lapack_driver="gelsy")[0].reshape(
            basis.shape
        )
    norm = (time_functions**2).sum(axis=1)
    coefficients = np.einsum("ft,tjk->fjk", time_functions, amplitude) / norm[:, None, None]
    made = np.einsum("ft,fjk->tjk", time_functions, coefficients)
    missed = [
        basis.displacement(made[t], x[here]) - true[t, here]
        for t, (x, here) in enumerate(zip(positions, inside, strict=True))
    ]
    return coefficients, np.sqrt((np.concatenate(missed) ** 2).mean(axis=0))


def _nees(measurement: Measurement, truth: TruePoints) -> tuple[float, int]:
    """Return d^T C^-1 d over the observed sections, and its degrees of freedom; NaN without a whole covariance."""
    functions = measurement.motion.time_functions
    if measurement.motion.covariance.ndim != 2:
        return math.nan, 0
    true, _ = true_coefficients(measurement.motion.basis, functions, measurement.recording.voxel_mm, truth)
    norm = (functions**2).sum(axis=1)[:, None, None]
    known = np.nan_to_num(measurement.motion.amplitude)
    error = np.einsum("ft,tjk->fjk", functions, known) / norm - true
    kept = np.broadcast_to(measurement.motion.observed[:, None], error.shape).ravel()
    d, c = error.ravel()[kept], measurement.motion.covariance[np.ix_(kept, kept)]
    scale = 1 / np.sqrt(np.diag(c))
    factor = linalg.cho_factor(c * scale[:, None] * scale)
    return float((d * scale) @ linalg.cho_solve(factor, d * scale)), int(kept.sum())


def _z(error: Floats, deviation: Floats) -> Floats:
    known = np.isfinite(error) & (deviation > 0)
    return np.asarray(error[known] / deviation[known])


def _mean(values: Floats | NDArray[np.bool_]) -> float:
    return float(np.mean(values)) if values.size else math.nan
