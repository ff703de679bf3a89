"""The command line as a user runs it: help, mistakes, and the whole job on a tiny scenario."""

from __future__ import annotations

import errno
import json
import shutil
import tomllib

import pytest
from rich.console import Console
from typer.testing import CliRunner

from pdvc.measurement import write_measurement
from tests import synthetic_records as records
from validation.cli import app
from validation.console import ProgressBars, one_line_errors


def pdvc_bench(*arguments):
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def only_line(result):
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    return lines[0]


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    _, amplitude = records.stretched(*records.tensile_history())
    path = tmp_path_factory.mktemp("motion") / "motion.nc"
    write_measurement(records.measurement(amplitude, unobserved=(8,)), path)
    return path


@pytest.mark.parametrize("command", ["scenarios", "options", "simulate", "measure", "score", "report", "run"])
def test_every_command_explains_itself(command):
    assert command in pdvc_bench("--help").stdout
    result = pdvc_bench(command, "--help")
    assert result.exit_code == 0
    assert "pdvc-bench" in result.stdout  # an example


def test_a_missing_experiment_folder_is_named(tmp_path):
    result = pdvc_bench("measure", tmp_path / "none", "-o", tmp_path / "m.nc")
    assert result.exit_code == 2
    assert only_line(result) == f"error: {tmp_path / 'none'}: expected an experiment folder, found none"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["score", "report"])
def test_a_corrupt_measurement_is_named(tmp_path, command):
    broken = tmp_path / "m.nc"
    broken.write_bytes(b"\x89HDF\r\n\x1a\nand then nothing")
    arguments = {"score": ["--truth", tmp_path], "report": ["-o", tmp_path / "out"]}[command]
    result = pdvc_bench(command, broken, *arguments)
    assert result.exit_code == 2
    assert only_line(result).startswith(f"error: {broken}: expected a measurement")
    assert not (tmp_path / "out").exists()


def test_a_folder_without_truth_cannot_score(tmp_path, motion):
    result = pdvc_bench("score", motion, "--truth", tmp_path)
    assert result.exit_code == 2
    assert str(tmp_path) in only_line(result)


def test_a_misspelt_flag_gets_a_hint(tmp_path):
    result = pdvc_bench("run", "quick", "-o", tmp_path, "--thread", "1")
    assert result.exit_code == 2
    assert "--threads" in result.stderr


def test_a_misspelt_key_of_the_options_is_named(tmp_path):
    path = tmp_path / "options.toml"
    path.write_text("colour = 3\n")
    result = pdvc_bench("run", "quick", "-o", tmp_path / "out", "--options", path)
    assert result.exit_code == 2
    assert only_line(result) == f"error: {path}: colour: unknown key"
    assert not (tmp_path / "out").exists()


def test_more_threads_than_the_machine_has(tmp_path):
    result = pdvc_bench("run", "quick", "-o", tmp_path / "out", "--threads", 100000)
    assert result.exit_code == 2
    assert "--threads: expected 1 to" in only_line(result)


def test_an_unknown_scenario_is_answered_with_those_there_are(tmp_path):
    result = pdvc_bench("simulate", "qick", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "quick" in only_line(result)
    assert not (tmp_path / "out").exists()


def test_scenarios_are_listed_and_printed_as_toml():
    listed = pdvc_bench("scenarios").stdout
    for name in ("jailin2018", "quick", "in-space", "rigid"):
        assert name in listed
        assert tomllib.loads(pdvc_bench("scenarios", name).stdout)


def test_options_are_printed_as_toml():
    assert tomllib.loads(pdvc_bench("options").stdout)


def test_report_without_truth(tmp_path, motion):
    result = pdvc_bench("report", motion, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    page = (tmp_path / "out" / "report.html").read_text()
    assert "No truth was given" in page
    assert page.count("data:image/png;base64,") == len(list((tmp_path / "out" / "figures").iterdir())) == 8
    assert "http" not in page.replace("http-equiv", "")  # nothing is fetched


class TestErrors:
    def outcome(self, error, capsys):
        # made here, so that it writes to what pytest captures
        with (
            pytest.raises(BaseException) as caught,  # noqa: PT011 - the exit itself is looked at
            one_line_errors(Console(stderr=True), resume="again"),
        ):
            raise error
        return caught.value.exit_code, capsys.readouterr().err

    def test_a_full_disk_says_so(self, capsys):
        error = OSError(errno.ENOSPC, "No space left on device", "/data/x.tif")
        code, text = self.outcome(error, capsys)
        assert code == 1
        assert text == ("error: /data/x.tif: No space left on device; make room, then run the same command again\n")

    def test_ctrl_c_says_how_to_go_on(self, capsys):
        assert self.outcome(KeyboardInterrupt(), capsys) == (130, "interrupted; again\n")

    def test_long_messages_stay_on_one_line(self, capsys):
        code, text = self.outcome(ValueError("much\n" * 100), capsys)
        assert code == 2
        assert text.count("\n") == 1


def test_progress_without_a_terminal_is_a_line_for_each_task():
    console = Console(file=open("/dev/null", "w"), record=True)  # noqa: SIM115 - closed with the test
    with ProgressBars(console) as progress:
        for task in ("first", "second"):
            for done in range(4):
                progress(task, done, 3)
    lines = console.export_text().splitlines()
    console.file.close()
    assert [line.split(":")[0] for line in lines] == ["first", "second"]


TINY = """
name = "tiny"
title = "Small enough for a test"
discarded_rows = 12

[graphite]
mean_diameter_mm = 0.25
smallest_diameter_mm = 0.1
largest_diameter_mm = 0.5
gap_mm = 0.016

[geometry]
pixel_mm = 2.3968
rows = 119
columns = 54

[acquisition]
reference_views = 60
test_steps = 25
steps_per_turn = 10
subpixels = 2

[loading]
plateau_steps = 10
stroke_mm_per_s = 0.01
"""


one_worker = pytest.mark.xdist_group("job")  # or two workers would each do the job


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """Do the main job once; the tests below look at what it left."""
    folder = tmp_path_factory.mktemp("job")
    scenario = folder / "tiny.toml"
    scenario.write_text(TINY)
    result = pdvc_bench("run", scenario, "-o", folder / "out", "--threads", 1)
    assert result.exit_code == 0, result.stderr
    return folder, result


@one_worker
def test_the_job_writes_all_it_promises(job):
    folder, result = job
    out = folder / "out"
    assert str(out / "report.html") in result.stderr
    assert "error across beam" in result.stdout
    for name in ("experiment/experiment.toml", "measurement.nc", "scores.json", "report.html"):
        assert (out / name).is_file()
    assert len(list((out / "figures").glob("*.png"))) == 10
    assert not list(out.rglob("*.partial"))


@one_worker
def test_scores_are_complete_and_plausible(job):
    folder, _ = job
    values = json.loads((folder / "out" / "scores.json").read_text())
    assert values["scenario"] == "tiny"
    assert values["steps"] == 25
    assert values["peak_memory_gib"] > 0
    assert min(values["seconds"].values()) > 0
    assert values["snr_db"]["final"] > values["snr_db"]["initial"]
    assert values["error_voxel"]["across_beam"] < 0.3


@one_worker
def test_asked_again_the_job_repeats_only_scores_and_report(job):
    folder, _ = job
    out = folder / "out"
    kept = [out / "measurement.nc", out / "experiment" / "experiment.toml"]
    before = [path.stat().st_mtime_ns for path in kept]
    scores = (out / "scores.json").read_text()
    (out / "report.html").unlink()
    result = pdvc_bench("run", folder / "tiny.toml", "-o", out, "--threads", 1)
    assert result.exit_code == 0, result.stderr
    assert "experiment: finished before, kept" in result.stderr
    assert "measurement: finished before, kept" in result.stderr
    assert [path.stat().st_mtime_ns for path in kept] == before
    assert (out / "scores.json").read_text() == scores
    assert (out / "report.html").is_file()


@one_worker
def test_another_scenario_does_not_overwrite_a_job(job):
    folder, _ = job
    other = folder / "other.toml"
    other.write_text(TINY.replace("reference_views = 60", "reference_views = 61"))
    result = pdvc_bench("run", other, "-o", folder / "out")
    assert result.exit_code == 2
    assert "acquisition.reference_views differs" in only_line(result)


@one_worker
def test_score_and_report_alone_agree_with_the_run(job):
    folder, _ = job
    out = folder / "out"
    arguments = (out / "measurement.nc", "--truth", out / "experiment")
    alone = json.loads(pdvc_bench("score", *arguments).stdout)
    together = json.loads((out / "scores.json").read_text())
    for key in ("error_voxel", "bias_voxel", "random_voxel", "strain_rms", "snr_db", "modes"):
        assert alone[key] == together[key]
    result = pdvc_bench("report", *arguments, "-o", folder / "page")
    assert result.exit_code == 0, result.stderr
    assert len(list((folder / "page" / "figures").glob("*.png"))) == 10


@one_worker
def test_a_truncated_stack_is_named(job):
    folder, _ = job
    copy = folder / "copy"
    shutil.copytree(folder / "out" / "experiment", copy)
    with (copy / "test" / "radiographs.tif").open("r+b") as file:
        file.truncate(10_000)
    result = pdvc_bench("measure", copy, "-o", folder / "never.nc")
    assert result.exit_code == 2
    assert str(copy / "test" / "radiographs.tif") in only_line(result)
    assert not (folder / "never.nc").exists()
