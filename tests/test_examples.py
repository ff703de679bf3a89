"""The examples run, as a reader would run them, and say what they promise."""

from __future__ import annotations

import runpy
import tomllib
from pathlib import Path

import pytest

from tests.command_line import install
from validation.methods.registry import GROUP, find_method
from validation.scoring.scores import score
from validation.testing.small_cases import SmallExperiment, small_scenario

EXAMPLES = Path(__file__).parent.parent / "examples"


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


@pytest.mark.parametrize("path", sorted(EXAMPLES.rglob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short_and_begins_with_how_to_run_it(path):
    lines = path.read_text().splitlines()
    assert 10 < len(lines) <= 55
    assert lines[0].startswith('"""')


def test_the_documentation_links_every_example():
    text = (EXAMPLES.parent / "docs" / "examples.md").read_text()
    for path in EXAMPLES.rglob("*.py"):
        assert f"(../{path.relative_to(EXAMPLES.parent).as_posix()})" in text
