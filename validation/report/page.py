"""The report: one self-contained HTML page, its figures also as files, for a reader who did not run it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pdvc.experiment import Experiment
from pdvc.measurement import Measurement
from pdvc.verdict import listed
from validation.report.figures import save
from validation.report.pictures import of_volumes, pictures
from validation.report.sentences import (
    calibration_sentences,
    nees_sentence,
    noise_known,
    phase_table,
    residual_sentences,
    trust_table,
)
from validation.report.template import template
from validation.scoring.centre_line import TruePoints, centre_line, nan_mean
from validation.scoring.interval_calibration import ONSET_STEPS
from validation.scoring.noise_floor import LEAST_STEPS, NoiseFloor, noise_floor
from validation.scoring.scores import Directions, Scores, mean_snr, modes_found

BELIEVED = {
    "trusted": "Nothing that was checked in the data, the residual or the motion speaks against the measured motion. "
    "How far its standard deviations may be relied on is another question: see below.",
    "doubtful": "The motion may be right; look at each of these before it is used.",
    "failed": "Nothing below is to be believed.",
}
"""What each word of a verdict means to a reader."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the summary table, as text."""

    name: str
    here: str
    paper: str = ""


def write_report(
    folder: Path,
    measurement: Measurement,
    *,
    experiment: Experiment | None = None,
    truth: TruePoints | None = None,
    scores: Scores | None = None,
) -> Path:
    """Write report.html and figures/*.png into the folder; returns the page's path.

    Without a truth the page shows the measurement alone; without the experiment it lacks the radiographs.
    """
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    shown = []
    for picture in pictures(measurement, experiment, truth):
        data = save(picture.figure, folder / "figures" / f"{picture.name}.png", dpi=130)
        shown.append({"name": picture.name, "caption": picture.caption, "data": data})
    page = folder / "report.html"
    partial = page.with_name(page.name + ".partial")
    partial.write_text(_page(measurement, truth, scores, shown), encoding="utf-8")
    partial.replace(page)
    return page


def _page(
    measurement: Measurement, truth: TruePoints | None, scores: Scores | None, shown: list[dict[str, str]]
) -> str:
    floor = noise_floor(measurement, truth)
    return template("report.html").render(
        title=scores.scenario if scores else measurement.recording.title,
        m=measurement,
        volumes=of_volumes(measurement),
        measured=int(np.isfinite(measurement.motion.amplitude).any(axis=(1, 2)).sum()),
        scores=scores,
        verdict=measurement.verdict,
        listed=listed,
        believed=BELIEVED[measurement.verdict.word],
        rows=summary_rows(measurement, scores),
        errors=_error_table(scores, measurement.recording.voxel_mm * 1e3) if scores else [],
        trust=trust_table(scores) if scores else [],
        phases=phase_table(scores) if scores else [],
        onset_steps=ONSET_STEPS,
        nees=nees_sentence(scores.calibration) if scores else "",
        calibration=calibration_sentences(measurement, scores, truth) if scores else [],
        residual=residual_sentences(
            measurement.fit.residual_tests, noise_known=noise_known(measurement), truth_known=scores is not None
        ),
        pictures=shown,
        floor=floor,
        floor_lines=_floor_table(floor, scores) if floor else [],
        least_steps=LEAST_STEPS,
        motions=_observability(measurement),
        unobserved=[f"{z:.2f}" for z in measurement.motion.basis.height_mm[~measurement.motion.observed]],
        voxel_um=f"{measurement.recording.voxel_mm * 1e3:.2f}",
    )


def summary_rows(measurement: Measurement, scores: Scores | None) -> list[Row]:
    """Return the lines of the summary, beside the paper's numbers where it has one."""
    snr = mean_snr(measurement)
    modes = modes_found(measurement)
    strain = scores.max_strain_measured if scores else _largest_strain(measurement)
    rows = [
        Row(name="SNR re-projection, dB", here=_number(snr.reprojection, 2), paper="21.70"),
        Row(name="SNR initial, dB", here=_number(snr.initial, 2), paper="9.94"),
        Row(name="SNR after rigid motions, dB", here=_number(snr.rigid, 2), paper="25.4"),
        Row(name="SNR final, dB", here=_number(snr.final, 2), paper="26.7"),
        Row(name="SNR that noise alone would leave, dB", here=_number(snr.noise_limit, 2)),
        Row(name="rigid modes", here=str(modes.rigid), paper="8"),
        Row(name="deformation modes", here=str(modes.deformation), paper="4"),
        Row(name="steps", here=str(len(measurement.recording.angle_rad)), paper="127"),
        Row(name="unknowns", here=str(measurement.fit.unknowns), paper="630"),
        Row(name="extension, voxel", here=_number(_extension(measurement), 1), paper="about 15"),
        Row(name="largest strain measured, %", here=_number(strain * 100, 2), paper="8 to 9"),
    ]
    return rows + (_score_rows(scores) if scores else [])


def _score_rows(scores: Scores) -> list[Row]:
    return [
        Row(name="largest strain true, %", here=_number(scores.max_strain_true * 100, 2)),
        Row(name="strain error, rms", here=f"{scores.strain_rms:.2e}"),
    ]


def _error_table(scores: Scores, voxel_um: float) -> list[list[str]]:
    """Return a line for each direction: error in voxels and micrometres, bias and random part in voxels."""
    return [
        [
            key.replace("_", " "),
            _number(getattr(scores.error_voxel, key), 4),
            _number(getattr(scores.error_voxel, key) * voxel_um, 3),
            _number(getattr(scores.bias_voxel, key), 4),
            _number(getattr(scores.random_voxel, key), 4),
        ]
        for key in ("across_beam", "vertical", "along_beam")
    ]


def _floor_table(floor: NoiseFloor, scores: Scores | None) -> list[list[str]]:
    """Return a line for each number of the noise floor, and of the true error beside it, voxels."""
    lines: list[tuple[str, Directions]] = [
        ("scatter over the steps (temporal)", floor.temporal_voxel),
        ("scatter over the points (spatial)", floor.spatial_voxel),
    ]
    if floor.true is not None:
        lines += [
            ("true error, scatter over the same steps", floor.true.scatter_voxel),
            ("true error over the same steps, rms", floor.true.rms_voxel),
        ]
    if scores is not None:
        lines.append(("true error over the whole test, rms", scores.error_voxel))
    return [
        [name, _number(part.across_beam, 4), _number(part.vertical, 4), _number(part.along_beam, 4)]
        for name, part in lines
    ]


def _extension(measurement: Measurement) -> float:
    """Return the largest difference of u_z between the ends of the observed axis, voxels."""
    centre = centre_line(measurement)
    vertical = centre.measured[:, centre.always_observed, 2]
    return float(np.nanmax(np.abs(vertical[:, -1] - vertical[:, 0]))) if vertical.shape[1] > 1 else math.nan


def _largest_strain(measurement: Measurement) -> float:
    """Return the largest strain between sections at any step, of the reference length."""
    centre = centre_line(measurement)
    current = centre.strain(centre.measured)
    known = current[np.isfinite(current)]
    # u is known against the current height z: du/dz = e / (1 + e)
    return float((known / (1 - known)).max()) if known.size else math.nan


def _observability(measurement: Measurement) -> list[dict[str, str]]:
    share = measurement.motion.data_share[:, measurement.motion.observed]
    spread = measurement.motion.amplitude_std[:, measurement.motion.observed]
    return [
        {
            "name": name.replace("_", " "),
            "share": _number(float(nan_mean(share[..., k])) * 100, 1),
            "lowest": _number(float(np.nanmin(share[..., k])) * 100, 1) if np.isfinite(share[..., k]).any() else "—",
            "std": _number(float(nan_mean(spread[..., k])), 3),
        }
        for k, name in enumerate(measurement.motion.basis.names)
    ]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "—"
