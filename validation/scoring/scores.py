"""How good a measurement is, against the truth of a simulated experiment.

A material point X that moved to x = X + U(X, t) has the error

    e(X, t) = u(x, t) - U(X, t)

which is given along three directions: across the beam e_c(theta), vertical e_z, and along the beam
e_b(theta) (`pdvc.geometry`), because one radiograph hardly sees motion along its beam. For each of them

    error^2 = bias^2 + random^2

where the bias of a point is its error averaged over the steps, in the directions that turn with the beam, and
the random part is what is left. All three are rms over the scored points and steps. A point is scored
while it is between the lowest and the highest observed section and no unobserved section shares its motion.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import beam_frame
from pdvc.measurement import Measurement, MeasurementError
from validation.scoring.centre_line import (
    CentreLine,
    TruePoints,
    centre_line,
    current_positions,
    measured_at,
    nan_mean,
)
from validation.scoring.interval_calibration import IntervalCalibration, interval_calibration

Floats = NDArray[np.float64]

LEAST_STRETCH_VOXEL = 0.1
"""Vertical motion against the mean, rms over the axis, below which no share of it is told."""


@dataclass(frozen=True, kw_only=True)
class Directions:
    """One number for each direction, voxels."""

    across_beam: float
    vertical: float
    along_beam: float


@dataclass(frozen=True, kw_only=True)
class Snr:
    """Mean signal-to-noise ratios, dB: over the views for `reprojection`, else over the steps."""

    reprojection: float
    initial: float
    rigid: float
    final: float
    noise_limit: float


@dataclass(frozen=True, kw_only=True)
class Modes:
    """The number of modes that each stage of the protocol found."""

    rigid: int
    deformation: int


@dataclass(frozen=True, kw_only=True)
class Seconds:
    """How long each part took, s; NaN where nobody noted it."""

    simulate: float
    reconstruct: float
    measure: float


@dataclass(frozen=True, kw_only=True)
class Scores:
    """What `scores.json` says."""

    scenario: str
    steps: int
    unknowns: int
    snr_db: Snr
    modes: Modes
    error_voxel: Directions
    """rms over scored points and steps"""
    bias_voxel: Directions
    random_voxel: Directions
    calibration: IntervalCalibration
    """whether the predicted standard deviations are those of the errors"""
    chi2_reduced: float
    """mean square of the residuals, each over its standard deviation; 1 if they are noise only; NaN: not asked"""
    strain_rms: float
    """rms difference of measured and true strain on the axis, over steps and intervals between levels"""
    max_strain_true: float
    max_strain_measured: float
    stretch_share: float
    """share of the true stretch found at the last step; 1: all of it, NaN: there was none"""
    points_scored: int
    """material points scored in at least one step"""
    points_left_out: int
    """material points never scored: outside the observed sections, or shared by an unobserved one"""
    verdict: str
    """trusted, doubtful or failed: what the measurement says of itself, without the truth"""
    doubts: str
    """names of what speaks against it, separated by commas"""
    seconds: Seconds
    peak_memory_gib: float
    """largest memory of the process that computed, GiB; NaN where nobody noted it"""

    def to_json(self) -> str:
        """Return the scores as JSON text; what is not a number becomes null."""
        return json.dumps(_without_nan(asdict(self)), indent=2) + "\n"


@dataclass(frozen=True, kw_only=True)
class Errors:
    """The error of each material point at each step."""

    components: Floats
    """(step, point, direction) across the beam, vertical, along the beam, voxels; NaN where not scored."""

    @property
    def scored(self) -> NDArray[np.bool_]:
        """Return which points (step, point) count."""
        return np.asarray(np.all(np.isfinite(self.components), axis=2))

    def rms(self) -> Directions:
        """Return the rms over points and steps."""
        return _directions(_rms(self.components, axis=(0, 1)))

    def bias(self) -> Directions:
        """Return the rms over points of each point's mean over its scored steps."""
        per_point = np.broadcast_to(nan_mean(self.components, axis=0), self.components.shape)
        # each point counts as often as it is scored, which keeps error^2 = bias^2 + random^2 exact
        return _directions(_rms(np.where(self.scored[..., None], per_point, np.nan), axis=(0, 1)))

    def random(self) -> Directions:
        """Return the rms deviation of the errors from their point's mean."""
        return _directions(_rms(self.components - nan_mean(self.components, axis=0), axis=(0, 1)))

    def by_step(self) -> Floats:
        """Return the rms over points (step, direction), voxels."""
        return _rms(self.components, axis=1)


def point_errors(measurement: Measurement, truth: TruePoints) -> Errors:
    """Compare u(X + U, t) with U(X, t) at every material point of the truth."""
    steps = len(measurement.recording.angle_rad)
    if len(truth.displacement_mm) != steps:
        raise MeasurementError(
            f"truth: expected the {steps} steps of the measurement, found {len(truth.displacement_mm)}: "
            "do both belong to the same experiment?"
        )
    error = measured_at(measurement, current_positions(truth))
    error -= truth.displacement_mm / measurement.recording.voxel_mm
    return Errors(components=error @ beam_frame(measurement.recording.angle_rad).transpose(0, 2, 1))


def score(
    measurement: Measurement,
    truth: TruePoints,
    *,
    scenario: str | None = None,
    simulate_s: float = math.nan,
    peak_memory_gib: float = math.nan,
) -> Scores:
    """Score a measurement against the truth; what the caller knows about the run is passed through."""
    errors = point_errors(measurement, truth)
    centre = centre_line(measurement, truth)
    assert centre.true is not None
    measured, true = centre.strain(centre.measured), centre.strain(centre.true)
    scored = errors.scored.any(axis=0)
    return Scores(
        scenario=measurement.recording.title if scenario is None else scenario,
        steps=len(measurement.recording.angle_rad),
        unknowns=measurement.fit.unknowns,
        snr_db=mean_snr(measurement),
        modes=modes_found(measurement),
        error_voxel=errors.rms(),
        bias_voxel=errors.bias(),
        random_voxel=errors.random(),
        calibration=interval_calibration(measurement, truth, errors.components),
        chi2_reduced=math.nan
        if measurement.fit.residual_tests is None
        else measurement.fit.residual_tests.chi2_reduced,
        strain_rms=float(_rms(measured - true)),
        max_strain_true=_largest(true),
        max_strain_measured=_largest(measured),
        stretch_share=stretch_share(centre),
        points_scored=int(scored.sum()),
        points_left_out=int((~scored).sum()),
        verdict=measurement.verdict.word,
        doubts=", ".join(measurement.verdict.names),
        seconds=Seconds(
            simulate=simulate_s,
            reconstruct=measurement.provenance.seconds.get("reconstruct", math.nan),
            measure=measurement.provenance.seconds.get("measure", math.nan),
        ),
        peak_memory_gib=peak_memory_gib,
    )


def stretch_share(centre: CentreLine) -> float:
    """Return s of the least-squares fit u = s U + constant over the axis, at the last step that was measured.

    u and U are the vertical motion, measured and true. One: the whole stretch is found, from end to end; what a few
    heights err by hardly counts. NaN where U differs by less than `LEAST_STRETCH_VOXEL` rms from its mean.
    """
    assert centre.true is not None
    measured, true = centre.measured[..., 2], centre.true[..., 2]
    last = np.flatnonzero(np.isfinite(measured).any(axis=1))[-1:]
    known = np.isfinite(measured[last])
    stretch = true[last][known] - nan_mean(true[last][known])
    if _rms(stretch) >= LEAST_STRETCH_VOXEL:
        return float(stretch @ measured[last][known] / (stretch @ stretch))
    return math.nan


def mean_snr(measurement: Measurement) -> Snr:
    """Average each SNR history as the paper does: the mean of the decibels."""
    return Snr(
        reprojection=float(nan_mean(measurement.fit.snr_reprojection_db)),
        initial=float(nan_mean(measurement.fit.snr_initial_db)),
        rigid=float(nan_mean(measurement.fit.snr_rigid_db)),
        final=float(nan_mean(measurement.fit.snr_final_db)),
        noise_limit=float(nan_mean(measurement.fit.snr_noise_db)),
    )


def modes_found(measurement: Measurement) -> Modes:
    """Count the modes of the rigid stage, and of all section stages together."""
    found = {"rigid": 0, "deformation": 0}
    for stage in measurement.fit.stages:
        found[stage.name] += stage.modes
    return Modes(**found)


def _rms(values: Floats, axis: int | tuple[int, ...] | None = None) -> Floats:
    known = np.isfinite(values)
    squares = np.where(known, values, 0.0) ** 2
    count = known.sum(axis=axis)
    return np.where(count > 0, np.sqrt(squares.sum(axis=axis) / np.maximum(count, 1)), np.nan)


def _largest(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else math.nan


def _directions(values: Floats) -> Directions:
    across, vertical, along = (float(value) for value in values)
    return Directions(across_beam=across, vertical=vertical, along_beam=along)


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(part) for key, part in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
