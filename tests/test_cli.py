"""The command line as a user runs it: help, mistakes, and what it answers."""

from __future__ import annotations

import errno
import tomllib

import pytest
from rich.console import Console

from pdvc.measurement_file import write_measurement
from tests import synthetic_records as records
from tests.command_line import only_line, pdvc_bench
from validation.console import ProgressBars, one_line_errors


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    _, amplitude = records.stretched(*records.tensile_history())
    path = tmp_path_factory.mktemp("motion") / "motion.nc"
    write_measurement(records.measurement(amplitude, unobserved=(8,)), path)
    return path


@pytest.mark.parametrize(
    "command", ["scenarios", "options", "simulate", "measure", "score", "report", "run", "studies", "study", "compare"]
)
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
    assert page.count("data:image/png;base64,") == len(list((tmp_path / "out" / "figures").iterdir())) == 11
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
