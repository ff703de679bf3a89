"""The protocol (section 4): calibrate, reconstruct, rigid stage at a coarse scale, section stage at scale 1.

Everything that takes long reports its progress; with a work folder, volumes and the rigid stage are kept there, so
that an interrupted measurement goes on where it was.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.cells import Cells, Spot
from pdvc.compilation import compile_kernels
from pdvc.correction import corrected
from pdvc.data_checks import cleared, doubts_of_data, doubts_of_time, usable
from pdvc.deviations import beam_frame, step_covariance
from pdvc.equations import Equations, check_size, linearise, residuals
from pdvc.experiment import Experiment
from pdvc.history import settled
from pdvc.measurement import Fit, MeasuredMotion, Measurement, Provenance, Stage
from pdvc.noise import Noise, Propagated, propagate
from pdvc.options import DEFAULT, MeasureOptions, ResolvedStage, check_discarded
from pdvc.outliers import ROUNDS, outliers, unchanged
from pdvc.pattern import Pattern
from pdvc.preparation import Prepared, prepare, snr_of, snr_reprojection
from pdvc.progress import Progress, silent
from pdvc.residual_tests import residual_tests
from pdvc.result_checks import check_finite, doubts_of_result, doubts_of_spots
from pdvc.scanner_checks import doubts_of_scanner
from pdvc.sections import SectionBasis
from pdvc.setup import Setup, set_up
from pdvc.solution import Known, Problem, Solution
from pdvc.threads import one_thread
from pdvc.uncertainty import posterior, stated
from pdvc.verdict import Doubt, Stop, Verdict, explained_by
from pdvc.volume import Volume
from pdvc.without_pattern import Cleared, without_pattern

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


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
    with one_thread(), explained_by(doubts):
        found, volume, spots, of_scanner = _measured(experiment, options, work, progress)
    geometry = experiment.geometry
    if found.correction is not None:
        geometry = corrected(geometry, found.correction.values_px)
    doubts = cleared(doubts, found.correction)
    after = doubts_of_result(found, volume, geometry, options.prior_voxel)
    verdict = Verdict(doubts=(*doubts, *of_scanner, *after, *doubts_of_spots(spots)))
    with explained_by(verdict.doubts):
        check_finite(found)
    seconds = {"compile": compiling, "examine": examining, **found.provenance.seconds}
    return replace(found, verdict=verdict, provenance=replace(found.provenance, seconds=seconds))


def _measured(
    experiment: Experiment, options: MeasureOptions, work: Path | None, progress: Progress
) -> tuple[Measurement, Volume, list[Spot], tuple[Doubt, ...]]:
    """Return a measurement without a verdict, the reference volume at scale 1, what is new at each step, and doubts.

    These are about the scanner, which may have changed between reference scan and test.
    """
    started = time.perf_counter()
    setup = set_up(experiment, options, work=work, progress=progress)
    rigid, sections, time_functions = setup.rigid, setup.sections, setup.time_functions()
    check_size(time_functions, sections)
    prepared = {scale: prepare(setup, scale, progress) for scale in setup.options.scales}
    fine = prepared[1]
    solving = time.perf_counter()
    solver = _Protocol(setup, prepared, time_functions, progress)
    still = np.zeros((len(time_functions), *rigid.shape))
    start = solver.run("rigid", rigid, setup.options.rigid, still, to_noise=False).coefficients
    start = sections.reproduced(start, rigid)
    standing = np.zeros((len(experiment.test), *sections.shape))
    initial = residuals(fine.images, sections, standing, progress=progress, task="initial residual")
    moved = np.einsum("ft,fjk->tjk", time_functions, start)
    after_rigid = residuals(fine.images, sections, moved, progress=progress, task="rigid residual")
    found = solver.run("deformation", sections, setup.options.deformation, start, to_noise=True)
    fine = solver.prepared[1]
    functions, amplitude = found.time_functions, np.einsum("ft,fjk->tjk", found.time_functions, found.coefficients)
    equations = solver.equations_at(sections, amplitude)
    propagating = time.perf_counter()
    prior = setup.prior(sections)
    noise = solver.noise(equations)
    if found.known is None:
        propagated = propagate(fine.images, fine.systematic, sections, amplitude, functions, noise, progress=progress)
        task = f"covariance of {len(functions) * standing[0].size} unknowns"
        progress(task, 0, 1)
        known = posterior(equations, functions, prior, propagated.parts)
        progress(task, 1, 1)
    else:
        known = stated(found.known, equations, functions, prior)
    unknowns = len(functions) * standing[0].size
    cells, spots = Cells(setup.geometry.cropped(*setup.window), sections, setup.outline.hull), list[Spot]()

    def see(step: int, white: Image) -> None:
        spots.append(cells.add(white, amplitude[step], float(experiment.test.angle_rad[step])))

    residual = equations.residual
    tests = residual_tests(fine.images, fine.systematic, sections, amplitude, noise, residual, unknowns, see)
    snr_views = snr_reprojection(fine, sections, amplitude)
    amplitude[:, ~known.observed] = np.nan
    snr = snr_of(fine.images)
    ended = time.perf_counter()
    measurement = Measurement(
        recording=setup.recording(),
        motion=MeasuredMotion(
            basis=sections,
            time_functions=functions,
            amplitude=amplitude,
            covariance=known.covariance,
            amplitude_std=np.where(known.observed[:, None], known.deviation, np.nan),
            data_share=np.where(known.observed[:, None], known.data_share, 0.0),
            observed=known.observed,
            std_by_source={
                name: _on_the_axis(part, sections, known.observed, functions, experiment.test.angle_rad)
                for name, part in known.by_source.items()
            },
        ),
        fit=Fit(
            stages=tuple(solver.stages),
            snr_reprojection_db=snr_views,
            snr_initial_db=snr(initial),
            snr_rigid_db=snr(after_rigid),
            snr_final_db=snr(equations.residual),
            snr_noise_db=fine.snr_noise_db,
            residual_initial=initial,
            residual_rigid=after_rigid,
            residual_final=residual,
            residual_tests=tests,
            outliers=solver.outliers,
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
        correction=setup.correction,
    )
    return measurement, fine.images.volume, spots, doubts_of_scanner(setup, prepared, measurement.motion)


def _on_the_axis(
    covariance: Floats, basis: SectionBasis, observed: NDArray[np.bool_], time_functions: Floats, angle_rad: Floats
) -> tuple[float, float, float]:
    """Return the rms standard deviations of u on the axis, over steps and observed sections, in three directions."""
    sections, motions = basis.shape
    points = np.zeros((sections, 3))
    points[:, 2] = basis.height_mm
    own = np.arange(sections)
    # at a section no other one takes part
    shapes = basis.shapes(points)[own, :, own]
    variances = []
    for t, frame in enumerate(beam_frame(angle_rad)):
        blocks = step_covariance(covariance, time_functions, t).reshape(sections, motions, sections, motions)
        turned = frame @ shapes
        variances.append(((turned @ blocks[own, :, own]) * turned).sum(axis=2)[observed])
    across, vertical, along = np.sqrt(np.maximum(np.mean(variances, axis=(0, 1)), 0)).tolist()
    return across, vertical, along


class _Protocol:
    """The stages of a measurement, one after the other: what each found, and the last equations."""

    def __init__(
        self, setup: Setup, prepared: Mapping[int, Prepared], time_functions: Floats, progress: Progress
    ) -> None:
        self.stages: list[Stage] = []
        self.outliers: NDArray[np.bool_] | None = None
        """Pixels (step, row, column) that were left out, where it was asked for."""
        self.prepared = dict(prepared)
        """The images of each scale, as they are used now."""
        self._setup = setup
        self._flats_left: Image | None = None
        self._time_functions = time_functions
        self._progress = progress
        self._last: tuple[Floats, Equations] | None = None

    def run(
        self, name: str, basis: SectionBasis, stages: tuple[ResolvedStage, ...], start: Floats, *, to_noise: bool
    ) -> _Found:
        """Solve the stages in turn from a start (function, section, motion), voxels; return where they end."""
        found = _Found(time_functions=self._time_functions, coefficients=start, known=None)
        for stage in stages:
            if to_noise and stage is stages[-1]:
                self._remove_pattern(basis, found)
            found = self._stage(name, basis, stage, found, to_noise)
        limit = self._setup.options.outliers_over
        if to_noise and limit != "none":
            found = self._without_outliers(name, basis, stages[-1], found, limit)
        return found

    def _without_outliers(
        self, name: str, basis: SectionBasis, stage: ResolvedStage, found: _Found, limit: float
    ) -> _Found:
        """Leave out outliers and solve the last stage again, until they stay."""
        fine = self.prepared[1]
        used = fine.images.weight > 0
        left_out = np.zeros(fine.images.grey.shape, dtype=bool)
        for _ in range(ROUNDS):
            amplitude = np.einsum("ft,fjk->tjk", found.time_functions, found.coefficients)
            pixels = outliers(self.equations_at(basis, amplitude).residual, limit) & used
            if unchanged(pixels, left_out):
                break
            left_out, self._last = pixels, None
            self.prepared[1] = fine.without_outliers(pixels)
            found = self._stage(name, basis, stage, found, to_noise=True)
        self.outliers = left_out
        return found

    def _stage(self, name: str, basis: SectionBasis, stage: ResolvedStage, before: _Found, to_noise: bool) -> _Found:
        functions = stage.solver.functions(self._time_functions)
        start = before.coefficients
        if functions is not before.time_functions:
            # orthonormal, both
            start = np.einsum("gt,ft,fjk->gjk", functions, before.time_functions, start) / functions.shape[1]
        kept = self._setup.store.arrays(
            "stage",
            (name, self._setup.options, stage, basis, functions, start),
            lambda: _packed(self._solved(name, basis, stage, functions, start, to_noise)),
        )
        self.stages.append(
            Stage(
                name=name,
                scale=stage.scale,
                solver=stage.solver.kind,
                unknowns=len(functions) * basis.shape[0] * basis.shape[1],
                temporal=kept["temporal"],
                spatial=kept["spatial"],
                rms=kept["rms"],
                stop=Stop(str(kept["stop"])),
                stop_reason=str(kept["stop_reason"]),
                last_change_voxel=float(kept["last_change"]),
            )
        )
        sources = {key.removeprefix(_PART): part for key, part in kept.items() if key.startswith(_PART)}
        known = Known(covariance=kept["covariance"], by_source=sources) if "covariance" in kept else None
        return _Found(time_functions=functions, coefficients=kept["coefficients"], known=known)

    def _remove_pattern(self, basis: SectionBasis, found: _Found) -> None:
        """Take the detector's fixed pattern from all images of scale 1, if the options say so and noise is known."""
        fine = self.prepared[1]
        amplitude = np.einsum("ft,fjk->tjk", found.time_functions, found.coefficients)
        key = (self._setup.options, basis, found.time_functions, found.coefficients)

        def residual() -> Image:
            return residuals(fine.images, basis, amplitude, progress=self._progress, task="fixed pattern")

        def keep(made: Callable[[], Pattern]) -> Pattern:
            return Pattern(**self._setup.store.arrays("pattern", key, lambda: vars(made())))

        cleared = without_pattern(self._setup, fine, basis, amplitude, residual, keep)
        self.prepared[1], self._flats_left = cleared.prepared, cleared.left

    def equations_at(self, basis: SectionBasis, amplitude: Floats) -> Equations:
        """Return the equations of scale 1 at amplitudes: the last pass, unless that was in an earlier run."""
        if self._last is not None and np.array_equal(self._last[0], amplitude):
            return self._last[1]
        return linearise(self.prepared[1].images, basis, amplitude, progress=self._progress, task="last pass")

    def noise(self, equations: Equations) -> Noise:
        """Return the noise of all images at scale 1; where the detector's is not stated, what the residual tells."""
        return Cleared(prepared=self.prepared[1], left=self._flats_left).noise(self._setup, lambda: equations.rms)

    def _solved(
        self, name: str, basis: SectionBasis, stage: ResolvedStage, functions: Floats, start: Floats, to_noise: bool
    ) -> Solution:
        prepared, passes = self.prepared[stage.scale], 0

        def at(amplitude: Floats) -> Equations:
            nonlocal passes
            passes += 1
            task = f"{name}, scale {stage.scale}, pass {passes}"
            return linearise(prepared.images, basis, amplitude, progress=self._progress, task=task)

        def noise_at(amplitude: Floats, equations: Equations, slow: Floats) -> Propagated:
            noise = self.noise(equations)
            images, systematic = prepared.images, prepared.systematic
            return propagate(images, systematic, basis, amplitude, slow, noise, progress=self._progress)

        solution = stage.solver.solve(
            Problem(
                linearise=at,
                basis=basis,
                series=self._setup.experiment.test,
                time_functions=functions,
                start=start,
                prior=self._setup.prior(basis),
                # as long as the sample only moves as a whole, what is left is not noise
                noise_rms=prepared.noise_rms if to_noise else None,
                noise_at=noise_at if stage.scale == 1 and to_noise else None,
            )
        )
        self._last = (np.einsum("ft,fjk->tjk", functions, solution.coefficients), solution.equations)
        return solution


@dataclass(frozen=True, kw_only=True)
class _Found:
    """What a stage found."""

    time_functions: Floats
    coefficients: Floats
    """(function, section, motion), voxels."""
    known: Known | None
    """How well it is known, where its solver tells."""


_PART = "part of the covariance: "


def _packed(solution: Solution) -> dict[str, NDArray[Any]]:
    known = {} if solution.known is None else {"covariance": solution.known.covariance}
    parts = {} if solution.known is None else solution.known.by_source
    return {
        **known,
        **{_PART + name: part for name, part in parts.items()},
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
