"""The command line as a user runs it: help, mistakes, and what it answers."""

from __future__ import annotations

import errno
import tomllib

import numpy as np
import pytest
import tifffile
from rich.console import Console

from pdvc.experiment import Description, GeometryEntry, StackEntry, write_description
from pdvc.measurement_file import write_measurement
from tests import synthetic_records as records
from tests.command_line import only_line, pdvc_bench
from validation.commands import live
from validation.console import ProgressBars, one_line_errors


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    _, amplitude = records.stretched(*records.tensile_history())
    path = tmp_path_factory.mktemp("motion") / "motion.nc"
    write_measurement(records.measurement(amplitude, unobserved=(8,)), path)
    return path


@pytest.mark.parametrize(
    "command",
    [
        *("scenarios", "options", "simulate", "measure", "score", "report", "run", "studies", "study", "compare"),
        *("prepare", "live", "play", "page", "watch", "import", "export"),
    ],
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
    for name in ("jailin2018", "quick", "in-space", "rigid", "small", "crack", "slip", "neck"):
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


@pytest.fixture
def experiment(tmp_path):
    """Return an experiment folder of 4 steps, whose stacks are noise."""
    folder = tmp_path / "experiment"
    entry = StackEntry(
        angle_deg=(0.0, 7.2, 14.4, 21.6), time_s=(0.0, 2.1, 4.2, 6.3), force_N=(250.0, 251.5, 253.0, 260.0)
    )
    for name in ("reference/radiographs.tif", "test/radiographs.tif", "flats.tif", "darks.tif"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        counts = np.random.default_rng(len(name)).integers(0, 65536, (4, 6, 5), dtype=np.uint16)
        tifffile.imwrite(folder / name, counts, photometric="minisblack")
    geometry = GeometryEntry(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=6, columns=5)
    write_description(folder, Description(geometry=geometry, reference=entry, test=entry))
    return folder


class TestPlay:
    def test_a_test_is_played_as_a_scanner_writes_it(self, experiment, tmp_path):
        result = pdvc_bench("play", experiment, "--to", tmp_path / "lab/arriving", "--pace", 0)
        assert result.exit_code == 0, result.stderr
        progress, told = result.stderr.splitlines()
        assert progress.startswith("radiographs: 4 of 4 in ")
        assert told == f"radiographs: 4, in {tmp_path / 'lab/arriving'}"
        first, *lines = (tmp_path / "lab/arriving/radiographs.csv").read_text().splitlines()
        assert first == "step,file,angle_deg,time_s,force_N"
        numbers = np.array([[float(part) for part in line.split(",")[2:]] for line in lines])
        np.testing.assert_allclose(
            numbers, [[0, 0, 250], [7.2, 2.1, 251.5], [14.4, 4.2, 253], [21.6, 6.3, 260]], rtol=1e-15
        )
        assert [line.split(",")[:2] for line in lines] == [[str(step), f"0000{step}.tif"] for step in range(4)]
        test = tifffile.imread(experiment / "test/radiographs.tif")
        for step in range(4):
            np.testing.assert_array_equal(tifffile.imread(tmp_path / f"lab/arriving/0000{step}.tif"), test[step])

    def test_a_test_is_played_from_a_step(self, experiment, tmp_path):
        result = pdvc_bench("play", experiment, "--to", tmp_path / "arriving", "--pace", 0, "--from", 2)
        assert result.exit_code == 0, result.stderr
        assert result.stderr.splitlines()[-1] == f"radiographs: 2, in {tmp_path / 'arriving'}"
        lines = (tmp_path / "arriving/radiographs.csv").read_text().splitlines()
        assert [line.split(",")[1] for line in lines] == ["file", "00002.tif", "00003.tif"]
        test = tifffile.imread(experiment / "test/radiographs.tif")
        np.testing.assert_array_equal(tifffile.imread(tmp_path / "arriving/00002.tif"), test[2])

    def test_a_step_after_the_test_is_refused(self, experiment, tmp_path):
        result = pdvc_bench("play", experiment, "--to", tmp_path / "arriving", "--from", 4)
        assert result.exit_code == 2
        assert only_line(result).startswith("error: --from: expected a step of the test, 0 to 3, given 4")
        assert not (tmp_path / "arriving").exists()

    def test_a_folder_is_played_into_once(self, experiment, tmp_path):
        table = tmp_path / "arriving/radiographs.csv"
        for code in (0, 2):
            result = pdvc_bench("play", experiment, "--to", tmp_path / "arriving", "--pace", 0)
            assert result.exit_code == code
        assert only_line(result) == f"error: {table}: expected a folder without a table, found one"
        assert len(table.read_text().splitlines()) == 5

    def test_a_missing_experiment_is_named(self, tmp_path):
        result = pdvc_bench("play", tmp_path / "none", "--to", tmp_path / "arriving")
        assert result.exit_code == 2
        assert only_line(result) == f"error: {tmp_path / 'none'}: expected an experiment folder, found none"
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(("given", "pace_s"), [((), 2.0), (("--pace", 0.5), 0.5)])
    def test_the_pace_is_kept(self, experiment, tmp_path, monkeypatch, given, pace_s):
        asked = []
        monkeypatch.setattr(live, "paced", lambda count, pace_s: iter([asked.append((count, pace_s))][1:]))
        result = pdvc_bench("play", experiment, "--to", tmp_path / "arriving", "--from", 1, *given)
        assert result.exit_code == 0, result.stderr
        assert asked == [(3, pace_s)]

    @pytest.mark.parametrize("pace", [-1, "inf"])
    def test_a_pace_that_cannot_be_kept_is_refused(self, experiment, tmp_path, pace):
        result = pdvc_bench("play", experiment, "--to", tmp_path / "arriving", "--pace", pace)
        assert result.exit_code == 2
        assert "--pace" in result.stderr

    @pytest.mark.parametrize(
        ("took_s", "due_s"),
        [
            ([0.5, 0.5, 0.5, 0.5], [0, 2, 4, 6]),  # what writing takes is not added
            ([5.0, 0.5, 0.5, 0.5], [0, 5, 5.5, 6]),  # what was late is made up for
        ],
    )
    def test_the_clock_of_playing_does_not_drift(self, took_s, due_s):
        now_s = [100.0]

        def sleep(seconds):
            assert seconds > 0
            now_s[0] += seconds

        began_s = []
        for n in live.paced(4, 2.0, clock=lambda: now_s[0], sleep=sleep):
            began_s.append(now_s[0] - 100)
            now_s[0] += took_s[n]
        assert began_s == due_s


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
