"""What goes wrong around a command: folders in use, full disks, folders that cannot be written, damaged files."""

from __future__ import annotations

import ctypes
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest

from benchmarks.faults import SCENARIO, STUDY, TIMES
from pdvc.experiment import ExperimentError
from pdvc.lock import HOLDER, LOCK, InUseError, held
from pdvc.options import MeasureOptions
from simulator.scenario import load_scenario
from tests.command_line import only_line, pdvc_bench
from validation.job import Job, run

FEW = MeasureOptions.parse(
    {
        "sections": 5,
        "time": [{"kind": "force"}, {"kind": "angle"}, {"kind": "polynomial"}],
        "rigid": [{"scale": 2, "solver": {"kind": "gauss-newton", "most_passes": 3}}],
        "deformation": [{"solver": {"kind": "gauss-newton", "most_passes": 3}}],
    },
    where="few",
)
"""Options that take a second."""
STACK = "test/radiographs.tif"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the folder of a job that was done, but for the figures of its report."""
    folder = tmp_path_factory.mktemp("whole")
    done(folder)
    return folder


def done(folder):
    """Do the job in a folder, without drawing; return its scores, without those that no two runs share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("validation.job.write_report", lambda *_, **__: folder / "report.html")
        outcome = run(Job(scenario=load_scenario(SCENARIO), options=FEW, folder=folder, workers=1))
    scores = json.loads((folder / "scores.json").read_text())
    return {name: value for name, value in scores.items() if name not in TIMES}, outcome.reused


@pytest.fixture
def copy(whole, tmp_path):
    """Return a copy of that folder, to be damaged."""
    shutil.copytree(whole, tmp_path / "copy", copy_function=shutil.copy2)
    return tmp_path / "copy"


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    path = tmp_path_factory.mktemp("options") / "few.toml"
    path.write_text(FEW.template())
    return path


def holder(folder):
    """Start another process that holds a folder, and wait until it does."""
    code = "import sys, time, pathlib; from pdvc.lock import held\n"
    code += "with held(pathlib.Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    process = subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


class TestAFolderInUse:
    @pytest.fixture
    def in_use(self, tmp_path):
        process = holder(tmp_path / "out")
        yield tmp_path / "out", process
        process.kill()
        process.communicate()

    def test_every_command_says_in_one_line_who_is_at_work(self, in_use, whole, options):
        folder, process = in_use
        work = folder.rename(folder.with_name("m.nc.work"))
        commands = [("measure", whole / "experiment", "-o", work.with_name("m.nc"), "--options", options)]
        for command in (("simulate", SCENARIO), ("run", SCENARIO), ("study", STUDY)):
            commands.append((*command, "-o", work))
        commands.append(("compare", SCENARIO, "--methods", "gauss-newton", "-o", work))
        for command in commands:
            before = sorted(path.name for path in work.iterdir())
            result = pdvc_bench(*command)
            assert result.exit_code == 1
            line = only_line(result)
            assert line.startswith(f"error: {work}: in use by process {process.pid} on ")
            assert line.endswith("wait until it has ended, or choose another folder")
            assert sorted(path.name for path in work.iterdir()) == before == [LOCK, HOLDER]

    def test_it_is_free_as_soon_as_the_other_is_killed(self, in_use):
        folder, process = in_use
        with pytest.raises(InUseError), held(folder):
            pass
        process.send_signal(signal.SIGKILL)
        process.wait()
        with held(folder):
            assert str(os.getpid()) in (folder / HOLDER).read_text()
        assert [path.name for path in folder.iterdir()] == [LOCK]

    def test_a_process_may_hold_a_folder_within_itself(self, tmp_path):
        with held(tmp_path):
            with held(tmp_path):
                pass
            assert (tmp_path / HOLDER).exists()
            code = f"import pathlib; from pdvc.lock import held\nwith held(pathlib.Path({str(tmp_path)!r})): pass"
            assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode
        assert not (tmp_path / HOLDER).exists()


class TestDamagedFiles:
    @pytest.mark.parametrize("share", [0.3, 0.999])
    def test_a_measurement_cut_short_is_made_again(self, copy, whole, share):
        path = copy / "measurement.nc"
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        scores, reused = done(copy)
        assert reused == ("experiment",)
        assert scores == done(whole)[0]
        assert path.stat().st_size >= 0.99 * len(content)

    @pytest.mark.parametrize("text", ["", '{"colour": 3}'])
    def test_a_state_that_cannot_be_read_is_forgotten(self, copy, whole, text):
        (copy / "work" / "state.json").write_text(text)
        scores, reused = done(copy)
        assert reused == ("experiment",)
        assert scores == done(whole)[0]

    def test_scores_cut_short_are_written_again(self, copy, whole):
        (copy / "scores.json").write_text('{"scenario": "fau')
        scores, reused = done(copy)
        assert reused == ("experiment", "measurement")
        assert scores == done(whole)[0]

    def test_a_stack_cut_short_is_named_and_nothing_is_lost(self, copy):
        path = copy / "experiment" / STACK
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
        before = {each: each.read_bytes() for each in copy.rglob("*") if each.is_file() and each.name != "state.json"}
        with pytest.raises(ExperimentError, match=r"test/radiographs\.tif: truncated: expected \d+ bytes"):
            done(copy)
        assert {each: each.read_bytes() for each in before} == before

    def test_a_simulation_goes_on_over_a_stack_cut_short(self, copy, whole):
        """Killed while the test was written, and then the reference scan was damaged."""
        folder = copy / "experiment"
        (folder / "experiment.toml").unlink()
        stack = folder / "reference/radiographs.tif"
        stack.write_bytes(stack.read_bytes()[:2000])
        assert pdvc_bench("simulate", SCENARIO, "-o", folder).exit_code == 0
        for name in ("reference/radiographs.tif", STACK, "flats.tif", "darks.tif", "experiment.toml"):
            assert (folder / name).read_bytes() == (whole / "experiment" / name).read_bytes(), name


class TestMeasure:
    """What `measure` leaves beside its output."""

    def answer(self, whole, tmp_path, options, **changes):
        out = tmp_path / "m.nc"
        result = pdvc_bench("measure", changes.get("folder", whole / "experiment"), "-o", out, "--options", options)
        return result, out, out.with_name("m.nc.work")

    def test_nothing_but_the_measurement(self, whole, tmp_path, options):
        result, out, _ = self.answer(whole, tmp_path, options)
        assert result.exit_code == 0
        assert list(tmp_path.iterdir()) == [out]

    def test_nothing_where_the_input_cannot_be_used(self, whole, tmp_path, options):
        options = tmp_path / "wrong.toml"
        options.write_text('time = [{ kind = "ramp", start = 5000 }]')
        result, _, _ = self.answer(whole, tmp_path, options)
        assert result.exit_code == 2
        assert "time functions: expected at least one" in result.stderr.splitlines()[-1]
        assert list(tmp_path.iterdir()) == [options]

    @pytest.mark.parametrize(
        ("error", "code", "start"),
        [
            (KeyboardInterrupt(), 130, "interrupted; "),
            (OSError(28, "No space left on device"), 1, "error: No space left on device; make room"),
            (MemoryError("too much"), 1, "error: not enough memory"),
        ],
        ids=["interrupted", "full disk", "no memory"],
    )
    def test_what_was_found_so_far_where_it_can_be_gone_on_from(self, whole, tmp_path, options, error, code, start):
        def fail(_, task, done, total):
            if task.startswith("deformation"):
                raise error

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("validation.console.ProgressBars.__call__", fail)
            result, out, work = self.answer(whole, tmp_path, options)
        assert result.exit_code == code
        line = only_line(result)
        assert line.startswith(start)
        assert line.endswith(f"what was found so far is kept in {work}, and the same command goes on from there")
        assert work.is_dir()
        assert not out.exists()
        assert self.answer(whole, tmp_path, options)[0].exit_code == 0
        assert list(tmp_path.iterdir()) == [out]


def limited(size):
    """Let no file of this process grow beyond a size, bytes: what it writes then fails as on a full disk."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def powerless():
    """Let this process no longer write where its user may not, should that be the superuser."""
    if os.geteuid() == 0:
        drop_bounding, override = 24, 1  # PR_CAPBSET_DROP, CAP_DAC_OVERRIDE of linux/prctl.h, linux/capability.h
        assert ctypes.CDLL(None).prctl(drop_bounding, override, 0, 0, 0) == 0


def elsewhere(*arguments, before):
    """Give a command in another process, after `before` was called there."""
    command = [sys.executable, "-m", "validation.cli", *map(str, arguments)]
    # a measurement of coverage would write there, too, what the disk has no room for
    environment = {key: value for key, value in os.environ.items() if not key.startswith("COVERAGE")}
    return subprocess.run(
        command, preexec_fn=before, env=environment, capture_output=True, text=True, check=False, timeout=300
    )


def one_error(result):
    assert result.returncode == 1, result.stderr
    lines = [line for line in result.stderr.splitlines() if " of " not in line or line.startswith("error")]
    assert len(lines) == 1, result.stderr
    return lines[0]


class TestAFullDisk:
    def test_a_simulation_says_what_it_needs_and_goes_on_with_room(self, whole, tmp_path):
        out = tmp_path / "out"
        line = one_error(elsewhere("simulate", SCENARIO, "-o", out, before=partial(limited, 60_000)))
        assert line.startswith(f"error: {out}: disk full: faults needs ")
        assert line.endswith("make room, then run the same command again")
        assert pdvc_bench("simulate", SCENARIO, "-o", out).exit_code == 0
        for name in ("reference/radiographs.tif", STACK, "truth/displacement.nc"):
            assert (out / name).stat().st_size == (whole / "experiment" / name).stat().st_size
        assert (out / STACK).read_bytes() == (whole / "experiment" / STACK).read_bytes()

    def test_a_measurement_says_where_it_goes_on_from(self, whole, tmp_path, options):
        out = tmp_path / "m.nc"
        command = ("measure", whole / "experiment", "-o", out, "--options", options)
        line = one_error(elsewhere(*command, before=partial(limited, 150_000)))
        assert f"{out}: File too large; make room" in line
        assert f"kept in {out}.work" in line
        assert not list(tmp_path.glob("*.partial"))
        assert pdvc_bench(*command).exit_code == 0

    def test_a_study_stops_and_goes_on_with_what_is_missing(self, tmp_path):
        out = tmp_path / "out"
        line = one_error(elsewhere("study", STUDY, "-o", out, "--workers", 1, before=partial(limited, 30_000)))
        assert "make room, then run the same command again" in line
        assert not list((out / "runs").glob("*"))
        assert not (out / "table.parquet").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="the superuser's powers are dropped as Linux does it")
class TestAFolderThatCannotBeWritten:
    def test_every_command_says_so_in_one_line(self, whole, tmp_path, options):
        shut = tmp_path / "shut"
        shut.mkdir(mode=0o555)
        for command in (
            ("simulate", SCENARIO, "-o", shut),
            ("measure", whole / "experiment", "-o", shut / "m.nc", "--options", options),
            ("study", STUDY, "-o", shut),
        ):
            line = one_error(elsewhere(*command, before=powerless))
            assert line.startswith(f"error: {shut}")
            assert line.endswith("Permission denied")
        assert not list(shut.iterdir())


def test_the_clock_of_a_job_is_that_of_all_attempts(copy):
    """Times are kept through damage: they are what was spent, not what the last attempt spent."""
    before = json.loads((copy / "work" / "state.json").read_text())["seconds"]
    (copy / "measurement.nc").unlink()
    began = time.perf_counter()
    done(copy)
    spent = time.perf_counter() - began
    after = json.loads((copy / "work" / "state.json").read_text())["seconds"]
    assert after["simulate"] == before["simulate"]
    assert before["measure"] < after["measure"] < before["measure"] + spent
    assert np.isfinite(after["measure"])
