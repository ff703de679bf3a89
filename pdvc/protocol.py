"""The protocol (section 4): calibrate, reconstruct, rigid stage at a coarse scale, section stage at scale 1.

Everything that takes long reports its progress; with a work folder, volumes and the rigid stage are kept there, so
that an interrupted measurement goes on where it was.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.compilation import compile_kernels
from pdvc.data_checks import doubts_of_data, doubts_of_time, usable
from pdvc.deviations import step_covariance, turned_std
from pdvc.equations import Equations, check_size, linearise, residuals
from pdvc.experiment import Experiment
from pdvc.history import settled
from pdvc.measurement import Fit, MeasuredMotion, Measurement, Provenance, Stage
from pdvc.noise import known_from_residual, propagate
from pdvc.options import DEFAULT, MeasureOptions, ResolvedStage, check_discarded
from pdvc.preparation import Prepared, noise_of, prepare, snr_of
from pdvc.progress import Progress, silent
from pdvc.result_checks import check_finite, doubts_of_result
from pdvc.sections import SectionBasis
from pdvc.setup import Setup, set_up
from pdvc.solution import Problem, Solution
from pdvc.uncertainty import posterior
from pdvc.verdict import Stop, Verdict, explained_by
from pdvc.volume import Volume

Floats = NDArray[np.float64]


def measure(
    experiment: Experiment, options: MeasureOptions = DEFAULT, *, progress: Progress = silent, work: Path | None = None
) -> Measurement:
    """Measure the motion of the sample in an experiment.

    Raises ValueError, in one line, where the data cannot be used, or what is found is not finite. `work` is a folder
    for intermediate results; they are used again only with the same experiment and options.
    """
    check_discarded(options, experiment.geometry)
    compiling = time.perf_counter()
    compile_kernels(progress=progress)
    compiling = time.perf_counter() - compiling
    examining = time.perf_counter()
    examined = usable(experiment, progress=progress)
    time_parts = settled(options.time, experiment.test)
    doubts = (*doubts_of_data(examined, experiment), *doubts_of_time(time_parts, experiment.test))
    examining = time.perf_counter() - examining
    with explained_by(doubts):
        found, volume = _measured(experiment, options, work, progress)
    after = doubts_of_result(found, volume, experiment.geometry, options.prior_voxel)
    verdict = Verdict(doubts=(*doubts, *after))
    with explained_by(verdict.doubts):
        check_finite(found)
    seconds = {"compile": compiling, "examine": examining, **found.provenance.seconds}
    return replace(found, verdict=verdict, provenance=replace(found.provenance, seconds=seconds))


def _measured(
    experiment: Experiment, options: MeasureOptions, work: Path | None, progress: Progress
) -> tuple[Measurement, Volume]:
    """Return a measurement without a verdict, and the reference volume at scale 1."""
    started = time.perf_counter()
    setup = set_up(experiment, options, work=work, progress=progress)
    rigid, sections, time_functions = setup.rigid, setup.sections, setup.time_functions()
    check_size(time_functions, sections)
    prepared = {scale: prepare(setup, scale, progress) for scale in setup.options.scales}
    fine = prepared[1]
    solving = time.perf_counter()
    solver = _Protocol(setup, prepared, time_functions, progress)
    still = np.zeros((len(time_functions), *rigid.shape))
    start = solver.run("rigid", rigid, setup.options.rigid, still, to_noise=False)
    start = sections.reproduced(start, rigid)
    standing = np.zeros((len(experiment.test), *sections.shape))
    initial = residuals(fine.images, sections, standing, progress=progress, task="initial residual")
    moved = np.einsum("ft,fjk->tjk", time_functions, start)
    after_rigid = residuals(fine.images, sections, moved, progress=progress, task="rigid residual")
    coefficients = solver.run("deformation", sections, setup.options.deformation, start, to_noise=True)
    equations = solver.equations_at(sections, coefficients)
    amplitude = np.einsum("ft,fjk->tjk", time_functions, coefficients)
    propagating = time.perf_counter()
    noise = noise_of(setup, fine) or known_from_residual(
        equations.rms, fine.systematic.shape, fine.systematic.fields.shape[1:], setup.options.smooth_px
    )
    propagated = propagate(
        fine.images,
        fine.systematic,
        sections,
        amplitude,
        time_functions,
        noise,
        equations.residual,
        progress=progress,
    )
    task = f"covariance of {len(time_functions) * standing[0].size} unknowns"
    progress(task, 0, 1)
    known = posterior(equations, time_functions, setup.prior(sections), propagated.parts)
    progress(task, 1, 1)
    amplitude[:, ~known.observed] = np.nan
    snr = snr_of(fine.images)
    ended = time.perf_counter()
    found = Measurement(
        recording=setup.recording(),
        motion=MeasuredMotion(
            basis=sections,
            time_functions=time_functions,
            amplitude=amplitude,
            covariance=known.covariance,
            amplitude_std=np.where(known.observed[:, None], known.deviation, np.nan),
            data_share=np.where(known.observed[:, None], known.data_share, 0.0),
            observed=known.observed,
            std_by_source={
                name: _on_the_axis(part, sections, known.observed, time_functions, experiment.test.angle_rad)
                for name, part in known.by_source.items()
            },
        ),
        fit=Fit(
            stages=tuple(solver.stages),
            snr_reprojection_db=fine.snr_reprojection_db,
            snr_initial_db=snr(initial),
            snr_rigid_db=snr(after_rigid),
            snr_final_db=snr(equations.residual),
            snr_noise_db=fine.snr_noise_db,
            residual_initial=initial,
            residual_rigid=after_rigid,
            residual_final=equations.residual,
            residual_tests=propagated.tests,
        ),
        provenance=Provenance(
            seconds={
                "reconstruct": solving - started,
                "measure": propagating - solving,
                "uncertainty": ended - propagating,
            },
            options=setup.options.template(),
            versions=versions(),
        ),
    )
    return found, fine.images.volume


def _on_the_axis(
    covariance: Floats, basis: SectionBasis, observed: NDArray[np.bool_], time_functions: Floats, angle_rad: Floats
) -> tuple[float, float, float]:
    """Return the rms standard deviations of u on the axis, over steps and observed sections, in three directions."""
    points = np.zeros((int(observed.sum()), 3))
    points[:, 2] = basis.height_mm[observed]
    found = [
        turned_std(basis, step_covariance(covariance, time_functions, t), float(angle), points)
        for t, angle in enumerate(angle_rad)
    ]
    across, vertical, along = np.sqrt((np.concatenate(found) ** 2).mean(axis=0)).tolist()
    return across, vertical, along


class _Protocol:
    """The stages of a measurement, one after the other: what each found, and the last equations."""

    def __init__(
        self, setup: Setup, prepared: Mapping[int, Prepared], time_functions: Floats, progress: Progress
    ) -> None:
        self.stages: list[Stage] = []
        self._setup = setup
        self._prepared = prepared
        self._time_functions = time_functions
        self._progress = progress
        self._last: tuple[Floats, Equations] | None = None

    def run(
        self, name: str, basis: SectionBasis, stages: tuple[ResolvedStage, ...], start: Floats, *, to_noise: bool
    ) -> Floats:
        """Solve the stages in turn from a start (function, section, motion), voxels; return where they end."""
        for stage in stages:
            kept = self._setup.store.arrays(
                "stage",
                (name, self._setup.options, stage, basis, self._time_functions, start),
                lambda stage=stage, start=start: _packed(self._solved(name, basis, stage, start, to_noise)),  # type: ignore[misc]
            )
            self.stages.append(
                Stage(
                    name=name,
                    scale=stage.scale,
                    solver=stage.solver.kind,
                    unknowns=len(self._time_functions) * basis.shape[0] * basis.shape[1],
                    temporal=kept["temporal"],
                    spatial=kept["spatial"],
                    rms=kept["rms"],
                    stop=Stop(str(kept["stop"])),
                    stop_reason=str(kept["stop_reason"]),
                    last_change_voxel=float(kept["last_change"]),
                )
            )
            start = kept["coefficients"]
        return start

    def equations_at(self, basis: SectionBasis, coefficients: Floats) -> Equations:
        """Return the equations of scale 1 at a solution: the last pass, unless that was in an earlier run."""
        if self._last is not None and np.array_equal(self._last[0], coefficients):
            return self._last[1]
        amplitude = np.einsum("ft,fjk->tjk", self._time_functions, coefficients)
        return linearise(self._prepared[1].images, basis, amplitude, progress=self._progress, task="last pass")

    def _solved(self, name: str, basis: SectionBasis, stage: ResolvedStage, start: Floats, to_noise: bool) -> Solution:
        prepared, passes = self._prepared[stage.scale], 0

        def at(amplitude: Floats) -> Equations:
            nonlocal passes
            passes += 1
            task = f"{name}, scale {stage.scale}, pass {passes}"
            return linearise(prepared.images, basis, amplitude, progress=self._progress, task=task)

        solution = stage.solver.solve(
            Problem(
                linearise=at,
                time_functions=self._time_functions,
                start=start,
                prior=self._setup.prior(basis),
                # as long as the sample only moves as a whole, what is left is not noise
                noise_rms=prepared.noise_rms if to_noise else None,
            )
        )
        self._last = (solution.coefficients, solution.equations)
        return solution


def _packed(solution: Solution) -> dict[str, NDArray[Any]]:
    return {
        "coefficients": solution.coefficients,
        "temporal": solution.temporal,
        "spatial": solution.spatial,
        "rms": solution.rms,
        "stop": np.array(str(solution.stop)),
        "stop_reason": np.array(solution.stop_reason),
        "last_change": np.array(solution.last_change_voxel),
    }


def versions() -> str:
    """Return the versions of this package and of the libraries that compute."""
    names = ("pdvc-bench", "numpy", "scipy", "numba")
    return ", ".join(f"{name} {version(name)}" for name in names) + f", Python {platform.python_version()}"
