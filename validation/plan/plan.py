"""Plan a test before it is made: what can be expected of it, from the sensitivities of its reference scan alone.

No load step is needed: at rest, a step at angle theta shows what the reference scan shows there. Its matrix B(theta)
says what the step tells about the sections, and Q(theta) = S^T W V_g W S what its noise does. A test has

    H = sum_t sigma(t) sigma(t)^T (x) B(theta_t)
    V = [ sum_t sigma(t) sigma(t)^T (x) Q(theta_t) + sum_v s_v s_v^T (x) Q(theta_v) + sum_p v_phi z z^T / m ] / k

with k the frames averaged and m the flats, each over those of the scenario; s_v the sum of sigma over the steps that
look along the reference view v, whose noise is as large as the steps' and returns with each turn; v_phi(p) the
relative variance of the mean flat and z(p) its effect (`pdvc.noise`). The flats' noise cancels where a pixel is
compared with itself, so that z depends on how far the sample moves: the scenario's mean motion of each step is taken,
to whole pixels. What is expected are the deviations of `pdvc.uncertainty`, which hold noise and prior, not what the
model cannot follow.

Designs differ in radiographs a turn, turns, frames, flats and sections. The test lasts as long as the scenario's: more
radiographs are taken faster, and the loading is the same.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.equations import STEPS_AT_ONCE, Images, linearise
from pdvc.experiment import Series, read_experiment
from pdvc.gauss_newton import hessian
from pdvc.history import TimeFunctions, time_basis
from pdvc.measurement import directions
from pdvc.noise import Pile, product
from pdvc.options import MeasureOptions, resolved
from pdvc.preparation import bases, calibrated, noise_of, prepare
from pdvc.progress import Progress, silent
from pdvc.projection import Sensitivities, sensitivities
from pdvc.radiographs import noise_overlap, smoothed
from pdvc.rays import ray_vectors
from pdvc.sections import SectionBasis
from pdvc.store import Store
from pdvc.uncertainty import sandwich
from pdvc.window import used_window
from simulator.scanner import simulate
from simulator.scenario import Course, Scenario, course_of
from simulator.truth import truth_points
from validation.scoring.bound import Bound, noise_free
from validation.scoring.interval_calibration import Quantities

Floats = NDArray[np.float64]

INVISIBLE_VOXEL = 0.5
"""A motion that is expected to be known no better than this, voxels rms, is called invisible."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """Hold how a test is made and measured."""

    steps_per_turn: int
    turns: float
    frames: int
    flats: int
    sections: int

    @property
    def steps(self) -> int:
        """Return the number of radiographs."""
        return round(self.steps_per_turn * self.turns)


@dataclass(frozen=True, kw_only=True)
class Expected:
    """Hold what is expected of a design."""

    design: Design
    deviation: Quantities
    """rms standard deviations over steps and material points, voxels; of the strain between sections, without unit"""


@dataclass(frozen=True, kw_only=True)
class WeakMotion:
    """Hold a motion that the radiographs hardly show: an independent direction of what stays uncertain."""

    deviation_voxel: tuple[float, float, float]
    """rms over steps and points, for one standard deviation: across the beam, vertical, along the beam."""
    prior_share: float
    """Its variance over that of the prior: 1 where the radiographs say nothing."""
    motions: tuple[str, ...]
    """Section motions that make most of it, the largest first."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Hold the scenario's own design, others around it, and what would stay invisible in its own."""

    own: Expected
    others: tuple[Expected, ...]
    weak: tuple[WeakMotion, ...]
    """The weakest motions, the weakest first."""

    @property
    def invisible(self) -> tuple[WeakMotion, ...]:
        """Return the weak motions that are expected to be known to no better than half a voxel."""
        return tuple(each for each in self.weak if np.linalg.norm(each.deviation_voxel) > INVISIBLE_VOXEL)


def designs_around(scenario: Scenario, options: MeasureOptions) -> tuple[Design, tuple[Design, ...]]:
    """Return the scenario's own design, and others that change one thing at a time."""
    acquisition = scenario.acquisition
    own = Design(
        steps_per_turn=acquisition.steps_per_turn,
        turns=acquisition.test_steps / acquisition.steps_per_turn,
        frames=scenario.detector.frames,
        flats=scenario.detector.flats,
        sections=options.sections,
    )
    others = [
        *(replace(own, steps_per_turn=max(round(own.steps_per_turn * f), 3)) for f in (0.25, 0.5, 2, 4)),
        *(
            replace(own, turns=own.turns * f, steps_per_turn=max(round(own.steps_per_turn / f), 3))
            for f in (0.5, 2, 4)
        ),
        *(replace(own, frames=frames) for frames in (1, 2 * own.frames, 4 * own.frames)),
        *(replace(own, flats=flats) for flats in (5 * own.flats, 25 * own.flats)),
        *(replace(own, sections=max(round(own.sections * f), 2)) for f in (0.5, 2)),
    ]
    return own, tuple(dict.fromkeys(other for other in others if other != own))


def plan(
    scenario: Scenario,
    options: MeasureOptions,
    designs: Sequence[Design] | None = None,
    *,
    weakest: int = 6,
    progress: Progress = silent,
) -> Plan:
    """Return what is expected of the scenario's own design and of others (by default `designs_around`).

    Simulates the reference scan without noise, reconstructs it, and computes B once for each number of sections.
    """
    own, around = designs_around(scenario, options)
    others = around if designs is None else tuple(designs)
    with tempfile.TemporaryDirectory() as name:
        views = _Views(scenario, options, Path(name), progress)
        found = []
        for n, design in enumerate((own, *others)):
            found.append(_expected(views, design))
            progress("designs", n + 1, len(others) + 1)
        weak = _weakest(views, own, weakest)
    return Plan(own=found[0], others=tuple(found[1:]), weak=weak)


class _Views:
    """Hold the reference scan of a scenario, and work out what steps at rest would tell."""

    def __init__(self, scenario: Scenario, options: MeasureOptions, folder: Path, progress: Progress) -> None:
        self.scenario = scenario
        self.options = resolved(options, scenario.geometry.cone_beam())
        self._progress = progress
        simulate(_at_rest(scenario), folder / "experiment", progress=progress)
        simulated = read_experiment(folder / "experiment")
        detector = scenario.detector
        experiment = replace(
            simulated,
            photons_per_count=detector.photons_per_count,
            readout_noise_counts=detector.readout_noise_counts,
            frames=detector.frames,
            test=simulated.reference,
        )
        self.reference_rad = experiment.reference.angle_rad
        self._geometry = experiment.geometry
        store = Store(None, experiment)
        calibration, outline = calibrated(experiment, self.options, store, progress)
        self._hull = outline.hull
        self._window = used_window(experiment.geometry, self.options, outline.hull)
        prepared = prepare(experiment, calibration, outline, self._window, 1, self.options, store, progress)
        noise = noise_of(experiment, calibration, prepared, self.options.smooth_px)
        assert noise is not None, "a scenario tells its noise"
        self._noise = noise
        self._images = prepared.images
        self._corner = prepared.systematic.corner
        left = noise_overlap(noise.smooth_px)[0] ** 2
        self.variance = left * float(np.mean([noise.step(t).variance.mean() for t in range(len(self.reference_rad))]))
        self._worked_out: dict[Design, tuple[Floats, Floats, Floats, SectionBasis, Floats, Floats]] = {}

    def basis(self, sections: int) -> SectionBasis:
        """Return the section basis with so many sections."""
        options = self.options.model_copy(update={"sections": sections})
        return bases(self._geometry, self._window, self._hull, options)[1]

    def nearest(self, angle_rad: Floats) -> NDArray[np.intp]:
        """Return the reference views nearest to angles."""
        apart = np.abs((angle_rad[:, None] - self.reference_rad + np.pi) % (2 * np.pi) - np.pi)
        return np.asarray(apart.argmin(axis=1))

    def sums(self, basis: SectionBasis, functions: Floats, course: Course) -> tuple[Floats, Floats, Floats]:
        """Return H, V of all images but the flats, and V of the flats, with the scenario's frames and flats."""
        angle_rad = course.test_angle_rad
        # steps a turn apart see the same
        _, first, turn = np.unique(np.round(angle_rad % (2 * np.pi), 9), return_index=True, return_inverse=True)
        views = self.nearest(angle_rad[first])
        images = self._at(angle_rad[first], views)
        still = np.zeros((len(first), *basis.shape))
        task = f"sensitivities at {len(first)} angles, {basis.shape[0]} sections"
        matrix = linearise(images, basis, still, progress=self._progress, task=task).matrix
        was = self._places(course)
        pile, noise = Pile(self._noise.flat.shape, functions, basis.shape[1]), np.empty_like(matrix)
        for k, field in enumerate(self._fields(images, basis)):
            step = self._noise.step(int(views[k]))
            noise[k] = product(field, field, step.variance, matrix.shape[1])
            for t in np.flatnonzero(turn == k):
                pile.add(int(t), field, -step.slope, self._corner)
                pile.add(int(t), field, step.slope, was[t])
        met, of_view, group = np.unique(views[turn], return_index=True, return_inverse=True)
        shared = np.stack([functions[:, group == v].sum(axis=1) for v in range(len(met))], axis=1)
        covariance = hessian(noise[turn], functions) + hessian(noise[turn][of_view], shared)
        return hessian(matrix[turn], functions), covariance, pile.covariance(self._noise.flat, matrix.shape[1])

    def _places(self, course: Course) -> list[tuple[int, int]]:
        """Return where the window's first pixel was before each step moved the sample, as a mean, whole pixels."""
        low, high = self.basis(2).height_mm
        axis = np.zeros((9, 3))
        axis[:, 2] = np.linspace(low, high, len(axis))
        moved = np.stack([course.motion.forward(axis, t) - axis for t in range(len(course.test_angle_rad))])
        turned = moved.mean(axis=1)[:, None] @ directions(course.test_angle_rad).transpose(0, 2, 1)
        across, up = (turned[:, 0, k] / self._geometry.voxel_mm for k in range(2))
        row, column = self._corner
        rows, columns = self._window[1] - self._window[0], self._window[3] - self._window[2]
        top = np.clip(np.round(row + up), 0, self._geometry.rows - rows).astype(int)
        left = np.clip(np.round(column - across), 0, self._geometry.columns - columns).astype(int)
        return list(zip(top.tolist(), left.tolist(), strict=True))

    def _at(self, angle_rad: Floats, views: NDArray[np.intp]) -> Images:
        """Return what would be seen at angles: the reference views next to them."""
        images = self._images
        return replace(
            images,
            rays=ray_vectors(self._geometry.cropped(*self._window), angle_rad).stacked(),
            grey=images.grey[views],
            weight=images.weight if len(images.weight) == 1 else images.weight[views],
            systematic=None,
        )

    def _fields(self, images: Images, basis: SectionBasis) -> Iterator[Sensitivities]:
        """Yield W S of each image; where S meets noise it is filtered once more."""
        volume = replace(images.volume, values=smoothed(images.volume.values, self.options.smooth_px))
        shape = (images.grey.shape[1], images.grey.shape[2])
        for start in range(0, len(images.rays), STEPS_AT_ONCE):
            rays = images.rays[start : start + STEPS_AT_ONCE]
            still = np.zeros((len(rays), *basis.shape))
            found = sensitivities(volume, rays, shape, basis, still, voxel_mm=images.voxel_mm)
            for k, field in enumerate(found):
                weight = images.weight[(start + k) % len(images.weight)]
                yield replace(field, values=field.values * weight[..., None])

    def covariance(self, design: Design) -> Bound:
        """Return the covariance that is expected of a design."""
        scenario, options = self.scenario, self.options
        like = replace(design, frames=scenario.detector.frames, flats=scenario.detector.flats)
        if like not in self._worked_out:
            course = _course(scenario, design)
            series = Series(
                counts=np.zeros((design.steps, 1, 1), dtype=np.uint16),
                angle_rad=course.test_angle_rad,
                time_s=course.test_time_s,
                force_N=course.history.force_N,
            )
            share = design.steps / scenario.acquisition.test_steps
            functions = time_basis(_stretched(options.time, share), series)
            basis = self.basis(design.sections)
            self._worked_out[like] = *self.sums(basis, functions, course), basis, functions, series.angle_rad
        matrix, noise, flats, basis, functions, angle_rad = self._worked_out[like]
        noise = noise + flats * scenario.detector.flats / design.flats
        # the solvers count residuals, which the prior's ridge follows
        frames = design.frames / scenario.detector.frames
        gamma2 = self.variance / frames
        return Bound(
            basis=basis,
            time_functions=functions,
            angle_rad=angle_rad,
            voxel_mm=self._geometry.voxel_mm,
            covariance=sandwich(matrix, noise / frames, np.full(len(noise), gamma2 / options.prior_voxel**2), gamma2),
        )


def _at_rest(scenario: Scenario) -> Scenario:
    """Return the scenario without noise, and with hardly any test."""
    quiet = noise_free(scenario)
    acquisition = quiet.acquisition.model_copy(update={"test_steps": 2})
    interrupted = quiet.interrupted.model_copy(update={"steps": ()})
    return quiet.model_copy(update={"acquisition": acquisition, "interrupted": interrupted})


def _course(scenario: Scenario, design: Design) -> Course:
    """Return what would happen in a test of this design."""
    acquisition, loading = scenario.acquisition, scenario.loading
    share = design.steps / acquisition.test_steps
    changed = scenario.model_copy(
        update={
            "acquisition": acquisition.model_copy(
                update={
                    "test_steps": design.steps,
                    "steps_per_turn": design.steps_per_turn,
                    "step_s": acquisition.step_s / share,
                }
            ),
            "loading": loading.model_copy(
                update={
                    "plateau_steps": round(loading.plateau_steps * share),
                    "necking_steps": max(round(loading.necking_steps * share), 1),
                }
            ),
        }
    )
    return course_of(changed)


def _stretched(parts: tuple[TimeFunctions, ...], share: float) -> tuple[TimeFunctions, ...]:
    """Return time functions for so many times the steps: what counts steps is stretched."""
    result = []
    for part in parts:
        steps = {name: getattr(part, name) for name in ("start", "period") if hasattr(part, name)}
        # an onset is found in the force, wherever it is
        steps = {name: value for name, value in steps.items() if value != "onset"}
        stretched = {name: type(value)(round(value * share)) for name, value in steps.items()}
        result.append(part.model_copy(update=stretched))
    return tuple(result)


@dataclass(frozen=True)
class _Still:
    """Be the material points of a sample at rest, at every step."""

    point_mm: Floats
    displacement_mm: Floats


def _points(views: _Views, known: Bound) -> _Still:
    low, high = known.basis.height_mm[[0, -1]]
    levels = np.linspace(low, high, 31)
    points = truth_points(views.scenario, levels)
    return _Still(points, np.zeros((len(known.angle_rad), *points.shape)))


def _expected(views: _Views, design: Design) -> Expected:
    known = views.covariance(design)
    return Expected(design=design, deviation=known.quantities(_points(views, known)))


def _weakest(views: _Views, design: Design, count: int) -> tuple[WeakMotion, ...]:
    """Return the principal directions of what stays uncertain, the largest first."""
    known = views.covariance(design)
    values, vectors = np.linalg.eigh(known.covariance)
    points = _points(views, known).point_mm
    shapes = known.basis.shapes(points).reshape(len(points), 3, -1)
    turn = directions(known.angle_rad)
    result = []
    for value, vector in zip(values[::-1][:count], vectors.T[::-1], strict=False):
        mode = vector.reshape(len(known.time_functions), -1)
        moved = np.einsum("pan,tn->tpa", shapes, known.time_functions.T @ mode)
        turned = np.einsum("tba,tpa->tpb", turn, moved)
        rms = np.sqrt(value * (turned**2).mean(axis=(0, 1)))
        share = (mode.reshape(-1, *known.basis.shape) ** 2).sum(axis=(0, 1))
        order = np.argsort(share)[::-1]
        named = tuple(known.basis.motions[k] for k in order if share[k] > 0.15)
        across, vertical, along = (float(each) for each in rms)
        result.append(
            WeakMotion(
                deviation_voxel=(across, vertical, along),
                prior_share=float(min(value / views.options.prior_voxel**2, 1.0)),
                motions=named,
            )
        )
    return tuple(result)
