"""What a reader may conclude from a measurement's standard deviations: a table, and sentences made from the numbers.

With a truth, errors are compared with what was predicted for them (`validation.scoring.interval_calibration`).
Without one only the residual can be asked whether it is the noise that was expected (`pdvc.noise`), which says nothing
about errors that radiographs hardly show.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import special

from pdvc.measurement import Measurement, ResidualTests
from validation.scoring.centre_line import TruePoints
from validation.scoring.interval_calibration import IntervalCalibration, true_coefficients
from validation.scoring.scores import Scores

TOO_SMALL = 1.5
"""A z rms above this is called an interval too small, below its inverse one too large: one draw tells no finer."""
CHI2_TOLERANCE = 0.05
"""What chi2 / (N - p) may differ from 1: more than chance leaves with some ten thousand pixels."""
LAG1_TOLERANCE = 0.05
"""What a correlation may differ from the expected one."""

_NAMES = {
    "across_beam": "across the beam",
    "vertical": "vertically",
    "along_beam": "along the beam",
    "strain": "in strain",
}


def trust_table(scores: Scores) -> list[list[str]]:
    """Return a line for each direction and for the strain: predicted, observed, z rms, coverages and CRPS, as text."""
    c = scores.calibration
    lines = []
    for key, name in (("across_beam", "across the beam, voxel"), ("vertical", "vertical, voxel"),
                      ("along_beam", "along the beam, voxel"), ("strain", "strain, %")):  # fmt: skip
        strain = key == "strain"
        observed = scores.strain_rms if strain else getattr(scores.error_voxel, key)
        factor = 100 if strain else 1
        lines.append(
            [name, _number(getattr(c.predicted, key) * factor, 4), _number(observed * factor, 4)]
            + [_number(getattr(c.z_rms, key), 2)]
            + [_number(getattr(part, key) * 100, 0) for part in (c.coverage_50, c.coverage_90, c.coverage_95)]
            + [_number(getattr(c.crps, key) * factor, 4)]
        )
    return lines


def phase_table(scores: Scores) -> list[list[str]]:
    """Return a line for each direction and for the strain: z rms and coverage of 95 % intervals in each phase."""
    phases = scores.calibration.phases
    return [
        [name]
        + [
            f"{_number(getattr(phase.z_rms, key), 2)}, {_number(getattr(phase.coverage_95, key) * 100, 0)}"
            for phase in (phases.plateau, phases.onset, phases.loading)
        ]
        for key, name in _NAMES.items()
    ]


def nees_sentence(found: IntervalCalibration) -> str:
    """Return how the error of all coefficients compares with chi-square; empty where their covariance is not whole."""
    if not math.isfinite(found.nees):
        return ""
    # quantiles of chi2; scipy.stats has them too, but takes a second to import
    low, high = 2 * special.gammaincinv(found.nees_unknowns / 2, (0.025, 0.975))
    side = "inside" if low <= found.nees <= high else "below" if found.nees < low else "above"
    return (
        f"All {found.nees_unknowns} coefficients together: NEES = {found.nees:.0f}, {side} the "
        f"{low:.0f} to {high:.0f} that chi-square leaves 95 % of the time."
    )


def calibration_sentences(measurement: Measurement, scores: Scores, truth: TruePoints | None) -> list[str]:
    """Return where the interval is too small or too large, by which factor, and why."""
    ratio = {name: getattr(scores.calibration.z_rms, key) for key, name in _NAMES.items()}
    small = {name: z for name, z in ratio.items() if z > TOO_SMALL}
    large = {name: z for name, z in ratio.items() if z < 1 / TOO_SMALL}
    fair = [name for name, z in ratio.items() if 1 / TOO_SMALL <= z <= TOO_SMALL]
    result = []
    if small:
        factors = _joined([f"{name} by a factor of {z:.1f}" for name, z in small.items()])
        result.append(
            f"The interval is too small {factors}: {_missing(measurement, small)}{_outside(measurement, truth)}"
        )
    if large:
        factors = _joined([f"{name} by a factor of {1 / z:.1f}" for name, z in large.items()])
        result.append(f"The interval is too large {factors}.")
    if fair:
        result.append(f"The interval agrees with the errors, to a factor of {TOO_SMALL:g}, {_joined(fair)}.")
    return result


def residual_sentences(tests: ResidualTests | None, *, noise_known: bool, truth_known: bool) -> list[str]:
    """Return whether the residual is the noise that was expected, and what follows from that."""
    if tests is None:
        return ["The residual was not tested against noise."]
    chi2 = tests.chi2_reduced
    pairs = ((tests.lag1_row, tests.lag1_row_expected), (tests.lag1_column, tests.lag1_column_expected))
    white = all(abs(seen - due) <= LAG1_TOLERANCE for seen, due in pairs)
    as_large = abs(chi2 - 1) <= CHI2_TOLERANCE
    if not noise_known:
        size = (
            f"chi²/(N - p) = {chi2:.2f} tells nothing: the noise is not known and was taken from the residual itself."
        )
    elif as_large:
        size = f"The residual is as large as noise: chi²/(N - p) = {chi2:.2f}, where 1 is due."
    elif chi2 > 1:
        size = f"The residual holds more than noise: chi²/(N - p) = {chi2:.2f}, where 1 is due."
    else:
        size = f"The residual is smaller than the noise expected: chi²/(N - p) = {chi2:.2f}, where 1 is due."
    lags = (
        f"The correlation of neighbouring pixels is {tests.lag1_row:.2f} from row to row and {tests.lag1_column:.2f} "
        f"from column to column, where noise would leave {tests.lag1_row_expected:.2f} and "
        f"{tests.lag1_column_expected:.2f}: {'as expected' if white else 'not as expected'}."
    )
    result = [size, lags]
    if not truth_known:
        result.append(_without_truth(white=white, chi2=chi2 if noise_known else 1.0))
    return result


def noise_known(measurement: Measurement) -> bool:
    """Return whether the noise of the detector was known, not taken from the residual."""
    return bool(np.isfinite(measurement.fit.snr_noise_db).any())


def _without_truth(*, white: bool, chi2: float) -> str:
    if chi2 > 1 + CHI2_TOLERANCE or (not white and chi2 >= 1 - CHI2_TOLERANCE):
        return (
            "So the model does not follow all that the radiographs show: errors may be larger than predicted, by a "
            "factor that nothing here tells."
        )
    if chi2 < 1 - CHI2_TOLERANCE:
        return "So the noise is not what the experiment says, and the standard deviations are not to be relied on."
    return (
        "So nothing in the radiographs speaks against the standard deviations. An error that they hardly show, as of "
        "a motion along the beam, may still be larger than predicted."
    )


def _missing(measurement: Measurement, small: dict[str, float]) -> str:
    causes = ["motion outside the space of sections and time functions"]
    if _NAMES["along_beam"] in small and measurement.fit.residual_final.size:
        causes.append("contraction and motion along the beam, which look alike")
    causes.append("the sampling of volume and radiographs")
    return f"it holds noise and prior, which cannot tell errors of the model ({'; '.join(causes)})."


def _outside(measurement: Measurement, truth: TruePoints | None) -> str:
    """Return how far the true motion is from all that the unknowns could say, where time functions join the steps."""
    if truth is None or measurement.motion.covariance.ndim != 2:
        return ""
    _, missed = true_coefficients(
        measurement.motion.basis, measurement.motion.time_functions, measurement.recording.voxel_mm, truth
    )
    return (
        " The nearest motion in that space is "
        f"{_joined([f'{value:.3f}' for value in missed])} voxel rms from the true one in x, y and z."
    )


def _joined(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "—"
