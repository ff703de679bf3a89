"""The examples run, as a reader would run them, and say what they promise."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from pdvc.record import MeasurementLine, read_record
from tests.command_line import install
from tests.followed_tests import ALARM, OVER, PLAN, step
from tests.tiny_scenarios import SHORT
from validation.methods.registry import GROUP, find_method
from validation.scoring.scores import score
from validation.testing.small_cases import SmallExperiment, small_scenario
from validation.view.places import Places

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"


def run(name, folder, monkeypatch):
    """Run a script with a folder as its only argument, and as working folder."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr("sys.argv", [name, str(folder / "out")])
    return runpy.run_path(str(EXAMPLES / name), run_name="__main__")


def test_one_experiment_is_simulated_measured_and_scored(tmp_path, monkeypatch, capsys):
    run("one_experiment.py", tmp_path, monkeypatch)
    assert "error across the beam 0.0" in capsys.readouterr().out
    for name in ("experiment/experiment.toml", "motion.nc"):
        assert (tmp_path / "out" / name).is_file()


def test_an_option_is_swept(tmp_path, monkeypatch, capsys):
    run("sweep_one_option.py", tmp_path, monkeypatch)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:4]] == ["3", "5", "8"]


def test_laws_of_one_s_own_hold():
    laws = {name: law for name, law in runpy.run_path(str(EXAMPLES / "test_my_law.py")).items() if "test_" in name}
    assert len(laws) == 2
    for law in laws.values():
        law()


def test_a_method_is_found_by_its_entry_point_and_measures(tmp_path, monkeypatch):
    folder = EXAMPLES / "my-method"
    entries = tomllib.loads((folder / "pyproject.toml").read_text())["project"]["entry-points"][GROUP]
    monkeypatch.syspath_prepend(tmp_path)
    install(tmp_path, entries, (folder / "my_method.py").read_text(), name="my_method")
    method = find_method("follows-force")
    assert method.assumes.startswith("Assume that the sample moves in proportion to the force")
    small = SmallExperiment(small_scenario({"motion.ingredients": ["tension", "compliance"]}))
    found = method.measure(small.experiment)
    assert len(found.motion.time_functions) == 2
    # what it assumes holds but for plastic strain, which is no multiple of the force
    assert score(found, small.truth).error_voxel.across_beam < 0.3
    still = SmallExperiment(small_scenario({"motion.ingredients": ["wobble"]}))
    assert score(method.measure(still.experiment), still.truth).error_voxel.across_beam > 0.2


def test_a_study_is_run_from_python(tmp_path, monkeypatch, capsys):
    run("my_study.py", tmp_path, monkeypatch)
    assert "photons_per_pixel" in capsys.readouterr().out
    for name in ("study.toml", "table.parquet", "summary.csv", "study.html"):
        assert (tmp_path / "out" / name).is_file()


def test_a_test_is_played_followed_and_shown_and_nothing_is_left_running(tmp_path):
    (tmp_path / "tiny.toml").write_text(SHORT.replace("plateau_steps = 10", "plateau_steps = 6"))
    command = [sys.executable, EXAMPLES / "follow_a_test.py", tmp_path / "out", tmp_path / "tiny.toml", "0"]
    # ends only once all that it began have closed what they print to
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert re.search(r"^the test is shown at http://127\.0\.0\.1:\d+/$", done.stdout, re.MULTILINE)
    places = Places(file=tmp_path / "out" / "motion.nc")
    assert isinstance(list(read_record(places.record))[-1], MeasurementLine)
    assert json.loads((places.pictures / "latest.json").read_text())["step"] == 13
    assert (places.pictures / "00013.residual.png").is_file()


def test_a_machine_is_stopped_once_where_something_breaks_and_the_rest_is_read(tmp_path):
    begins = replace(ALARM, alarm="sudden", step=2)
    lines = (PLAN, step(0), begins, ALARM, step(6), ALARM, OVER)
    text = "".join(line.text() + "\n" for line in lines)
    done = subprocess.run(
        [sys.executable, EXAMPLES / "stop_on_alarm.py"], input=text, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["STOP", f"crack at step 5: {ALARM.reason}"]
    (shown,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "live.md").read_text(), re.MULTILINE | re.DOTALL)
    assert shown in (EXAMPLES / "stop_on_alarm.py").read_text()


@pytest.mark.parametrize("path", sorted(EXAMPLES.rglob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short_and_begins_with_how_to_run_it(path):
    lines = path.read_text().splitlines()
    assert 10 < len(lines) <= 55
    assert lines[0].startswith('"""')


def test_the_documentation_links_every_example():
    text = (EXAMPLES.parent / "docs" / "examples.md").read_text()
    for path in EXAMPLES.rglob("*.py"):
        assert f"(../{path.relative_to(EXAMPLES.parent).as_posix()})" in text
