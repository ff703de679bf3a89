"""Identification as a user runs it, and what wrong input gets."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pdvc.experiment import read_experiment
from pdvc.identify.options import IdentifyOptions
from pdvc.identify.protocol import choice, identify
from pdvc.identify.result import IdentificationError, read_identification
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.protocol import measure
from simulator.scanner import simulate
from tests.command_line import pdvc_bench
from validation.testing.small_cases import small_options, small_scenario


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("identify")
    scenario = small_scenario()
    simulate(scenario, folder / "experiment", workers=1)
    write_measurement(measure(read_experiment(folder / "experiment"), small_options(scenario)), folder / "motion.nc")
    return folder


@pytest.fixture(scope="module")
def identified(measured):
    command = ["identify", measured / "experiment", "-o", measured / "law.nc", "--measurement", measured / "motion.nc"]
    laws = ["--law", "ludwik", "--law", "linear"]
    more = ["--stroke", "0.018", "--report", measured / "report", "--truth"]
    return pdvc_bench(*(str(each) for each in (*command, *laws, *more)))


def test_the_command_tells_parameters_and_writes_file_and_page(measured, identified):
    assert identified.exit_code == 0, identified.output
    for word in ("yield_MPa", "integrated", "two-step-unweighted", "crosshead", "Log evidence", "Machine compliance"):
        assert word in identified.output
    found = read_identification(measured / "law.nc")
    assert found.law == "ludwik"
    assert set(found.log_evidence) == {"ludwik", "linear"}
    assert set(found.methods) == {"integrated", "two-step", "two-step-unweighted", "crosshead"}
    value, low, high = found.values()["hardening_MPa"]
    assert low < value < high
    page = (measured / "report" / "report.html").read_text(encoding="utf-8")
    assert "579.5" in page
    assert page.count("data:image/png;base64,") == 3
    # one pixel is a tenth of this sample: the areas, and with them all stresses, are known to some per cent
    assert abs(np.log(value / 579.5)) < 4 * found.best.deviation[2]


def test_the_file_says_what_was_found(measured, identified):
    found = read_identification(measured / "law.nc")
    assert identified.exit_code == 0
    assert len(found.combinations()) == found.of_law
    spread = sum(deviation**2 for deviation, _ in found.combinations())
    assert spread == pytest.approx(np.trace(found.best.covariance[: found.of_law, : found.of_law]))
    assert set(found.seen()) == {"young_MPa", "yield_MPa", "hardening_MPa", "exponent"}
    plastic, flow, low, high = found.curve
    assert (np.diff(plastic) > 0).all()
    assert ((low < flow) & (flow < high)).all()


def test_another_experiments_measurement_is_refused(measured):
    opened, motion = read_experiment(measured / "experiment"), read_measurement(measured / "motion.nc")
    other = motion.__class__(
        **{
            **vars(motion),
            "recording": motion.recording.__class__(
                **{**vars(motion.recording), "angle_rad": motion.recording.angle_rad + 0.5}
            ),
        }
    )
    with pytest.raises(ValueError, match=r"measurement: expected one of this experiment"):
        identify(opened, other, IdentifyOptions())


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--law", "hooke"], "law: expected one of"),
        (["--law", "ludwik", "--stroke", "0"], "--stroke: expected a rate above 0 mm/s, given 0.0"),
        (["--identify-options", "nowhere.toml"], "nowhere.toml: expected a TOML file, found none"),
    ],
)
def test_wrong_input_is_answered_in_one_line(measured, more, said):
    wrong = pdvc_bench("identify", str(measured / "experiment"), "-o", str(measured / "wrong.nc"), *more)
    assert wrong.exit_code == 2
    assert said in wrong.output.replace("\n", " ")
    assert not (measured / "wrong.nc").exists()


def test_a_file_that_is_no_identification_is_refused(measured, tmp_path):
    with pytest.raises(IdentificationError, match=r"expected an identification of format 1"):
        read_identification(measured / "motion.nc")
    with pytest.raises(IdentificationError, match=r"found none"):
        read_identification(tmp_path / "nothing.nc")


def test_options_are_explained_as_toml():
    text = IdentifyOptions().template()
    assert "young_MPa" in text
    assert json.dumps("ludwik") in text


def test_a_plan_tells_deviations_for_other_force_programmes(measured, tmp_path):
    told = pdvc_bench("plan", measured / "experiment", "--law", "ludwik", "-o", tmp_path / "plan.csv")
    assert told.exit_code == 0, told.output
    lines = (tmp_path / "plan.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "force programme,young_MPa,yield_MPa,hardening_MPa,exponent"
    assert [line.split(",")[0] for line in lines[1:]] == ["as planned", "2 unloadings", "slower near yield"]
    numbers = np.array([line.split(",")[1:] for line in lines[1:]], dtype=float)
    assert ((numbers > 1e-3) & (numbers < 1.01)).all()


def test_options_written_as_toml_are_read_again_and_a_law_to_compare_that_is_none_is_refused_first(measured, tmp_path):
    path = tmp_path / "identify.toml"
    path.write_text(IdentifyOptions().template(), encoding="utf-8")
    assert IdentifyOptions.read(path) == IdentifyOptions()
    opened, motion = read_experiment(measured / "experiment"), read_measurement(measured / "motion.nc")
    with pytest.raises(ValueError, match=r"law: expected one of .*, got 'hooke'"):
        identify(opened, motion, IdentifyOptions(compare=("hooke",)))


def test_made_up_tests_tell_how_often_the_choice_would_be_right(measured, tmp_path):
    command = ["identify-choice", measured / "experiment", "--measurement", measured / "motion.nc"]
    command += ["-o", tmp_path / "choice.csv", "--draws", "1", "--law", "ludwik", "--law", "linear"]
    told = pdvc_bench(*(str(each) for each in command))
    assert told.exit_code == 0, told.output
    assert "of 2" in told.output
    lines = (tmp_path / "choice.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "true_law,draw,ludwik,linear"
    assert [line.split(",")[0] for line in lines[1:]] == ["ludwik", "linear"]
    assert np.isfinite(np.array([line.split(",")[2:] for line in lines[1:]], dtype=float)).all()


def test_a_choice_of_a_single_law_is_refused(measured):
    opened, motion = read_experiment(measured / "experiment"), read_measurement(measured / "motion.nc")
    with pytest.raises(ValueError, match=r"compare: expected some laws to choose among, found none"):
        choice(opened, motion, IdentifyOptions(), 1)
