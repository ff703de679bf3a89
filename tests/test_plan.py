"""A plan against what the measurement itself says, and laws of planning."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc.experiment import Series, read_experiment
from pdvc.history import Fourier, Polynomial, Ramp, time_basis
from pdvc.protocol import measure
from simulator.scanner import simulate
from simulator.truth import read_truth
from tests.command_line import pdvc_bench
from tests.laws import law
from tests.tiny_scenarios import TINY, trial
from validation.plan.simulated import design_of, plan
from validation.plan.tables import designs_csv, designs_table, weak_table
from validation.scoring.interval_calibration import interval_calibration
from validation.scoring.scores import point_errors
from validation.testing.small_cases import small_options, small_scenario

ONE = trial({"sections": 4})


@pytest.fixture(scope="module")
def planned():
    own = design_of(ONE.scenario, ONE.options)
    designs = (
        replace(own, frames=4 * own.frames),
        replace(own, steps_per_turn=2 * own.steps_per_turn),
        replace(own, flats=100 * own.flats),
        # several steps, at different angles, next to each reference view
        replace(own, steps_per_turn=8 * own.steps_per_turn),
        replace(own, turns=0.1, steps_per_turn=10 * own.steps),
    )
    return plan(ONE.scenario, ONE.options, designs)


def test_what_is_planned_is_what_the_measurement_says_of_itself(planned, tmp_path):
    """Planned from the reference scan at rest; measured with motion, noise, and the noise of everything propagated."""
    simulate(ONE.scenario, tmp_path / "experiment")
    truth = read_truth(tmp_path / "experiment")
    measured = measure(read_experiment(tmp_path / "experiment"), ONE.options)
    predicted = interval_calibration(measured, truth, point_errors(measured, truth).components).predicted
    for name in ("across_beam", "vertical"):
        assert getattr(planned.own.deviation, name) == pytest.approx(getattr(predicted, name), rel=0.35), name


@pytest.mark.parametrize("steps_per_turn", [400, 72])
def test_steps_at_different_angles_may_look_along_the_same_view(tmp_path, steps_per_turn):
    """Its noise joins them as their own sensitivities see it: of 18 steps over an arc, one to six for each view.

    Along the beam, which hardly shows, it counts most: were they taken to see alike, the plan would say two to four
    times as much as the measurement does.
    """
    scenario = small_scenario({"acquisition.start_deg": -8.0, "acquisition.steps_per_turn": steps_per_turn})
    options = small_options(scenario).model_copy(update={"sections": 3})
    simulate(scenario, tmp_path / "experiment")
    truth = read_truth(tmp_path / "experiment")
    measured = measure(read_experiment(tmp_path / "experiment"), options)
    stated = interval_calibration(measured, truth, point_errors(measured, truth).components).predicted
    found = plan(scenario, options, [], count=1).own.deviation
    assert found.along_beam == pytest.approx(stated.along_beam, rel=0.35)


def test_more_frames_steps_and_flats_never_make_it_worse(planned):
    frames, steps, flats, dense, _ = (each.deviation for each in planned.others)
    own = planned.own.deviation
    # a weak prior: four times the frames, in flats too, halve the deviations, but for what re-projection leaves
    assert own.across_beam / 2 < frames.across_beam < 0.65 * own.across_beam
    # along the beam it is what re-projection leaves that counts here, and other steps see other parts of it
    most = {"across_beam": 1.02, "vertical": 1.02, "along_beam": 1.06, "strain": 1.02}
    for name in most:
        assert getattr(steps, name) < 1.02 * getattr(own, name), name
        assert getattr(flats, name) <= getattr(own, name), name
        assert getattr(dense, name) < most[name] * getattr(steps, name), name


def test_a_tenth_of_a_turn_hides_the_motion_along_the_beam(planned):
    hidden, own = planned.others[-1].deviation, planned.own.deviation
    assert hidden.along_beam > 3 * own.along_beam
    assert hidden.along_beam / own.along_beam > 2 * hidden.across_beam / own.across_beam


def test_the_weakest_motions_are_told_in_order(planned):
    shares = [each.prior_share for each in planned.weak]
    assert shares == sorted(shares, reverse=True)
    assert all(each.deviation_voxel[2] > each.deviation_voxel[0] for each in planned.weak[:1])
    assert weak_table(planned).row_count == len(planned.weak) == 6
    assert designs_table(planned, ONE.scenario.name).row_count == 6


@pytest.mark.parametrize(
    ("beam_deg", "photons", "named", "invisible"),
    [
        (0.0, 105.0, {"translation_x"}, 1),
        (15.0, 64000.0, {"translation_x"}, 0),
        (30.0, 64000.0, {"translation_x", "translation_y"}, 0),
        (45.0, 64000.0, {"translation_x", "translation_y"}, 0),
        (90.0, 64000.0, {"translation_y"}, 0),
    ],
)
def test_a_test_that_hardly_turns_hides_what_moves_along_its_beam(beam_deg, photons, named, invisible):
    """Eighteen steps over 16 degrees about the direction named, from x towards -y.

    The weakest motions are shifts along the beam, made of the axes by the squares of its cosines: a quarter of one is
    told (30 degrees), a fifteenth is not (15 degrees). With few photons one of them is known to just over half a
    voxel, the next to just under; with 600 times as many none is invisible.
    """
    scenario = small_scenario(
        {
            "acquisition.start_deg": beam_deg - 8.0,
            "acquisition.steps_per_turn": 400,
            "detector.photons_per_pixel": photons,
        }
    )
    found = plan(scenario, small_options(scenario).model_copy(update={"sections": 3}), [], count=3)
    assert set(found.weak[0].motions) == named
    for each in found.weak:
        across, vertical, along = each.deviation_voxel
        assert along > 9 * max(across, vertical)
    assert found.invisible == found.weak[:invisible]
    caption = str(weak_table(found).caption)
    assert ("none is invisible" in caption) == (invisible == 0)
    assert (f"{invisible} known to no better than 0.5 voxel" in caption) == (invisible > 0)


@law(30)
@given(
    st.integers(2, 4),
    st.integers(8, 20),
    st.data(),
)
def test_stretched_time_functions_are_the_same_functions_of_time(times, steps, data):
    """Of a test with so many times the radiographs, those taken when the scenario's are see the scenario's basis."""
    start = data.draw(st.integers(1, steps - 4))
    part = data.draw(
        st.sampled_from(
            (Ramp(start=start, powers=(1,)), Ramp(start=start, powers=(0, 2)), Fourier(period=start + 4, harmonics=1))
        )
    )

    def basis(parts, count):
        nothing = np.zeros(count)
        series = Series(
            counts=np.zeros((count, 1, 1), dtype=np.uint16), angle_rad=nothing, time_s=nothing, force_N=nothing
        )
        return time_basis(parts, series)

    own = basis((Polynomial(degree=0), part), steps)
    often = basis([each.stretched(times) for each in (Polynomial(degree=0), part)], times * steps)[:, ::times]
    span, _ = np.linalg.qr(own.T)
    assert np.linalg.matrix_rank(often, tol=1e-6) == len(own)
    np.testing.assert_allclose(often.T, span @ (span.T @ often.T), atol=1e-9)


def test_the_table_holds_every_design(planned):
    rows = list(csv.DictReader(designs_csv(planned).splitlines()))
    assert len(rows) == 6
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
