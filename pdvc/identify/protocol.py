"""Identify a law in an experiment that has been measured: two steps, crosshead, and all in one."""

from __future__ import annotations

import time
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pdvc.equations import Equations, linearise, residuals
from pdvc.experiment import Experiment
from pdvc.identify.beam import Profile, elongation_mm
from pdvc.identify.carried import Carrier, shift_of
from pdvc.identify.crosshead import from_crosshead
from pdvc.identify.integrated import Identified, Radiographs, carried_by, integrated, log_evidence, radiographs_at
from pdvc.identify.laws import Law, Ludwik, law_named
from pdvc.identify.model import Model, neck_ramps
from pdvc.identify.outline import areas_of, outline_of, profile_of
from pdvc.identify.result import CROSSHEAD, INTEGRATED, UNWEIGHTED, WEIGHTED, Found, Identification
from pdvc.identify.two_step import Estimate, seen_motions, unweighted, weighted, zeroed
from pdvc.measurement import Measurement
from pdvc.noise import Propagated, known_from_residual, propagate
from pdvc.onset import force_noise, onset
from pdvc.options import MeasureOptions
from pdvc.pattern import fixed_pattern
from pdvc.preparation import Prepared, noise_of, prepare
from pdvc.progress import Progress, silent
from pdvc.protocol import versions
from pdvc.sections import TRANSLATION_Z, SectionBasis
from pdvc.settings import Settings
from pdvc.setup import Setup, set_up
from pdvc.smoother import Smoother
from pdvc.solution import Problem
from pdvc.volume import Volume

Floats = NDArray[np.float64]

ENDS_MM = 0.2
"""Height at either end of the volume that is left out: rays through its cut ends blur it."""
MOVED_VOXEL = 0.02
"""Change of the motion, rms, from which on the radiographs are walked again."""
MOST_PASSES = 3
DRAWS = 2000
"""Draws of the law that its band is made of."""
LEAST_NOISE_N = 1e-3
"""Of a force that was recorded without any scatter."""
POINTS = 60
"""Plastic strains at which a law is drawn."""


class IdentifyOptions(Settings):
    """What is identified, and what is known beforehand."""

    law: Law = Ludwik()
    """the law, with values to start from: ludwik, voce, ramberg-osgood, swift, linear, multi-voce"""
    compare: tuple[str, ...] = ()
    """kinds of laws whose evidence is compared with that of the law"""
    until: Annotated[int, Field(ge=4)] | None = None
    """number of steps that are used, from the first; default: all"""
    neck: bool = True
    """whether a neck may form in the last steps, which the law does not tell"""
    outline_voxel: Annotated[float, Field(gt=0)] = 0.1
    """standard deviation of the sample's outline in the volume, voxels: with it, all areas may be off together"""
    area_mm2: Annotated[float, Field(gt=0)] | None = None
    """area of the smallest section, mm2, where it was measured otherwise; default: from the volume"""
    area_deviation: Annotated[float, Field(gt=0, le=0.5)] = 0.002
    """relative standard deviation of area_mm2"""
    force_noise_N: Annotated[float, Field(gt=0)] | None = None
    """standard deviation of a recorded force, N; default: from the record's second differences"""
    stroke_mm_per_s: Annotated[float, Field(gt=0)] | None = None
    """rate of the crosshead while the sample is loaded, mm/s; default: it was not told"""
    bridgman: bool = False
    """whether the stress of a notch or neck at rest is corrected by Bridgman's factor"""


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

    def two_steps(self, amplitude: Floats, covariance: Floats, start: Floats | None = None) -> dict[str, Estimate]:
        """Return what a measured motion (step, unknown) and its covariances (step, unknown, unknown) tell."""
        flat = zeroed(amplitude, self.loaded)
        plain = unweighted(self.model, flat, self.seen, self.force_N, self.sections, start)
        nearest = weighted(self.model, flat, covariance, self.seen, self.force_N, self.sections, plain.vector)
        return {UNWEIGHTED: plain, WEIGHTED: nearest}


def largest_MPa(force_N: Floats, profile: Profile) -> float:
    """Return the largest stress of a test, that of the smallest section."""
    return float(force_N.max() / profile.area_mm2.min())


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
    volume, problem = _prepared(used, measurement, work, progress)
    amplitude, basis, voxel_mm = _filled(measurement, steps), measurement.motion.basis, measurement.recording.voxel_mm
    profile, share = profile_from(volume, basis, options)
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


def identify(
    experiment: Experiment,
    measurement: Measurement,
    options: IdentifyOptions,
    *,
    work: Path | None = None,
    progress: Progress = silent,
) -> Identification:
    """Identify a law from the radiographs, the forces and a measurement of the same experiment.

    `work` is a folder for intermediate results, which a measurement may have left there.
    Raises ValueError, in one line, where measurement and experiment do not belong together, no load is recorded, or
    the motion tells nothing of a stretch.
    """
    clock = _Clock()
    opened = ready(experiment, measurement, options, work=work, progress=progress)
    model, stroke, steps = opened.model, opened.stroke_mm, len(opened.force_N)
    clock.note("prepare")
    methods: dict[str, Found] = {}
    covariance = np.stack([measurement.motion.step_covariance(t) for t in range(steps)])
    for name, estimate in opened.two_steps(opened.amplitude, covariance).items():
        methods[name] = clock.found(name, estimate)
    start = methods[UNWEIGHTED].vector
    if stroke is not None:
        machine = from_crosshead(model, opened.force_N, stroke, opened.loaded, start)
        methods[CROSSHEAD] = clock.found(CROSSHEAD, machine)
    progress("identification", 0, 2)
    found, radiographs = _integrated(opened, start)
    methods[INTEGRATED] = clock.found(INTEGRATED, found.estimate)
    progress("identification", 1, 2)
    evidence = _compared(opened, found, radiographs)
    clock.note("compare laws")
    progress("identification", 2, 2)
    unknowns = model.unknowns
    return Identification(
        title=experiment.title,
        law=options.law.kind,
        names=unknowns.names,
        of_law=unknowns.of_law,
        prior_mean=unknowns.mean,
        prior_deviation=unknowns.deviation,
        methods=methods,
        by_source={name: np.diag(part).copy() for name, part in found.by_source.items()},
        log_evidence=evidence,
        compliance_mm_per_N=_compliance(model, found, stroke, opened.loaded),
        height_mm=model.profile.height_mm,
        area_mm2=model.profile.area_mm2,
        time_s=opened.experiment.test.time_s,
        force_N=opened.force_N,
        force_found_N=found.force_N,
        force_noise_N=model.force_noise_N,
        **_strains(measurement, found, steps),
        curve=_curve(model, found.estimate, found.force_N),
        seconds=clock.seconds,
        versions=versions(),
    )


class _Clock:
    """What each part took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def note(self, part: str) -> float:
        """Take the time since the last part."""
        now = time.perf_counter()
        self.seconds[part], self._last = now - self._last, now
        return self.seconds[part]

    def found(self, part: str, estimate: Estimate) -> Found:
        """Return an estimate with the time it took."""
        return Found(
            vector=estimate.vector,
            covariance=estimate.covariance,
            misfit=estimate.misfit,
            seconds=self.note(part),
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
) -> tuple[Volume, Problem]:
    """Return the volume and the radiographs of scale 1, made ready as in the last stage of a measurement."""
    stated = MeasureOptions.parse(tomllib.loads(measurement.provenance.options), where="measurement: options")
    setup = set_up(experiment, stated, work=work, progress=progress)
    fine = prepare(setup, 1, progress)
    basis, steps = measurement.motion.basis, len(experiment.test)
    amplitude = _filled(measurement, steps).reshape(-1, *basis.shape)
    return fine.images.volume, problem_at(setup, fine, basis, amplitude, progress=progress)


def problem_at(
    setup: Setup,
    fine: Prepared,
    basis: SectionBasis,
    amplitude: Floats,
    *,
    without_pattern: bool = True,
    progress: Progress = silent,
) -> Problem:
    """Return the problem of the last stage near amplitudes (step, section, motion), voxels.

    The detector's pattern is taken from all images there, if the options say so, unless it is not asked for.
    """
    steps = len(amplitude)
    noise = noise_of(setup, fine.systematic)
    remove = without_pattern and setup.options.remove_pattern
    if noise is None or remove:
        rho = residuals(fine.images, basis, amplitude, progress=progress, task="residual")
        if noise is None:
            rms, systematic = float(np.sqrt(np.mean(rho**2))), fine.systematic
            noise = known_from_residual(rms, systematic.shape, systematic.detector, setup.options.smooth_px)
        else:
            pattern = fixed_pattern(fine.images, fine.systematic, basis, amplitude, noise, rho)
            fine = fine.without(pattern.grey)
            noise = replace(noise, flat=noise.flat * pattern.left)
    known = noise

    def at(amplitude: Floats) -> Equations:
        return linearise(fine.images, basis, amplitude, progress=progress, task="identification: pass")

    def noise_at(amplitude: Floats, _: Equations, slow: Floats) -> Propagated:
        return propagate(fine.images, fine.systematic, basis, amplitude, slow, known, progress=progress)

    return Problem(
        linearise=at,
        basis=basis,
        series=setup.experiment.test,
        time_functions=np.eye(steps) * np.sqrt(steps),
        start=amplitude / np.sqrt(steps),
        prior=setup.prior(basis),
        noise_rms=fine.noise_rms,
        noise_at=noise_at,
    )


def profile_from(volume: Volume, basis: SectionBasis, options: IdentifyOptions) -> tuple[Profile, float]:
    """Return the sections' areas from a volume, and the relative standard deviation of all of them together."""
    grid = volume.grid
    low = grid.origin_mm[2] + ENDS_MM
    high = grid.origin_mm[2] + grid.voxel_mm * (grid.shape[0] - 1) - ENDS_MM
    height, radius = outline_of(volume, low, high)
    area, perimeter = areas_of(radius)
    smallest = int(area.argmin())
    if options.area_mm2 is not None:
        return profile_of(height, area * (options.area_mm2 / area[smallest])), options.area_deviation
    share = options.outline_voxel * grid.voxel_mm * perimeter[smallest] / area[smallest]
    return profile_of(height, area), float(share)


def _integrated(opened: Ready, start: Floats) -> tuple[Identified, Radiographs]:
    """Return what radiographs and force tell, walked again where the motion found is far from where they were."""
    problem, model, force_N = opened.problem, opened.model, opened.force_N
    radiographs = radiographs_at(problem, Smoother().spaces(problem), opened.amplitude)
    found = integrated(model, force_N, start, radiographs)
    for _ in range(1, MOST_PASSES):
        if np.sqrt(np.mean((found.amplitude - radiographs.amplitude) ** 2)) < MOVED_VOXEL:
            break
        there = found.amplitude.reshape(-1, *problem.basis.shape)
        radiographs = replace(radiographs, amplitude=found.amplitude, equations=problem.linearise(there))
        model = carried_by(model, found.amplitude, problem.basis.shape)
        found = integrated(model, force_N, found.estimate.vector, radiographs, found.deviations)
    return found, radiographs


def _compared(opened: Ready, found: Identified, radiographs: Radiographs) -> dict[str, float]:
    """Return the log evidence of the law and of those that it is compared with, less the law's own."""
    kind = str(opened.options.law.kind)
    others = [other for other in opened.options.compare if other != kind]
    if not others:
        return {}
    flat = zeroed(opened.amplitude, opened.loaded)
    own = log_evidence(opened.model, opened.force_N, found.estimate.vector, radiographs, found.deviations)
    result = {kind: 0.0}
    for other in others:
        law = law_named(other).started_for(largest_MPa(opened.force_N, opened.model.profile))
        model = replace(opened.model, law=law)
        start = unweighted(model, flat, opened.seen, found.force_N, opened.sections).vector
        result[other] = log_evidence(model, opened.force_N, start, radiographs, found.deviations) - own
    return result


def _compliance(model: Model, found: Identified, stroke: Floats | None, loaded: int) -> tuple[float, float]:
    """Return the machine's compliance, mm/N, and its deviation: what the stroke is beyond the sample's elongation.

    By a line through the loaded steps: an offset of the stroke is no compliance.
    """
    if stroke is None:
        return float("nan"), float("nan")
    gain = found.force_N[loaded:] - model.reference_N
    design = np.column_stack([gain, np.ones_like(gain)])

    def slope(vector: Floats) -> tuple[float, float]:
        elastic, plastic = model.strains(vector, found.force_N)
        beyond = (stroke - elongation_mm(elastic + plastic, model.profile))[loaded:]
        solved, *_ = np.linalg.lstsq(design, beyond, rcond=None)
        left = beyond - design @ solved
        scatter = np.sqrt(left @ left / max(len(gain) - 2, 1) * np.linalg.inv(design.T @ design)[0, 0])
        return float(solved[0]), float(scatter)

    vector, deviation = found.estimate.vector, np.sqrt(np.diag(found.estimate.covariance))
    value, scatter = slope(vector)
    small = 1e-3 * deviation
    by = np.array([(slope(vector + step)[0] - slope(vector - step)[0]) / 2 for step in np.diag(small)]) / small
    return value, float(np.sqrt(by @ found.estimate.covariance @ by + scatter**2))


def _strains(measurement: Measurement, found: Identified, steps: int) -> dict[str, Floats]:
    """Return the axial strain between sections: of the free measurement, its deviation, and of the law."""
    basis, voxel = measurement.motion.basis, measurement.recording.voxel_mm
    axial = basis.motions.index(TRANSLATION_Z)
    gap = np.diff(basis.height_mm)

    def strain(amplitude: Floats) -> Floats:
        return np.asarray(np.diff(amplitude.reshape(steps, *basis.shape)[..., axial], axis=1) * voxel / gap)

    return {
        "section_mm": (basis.height_mm[1:] + basis.height_mm[:-1]) / 2,
        "strain_measured": strain(measurement.motion.amplitude[:steps]),
        "strain_deviation": np.stack([measurement.strain_std(t, basis.height_mm) for t in range(steps)]),
        "strain_law": strain(found.of_law),
    }


def _curve(model: Model, estimate: Estimate, force_N: Floats) -> Floats:
    """Return plastic strains up to the largest one, the flow stress there, and the limits of its 95 % band, MPa."""
    _, plastic = model.strains(estimate.vector, force_N)
    # denser where it has just yielded, and the first one not quite zero, where slopes may be infinite
    p = max(float(plastic.max()), 1e-4) * np.linspace(0.01, 1.0, POINTS) ** 2
    rng = np.random.default_rng(0)
    count = model.unknowns.of_law
    draws = rng.multivariate_normal(estimate.vector[:count], estimate.covariance[:count, :count], DRAWS)

    def flow(vector: Floats) -> Floats:
        return model.unknowns.law(model.law, vector).flow_MPa(p)

    low, high = np.percentile([flow(draw) for draw in draws], [2.5, 97.5], axis=0)
    return np.stack([p, flow(estimate.vector), low, high])
