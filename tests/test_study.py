"""Studies as a user writes and runs them: designs, mistakes, a whole one, and one that is broken off on the way."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulator.scenario import course_of, load_scenario
from simulator.streams import stream
from tests.command_line import only_line, pdvc_bench
from tests.laws import law
from validation.batch.engine import is_done
from validation.study.description import Study, builtin_studies, combinations, study_file, trials_of

SCENARIO = """
name = "tiny"
discarded_rows = 4
[specimen]
facet_mm = 0.12
thinned = "both"
[graphite]
mean_diameter_mm = 0.4
smallest_diameter_mm = 0.2
largest_diameter_mm = 0.8
[geometry]
rows = 40
columns = 24
pixel_mm = 7.1
[acquisition]
reference_views = 20
test_steps = 16
steps_per_turn = 8
subpixels = 2
[loading]
plateau_steps = 8
stroke_mm_per_s = 0.01
necking_strain = 0.0
"""
BASE = """
name = "tiny"
title = "Small enough for a test"
scenario = "tiny.toml"
repetitions = 2
[change.options]
beam_hardening = "none"
section_motions = ["translation_x", "translation_y", "translation_z", "rotation_z"]
time = [{ kind = "force" }, { kind = "angle" }, { kind = "polynomial" }]
rigid = [{ solver = { kind = "gauss-newton", most_passes = 2 } }]
deformation = [{ solver = { kind = "gauss-newton", most_passes = 1 } }]
"""
FACTORS = """
[[factor]]
key = "scenario.detector.photons_per_pixel"
values = [500, 8000.0]
log = true
[[factor]]
key = "options.sections"
values = [3, 5]
"""


def written(folder: Path, text: str) -> Path:
    (folder / "tiny.toml").write_text(SCENARIO)
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


def trials(folder: Path, text: str):
    path = written(folder, text)
    return trials_of(Study.read(path), path)


class TestDesigns:
    def test_a_grid_takes_every_value_with_every_other_and_repeats(self, tmp_path):
        found = trials(tmp_path, BASE + FACTORS)
        assert [tuple(trial.columns.values()) for trial in found] == [
            (photons, sections, 0, repetition)
            for photons in (500.0, 8000.0)
            for sections in (3, 5)
            for repetition in range(2)
        ]
        for trial in found:
            assert trial.scenario.detector.photons_per_pixel == trial.factors["photons_per_pixel"]
            assert trial.options.sections == trial.factors["sections"]
            assert trial.options.rigid[0].solver.kind == "gauss-newton"
            assert trial.scenario.geometry.rows == 40
        assert len({trial.key for trial in found}) == 8

    def test_a_list_takes_values_side_by_side(self, tmp_path):
        found = trials(tmp_path, 'design = "list"\n' + BASE + FACTORS)
        assert [tuple(trial.factors.values()) for trial in found[::2]] == [(500.0, 3), (8000.0, 5)]

    def test_several_keys_may_change_together_under_a_name(self, tmp_path):
        turns = """
            [[factor]]
            key = ["scenario.acquisition.test_steps", "scenario.acquisition.steps_per_turn", "options.time"]
            values = [[16, 8, [{ kind = "force" }]], [24, 8, [{ kind = "polynomial", degree = 2 }]]]
            name = "turns"
            names = [2, 3]
        """
        first, *_, last = trials(tmp_path, BASE + turns)
        assert (first.factors, last.factors) == ({"turns": 2}, {"turns": 3})
        assert (first.scenario.acquisition.test_steps, last.scenario.acquisition.test_steps) == (16, 24)
        assert (first.options.time[0].kind, last.options.time[0].kind) == ("force", "polynomial")

    def test_a_table_changes_the_keys_that_it_names_and_leaves_the_others(self, tmp_path):
        protocols = """
            [[factor]]
            key = "options"
            name = "method"
            names = ["base", "weighted"]
            [[factor.values]]
            [[factor.values]]
            sections = 4
            weighting = "noise"
            [[factor]]
            key = "options.sections"
            values = [5]
        """
        base, _, other, _ = trials(tmp_path, BASE + protocols)
        assert (base.factors, other.factors) == (
            {"method": "base", "sections": 5},
            {"method": "weighted", "sections": 5},
        )
        assert base.options.weighting == "uniform"
        # the later factor has the last word, and what the table does not name is as in the base
        assert other.options == base.options.model_copy(update={"weighting": "noise"})
        assert other.options.rigid[0].solver.kind == "gauss-newton"

    def test_values_of_several_types_become_text_in_the_table(self, tmp_path):
        factor = '[[factor]]\nkey = "options.beam_hardening"\nvalues = ["fit", "none", [0.9, 0.1, 0.0]]\n'
        found = trials(tmp_path, BASE + factor)
        assert [trial.factors["beam_hardening"] for trial in found[::2]] == ["fit", "none", "[0.9, 0.1, 0.0]"]
        assert found[-1].options.beam_hardening == (0.9, 0.1, 0.0)

    def test_without_factors_the_base_is_repeated(self, tmp_path):
        found = trials(tmp_path, BASE.replace("repetitions = 2", "repetitions = 5\nseed = 3"))
        assert [dict(trial.columns) for trial in found] == [{"seed": 3, "repetition": r} for r in range(5)]

    def test_the_same_repetition_has_the_same_noise_in_every_combination(self, tmp_path):
        found = trials(tmp_path, BASE + FACTORS)
        draws = [stream(trial.scenario, "test", 5).random() for trial in found]
        assert draws == draws[:2] * 4
        assert draws[0] != draws[1]

    @law(30)
    @given(st.integers(1, 40), st.integers(0, 5), st.integers(1, 3))
    def test_a_latin_hypercube_meets_each_part_of_each_range_once(self, samples, seed, factors):
        keys = [
            "scenario.detector.photons_per_pixel",
            "scenario.misalignment.lean_deg",
            "scenario.xray.silicon_fraction",
        ]
        low, high = 10.0, 1e5
        described = [{"key": key, "low": low, "high": high, "log": n == 0} for n, key in enumerate(keys[:factors])]
        values = {"name": "x", "seed": seed, "design": "latin-hypercube", "samples": samples, "factor": described}
        study = Study.parse(values, where="test")
        base = {"scenario": load_scenario("small").model_dump(mode="json")}
        points = np.array([list(each.factors.values()) for each in combinations(study, base)])
        assert points.shape == (samples, factors)
        share = (points - low) / (high - low)
        share[:, 0] = np.log(points[:, 0] / low) / np.log(high / low)
        np.testing.assert_array_equal(
            np.sort(np.floor(share * samples), axis=0), np.arange(samples)[:, None] + 0 * share
        )

    def test_a_latin_hypercube_rounds_whole_numbers_and_takes_values_evenly(self, tmp_path):
        text = 'design = "latin-hypercube"\nsamples = 6\n' + BASE
        text += '[[factor]]\nkey = "options.sections"\nlow = 3\nhigh = 9\n'
        text += '[[factor]]\nkey = "options.weighting"\nvalues = ["uniform", "noise"]\n'
        found = trials(tmp_path, text)[::2]
        assert all(isinstance(trial.options.sections, int) for trial in found)
        assert sorted(trial.factors["weighting"] for trial in found) == ["noise"] * 3 + ["uniform"] * 3


FACTOR = '[[factor]]\nkey = "scenario.detector.frames"\n'
MISTAKES = {
    "repetition = 3\n" + BASE: "study.toml: repetition: unknown key",
    BASE + FACTOR + "values = [1, 0]": "detector.frames = 0: scenario: detector.frames: expected greater than",
    BASE + FACTOR + 'values = ["many"]': "detector.frames: expected a valid integer, given 'many'",
    BASE + FACTOR.replace("frames", "photons_per_pixl") + "values = [1.0]": (
        "'scenario.detector.photons_per_pixl': unknown key; did you mean 'scenario.detector.photons_per_pixel'?"
    ),
    BASE + FACTOR.replace("scenario.", "") + "values = [1]": "unknown key; did you mean 'scenario.detector.frames'?",
    BASE + FACTOR.replace("detector.frames", "repetition") + "values = [1]": "scenario.repetition is what",
    BASE + FACTOR: "factor.0: expected either values, or low and high",
    BASE + FACTOR + "low = 1\nhigh = 5": "values of factor frames, as a grid takes no low and high",
    BASE + FACTOR + "values = [1]\n" + FACTOR + "values = [2]": "expected another name for factor frames",
    BASE + FACTOR + 'values = [1]\nname = "strain_rms"': "expected another name for factor strain_rms",
    'draw = ["strech_share"]\n' + BASE: "among the scores, got 'strech_share'; did you mean 'stretch_share'?",
    'draw = ["verdict"]\n' + BASE: "expected draw of numbers among the scores, got 'verdict'",
    BASE + FACTOR + 'values = [1, 2]\nnames = ["one"]': "as many names as values, 2, got 1",
    BASE + '[[factor]]\nkey = ["options.sections", "options.weighting"]\nvalues = [[1]]': "a list of 2, one for",
    BASE + '[[factor]]\nkey = "options"\n[[factor.values]]\nsection = 3': (
        "study.toml: factor.options.section: unknown key; did you mean 'sections'?"
    ),
    BASE + '[[factor]]\nkey = "options.discard_rows"\nvalues = [20]': "options.discard_rows = 20: options:",
    'design = "list"\n' + BASE + FACTORS.replace("[3, 5]", "[3]"): "as many values of each factor in a list",
    'design = "latin-hypercube"\n' + BASE + FACTORS: "expected samples for design = 'latin-hypercube'",
    'design = "random"\n' + BASE: "'latin-hypercube', 'morris' or 'sobol', given 'random'",
    'design = "sobol"\nsamples = 6\n' + BASE + FACTORS: "samples a power of two for design = 'sobol', got 6",
    'design = "morris"\nsamples = 6\n' + BASE: "at least one [[factor]] for design = 'morris'",
    BASE + FACTOR + 'relative = true\nvalues = ["twice"]': "numbers, as the factor is relative, got ('twice',)",
    BASE + FACTOR.replace("detector.frames", "scanner.scatter.ratio") + "relative = true\nvalues = [2]": (
        "scatter.ratio': expected a number other than 0 in the base, as the factor is relative, found 0.0"
    ),
    BASE + FACTOR.replace("detector.frames", "specimen.thinned") + "relative = true\nvalues = [2]": "found 'both'",
    BASE.replace("[change.options]", "[change.option]"): "change.option: unknown key; did you mean 'options'?",
    BASE + '[change.scenario.detector]\nframe = 3': "change.scenario.detector.frame: unknown key; did you mean",
    BASE + '[change.scenario.detector]\nframes = 3.5': "scenario: detector.frames: expected a valid integer",
    BASE.replace("tiny.toml", "none.toml"): "none.toml: expected a TOML file, found none",
    BASE.replace('"tiny.toml"', '"smal"'): "given 'smal'; did you mean 'small'?",
    'options = "papr"\n' + BASE: "papr: expected a TOML file, found none",
    "name = \n": "study.toml: not valid TOML",
}  # fmt: skip


@pytest.mark.parametrize(("text", "answer"), MISTAKES.items())
def test_a_mistake_is_answered_in_one_line_before_anything_is_done(tmp_path, text, answer):
    path = written(tmp_path, text)
    result = pdvc_bench("study", path, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert answer in only_line(result)
    assert str(tmp_path) in only_line(result) or "did you mean" in answer
    assert not (tmp_path / "out").exists()


def test_the_studies_of_the_documentation_are_valid(tmp_path):
    text = (Path(__file__).parent.parent / "docs" / "studies.md").read_text()
    first, second, third = (block.partition("```")[0] for block in text.split("```toml")[1:])
    found = trials(tmp_path, first)
    assert len(found) == 3 * 2 * 10
    assert found[-1].factors == {"photons_per_pixel": 8000.0, "nodules": "coarse"}
    assert found[-1].scenario.graphite.mean_diameter_mm == 0.4
    assert len(trials(tmp_path, 'name = "spread"\nrepetitions = 1\n' + second)) == 40
    relative = trials(tmp_path, 'name = "drift"\nrepetitions = 1\ndesign = "morris"\nsamples = 2\n' + third)
    usual = load_scenario("laboratory").scanner.open_beam
    for trial in relative:
        at = trial.scenario.scanner.open_beam
        assert at.drift_per_hour == pytest.approx(trial.factors["beam_drift"] * usual.drift_per_hour)
        assert at.tilt_per_hour == pytest.approx(trial.factors["beam_drift"] * usual.tilt_per_hour)


def test_an_unknown_study_is_answered_with_those_there_are(tmp_path):
    result = pdvc_bench("study", "nois", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "did you mean 'noise'?" in only_line(result)


RUNS = {"noise": 80, "views-per-turn": 60, "sections": 60, "coverage": 60, "capture": 45, "resolution": 90}
RUNS |= {"honest": 20, "identification": 16, "which-error-matters": 64, "which-error-matters-most": 48}


@pytest.mark.parametrize(("name", "runs"), RUNS.items())
def test_builtin_studies_are_valid_and_printed_as_they_are_written(name, runs):
    assert name in builtin_studies()
    path = study_file(name)
    found = trials_of(Study.read(path), path)
    assert len({trial.key for trial in found}) == len(found) == runs
    assert pdvc_bench("studies", name).stdout == path.read_text()
    assert f"{runs}" in next(line for line in pdvc_bench("studies").stdout.splitlines() if line.startswith(name))


def test_the_extensions_of_the_capture_study_are_those_of_its_motion():
    path = study_file("capture")
    found = {trial.factors["extension_voxel"]: trial.scenario for trial in trials_of(Study.read(path), path)}
    for voxels, scenario in found.items():
        course, view = course_of(scenario), scenario.view_mm
        low, high = course.motion.forward(np.array([[0, 0, -view], [0, 0, view]]), len(course.test_time_s) - 1)
        extension_mm = high[2] - low[2] - 2 * view
        assert extension_mm / scenario.geometry.cone_beam().voxel_mm == pytest.approx(voxels, rel=0.02)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory, address):
    """Carry out a study of two values, twice each, once; the tests below look at what it left."""
    folder = tmp_path_factory.mktemp("study")
    text = BASE + FACTORS.replace("[3, 5]", "[3]")
    result = pdvc_bench("study", written(folder, text), "-o", folder / "out", "--scheduler", address)
    assert result.exit_code == 0, result.stderr
    return folder, result


def comparable(folder: Path) -> pd.DataFrame:
    table = pd.read_parquet(folder / "table.parquet")
    return table[[name for name in table.columns if not name.startswith("seconds")]]


class TestAWholeStudy:
    def test_it_leaves_all_it_promises(self, undisturbed):
        folder, result = undisturbed
        out = folder / "out"
        assert str(out / "study.html") in result.stderr
        table = pd.read_parquet(out / "table.parquet")
        assert len(table) == len(list((out / "runs").iterdir())) == len(list((out / "errors").iterdir())) == 4
        assert set(table["status"]) == {"done"}
        assert table["seconds"].min() > 0
        assert {path.name for path in out.iterdir()} == {
            *("runs", "errors", "failed", "figures", "table.parquet"),
            *("summary.csv", "scores.csv", "coverage.csv", "study.html", ".in-use"),
        }
        assert len(list((out / "figures").iterdir())) == 2
        assert str(FACTORS.splitlines()[2]) in (out / "study.html").read_text().replace("&#34;", '"')

    def test_more_photons_leave_less_random_error(self, undisturbed):
        folder, _ = undisturbed
        summary = pd.read_csv(folder / "out" / "summary.csv").set_index(["photons_per_pixel", "sections"])
        dark, bright = (summary.loc[(photons, 3), "random_voxel_across_beam"] for photons in (500, 8000))
        assert 2 < dark / bright < 8  # 4 if photon noise were all

    def test_asked_again_it_only_draws_anew(self, undisturbed, monkeypatch):
        folder, _ = undisturbed
        before = {path: path.stat().st_mtime_ns for path in (folder / "out" / "runs").iterdir()}
        (folder / "out" / "study.html").unlink()
        monkeypatch.setattr("validation.batch.engine.connected", None)
        monkeypatch.setattr("validation.study.page.study_pictures", lambda *_: [])
        result = pdvc_bench("study", folder / "study.toml", "-o", folder / "out")
        assert result.exit_code == 0, result.stderr
        assert {path: path.stat().st_mtime_ns for path in (folder / "out" / "runs").iterdir()} == before
        assert (folder / "out" / "study.html").exists()

    def test_effects_are_those_of_the_runs_that_the_command_line_made(self, address, tmp_path, monkeypatch):
        monkeypatch.setattr("validation.study.page.study_pictures", lambda *_: [])
        base = BASE.replace("repetitions = 2", 'repetitions = 1\ndesign = "morris"\nsamples = 2\n')
        base += "[change.scenario]\nscanner.scatter.ratio = 0.05\nscanner.lag.share = 0.05\n"
        for key in ("scatter.ratio", "lag.share"):
            base += f'[[factor]]\nkey = "scenario.scanner.{key}"\nrelative = true\nlow = 0.0\nhigh = 2.0\n'
        out = tmp_path / "out"
        result = pdvc_bench("study", written(tmp_path, base), "-o", out, "--scheduler", address)
        assert result.exit_code == 0, result.stderr
        found = pd.read_csv(out / "sensitivity.csv").set_index(["factor", "part", "quantity"])
        table = pd.read_parquet(out / "table.parquet")
        steps = table[["ratio", "share", "bias_voxel_vertical"]].diff().drop(index=[0, 3])
        for name in ("ratio", "share"):
            moved = steps[steps[name] != 0]
            assert len(moved) == 2
            # changes are over the whole range, 0 to 2
            change = 2 * moved["bias_voxel_vertical"] / moved[name]
            told = found.loc[(name, "bias", "voxel_vertical")]
            assert told["mu_star"] == pytest.approx(change.abs().mean())
            assert told["mu"] == pytest.approx(change.mean())
            assert told["sigma"] == pytest.approx(change.std())
        assert "bias: mean change over its range, mu*" in result.stdout
        assert (out / "figures" / "sensitivity.png").exists()
        page = (out / "study.html").read_text()
        assert page.count("<tr>", page.index('id="sensitivity"'), page.index("<h2>Errors")) == 4

    def test_a_run_that_fails_is_a_row_and_the_rest_goes_on(self, address, tmp_path, monkeypatch):
        monkeypatch.setattr("validation.study.page.study_pictures", lambda *_: [])
        # a beam that makes less than a count is none
        factor = """
            [[factor]]
            key = ["scenario.detector.counts_full", "scenario.detector.readout_noise_counts"]
            values = [[40000.0, 30.0], [0.1, 0.0]]
        """
        text = BASE.replace("repetitions = 2", "repetitions = 1") + factor
        result = pdvc_bench("study", written(tmp_path, text), "-o", tmp_path / "out", "--scheduler", address)
        assert result.exit_code == 0, result.stderr
        assert "1 of 2 runs failed" in result.stderr
        table = pd.read_parquet(tmp_path / "out" / "table.parquet")
        assert list(table["status"]) == ["done", "failed"]
        assert table["reason"][1].startswith("ExperimentError: flats.tif: ")
        assert np.isnan(table["error_voxel_vertical"][1])
        assert table["reason"][1].partition(": ")[2] in (tmp_path / "out" / "study.html").read_text()


def test_a_study_that_was_broken_off_goes_on_to_the_same_table(undisturbed, address, monkeypatch):
    """Left as when one run was done, and the next about to be; `tests/test_kills.py` really kills one."""
    monkeypatch.setattr("validation.study.page.study_pictures", lambda *_: [])
    folder, _ = undisturbed
    out, path = folder / "broken-off", folder / "study.toml"
    shutil.copytree(folder / "out", out)
    (out / "table.parquet").unlink()
    first, *others = trials_of(Study.read(path), path)
    for trial in others:
        (out / "runs" / f"{trial.key}.parquet").unlink()
    for trial in others[1:]:
        (out / "errors" / f"{trial.key}.npz").unlink()
    (out / "work" / "experiment-0").mkdir(parents=True)
    assert [is_done(out, trial) for trial in (first, *others)] == [True, False, False, False]
    before = (out / "runs" / f"{first.key}.parquet").stat().st_mtime_ns
    result = pdvc_bench("study", path, "-o", out, "--scheduler", address)
    assert result.exit_code == 0, result.stderr
    assert (out / "runs" / f"{first.key}.parquet").stat().st_mtime_ns == before
    assert not (out / "work").exists()
    pd.testing.assert_frame_equal(comparable(out), comparable(folder / "out"))
