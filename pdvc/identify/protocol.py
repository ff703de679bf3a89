"""Identify a law in an experiment that has been measured: two steps, crosshead, and all in one."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.experiment import Experiment
from pdvc.identify.beam import elongation_mm
from pdvc.identify.choice import Choices, choices
from pdvc.identify.crosshead import from_crosshead
from pdvc.identify.integrated import Identified, Radiographs, carried_by, integrated, log_evidence, radiographs_at
from pdvc.identify.model import Model
from pdvc.identify.opening import Ready, nearest, of_kind, ready
from pdvc.identify.options import IdentifyOptions
from pdvc.identify.result import CROSSHEAD, INTEGRATED, UNWEIGHTED, Found, Identification
from pdvc.identify.two_step import LawEstimate
from pdvc.measurement import Measurement
from pdvc.progress import Progress, silent
from pdvc.protocol import versions
from pdvc.sections import TRANSLATION_Z
from pdvc.smoother import Smoother

Floats = NDArray[np.float64]

MOVED_VOXEL = 0.02
"""Change of the motion, rms, from which on the radiographs are walked again."""
MOST_PASSES = 3
DRAWS = 2000
"""Draws of the law that its band is made of."""
POINTS = 60
"""Plastic strains at which a law is drawn."""


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


def choice(
    experiment: Experiment,
    measurement: Measurement,
    options: IdentifyOptions,
    draws: int,
    *,
    work: Path | None = None,
    progress: Progress = silent,
) -> Choices:
    """Return how the choice among the law and those it is compared with turns out in made-up tests like this one.

    Raises ValueError as `identify` does, and where no law is compared.
    """
    if not options.compare:
        raise ValueError("compare: expected some laws to choose among, found none")
    opened = ready(experiment, measurement, options, work=work, progress=progress)
    start = nearest(opened, opened.model, opened.amplitude, opened.force_N)
    found, radiographs = _integrated(opened, start)
    return choices(opened, radiographs, found, options.compare, draws, progress=progress)


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

    def found(self, part: str, estimate: LawEstimate) -> Found:
        """Return an estimate with the time it took."""
        return Found(
            vector=estimate.vector,
            covariance=estimate.covariance,
            misfit=estimate.misfit,
            seconds=self.note(part),
        )


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
    own = log_evidence(opened.model, opened.force_N, found.estimate.vector, radiographs, found.deviations)
    result = {kind: 0.0}
    for other in others:
        model = of_kind(opened, other)
        start = nearest(opened, model, opened.amplitude, found.force_N)
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


def _curve(model: Model, estimate: LawEstimate, force_N: Floats) -> Floats:
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
