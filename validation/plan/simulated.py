"""Plan a scenario's test, from a simulated reference scan."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import Knowledge
from pdvc.experiment import Experiment, read_experiment
from pdvc.options import MeasureOptions
from pdvc.plan import PlannedTest, Planner
from pdvc.progress import Progress, silent
from simulator.scanner import simulate
from simulator.scenario import Course, Scenario, course_of
from simulator.truth import truth_points
from validation.plan.designs import Design, Plan, compared
from validation.scoring.bound import noise_free

Floats = NDArray[np.float64]


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
        planner = Planner(reference_of(scenario, Path(name), progress), options, progress=progress)

        def test(design: Design) -> PlannedTest:
            return planned(scenario, design, planner.heights_mm)

        def points(known: Knowledge) -> Floats:
            low, high = known.basis.height_mm[[0, -1]]
            return truth_points(scenario, np.linspace(low, high, 31))

        return compared(planner, own, designs, test, points, count, progress)


def design_of(scenario: Scenario, options: MeasureOptions) -> Design:
    """Return the scenario's own design."""
    acquisition = scenario.acquisition
    return Design(
        steps_per_turn=acquisition.steps_per_turn,
        turns=acquisition.test_steps / acquisition.steps_per_turn,
        frames=scenario.detector.frames,
        flats=scenario.detector.flats,
        sections=options.sections_for(scenario.geometry.rows),
    )


def reference_of(scenario: Scenario, folder: Path, progress: Progress) -> Experiment:
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
    acquisition, loading, motion = scenario.acquisition, scenario.loading, scenario.motion
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
            "motion": motion.model_copy(
                update={"slip": motion.slip.model_copy(update={"step": int(motion.slip.step * share)})}
            ),
        }
    )
    return course_of(changed)
