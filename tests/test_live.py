"""A test followed while it runs: radiographs come in, their motion goes to a record, killed and gone on with."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from pdvc import lagged, live
from pdvc.correction import corrected
from pdvc.deviations import beam_frame
from pdvc.experiment import Experiment, ExperimentError, read_experiment
from pdvc.gauss_newton import GaussNewton
from pdvc.incoming import IncomingWriter
from pdvc.late_light import LatePart
from pdvc.live import follow, make_ready
from pdvc.options import MeasureOptions, StageOptions
from pdvc.protocol import measure
from pdvc.record import AlarmLine, Line, LostLine, MeasurementLine, PlanLine, StepLine, read_record, record_of
from simulator.scanner import simulate
from simulator.scenario import Scenario, course_of
from tests.command_line import pdvc_bench
from tests.tiny_scenarios import TINY

STEPS = 25


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return Scenario.parse(tomllib.loads(TINY), where="tiny")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, scenario) -> Path:
    path = tmp_path_factory.mktemp("live") / "experiment"
    simulate(scenario, path)
    return path


@pytest.fixture(scope="module")
def planned(folder) -> Experiment:
    return read_experiment(folder, planned=True)


@pytest.fixture(scope="module")
def ready(planned, tmp_path_factory) -> Path:
    """Return what prepare keeps."""
    work = tmp_path_factory.mktemp("ready")
    make_ready(planned, work=work)
    return work


def played(experiment: Path, to: Path, steps=range(STEPS)) -> Path:
    """Write radiographs of the test into a folder, as a scanner does."""
    test, writer = read_experiment(experiment).test, IncomingWriter(to)
    for t in steps:
        writer.write(t, test.counts[t], test.angle_rad[t], test.time_s[t], test.force_N[t])
    return to


@pytest.fixture(scope="module")
def followed(folder, planned, ready, tmp_path_factory):
    """Return the lines of a test that was followed without a break, and its measurement."""
    path = tmp_path_factory.mktemp("followed")
    told: list[Line] = []
    found = follow(planned, played(folder, path / "arriving"), path / "motion.nc", work=ready, tell=told.append)
    lines = list(read_record(record_of(path / "motion.nc")))
    assert lines == told
    return lines, found


def motions(lines) -> list[StepLine]:
    """Return the motions of a record, without what depends on the clock."""
    return [replace(line, seconds=0.0, unix_s=0.0) for line in lines if isinstance(line, StepLine)]


def alarms(lines) -> list[AlarmLine]:
    """Return the alarms of a record."""
    return [line for line in lines if isinstance(line, AlarmLine)]


def test_there_is_a_line_for_the_plan_for_each_radiograph_in_turn_and_for_the_measurement(followed, planned):
    lines, _ = followed
    assert isinstance(lines[0], PlanLine)
    assert lines[0].steps == STEPS
    steps = motions(lines)
    assert [line.step for line in steps] == list(range(STEPS))
    np.testing.assert_allclose([np.deg2rad(line.angle_deg) for line in steps], planned.test.angle_rad)
    # loading begins
    assert (alarms(lines)[0].step, alarms(lines)[0].alarm) == (11, "sudden")
    assert isinstance(lines[-1], MeasurementLine)


def test_the_whole_test_is_measured_as_if_nothing_had_been_followed(followed, folder):
    _, found = followed
    alone = measure(read_experiment(folder))
    # angles come through degrees
    np.testing.assert_allclose(found.motion.amplitude, alone.motion.amplitude, atol=1e-5)
    np.testing.assert_allclose(found.motion.amplitude_std, alone.motion.amplitude_std, rtol=1e-4)


def test_stated_intervals_of_each_step_hold_for_the_true_motion(followed, scenario):
    lines, _ = followed
    motion, height = course_of(scenario).motion, np.array(lines[0].height_mm)
    points = np.zeros((len(height), 3))
    points[:, 2] = height
    share, sizes = [], []
    for line in motions(lines):
        truth = (points - motion.inverse(points, line.step)) / lines[0].voxel_mm
        error = np.array(line.displacement_voxel) - truth @ beam_frame(np.deg2rad(line.angle_deg)).T
        share.append(np.abs(error / line.displacement_std) < 1.96)
        sizes.append(np.abs(truth).max())
    assert max(sizes) > 1
    # along the beam too little is known here: grey levels of so coarse a scenario are some percent off
    assert (np.mean(share, axis=(0, 1))[:2] > 0.85).all()


def test_a_test_is_followed_with_the_scanner_that_its_reference_scan_tells(folder, planned, followed, tmp_path):
    """Told with the axis beside its place, prepared, followed and measured as if it had been told rightly."""
    options = MeasureOptions(self_calibration="geometry")
    wrong = replace(planned, geometry=corrected(planned.geometry, {"column_shift": -1.3, "roll": 0.5}))
    work, steps = tmp_path / "ready", 8
    make_ready(wrong, options, work=work)
    arriving = played(folder, tmp_path / "in", range(steps))
    found = follow(wrong, arriving, tmp_path / "motion.nc", options, work=work, idle_s=0.0)
    assert found.correction is not None
    assert found.correction.values_px["column_shift"] == pytest.approx(1.3, abs=0.03)
    assert found.correction.values_px["roll"] == pytest.approx(-0.5, abs=0.1)
    told, right = (
        np.array([line.displacement_voxel for line in motions(lines)][:steps])
        for lines in (read_record(record_of(tmp_path / "motion.nc")), followed[0])
    )
    assert len(told) == found.recording.steps == steps
    assert np.sqrt(((told - right) ** 2).mean(axis=(0, 1)))[:2] == pytest.approx([0, 0], abs=0.05)


def test_light_that_comes_late_is_not_taken_out_while_a_test_is_followed(planned, tmp_path):
    options = MeasureOptions(lag=(LatePart(share=0.01, time_s=1.0),))
    with pytest.raises(ValueError, match="lag: expected none where a test is followed"):
        make_ready(planned, options, work=tmp_path / "ready")
    with pytest.raises(ValueError, match="lag: expected none where a test is followed"):
        follow(planned, tmp_path, tmp_path / "motion.nc", options)


class Killed(BaseException):
    """The process ends here."""


@pytest.fixture
def measured_never(monkeypatch):
    """Kill the process when it begins to measure the whole test."""

    def killed(*_, **__):
        raise Killed

    monkeypatch.setattr(live, "measure_into", killed)


def follow_to_its_end(*arguments, **options) -> list[Line]:
    """Follow all radiographs, and be killed then; return the lines that were told."""
    told: list[Line] = []
    with pytest.raises(Killed):
        follow(*arguments, **options, tell=told.append)
    return told


def test_killed_anywhere_it_goes_on_to_the_same_numbers(folder, planned, ready, tmp_path, monkeypatch, measured_never):
    monkeypatch.setattr(lagged, "FIRST", 16)
    arriving, file, lines = played(folder, tmp_path / "arriving"), tmp_path / "motion.nc", []
    at_once = follow_to_its_end(planned, arriving, tmp_path / "at once.nc", work=ready)
    writes, kept = 0, live.write_arrays

    def killed_at(write: int):
        def write_arrays(path, values):
            nonlocal writes
            writes += 1
            if writes == write:
                raise Killed
            kept(path, values)

        return write_arrays

    def kill_after(step: int):
        def tell(line):
            lines.append(line)
            if isinstance(line, StepLine) and line.step == step:
                raise Killed

        return tell

    # before what a radiograph told is kept, before what the tracker knows, after its line and before its alarm, and
    # before and while deviations are fitted
    kills = ((7, lines.append), (2, lines.append), *((0, kill_after(step)) for step in (11, 15, 16, 17)))
    for write, tell in kills:
        writes = 0
        monkeypatch.setattr(live, "write_arrays", killed_at(write))
        with pytest.raises(Killed):
            follow(planned, arriving, file, work=ready, tell=tell)
    # and while a line was written, which is then half there
    record = record_of(file)
    record.write_bytes(record.read_bytes()[:-40])
    follow_to_its_end(planned, arriving, file, work=ready)
    found = list(read_record(record))
    assert motions(found) == motions(at_once)
    assert alarms(found) == alarms(at_once)


def test_radiographs_without_a_beam_raise_one_alarm_and_are_left_out_to_the_end(
    folder, planned, ready, followed, tmp_path
):
    arriving, file = played(folder, tmp_path / "arriving", range(14)), tmp_path / "motion.nc"
    dark = np.rint(np.mean(planned.darks, axis=0)).astype(np.uint16)
    for step in (8, 9):
        tifffile.imwrite(arriving / f"{step:05d}.tif", dark)

    def kill_after(step: int):
        def tell(line):
            if getattr(line, "step", None) == step and not isinstance(line, AlarmLine):
                raise Killed

        return tell

    for step in (8, 9, 10, 12):
        with pytest.raises(Killed):
            follow(planned, arriving, file, work=ready, tell=kill_after(step), idle_s=0.2)
    told: list[Line] = []
    found = follow(planned, arriving, file, work=ready, tell=told.append, idle_s=0.2)
    lines = list(read_record(record_of(file)))
    assert [(line.step, line.alarm) for line in alarms(lines) if line.alarm == "beam"] == [(8, "beam")]
    assert [line.step for line in lines if isinstance(line, LostLine)] == [8, 9]
    assert [line.step for line in motions(lines)] == [t for t in range(14) if t not in (8, 9)]
    # the line after which it was killed is told again
    assert told[0] == next(line for line in lines if isinstance(line, StepLine) and line.step == 12)
    assert found.recording.steps == 12
    # they are as if they had not come
    assert motions(lines)[:8] == motions(followed[0])[:8]


def test_what_cannot_be_used_is_said_once_and_the_others_are_followed(
    folder, planned, ready, tmp_path, measured_never
):
    arriving, file = played(folder, tmp_path / "arriving"), tmp_path / "motion.nc"
    tifffile.imwrite(arriving / "00004.tif", np.zeros((3, 3), dtype=np.uint16))
    with (arriving / "radiographs.csv").open("a", encoding="utf-8") as table:
        table.write("many,00000.tif,0,0,0\n")
    told = follow_to_its_end(planned, arriving, file, work=ready)
    lines = list(read_record(record_of(file)))
    # it may be that the last one was not told any more
    assert follow_to_its_end(planned, arriving, file, work=ready) == lines[-1:]
    assert list(read_record(record_of(file))) == lines
    lost = [line for line in lines if isinstance(line, LostLine)]
    assert sorted(line.step for line in lost) == [-1, 4]
    assert all("expected" in line.reason for line in lost)
    assert lines == told
    assert [line.step for line in motions(lines)] == [t for t in range(STEPS) if t != 4]


def test_a_radiograph_of_another_thing_is_lost_and_the_next_ones_are_not(
    folder, planned, ready, followed, tmp_path, measured_never, monkeypatch
):
    arriving, take = played(folder, tmp_path / "arriving"), live.Tracker.take

    def fails(self, radiograph):
        taken = take(self, radiograph)
        if radiograph.step == 9:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return taken

    monkeypatch.setattr(live.Tracker, "take", fails)
    told = follow_to_its_end(planned, arriving, tmp_path / "motion.nc", work=ready)
    assert [line.reason for line in told if isinstance(line, LostLine)] == ["step 9: Matrix is not positive definite"]
    assert [line.step for line in motions(told)] == [t for t in range(STEPS) if t != 9]
    # nothing of it was left behind
    assert motions(told)[:9] == motions(followed[0])[:9]
    one, other = motions(told)[9], motions(followed[0])[10]
    assert np.all(np.array(one.displacement_std) >= np.array(other.displacement_std) * 0.99)


def test_a_first_radiograph_that_fails_leaves_nothing_behind(
    folder, planned, ready, tmp_path, measured_never, monkeypatch
):
    take = live.Tracker.take

    def fails(self, radiograph):
        taken = take(self, radiograph)
        if radiograph.step == 0 and not tried:
            tried.append(0)
            raise ValueError("expected a sample")
        return taken

    monkeypatch.setattr(live.Tracker, "take", fails)
    # with one to fail on, and without the first one at all
    tried, found = list[int](), []
    for name, steps in (("whole", range(4)), ("without", range(1, 4))):
        arriving = played(folder, tmp_path / name, steps)
        found.append(follow_to_its_end(planned, arriving, tmp_path / f"{name}.nc", work=ready, idle_s=0.2))
    assert tried == [0]
    assert motions(found[0]) == motions(found[1])


def test_what_an_earlier_run_left_does_not_enter_a_new_record(
    folder, planned, ready, followed, tmp_path, measured_never
):
    arriving, file = played(folder, tmp_path / "arriving", range(4)), tmp_path / "motion.nc"
    follow_to_its_end(planned, arriving, file, work=ready, idle_s=0.2)
    record_of(file).unlink()
    told = follow_to_its_end(planned, arriving, file, work=ready, idle_s=0.2)
    assert motions(told) == motions(followed[0])[:4]


def test_a_radiograph_that_vanished_is_missed_in_the_end(folder, planned, ready, tmp_path):
    arriving = played(folder, tmp_path / "arriving", range(3))

    def vanish(line):
        if isinstance(line, StepLine) and line.step == 2:
            (arriving / "00001.tif").unlink()

    with pytest.raises(ExperimentError, match="that of step 1 not any more"):
        follow(planned, arriving, tmp_path / "motion.nc", work=ready, idle_s=0.2, tell=vanish)


def test_a_test_that_stops_early_is_measured_as_far_as_it_went(folder, planned, ready, tmp_path):
    arriving = played(folder, tmp_path / "arriving", range(12))
    found = follow(planned, arriving, tmp_path / "motion.nc", work=ready, idle_s=0.2)
    assert found.recording.steps == 12


def test_what_cannot_be_followed_is_refused(planned, ready, folder, tmp_path):
    direct = MeasureOptions(deformation=(StageOptions(scale=1, solver=GaussNewton()),))
    with pytest.raises(ValueError, match="deformation: expected kind = 'smoother' in the last stage"):
        make_ready(planned, direct, work=tmp_path / "work")
    with pytest.raises(ExperimentError, match="nowhere"):
        follow(planned, tmp_path / "nowhere", tmp_path / "motion.nc", work=ready)
    with pytest.raises(ValueError, match="noise: expected photons_per_count"):
        make_ready(replace(planned, photons_per_count=None), work=tmp_path / "work")


def test_a_record_of_another_test_is_not_gone_on_with(folder, planned, ready, tmp_path, measured_never):
    arriving = played(folder, tmp_path / "arriving", range(3))
    follow_to_its_end(planned, arriving, tmp_path / "motion.nc", work=ready, idle_s=0.2)
    other = replace(planned, test=replace(planned.test, force_N=planned.test.force_N + 1))
    with pytest.raises(ValueError, match="expected the same reference scan, plan, options, folder and software"):
        follow(other, arriving, tmp_path / "motion.nc", work=ready, idle_s=0.2)
    with pytest.raises(ValueError, match="expected the record of this test"):
        follow(replace(planned, title="another"), arriving, tmp_path / "motion.nc", work=ready, idle_s=0.2)


def test_the_commands(folder, tmp_path, followed, capfd):
    work, arriving, file = tmp_path / "ready", tmp_path / "arriving", tmp_path / "motion.nc"
    assert pdvc_bench("prepare", folder, "--work", work).exit_code == 0
    assert pdvc_bench("play", folder, "--to", arriving, "--pace", 0).exit_code == 0
    # no room for pictures: they are only looked at
    file.with_name("motion.nc.pictures").write_text("in the way")
    done = pdvc_bench("live", folder, "--radiographs", arriving, "--work", work, "-o", file, "--json", "--page")
    assert done.exit_code == 0, done.stderr
    assert done.stderr.count("no pictures for a while") == 1
    shown, error = capfd.readouterr()
    assert not shown
    assert error.startswith("http://127.0.0.1:")
    lines = list(read_record(record_of(file)))
    assert done.stdout.splitlines() == [line.text() for line in lines]
    assert motions(lines) == motions(followed[0])
    assert file.is_file()
    # what was followed to its end has nothing to go on with
    again = pdvc_bench("live", folder, "--radiographs", arriving, "--work", work, "-o", file)
    assert again.exit_code != 0
    assert "choose another file" in again.stderr.splitlines()[-1]
