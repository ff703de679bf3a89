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
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc import gauss_newton
from pdvc.compilation import compile_comparison, compile_kernels
from pdvc.data_checks import doubts_of_reference, usable
from pdvc.equations import Equations
from pdvc.experiment import Experiment, InterruptedScan
from pdvc.geometry import ConeBeam
from pdvc.history import Steps, time_basis
from pdvc.measure import versions
from pdvc.measurement import Measurement, Stage
from pdvc.options import MeasureOptions, coarse_scale, resolved
from pdvc.preparation import bases, calibrated, outlined, reference_volume, scan_volume
from pdvc.prior import LEAST_RMS, Prior
from pdvc.progress import Progress, silent
from pdvc.radiographs import IDENTITY, Calibration, snr_db
from pdvc.result_checks import doubts_of_solution
from pdvc.sections import SectionBasis
from pdvc.solution import Solution
from pdvc.store import Store
from pdvc.uncertainty import UNSEEN, sandwich
from pdvc.verdict import Stop, Verdict
from pdvc.volume import Volume, halved, smoothed
from pdvc.volume_equations import Comparison, VolumePair, compare, used_voxels
from pdvc.window import used_window

__all__ = ["MeasureOptions", "correlate"]

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
    compiling = time.perf_counter()
    compile_kernels(progress=progress)
    compile_comparison()
    started = time.perf_counter()
    # volumes are filtered here, not the radiographs
    options = resolved(options, experiment.geometry).model_copy(update={"smooth_px": 0.0})
    examined = usable(experiment, progress=progress)
    store = Store(work, experiment)
    calibration, outline = calibrated(experiment, options, store, progress)
    window = used_window(experiment.geometry, options, outline.hull)
    rigid, sections = bases(experiment.geometry, window, outline.hull, options)
    bench = _Bench(
        geometry=experiment.geometry,
        calibration=calibration,
        options=options,
        bases={"rigid": rigid, "deformation": sections},
        store=store,
    )

    def reference(scale: int) -> Volume:
        volume = reference_volume(experiment, calibration, outline.hull, scale, options, store, progress)
        return halved(smoothed(volume, SMOOTHING_VOXEL))

    references = {scale: reference(scale) for scale in bench.scales}
    prepared = time.perf_counter()
    found = {
        scan.step: store.arrays(
            "correlation",
            (scan.step, options),
            lambda scan=scan: _correlated(bench, references, scan, progress),  # type: ignore[misc]
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
    nothing = np.zeros((len(experiment.test), 0, 0), dtype=np.float32)
    measured = Measurement(
        title=experiment.title,
        voxel_mm=experiment.geometry.voxel_mm,
        source_axis_mm=experiment.geometry.source_axis_mm,
        angle_rad=experiment.test.angle_rad,
        time_s=experiment.test.time_s,
        force_N=experiment.test.force_N,
        window=window,
        basis=sections,
        time_functions=time_basis((Steps(),), experiment.test)[steps],
        amplitude=np.where(observed[:, None], at_steps("amplitude"), np.nan),
        # coefficients multiply a function that is sqrt(steps) at its scan
        covariance=np.stack([each["covariance"] for each in found.values()]) / len(experiment.test),
        amplitude_std=np.where(observed[:, None], at_steps("deviation"), np.nan),
        data_share=np.where(observed[:, None], at_steps("data_share"), 0.0),
        observed=observed,
        stages=_stages(bench, found, len(experiment.test)),
        snr_reprojection_db=np.empty(0),
        snr_initial_db=at_steps("snr_initial"),
        snr_rigid_db=at_steps("snr_rigid"),
        snr_final_db=at_steps("snr_final"),
        snr_noise_db=np.full(len(experiment.test), np.nan),
        residual_initial=nothing,
        residual_rigid=nothing,
        residual_final=nothing,
        seconds={
            "compile": started - compiling,
            "reconstruct": prepared - started + float(reconstructing),
            "measure": float(measuring),
        },
        options=options.template(),
        versions=versions(),
    )
    doubts = (*doubts_of_reference(examined, experiment), *doubts_of_solution(measured, options.prior_voxel))
    return replace(measured, verdict=Verdict(doubts=doubts))


@dataclass(frozen=True, kw_only=True)
class _Bench:
    """Hold what all scans have in common."""

    geometry: ConeBeam
    calibration: Calibration
    options: MeasureOptions
    bases: Mapping[str, SectionBasis]
    """By the name of the stage: ``rigid``, ``deformation``."""
    store: Store

    @property
    def stages(self) -> tuple[tuple[str, int], ...]:
        """Return name and scale of the stages, in the order carried out."""
        coarse = coarse_scale(self.geometry)
        finer = (coarse >> n for n in range(coarse.bit_length()))
        return (("rigid", coarse), *(("deformation", scale) for scale in finer))

    @property
    def scales(self) -> tuple[int, ...]:
        """Return the scales of the stages, coarsest first."""
        return tuple(dict.fromkeys(scale for _, scale in self.stages))

    def pairs(
        self, references: Mapping[int, Volume], scan: InterruptedScan, progress: Progress
    ) -> dict[int, VolumePair]:
        """Reconstruct an interrupted scan, inside the hull that its own views show, to be compared."""
        series, calibration = scan.series, self.calibration
        outline = outlined(
            series,
            self.geometry,
            calibration.with_polynomial(IDENTITY),
            calibration.polynomial,
            partial(self.store.arrays, "outline", (scan.step, calibration)),
            progress,
        )
        low, high = self.bases["deformation"].height_mm[[0, -1]]

        def pair(scale: int) -> VolumePair:
            keep = partial(self.store.arrays, "volume", (scan.step, scale, calibration, outline.hull))
            volume = scan_volume(series, self.geometry, calibration, outline.hull, scale, 0.0, keep, progress)
            return VolumePair(
                reference=references[scale],
                deformed=smoothed(volume, SMOOTHING_VOXEL),
                used=used_voxels(volume.grid, outline.hull, float(low), float(high)),
                voxel_mm=self.geometry.voxel_mm,
            )

        return {scale: pair(scale) for scale in self.scales}


def _correlated(
    bench: _Bench, references: Mapping[int, Volume], scan: InterruptedScan, progress: Progress
) -> dict[str, NDArray[Any]]:
    """Measure one scan: the amplitudes and all that is told of them, as arrays."""

    def named(task: str, done: int, total: int) -> None:
        progress(f"scan at step {scan.step}: {task}", done, total)

    started = time.perf_counter()
    try:
        pairs = bench.pairs(references, scan, named)
    except ValueError as error:
        raise ValueError(f"interrupted scan at step {scan.step}: {error}") from None
    solving = time.perf_counter()
    solutions: list[Solution] = []
    amplitude = np.zeros(bench.bases["rigid"].shape)
    for name, scale in bench.stages:
        basis = bench.bases[name]
        if len(solutions) == 1:
            rigid = amplitude
            amplitude = basis.rigid(rigid, bench.bases["rigid"])
        prior = _prior(basis, bench.options)
        solutions.append(_solved(pairs[scale], basis, amplitude, prior, f"{name}, scale {scale}", named))
        amplitude = solutions[-1].coefficients[0]
    fine = pairs[1]
    last = compare(fine, basis, amplitude)
    covariance = _covariance(last, prior)
    information = np.diag(last.equations().matrix[0]).reshape(basis.shape).sum(axis=1)
    deviation = np.sqrt(np.diag(covariance)).reshape(basis.shape)
    before = compare(fine, basis, np.zeros(basis.shape))
    moved = compare(fine, basis, basis.rigid(rigid, bench.bases["rigid"]))
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


def _prior(basis: SectionBasis, options: MeasureOptions) -> Prior:
    return Prior(deviation_voxel=np.full(basis.shape, options.prior_voxel))


def _covariance(comparison: Comparison, prior: Prior) -> Floats:
    """Return the covariance (section * motion, the same), voxel^2, of the amplitudes at a comparison."""
    equations = comparison.equations()
    gamma2 = max(equations.rms, LEAST_RMS) ** 2
    return sandwich(equations.matrix[0], comparison.vector_covariance(), prior.ridge(equations.rms), gamma2)


def _stages(bench: _Bench, found: Mapping[int, Mapping[str, NDArray[Any]]], steps: int) -> tuple[Stage, ...]:
    """Return the record of each stage, all scans together."""
    scans = list(found.values())
    result = []
    for n, (name, scale) in enumerate(bench.stages):
        shape = bench.bases[name].shape
        squares = sum(scan["voxels"][n] * scan["rms"][n] ** 2 for scan in scans)
        unfinished = any(scan["stops"][n] == Stop.UNFINISHED for scan in scans)
        result.append(
            Stage(
                name=name,
                scale=scale,
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
