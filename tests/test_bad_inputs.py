"""The catalogue of bad inputs, each a mistake of its own; and the bench, where nothing silent passes for answered.

What the whole catalogue gets from the command line is in docs/bad-inputs.md; here a few are carried out.
"""

from __future__ import annotations

import hashlib
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import tomlkit
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from benchmarks.bad_inputs.bench import Bench, Outcome
from benchmarks.bad_inputs.catalogue import CATALOGUE, FOLLOWED
from benchmarks.bad_inputs.experiments import EXPERIMENTS, SMALL
from benchmarks.bad_inputs.record import BadInput, unchanged
from benchmarks.bad_inputs.table import followed_part, measured_part, page, parts, row
from pdvc.experiment import DARKS, DESCRIPTION, FLATS, REFERENCE, TEST
from simulator.scanner import describe, simulate
from simulator.scenario import course_of
from tests.command_line import only_line, pdvc_bench

ALL = (*CATALOGUE, *FOLLOWED)
NAMED = {case.name: case for case in ALL}
BAD = [case for case in CATALOGUE if case.due in ("error", "warning")]
PAGE = Path(__file__).parents[1] / "docs" / "bad-inputs.md"


def made_up(name, folder):
    """Write a folder of the size of `small` with a shadow in it, drawn at random, not simulated."""
    if folder.exists():
        return
    scenario = EXPERIMENTS[name]
    rng = np.random.default_rng(scenario.seed)
    shape = (SMALL.geometry.rows, SMALL.geometry.columns)
    across = np.abs(np.arange(shape[1]) - shape[1] / 2)
    shadow = np.where(across < 10, 0.3 + 0.2 * rng.random(shape), 1.0)
    plan, detector = scenario.acquisition, scenario.detector
    sizes = {REFERENCE: plan.reference_views, TEST: plan.test_steps, FLATS: detector.flats, DARKS: detector.darks}
    for stack, count in sizes.items():
        level = 0 if stack == DARKS else 40000 * (1.0 if stack == FLATS else shadow)
        (folder / stack).parent.mkdir(parents=True, exist_ok=True)
        counts = 800 + level + rng.normal(0, 90, (count, *shape))
        tifffile.imwrite(folder / stack, counts.astype(np.uint16), photometric="minisblack")
    values = describe(SMALL, course_of(SMALL)).model_dump()
    (folder / DESCRIPTION).write_text(tomlkit.dumps(values))


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return Bench(tmp_path_factory.mktemp("bench"), make=made_up)


def digest(folder):
    """Return a digest of all that lies in a folder."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        found.update(str(path.relative_to(folder)).encode())
        found.update(path.read_bytes() if path.is_file() else b"")
    return found.hexdigest()


def test_the_catalogue_is_large_and_each_entry_has_a_name_of_its_own():
    assert len(BAD) >= 80
    assert len(NAMED) == len(ALL)
    assert all(re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name) for name in NAMED)
    assert all(case.wrong.endswith(".") for case in ALL)
    assert {case.experiment for case in ALL} <= set(EXPERIMENTS)
    assert {case.command for case in CATALOGUE} == {"measure"}
    assert {case.command for case in FOLLOWED} == {"prepare", "live", "play", "page", "watch"}
    assert all(case.name.startswith(f"{case.command}-") for case in FOLLOWED)


def test_no_two_inputs_are_the_same_and_none_is_the_good_one(bench, tmp_path):
    seen, good = {}, {}
    for case in ALL:
        if case.change is unchanged:
            what = ""
        else:
            if case.experiment not in good:
                bench.changed(replace(case, change=unchanged), tmp_path / f"good-{len(good)}" / "experiment")
                good[case.experiment] = digest(tmp_path / f"good-{len(good)}")
            bench.changed(case, tmp_path / case.name / "experiment")
            what = digest(tmp_path / case.name)
            assert what != good[case.experiment], case.name
        # what else goes on is no part of the folder
        key = (what, case.experiment, case.options, case.command, case.arguments, case.meanwhile)
        assert key not in seen, f"{case.name} is {seen[key]}"
        seen[key] = case.name
    assert seen["", "small", "", "measure", (), nullcontext] == "good-small"


@pytest.mark.parametrize("name", [name for name in EXPERIMENTS if name != "small"])
def test_each_experiment_is_a_scenario_of_its_own(name):
    scenario = EXPERIMENTS[name]
    # as it will be read back from its folder: what is built without a check is checked here
    assert type(scenario).parse(scenario.model_dump(mode="json"), where=name) == scenario
    assert sum(other == scenario for other in EXPERIMENTS.values()) == 1


@pytest.mark.skipif(not PAGE.is_file(), reason="the page is not written yet: make bad-inputs")
def test_the_page_lists_the_catalogue():
    for part, listed in zip(parts(PAGE.read_text()), (CATALOGUE, FOLLOWED), strict=True):
        rows = [line.split("|")[1].strip().rstrip("*") for line in part.splitlines() if line.startswith("| ")]
        assert rows[2:] == [case.name for case in listed]


answers = st.sampled_from(["", "trusted", "doubtful", "failed"])
cases = st.sampled_from(CATALOGUE)
EXPECTED = "error: experiment.toml: pixel_mm: expected a number"


def measured(case, verdict):
    """Return a result that is shown as it should be."""
    doubts = () if verdict in ("", "trusted") else (("air-level", "0.4", "expose again"),)
    return Outcome(
        case=case,
        code=0,
        console=(f"verdict: {verdict}",),
        verdict=verdict,
        doubts=doubts,
        report=f"{verdict} air-level",
    )


@settings(deadline=None)
@given(case=cases, verdict=answers)
def test_a_result_is_answered_only_by_the_verdict_that_is_due(case, verdict):
    faults = measured(case, verdict).faults
    allowed = {
        "error": (),
        "warning": ("doubtful", "failed"),
        "good": ("trusted",),
        "unknowable": ("", "trusted", "doubtful", "failed"),
    }
    assert (not faults) == (verdict in allowed[case.due])
    if case.due in ("error", "warning") and verdict in ("", "trusted"):
        assert faults == ("SILENT",)


@settings(deadline=None)
@given(case=cases)
def test_an_error_is_an_answer_to_all_but_good_inputs(case):
    assert (not Outcome(case=case, code=2, console=(EXPECTED,)).faults) == (case.due != "good")


@settings(deadline=None)
@given(case=cases, code=st.sampled_from([0, 1, 2, -9, None]), verdict=answers)
def test_what_is_not_meant_for_a_user_is_always_a_fault(case, code, verdict):
    seen = replace(measured(case, verdict), code=code)
    assume(code != 0 or not seen.faults)
    for line in ("Traceback (most recent call last):", "pdvc/equations.py:12: RuntimeWarning: overflow"):
        assert replace(seen, console=(*seen.console, EXPECTED, line)).faults
    assert replace(seen, console=(*seen.console, EXPECTED), left=("motion.nc.work",)).faults


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"console": ("measurement.nc",)}, "verdict not on the console"),
        ({"report": "doubtful"}, "verdict not in the report"),
        ({"report": None}, "no report"),
        ({"doubts": ()}, "no reasons"),
        ({"doubts": (("air-level", "0.4", ""),)}, "a reason without figure or advice"),
        ({"left": ("motion.nc.work",)}, "leaves motion.nc.work"),
        (
            {"code": 2, "console": ("error: 756-th leading minor of the array is not positive definite",)},
            "unclear error",
        ),
        ({"code": 2, "console": (EXPECTED, EXPECTED)}, "unclear error"),
        ({"code": 2, "console": (EXPECTED + ", given {'rows': 3}",)}, "unclear error"),
        ({"code": 2}, "CRASH, exit code 2"),
        ({"code": 1, "console": (EXPECTED,)}, "CRASH, exit code 1"),
        ({"code": None}, "NO END"),
    ],
)
def test_a_warning_that_a_user_would_not_see_is_a_fault(changes, fault):
    assert replace(measured(NAMED["test-all-zero"], "doubtful"), **changes).faults == (fault,)


@pytest.mark.parametrize("name", ["no-flats", "description-decimal-comma", "motion-unknown", "protocol-misspelt"])
def test_inputs_that_cannot_be_read_are_answered_with_an_error(bench, name):
    seen = bench.outcome(NAMED[name])
    assert seen.code == 2
    assert len(seen.console) == 1
    assert seen.answer == "error"
    assert not seen.faults


def test_a_command_that_does_not_end_is_stopped_and_shown(bench, tmp_path):
    hasty = Bench(tmp_path, limit_s=0.01, make=made_up)
    seen = hasty.outcome(NAMED["good-small"])
    assert seen.faults == ("NO END",)
    assert row(seen)[2] == "**NO END**"


def test_a_good_test_is_measured_and_reported_by_the_bench(tmp_path):
    plan = SMALL.acquisition.model_copy(update={"reference_views": 40, "test_steps": 20, "subpixels": 1})
    loading = SMALL.loading.model_copy(update={"plateau_steps": 5})
    scenario = SMALL.model_copy(update={"acquisition": plan, "loading": loading})
    options = '[[time]]\nkind = "polynomial"\n[[rigid]]\nscale = 2\n[[deformation]]\nscale = 1\n'
    case = BadInput(name="quickly", wrong="Nothing.", due="good", options=options)
    bench = Bench(tmp_path, make=lambda name, folder: simulate(scenario, folder))
    seen = bench.outcome(case)
    assert seen.code == 0, seen.console
    assert 0 < seen.strain < 0.2
    assert (seen.report is not None) == (seen.verdict != "")
    assert not seen.raw
    assert not seen.left
    assert not (tmp_path / case.name).exists()


@pytest.mark.parametrize(
    "name",
    [
        *("prepare-nowhere", "live-no-radiographs-folder", "live-table-header", "live-record-complete"),
        *("live-into-a-folder", "live-idle-negative", "play-from-beyond", "play-into-a-table", "page-port-70000"),
        *("page-port-in-use", "page-record-random", "watch-plan-of-another-kind"),
    ],
)
def test_commands_about_a_test_that_runs_answer_in_one_line(bench, monkeypatch, name):
    monkeypatch.setattr(bench, "ready", bench.simulated)  # so that nothing is prepared: it is not needed
    seen = bench.outcome(NAMED[name])
    assert seen.code == NAMED[name].code
    assert len(seen.errors) == 1
    assert not seen.faults


def test_what_live_would_find_in_the_end_is_refused_before_anything_is_made(bench, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for radiographs, out, work, said in (
        ("none", "motion.nc", "work", "expected a folder of radiographs, found none"),
        ("file", "motion.nc", "work", "expected a folder of radiographs, found a file"),
        ("folder", "folder", "work", "expected a file to write, found a folder"),
        ("folder", "motion.nc", "file", "--work: expected a folder, or none yet, found"),
    ):
        result = pdvc_bench(
            *("live", bench.simulated("small"), "--radiographs", tmp_path / radiographs),
            *("-o", tmp_path / out, "--work", tmp_path / work),
        )
        assert result.exit_code == 2
        assert said in only_line(result)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize(
    ("name", "changes", "faults"),
    [
        ("live-step-twice", {}, ()),
        ("live-step-twice", {"code": 2, "console": ("lost: table: expected a step", EXPECTED)}, ()),
        ("live-step-twice", {"console": ("verdict: trusted",)}, ("SILENT",)),
        ("live-step-twice", {"code": 2, "console": (EXPECTED,)}, ("SILENT",)),
        ("live-step-twice", {"console": ("lost: step 1",)}, ("unclear error",)),
        ("live-table-header", {}, ("SILENT",)),
        ("live-work-in-use", {"code": 1, "console": ("error: ready: in use by process 7",)}, ()),
        ("live-work-in-use", {"code": 2, "console": ("error: ready: in use by process 7",)}, ("CRASH, exit code 2",)),
        ("page-port-70000", {"code": 2, "console": ("╭─ Error ─╮", "│ Input should │", "│ be less │", "╰─╯")}, ()),
        ("page-port-70000", {"code": 2, "console": ("Usage: page",)}, ("CRASH, exit code 2",)),
    ],
)
def test_what_was_lost_has_to_be_told_and_an_error_has_its_exit_code(name, changes, faults):
    seen = Outcome(case=NAMED[name], code=0, console=("lost: table: expected a step",))
    assert replace(seen, **changes).faults == faults


def test_a_page_is_of_two_parts_each_of_which_can_be_written_alone():
    measurements = measured_part([measured(case, "trusted") for case in CATALOGUE], "a machine", 180.0)
    tests = followed_part([Outcome(case=case, code=2, console=(EXPECTED,)) for case in FOLLOWED], "a machine", 60.0)
    assert parts(page(measurements, tests)) == (measurements, tests)
    assert parts("# Bad inputs\n") == ("", "")


def test_silent_inputs_are_counted_first_and_marked_in_their_rows():
    outcomes = [measured(case, "trusted") for case in CATALOGUE]
    text = measured_part(outcomes, "a machine", 180.0)
    silent = [case.name for case in BAD]
    assert f"{len(BAD)} x SILENT" in text
    assert re.findall(r"^\| ([a-z0-9-]+) .*\*\*SILENT\*\*", text, re.M) == silent
