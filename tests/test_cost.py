"""The machine time of a method, against the paper's numbers."""

import numpy as np
import pytest

from pdvc.experiment import Experiment, InterruptedScan, Series
from simulator.scenario import course_of, load_scenario
from validation.methods.cost import cost_of_projections, cost_of_stack, cost_of_volumes


def series(time_s):
    nothing = np.zeros(len(time_s))
    return Series(counts=np.zeros((len(time_s), 1, 1), np.uint16), angle_rad=nothing, time_s=time_s, force_N=nothing)


def experiment(name, steps):
    scenario = load_scenario(name)
    scenario = scenario.model_copy(update={"interrupted": scenario.interrupted.model_copy(update={"steps": steps})})
    course = course_of(scenario)
    blank = np.zeros((1, 1, 1), np.uint16)
    return Experiment(
        title="",
        material="",
        geometry=scenario.geometry.cone_beam(),
        frames=1,
        photons_per_count=None,
        readout_noise_counts=None,
        reference=series(course.reference_time_s),
        test=series(course.test_time_s),
        flats=blank,
        darks=blank,
        interrupted=tuple(
            InterruptedScan(step=step, series=series(time_s))
            for step, time_s in zip(steps, course.interrupted_time_s, strict=True)
        ),
    )


@pytest.mark.parametrize(("name", "views"), [("quick", 150), ("jailin2018", 600)])
def test_a_scan_takes_22_minutes_and_the_test_four_as_in_the_paper(name, views):
    used = experiment(name, (0, 55, 126))
    assert cost_of_stack(used.reference).minutes == pytest.approx(22)
    by_projections, by_volumes = cost_of_projections(used), cost_of_volumes(used)
    assert by_projections.radiographs == views + 127
    assert by_projections.minutes == pytest.approx(22 + 127 * 2 / 60)
    assert by_volumes.radiographs == 4 * views
    assert by_volumes.minutes == pytest.approx(4 * 22)


def test_one_radiograph_alone_has_no_duration():
    assert cost_of_stack(series(np.array([7.0]))).minutes == 0.0
