"""A plan against what the measurement itself says, and laws of planning."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from pdvc.experiment import read_experiment
from pdvc.measure import measure
from simulator.scanner import simulate
from simulator.truth import read_truth
from tests.command_line import pdvc_bench
from tests.tiny_scenarios import TINY, trial
from validation.calibration import calibration
from validation.plan import designs_around, plan
from validation.plan_tables import designs_csv, designs_table, weak_table
from validation.scores import point_errors

ONE = trial({"sections": 4})


@pytest.fixture(scope="module")
def planned():
    own, _ = designs_around(ONE.scenario, ONE.options)
    designs = (
        replace(own, frames=4 * own.frames),
        replace(own, steps_per_turn=2 * own.steps_per_turn),
        replace(own, flats=100 * own.flats),
        replace(own, turns=0.1, steps_per_turn=10 * own.steps),
    )
    return plan(ONE.scenario, ONE.options, designs)


def test_what_is_planned_is_what_the_measurement_says_of_itself(planned, tmp_path):
    """Planned from the reference scan at rest; measured with motion, noise, and the noise of everything propagated."""
    simulate(ONE.scenario, tmp_path / "experiment")
    truth = read_truth(tmp_path / "experiment")
    measured = measure(read_experiment(tmp_path / "experiment"), ONE.options)
    predicted = calibration(measured, truth, point_errors(measured, truth).components).predicted
    for name in ("across_beam", "vertical"):
        assert getattr(planned.own.deviation, name) == pytest.approx(getattr(predicted, name), rel=0.35), name


def test_more_frames_steps_and_flats_never_make_it_worse(planned):
    frames, steps, flats, _ = (each.deviation for each in planned.others)
    own = planned.own.deviation
    # a weak prior: four times the frames, in flats too, halve the deviations
    assert frames.across_beam == pytest.approx(own.across_beam / 2, rel=0.02)
    for name in ("across_beam", "vertical", "along_beam", "strain"):
        assert getattr(steps, name) < 1.02 * getattr(own, name), name
        assert getattr(flats, name) <= getattr(own, name), name


def test_a_tenth_of_a_turn_hides_the_motion_along_the_beam(planned):
    hidden, own = planned.others[-1].deviation, planned.own.deviation
    assert hidden.along_beam > 5 * own.along_beam
    assert hidden.along_beam / own.along_beam > 2 * hidden.across_beam / own.across_beam


def test_the_weakest_motions_are_told_in_order(planned):
    sizes = [np.linalg.norm(each.deviation_voxel) for each in planned.weak]
    shares = [each.prior_share for each in planned.weak]
    assert shares == sorted(shares, reverse=True)
    assert all(each.deviation_voxel[2] > each.deviation_voxel[0] for each in planned.weak[:1])
    assert len(planned.invisible) == sum(size > 0.5 for size in sizes)
    assert weak_table(planned).row_count == len(planned.weak)
    assert designs_table(planned, ONE.scenario).row_count == 5


def test_the_table_holds_every_design(planned):
    rows = list(csv.DictReader(designs_csv(planned).splitlines()))
    assert len(rows) == 5
    assert float(rows[0]["std_vertical"]) == pytest.approx(planned.own.deviation.vertical, rel=1e-3)


def test_the_command_line(tmp_path):
    (tmp_path / "tiny.toml").write_text(TINY)
    found = pdvc_bench("plan", str(tmp_path / "tiny.toml"), "-o", str(tmp_path / "plan.csv"))
    assert found.exit_code == 0, found.stderr
    assert "expected standard deviations" in found.stdout
    assert len((tmp_path / "plan.csv").read_text().splitlines()) > 8
    wrong = pdvc_bench("plan", "quik")
    assert wrong.exit_code == 2
    assert "did you mean 'quick'" in wrong.stderr
