"""An experiment made ready for its law to be identified: radiographs near a measured motion, areas, and the beam."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.equations import Equations, linearise, residuals
from pdvc.experiment import Experiment
from pdvc.identify.beam import Profile
from pdvc.identify.carried import Carrier, shift_of
from pdvc.identify.faces import Scan, areas_between_faces
from pdvc.identify.laws import law_named
from pdvc.identify.model import Model, neck_ramps
from pdvc.identify.options import IdentifyOptions
from pdvc.identify.outline import areas_of, outline_of, profile_of
from pdvc.identify.result import UNWEIGHTED, WEIGHTED
from pdvc.identify.two_step import LawEstimate, seen_motions, unweighted, weighted, zeroed
from pdvc.measurement import Measurement
from pdvc.noise import Propagated, propagate
from pdvc.onset import force_noise, onset
from pdvc.options import MeasureOptions
from pdvc.preparation import Prepared, prepare
from pdvc.progress import Progress, silent
from pdvc.sections import TRANSLATION_Z, SectionBasis
from pdvc.setup import Setup, set_up
from pdvc.solution import Problem
from pdvc.volume import Volume
from pdvc.without_pattern import Cleared, without_pattern

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

ENDS_MM = 0.2
"""Height at either end of the volume that is left out: rays through its cut ends blur it."""
LEAST_NOISE_N = 1e-3
"""Of a force that was recorded without any scatter."""


@dataclass(frozen=True, kw_only=True)
class Ready:
    """An experiment made ready for its law to be identified."""

    experiment: Experiment
    """Of the steps that are used."""
    options: IdentifyOptions
    model: Model
    problem: Problem
    """Of the radiographs at scale 1."""
    amplitude: Floats
    """The motion as measured (step, unknown), voxels."""
    seen: NDArray[np.intp]
    """Unknowns of a step that tell the stretch."""
    sections: int
    """Sections that were observed."""
    loaded: int
    """First loaded step."""

    @property
    def force_N(self) -> Floats:
        """Return the recorded forces (step,)."""
        return self.experiment.test.force_N

    @property
    def stroke_mm(self) -> Floats | None:
        """Return the crosshead's stroke (step,), mm, or None where its rate was not told."""
        if self.options.stroke_mm_per_s is None:
            return None
        time_s = self.experiment.test.time_s
        return np.asarray(self.options.stroke_mm_per_s * np.maximum(time_s - time_s[self.loaded], 0.0))

    def two_steps(self, amplitude: Floats, covariance: Floats, start: Floats | None = None) -> dict[str, LawEstimate]:
        """Return what a measured motion (step, unknown) and its covariances (step, unknown, unknown) tell."""
        flat = zeroed(amplitude, self.loaded)
        plain = unweighted(self.model, flat, self.seen, self.force_N, self.sections, start)
        nearest = weighted(self.model, flat, covariance, self.seen, self.force_N, self.sections, plain.vector)
        return {UNWEIGHTED: plain, WEIGHTED: nearest}


def largest_MPa(force_N: Floats, profile: Profile) -> float:
    """Return the largest stress of a test, that of the smallest section."""
    return float(force_N.max() / profile.area_mm2.min())


def of_kind(opened: Ready, kind: str) -> Model:
    """Return the model with a law of another kind, started for this test."""
    law = law_named(kind).started_for(largest_MPa(opened.force_N, opened.model.profile))
    return replace(opened.model, law=law)


def nearest(opened: Ready, model: Model, amplitude: Floats, force_N: Floats) -> Floats:
    """Return the unknowns (unknown,) whose law is nearest to amplitudes (step, unknown) at forces (step,): a start."""
    flat = zeroed(amplitude, opened.loaded)
    return unweighted(model, flat, opened.seen, force_N, opened.sections).vector


def ready(
    experiment: Experiment,
    measurement: Measurement,
    options: IdentifyOptions,
    *,
    work: Path | None = None,
    progress: Progress = silent,
) -> Ready:
    """Make an experiment ready, with a measurement of it: radiographs, areas, and the model of the beam.

    Raises ValueError as `identify` does.
    """
    _check(experiment, measurement)
    for kind in options.compare:
        law_named(kind)  # before anything is computed
    steps = len(experiment.test) if options.until is None else min(options.until, len(experiment.test))
    used = _first_steps(experiment, steps)
    if np.ptp(used.test.force_N) == 0:
        raise ValueError("force_N: expected a force that changes over the test, found the same at all steps")
    loaded = onset(used.test.force_N) or 0
    setup, volume, problem = _prepared(used, measurement, work, progress)
    amplitude, basis, voxel_mm = _filled(measurement, steps), measurement.motion.basis, measurement.recording.voxel_mm
    profile, share = profile_from(volume, setup, options)
    carrier = Carrier(
        basis=basis,
        voxel_mm=voxel_mm,
        height_mm=profile.height_mm,
        shift_mm=shift_of(basis, amplitude.reshape(-1, *basis.shape), voxel_mm),
    )
    starts = options.law == law_named(str(options.law.kind))
    model = Model(
        # values that the user gave stay
        law=options.law.started_for(largest_MPa(used.test.force_N, profile)) if starts else options.law,
        profile=profile,
        area_deviation=share,
        reference_N=float(np.mean(experiment.reference.force_N)),
        force_noise_N=options.force_noise_N or max(force_noise(experiment.test.force_N), LEAST_NOISE_N),
        carrier=carrier,
        neck=neck_ramps(steps, loaded) if options.neck else np.zeros((0, steps)),
        bridgman=options.bridgman,
    )
    return Ready(
        experiment=used,
        options=options,
        model=model,
        problem=problem,
        amplitude=amplitude,
        seen=seen_motions(basis, measurement.motion.observed),
        sections=int(measurement.motion.observed.sum()),
        loaded=loaded,
    )


def _check(experiment: Experiment, measurement: Measurement) -> None:
    steps, found = len(experiment.test), measurement.recording.steps
    if steps != found or not np.allclose(experiment.test.angle_rad, measurement.recording.angle_rad):
        raise ValueError(
            f"measurement: expected one of this experiment, of {steps} steps at its angles, got one of {found} steps"
        )
    if TRANSLATION_Z not in measurement.motion.basis.motions:
        raise ValueError("measurement: expected sections that move along the beam, translation_z, found none")
    if not measurement.provenance.options:
        raise ValueError("measurement: expected the options it was made with, found none")


def _first_steps(experiment: Experiment, steps: int) -> Experiment:
    """Return an experiment of its first steps."""
    test = experiment.test
    cut = replace(
        test,
        counts=test.counts[:steps],
        angle_rad=test.angle_rad[:steps],
        time_s=test.time_s[:steps],
        force_N=test.force_N[:steps],
    )
    return replace(experiment, test=cut, interrupted=())


def _filled(measurement: Measurement, steps: int) -> Floats:
    """Return amplitudes (step, unknown), voxels, sections that were not observed like the nearest one that was."""
    amplitude = measurement.motion.amplitude[:steps]
    observed = np.flatnonzero(measurement.motion.observed)
    if len(observed) < 2:
        raise ValueError(f"measurement: expected at least 2 sections that were observed, found {len(observed)}")
    sections = np.arange(amplitude.shape[1])
    nearest = observed[np.abs(sections[:, None] - observed).argmin(axis=1)]
    filled = amplitude[:, nearest].reshape(steps, -1)
    if not np.isfinite(filled).all():
        raise ValueError("measurement: expected a motion at every step, found steps that were not measured")
    return np.asarray(filled)


def _prepared(
    experiment: Experiment, measurement: Measurement, work: Path | None, progress: Progress
) -> tuple[Setup, Volume, Problem]:
    """Return the volume and the radiographs of scale 1, made ready as in the last stage of a measurement."""
    stated = MeasureOptions.parse(tomllib.loads(measurement.provenance.options), where="measurement: options")
    setup = set_up(experiment, stated, work=work, progress=progress)
    fine = prepare(setup, 1, progress)
    basis, steps = measurement.motion.basis, len(experiment.test)
    amplitude = _filled(measurement, steps).reshape(-1, *basis.shape)
    return setup, fine.images.volume, problem_at(setup, fine, basis, amplitude, progress=progress)


def problem_at(
    setup: Setup,
    fine: Prepared,
    basis: SectionBasis,
    amplitude: Floats,
    *,
    clear: bool = True,
    progress: Progress = silent,
) -> Problem:
    """Return the problem of the last stage near amplitudes (step, section, motion), voxels.

    The detector's pattern is taken from all images there, if the options say so, unless it is not asked for.
    """
    steps = len(amplitude)

    def residual() -> Image:
        return residuals(fine.images, basis, amplitude, progress=progress, task="residual")

    cleared = Cleared(prepared=fine)
    if clear:
        cleared = without_pattern(setup, fine, basis, amplitude, residual)
    known = cleared.noise(setup, lambda: float(np.sqrt(np.mean(residual() ** 2))))
    images, systematic = cleared.prepared.images, cleared.prepared.systematic

    def at(amplitude: Floats) -> Equations:
        return linearise(images, basis, amplitude, progress=progress, task="identification: pass")

    def noise_at(amplitude: Floats, _: Equations, slow: Floats) -> Propagated:
        return propagate(images, systematic, basis, amplitude, slow, known, progress=progress)

    return Problem(
        linearise=at,
        basis=basis,
        series=setup.experiment.test,
        time_functions=np.eye(steps) * np.sqrt(steps),
        start=amplitude / np.sqrt(steps),
        prior=setup.prior(basis),
        noise_rms=cleared.prepared.noise_rms,
        noise_at=noise_at,
    )


def profile_from(volume: Volume, setup: Setup, options: IdentifyOptions) -> tuple[Profile, float]:
    """Return the sections' areas from a volume, and the relative standard deviation of all of them together."""
    grid = volume.grid
    low = grid.origin_mm[2] + ENDS_MM
    high = grid.origin_mm[2] + grid.voxel_mm * (grid.shape[0] - 1) - ENDS_MM
    outline = outline_of(volume, low, high)
    area, (_, perimeter) = areas_between_faces(outline, _scan_of(setup)), areas_of(outline.radius_mm)
    smallest = int(area.argmin())
    if options.area_mm2 is not None:
        area, share = area * (options.area_mm2 / area[smallest]), options.area_deviation
    else:
        share = options.outline_voxel * grid.voxel_mm * float(perimeter[smallest] / area[smallest])
    return profile_of(outline.height_mm, area), share


def _scan_of(setup: Setup) -> Scan:
    """Return how the volume of scale 1 was made."""
    return Scan(
        geometry=setup.geometry,
        angle_rad=setup.experiment.reference.angle_rad,
        polynomial=setup.calibration.polynomial,
        smooth_px=setup.options.smooth_px,
        sharpen=setup.options.sharpen,
    )
