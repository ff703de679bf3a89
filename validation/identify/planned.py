"""What is expected of a law's parameters, of the test of a scenario that is not carried out."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from pdvc.experiment import Experiment
from pdvc.identify.expected import ExpectedLaw, expected_laws
from pdvc.identify.options import IdentifyOptions
from pdvc.options import MeasureOptions
from pdvc.plan import PlannedTest
from pdvc.progress import Progress, silent
from simulator.scenario import Scenario, course_of
from validation.identify.truth import truth_of
from validation.plan.simulated import reference_of


def plan_law(
    scenario: Scenario, measure: MeasureOptions, options: IdentifyOptions, *, progress: Progress = silent
) -> tuple[ExpectedLaw, ...]:
    """Return what is expected of the law of a scenario, whose reference scan is simulated without noise.

    Where the law is the scenario's kind its parameters are the true ones, else those of `options`.
    """
    course = course_of(scenario)
    if options.law.kind == "ludwik":
        options = options.model_copy(update={"law": options.law.with_values(truth_of(scenario.loading))})
    test = PlannedTest(
        angle_rad=course.test_angle_rad,
        time_s=course.test_time_s,
        force_N=course.history.force_N,
        moved_mm=0 * course.test_angle_rad[:, None],
    )
    with tempfile.TemporaryDirectory() as name:
        reference: Experiment = reference_of(scenario, Path(name), progress)
        noise = max(scenario.acquisition.force_noise_N, 1e-3)
        told = options.model_copy(update={"force_noise_N": options.force_noise_N or noise})
        return expected_laws(replace(reference, test=test.recorded()), measure, told, progress=progress)
