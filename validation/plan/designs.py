"""Plan a scenario's test: what to expect of its own design, and of others around it.

Designs differ in radiographs a turn, turns, frames, flats and sections. The test lasts as long as the scenario's: more
radiographs are taken faster, and the loading is the same. `pdvc.plan` works out what is expected.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import Knowledge, Quantities
from pdvc.experiment import Experiment, read_experiment
from pdvc.options import MeasureOptions
from pdvc.plan import PlannedTest, Planner, WeakMotion, weakest
from pdvc.progress import Progress, silent
from simulator.scanner import simulate
from simulator.scenario import Course, Scenario, course_of
from simulator.truth import truth_points
from validation.scoring.bound import noise_free

Floats = NDArray[np.float64]

INVISIBLE_VOXEL = 0.5
"""A motion that is expected to be known no better than this, voxels rms, is called invisible."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """How a test is made and measured."""

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
    """What is expected of a design."""

    design: Design
    deviation: Quantities
    """rms standard deviations over steps and material points, voxels; of the strain between sections, without unit"""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The scenario's own design, others around it, and what would stay invisible in its own."""

    own: Expected
    others: tuple[Expected, ...]
    weak: tuple[WeakMotion, ...]
    """The weakest motions, the weakest first."""

    @property
    def invisible(self) -> tuple[WeakMotion, ...]:
        """Return the weak motions that are expected to be known to no better than half a voxel."""
        return tuple(each for each in self.weak if np.linalg.norm(each.deviation_voxel) > INVISIBLE_VOXEL)


def design_of(scenario: Scenario, options: MeasureOptions) -> Design:
    """Return the scenario's own design."""
    acquisition = scenario.acquisition
    return Design(
        steps_per_turn=acquisition.steps_per_turn,
        turns=acquisition.test_steps / acquisition.steps_per_turn,
        frames=scenario.detector.frames,
        flats=scenario.detector.flats,
        sections=options.sections,
    )


def designs_around(own: Design) -> tuple[Design, ...]:
    """Return designs that differ from one in one thing at a time."""
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
    return tuple(dict.fromkeys(other for other in others if other != own))


def plan(
    scenario: Scenario,
    options: MeasureOptions,
    designs: Sequence[Design] | None = None,
    *,
    count: int = 6,
    progress: Progress = silent,
) -> Plan:
    """Return what is expected of the scenario's own design and of others (by default `designs_around`).

    Simulates the reference scan without noise, reconstructs it, and computes B once for each number of sections.
    `count` weakest motions are told.
    """
    own = design_of(scenario, options)
    with tempfile.TemporaryDirectory() as name:
        planner = Planner(_reference_of(scenario, Path(name), progress), options, progress=progress)

        def test(design: Design) -> PlannedTest:
            return planned(scenario, design, planner.heights_mm)

        def points(known: Knowledge) -> Floats:
            low, high = known.basis.height_mm[[0, -1]]
            return truth_points(scenario, np.linspace(low, high, 31))

        return _worked_out(planner, own, designs, test, points, count, progress)


def plan_experiment(
    experiment: Experiment,
    options: MeasureOptions,
    designs: Sequence[Design] | None = None,
    *,
    count: int = 6,
    progress: Progress = silent,
) -> Plan:
    """Return what is expected of a test like that of an experiment, from its real reference scan.

    The course of angle and force is the experiment's, made denser, longer or shorter; how far the sample will move is
    not known, and taken as nothing. Raises ValueError where the description does not tell the noise.
    """
    planner = Planner(experiment, options, progress=progress)
    own = design_of_experiment(experiment, options)

    def test(design: Design) -> PlannedTest:
        return planned_like(experiment, design)

    return _worked_out(planner, own, designs, test, lambda _: planner.points_mm(), count, progress)


def design_of_experiment(experiment: Experiment, options: MeasureOptions) -> Design:
    """Return the design of an experiment, by its recorded angles; a test of one step stands for a turn of one."""
    angle = experiment.test.angle_rad
    step = float(np.median(np.abs(np.diff(angle)))) if len(angle) > 1 else 2 * np.pi
    steps_per_turn = max(round(2 * np.pi / step), 1) if step > 0 else 1
    return Design(
        steps_per_turn=steps_per_turn,
        turns=len(angle) / steps_per_turn,
        frames=experiment.frames,
        flats=len(experiment.flats),
        sections=options.sections,
    )


def planned_like(experiment: Experiment, design: Design) -> PlannedTest:
    """Return a test as a design makes it, of the same duration and loading as an experiment's."""
    test, steps = experiment.test, design.steps
    share = np.linspace(0, 1, steps)
    recorded = np.linspace(0, 1, len(test))
    sense = -1.0 if test.angle_rad[-1] < test.angle_rad[0] else 1.0
    return PlannedTest(
        angle_rad=test.angle_rad[0] + sense * 2 * np.pi * np.arange(steps) / design.steps_per_turn,
        time_s=np.interp(share, recorded, test.time_s),
        force_N=np.interp(share, recorded, test.force_N),
        moved_mm=np.zeros((steps, 3)),
        share=steps / len(test),
        sections=design.sections,
        frames=design.frames / experiment.frames,
        flats=design.flats / len(experiment.flats),
    )


def _worked_out(
    planner: Planner,
    own: Design,
    designs: Sequence[Design] | None,
    test: Callable[[Design], PlannedTest],
    points: Callable[[Knowledge], Floats],
    count: int,
    progress: Progress,
) -> Plan:
    others = designs_around(own) if designs is None else tuple(designs)

    def expected(known: Knowledge, design: Design) -> Expected:
        at = points(known)
        still = np.zeros((len(known.angle_rad), *at.shape))
        return Expected(design=design, deviation=known.quantities(at, still))

    of_own = planner.expected(test(own))
    found = []
    for n, design in enumerate(others):
        found.append(expected(planner.expected(test(design)), design))
        progress("designs", n + 1, len(others))
    return Plan(
        own=expected(of_own, own),
        others=tuple(found),
        weak=weakest(of_own, points(of_own), planner.prior_voxel, count),
    )


def _reference_of(scenario: Scenario, folder: Path, progress: Progress) -> Experiment:
    """Return the reference scan of a scenario, without noise but with the noise that it would have described."""
    simulate(_at_rest(scenario), folder / "experiment", progress=progress)
    detector = scenario.detector
    return replace(
        read_experiment(folder / "experiment"),
        photons_per_count=detector.photons_per_count,
        readout_noise_counts=detector.readout_noise_counts,
        frames=detector.frames,
    )


def planned(scenario: Scenario, design: Design, heights_mm: tuple[float, float]) -> PlannedTest:
    """Return a scenario's test as a design makes it; the sample moves as the axis does between two heights."""
    course = _course(scenario, design)
    axis = np.zeros((9, 3))
    axis[:, 2] = np.linspace(*heights_mm, len(axis))
    moved = np.stack([course.motion.forward(axis, t) - axis for t in range(design.steps)])
    return PlannedTest(
        angle_rad=course.test_angle_rad,
        time_s=course.test_time_s,
        force_N=course.history.force_N,
        moved_mm=moved.mean(axis=1),
        share=design.steps / scenario.acquisition.test_steps,
        sections=design.sections,
        frames=design.frames / scenario.detector.frames,
        flats=design.flats / scenario.detector.flats,
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
