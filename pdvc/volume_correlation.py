"""Classical digital volume correlation of interrupted scans, with the same sections as the measurement by radiographs.

Every interrupted scan is reconstructed as the reference scan is, with the same calibration, and compared with it voxel
by voxel (`pdvc.volume_equations`), over the sample's hull in the scan itself and the used height:

1. the sample moves as one rigid body, at the coarse scale;
2. every section by itself, at the coarse scale and at each finer one, down to scale 1.

Each scan starts from rest, so that no result depends on another scan. All stages take Gauss-Newton steps until they
converge.

Both volumes pass the same Gaussian filter, and the reference volume is then interpolated by cubic splines to half the
voxel. Between its voxels trilinear interpolation blurs an image, the more the farther from a voxel, and the blur is
mistaken for motion towards the next whole voxel: by up to 0.03 voxel in `quick`. Filter and splines leave 0.004.

Of MeasureOptions this uses `discard_rows`, `sections`, `section_motions`, `beam_hardening` and `prior_voxel`. All else
concerns radiographs or time.

The standard deviations hold the noise of both volumes, correlated as it is within blocks, and of what the model cannot
follow the part that varies from block to block. The noise of the reference volume is the same for all scans: their
errors are not quite independent.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc import gauss_newton
from pdvc.compilation import compile_comparison, compile_kernels
from pdvc.data_checks import cleared, doubts_of_reference, usable
from pdvc.equations import Equations
from pdvc.experiment import Experiment, InterruptedScan
from pdvc.history import Steps, time_basis
from pdvc.measurement import MeasuredMotion, Measurement, Provenance, Stage, unfitted
from pdvc.options import MeasureOptions, check_discarded, coarse_scale
from pdvc.preparation import Care, reference_volume, scan_volume
from pdvc.prior import LEAST_RMS, Prior
from pdvc.progress import Progress, silent
from pdvc.protocol import versions
from pdvc.radiographs import IDENTITY, snr_db
from pdvc.result_checks import doubts_of_solution
from pdvc.sections import SectionBasis
from pdvc.setup import Setup, outlined, set_up
from pdvc.solution import Solution
from pdvc.threads import one_thread
from pdvc.uncertainty import UNSEEN, sandwich
from pdvc.verdict import Stop, Verdict
from pdvc.volume import Volume, halved, smoothed
from pdvc.volume_equations import VolumeComparison, VolumePair, compare, used_voxels

Floats = NDArray[np.float64]

SMOOTHING_VOXEL = 0.7
"""Standard deviation of the filter of both volumes, voxels of the scale."""
MOST_PASSES = 30
LEAST_CHANGE_VOXEL = 2e-3
SOLVER = "volume correlation"


def correlate(
    experiment: Experiment, options: MeasureOptions, *, progress: Progress = silent, work: Path | None = None
) -> Measurement:
    """Measure the motion of the sample at the steps of its interrupted scans; other steps are NaN.

    The record is that of a measurement by radiographs, with these differences. `time_functions` has one function for
    each scan, zero at the other steps. SNRs compare volumes, 20 log10(std(G) / std(rho)) over the used voxels, both
    filtered; those of noise and re-projection are not known (NaN, or empty). Residual fields are empty: (step, 0, 0).
    A stage holds all scans, with their rms residual (grey levels / mm) before and after.

    Raises ValueError, in one line, where there is no scan or one cannot be used. `work` is a folder for intermediate
    results; they are used again only with the same experiment and options.
    """
    if not experiment.interrupted:
        raise ValueError(
            "interrupted scans: expected at least one [[interrupted]] entry in experiment.toml, found none: volume "
            "correlation compares full scans"
        )
    check_discarded(options, experiment.geometry)
    compiling = time.perf_counter()
    compile_kernels(progress=progress)
    compile_comparison()
    started = time.perf_counter()
    # volumes are filtered here, not the radiographs
    examined = usable(experiment, progress=progress)
    options = options.model_copy(update={"smooth_px": 0.0, "sharpen": False})
    with one_thread():
        setup = set_up(experiment, options, work=work, progress=progress)
        stages = _stages_of(setup)

        def reference(scale: int) -> Volume:
            return halved(smoothed(reference_volume(setup, scale, progress), SMOOTHING_VOXEL))

        references = {scale: reference(scale) for scale in dict.fromkeys(stage.scale for stage in stages)}
        prepared = time.perf_counter()
        found = {
            scan.step: setup.store.arrays(
                "correlation",
                (scan.step, setup.options, setup.sections),
                lambda scan=scan: _correlated(setup, references, scan, progress),  # type: ignore[misc]
            )
            for scan in experiment.interrupted
        }
    steps = list(found)

    observed = np.any([each["observed"] for each in found.values()], axis=0)

    def at_steps(name: str) -> Floats:
        """Spread what was found at the scans over all steps, NaN between."""
        values = np.stack([each[name] for each in found.values()])
        result = np.full((len(experiment.test), *values.shape[1:]), np.nan)
        result[steps] = values
        return result

    reconstructing, measuring = np.sum([each["seconds"] for each in found.values()], axis=0)
    measured = Measurement(
        recording=setup.recording(),
        motion=MeasuredMotion(
            basis=setup.sections,
            time_functions=time_basis((Steps(),), experiment.test)[steps],
            amplitude=np.where(observed[:, None], at_steps("amplitude"), np.nan),
            # coefficients multiply a function that is sqrt(steps) at its scan
            covariance=np.stack([each["covariance"] for each in found.values()]) / len(experiment.test),
            amplitude_std=np.where(observed[:, None], at_steps("deviation"), np.nan),
            data_share=np.where(observed[:, None], at_steps("data_share"), 0.0),
            observed=observed,
        ),
        fit=replace(
            unfitted(_records(stages, found, len(experiment.test)), len(experiment.test)),
            snr_initial_db=at_steps("snr_initial"),
            snr_rigid_db=at_steps("snr_rigid"),
            snr_final_db=at_steps("snr_final"),
        ),
        provenance=Provenance(
            seconds={
                "compile": started - compiling,
                "reconstruct": prepared - started + float(reconstructing),
                "measure": float(measuring),
            },
            options=setup.options.template(),
            versions=versions(),
        ),
        correction=setup.correction,
    )
    before = cleared(doubts_of_reference(examined, experiment), setup.correction)
    doubts = (*before, *doubts_of_solution(measured, options.prior_voxel))
    return replace(measured, verdict=Verdict(doubts=doubts))


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """A stage of the correlation of a scan."""

    name: str
    """``rigid`` or ``deformation``."""
    scale: int
    basis: SectionBasis


def _stages_of(setup: Setup) -> tuple[_Stage, ...]:
    """Return the stages in the order carried out: rigid at the coarse scale, then sections down to scale 1."""
    coarse = coarse_scale(setup.geometry)
    finer = (coarse >> n for n in range(coarse.bit_length()))
    return (
        _Stage(name="rigid", scale=coarse, basis=setup.rigid),
        *(_Stage(name="deformation", scale=scale, basis=setup.sections) for scale in finer),
    )


def _pairs(
    setup: Setup, references: Mapping[int, Volume], scan: InterruptedScan, progress: Progress
) -> dict[int, VolumePair]:
    """Reconstruct an interrupted scan, inside the hull that its own views show, to be compared at each scale."""
    series, calibration = scan.series, setup.calibration
    outline = outlined(
        series,
        setup.geometry,
        calibration.with_polynomial(IDENTITY),
        calibration.polynomial,
        partial(setup.store.arrays, "outline", (scan.step, calibration)),
        progress,
    )
    low, high = setup.sections.height_mm[[0, -1]]

    def pair(scale: int) -> VolumePair:
        keep = partial(setup.store.arrays, "volume", (scan.step, scale, calibration, outline.hull))
        volume = scan_volume(series, setup.geometry, calibration, outline.hull, scale, Care(), keep, progress)
        return VolumePair(
            reference=references[scale],
            deformed=smoothed(volume, SMOOTHING_VOXEL),
            used=used_voxels(volume.grid, outline.hull, float(low), float(high)),
            voxel_mm=setup.geometry.voxel_mm,
        )

    return {scale: pair(scale) for scale in references}


def _correlated(
    setup: Setup, references: Mapping[int, Volume], scan: InterruptedScan, progress: Progress
) -> dict[str, NDArray[Any]]:
    """Measure one scan: the amplitudes and all that is told of them, as arrays."""

    def named(task: str, done: int, total: int) -> None:
        progress(f"scan at step {scan.step}: {task}", done, total)

    started = time.perf_counter()
    try:
        pairs = _pairs(setup, references, scan, named)
    except ValueError as error:
        raise ValueError(f"interrupted scan at step {scan.step}: {error}") from None
    solving = time.perf_counter()
    basis, prior = setup.sections, setup.prior(setup.sections)
    solutions: list[Solution] = []
    amplitude = np.zeros(setup.rigid.shape)
    for stage in _stages_of(setup):
        if len(solutions) == 1:
            amplitude = rigid = basis.reproduced(amplitude, setup.rigid)
        task = f"{stage.name}, scale {stage.scale}"
        believed = setup.prior(stage.basis)
        solutions.append(_solved(pairs[stage.scale], stage.basis, amplitude, believed, task, named))
        amplitude = solutions[-1].coefficients[0]
    fine = pairs[1]
    last = compare(fine, basis, amplitude)
    covariance = _covariance(last, prior)
    information = np.diag(last.equations().matrix[0]).reshape(basis.shape).sum(axis=1)
    deviation = np.sqrt(np.diag(covariance)).reshape(basis.shape)
    before = compare(fine, basis, np.zeros(basis.shape))
    moved = compare(fine, basis, rigid)
    return {
        "amplitude": amplitude,
        "covariance": covariance,
        "deviation": deviation,
        "data_share": np.clip(1 - (deviation / prior.deviation_voxel) ** 2, 0, 1),
        "observed": information > UNSEEN * np.median(information),
        "snr_initial": np.array(snr_db(fine.deformed.values, before.residual, fine.used)),
        "snr_rigid": np.array(snr_db(fine.deformed.values, moved.residual, fine.used)),
        "snr_final": np.array(snr_db(fine.deformed.values, last.residual, fine.used)),
        "rms": np.array([solution.rms[[0, -1]] for solution in solutions]),
        "voxels": np.array([solution.equations.pixels for solution in solutions]),
        "stops": np.array([str(solution.stop) for solution in solutions]),
        "reasons": np.array([solution.stop_reason for solution in solutions]),
        "seconds": np.array([solving - started, time.perf_counter() - solving]),
    }


def _solved(
    pair: VolumePair, basis: SectionBasis, start: Floats, prior: Prior, task: str, progress: Progress
) -> Solution:
    passes = 0

    def at(amplitude: Floats) -> Equations:
        nonlocal passes
        passes += 1
        progress(f"{task}, pass {passes}", 1, 1)
        return compare(pair, basis, amplitude[0]).equations()

    # one state by itself: one step, and one time function that is one there
    return gauss_newton.solve(
        at,
        np.ones((1, 1)),
        start[None],
        prior,
        most_passes=MOST_PASSES,
        least_change_voxel=LEAST_CHANGE_VOXEL,
    )


def _covariance(comparison: VolumeComparison, prior: Prior) -> Floats:
    """Return the covariance (section * motion, the same), voxel^2, of the amplitudes at a comparison."""
    equations = comparison.equations()
    gamma2 = max(equations.rms, LEAST_RMS) ** 2
    return sandwich(equations.matrix[0], comparison.vector_covariance(), prior.ridge(equations.rms), gamma2)


def _records(
    stages: Sequence[_Stage], found: Mapping[int, Mapping[str, NDArray[Any]]], steps: int
) -> tuple[Stage, ...]:
    """Return the record of each stage, all scans together."""
    scans = list(found.values())
    result = []
    for n, stage in enumerate(stages):
        shape = stage.basis.shape
        squares = sum(scan["voxels"][n] * scan["rms"][n] ** 2 for scan in scans)
        unfinished = any(scan["stops"][n] == Stop.UNFINISHED for scan in scans)
        result.append(
            Stage(
                name=stage.name,
                scale=stage.scale,
                solver=SOLVER,
                unknowns=len(scans) * shape[0] * shape[1],
                temporal=np.empty((0, steps)),
                spatial=np.empty((0, *shape)),
                rms=np.sqrt(squares / sum(scan["voxels"][n] for scan in scans)),
                stop=Stop.UNFINISHED if unfinished else Stop.CONVERGED,
                stop_reason="; ".join(f"step {step}: {scan['reasons'][n]}" for step, scan in found.items()),
            )
        )
    return tuple(result)
