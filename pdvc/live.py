"""Follow a test while it runs: radiographs come into a folder, their motion goes to a record, one line for each.

After the reference scan, `make_ready` prepares all that does not depend on the test and keeps it. `follow` takes each
radiograph as soon as it is whole (`pdvc.incoming`), finds the motion (`pdvc.tracker`), and adds it to the record
(`pdvc.record`), with what is alarming (`pdvc.alarms`); when all that are planned are in, the whole test is measured as
in `pdvc.protocol`.

What the tracker knows is kept before lines are added to the record, lines included: a process that is killed and
started again goes on with the radiograph that it had in hand, to the same numbers.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.alarms import Alarm, Watch
from pdvc.compilation import compile_kernels
from pdvc.deviations import beam_frame, strain_std, turned_std
from pdvc.digest import digest
from pdvc.experiment import Experiment, ExperimentError
from pdvc.incoming import Arrival, Incoming, series_of
from pdvc.lagged import Late, Told
from pdvc.lock import held
from pdvc.measurement import Measurement
from pdvc.options import DEFAULT, MeasureOptions
from pdvc.progress import Progress, silent
from pdvc.radiograph_table import TABLE
from pdvc.record import (
    Line,
    LostLine,
    MeasurementLine,
    PlanLine,
    Record,
    StepLine,
    line_of,
    read_record,
    record_of,
)
from pdvc.resumable import measure_into
from pdvc.setup import Setup, set_up
from pdvc.store import Arrays, experiment_digest, read_arrays, write_arrays
from pdvc.threads import one_thread
from pdvc.tracker import Taken, Tracker
from pdvc.verdict import listed

Floats = NDArray[np.float64]

POLL_S = 0.05
"""Time between looks at the folder, s."""


def make_ready(
    experiment: Experiment, options: MeasureOptions = DEFAULT, *, work: Path, progress: Progress = silent
) -> None:
    """Prepare all that a test does not change, and keep it in a folder: kernels, outline, volumes, e of all views.

    `experiment` as `read_experiment(folder, planned=True)` opens it. Interrupted, it goes on where it was. Raises
    ValueError where a test cannot be followed with these options.
    """
    _check_followable(options)
    with held(work), one_thread():
        compile_kernels(progress=progress)
        Tracker(set_up(experiment, options, work=work, progress=progress), progress=progress)


def follow(
    experiment: Experiment,
    radiographs: Path,
    file: Path,
    options: MeasureOptions = DEFAULT,
    *,
    work: Path | None = None,
    progress: Progress = silent,
    tell: Callable[[Line], None] = lambda _: None,
    see: Callable[[Arrival, Taken], None] = lambda _arrival, _taken: None,
    idle_s: float = float("inf"),
) -> Measurement:
    """Follow the radiographs that come into a folder, until all that are planned are in, or no more for `idle_s`.

    Adds to `record_of(file)`, then measures the whole test into `file`, and returns the measurement. `tell` is called
    with each line that is added, `see` with each radiograph after its line was. `work` as in `measure_into`, with what
    `make_ready` has kept there. Interrupted, it goes on where it was.
    Raises ExperimentError where the folder cannot be followed, ValueError where the test cannot be measured or the
    record belongs to another one or is complete, InUseError where another process is at the same file.
    """
    _check_followable(options)
    folder, kept = work or file.with_name(file.name + ".work"), file.with_name(file.name + ".live")
    with held(folder), held(kept), closing(Record(record_of(file))) as record, one_thread():
        _check_unfinished(record)
        compile_kernels(progress=progress)
        setup = set_up(experiment, options, work=folder, progress=progress)
        follower = _Follower(setup, Tracker(setup, progress), radiographs, record, kept, tell, see)
        heard = time.monotonic() if follower.begun else float("inf")
        while follower.waits and time.monotonic() < heard + idle_s:
            if follower.look():
                heard = time.monotonic()
            else:
                time.sleep(POLL_S)
        recorded = follower.recorded()
        # volumes of all scales and e of all views are not needed any more
        del follower
        started = time.perf_counter()
        measurement = measure_into(file, recorded, options, work=folder, progress=progress)
        last = MeasurementLine(file=file.name, seconds=time.perf_counter() - started)
        record.add(last)
        tell(last)
        shutil.rmtree(kept, ignore_errors=True)
        if work is None:
            shutil.rmtree(folder, ignore_errors=True)
    return measurement


def _check_followable(options: MeasureOptions) -> None:
    """Raise ValueError for options that need all radiographs."""
    if options.lag:
        raise ValueError(
            "lag: expected none where a test is followed, as the light of radiographs that are late or lost is not "
            f"known, got {len(options.lag)}: give it to measure"
        )


def _check_unfinished(record: Record) -> None:
    """Raise ValueError where a record is complete."""
    if any(isinstance(line, MeasurementLine) for line in read_record(record.path)):
        raise ValueError(
            f"{record.path}: expected a test to be followed, found it followed to its end: choose another file"
        )


class _Follower:
    """A test that is followed: what has come in, what the tracker knows, and the record."""

    def __init__(
        self,
        setup: Setup,
        tracker: Tracker,
        radiographs: Path,
        record: Record,
        folder: Path,
        tell: Callable[[Line], None],
        see: Callable[[Arrival, Taken], None],
    ) -> None:
        """Begin, or resume where the record ends; raises ValueError where it belongs to another test."""
        self._setup, self._tracker, self._radiographs = setup, tracker, radiographs
        self._watch = Watch(setup)
        self._record, self._folder, self._tell, self._see = record, folder, tell, see
        self._key = digest("live", experiment_digest(setup.experiment), setup.options, str(radiographs.resolve()))
        plan = PlanLine(
            title=setup.experiment.title,
            steps=len(setup.experiment.test),
            height_mm=tuple(setup.sections.height_mm.tolist()),
            voxel_mm=setup.geometry.voxel_mm,
        )
        self._blank = {name: np.array(values) for name, values in self._state().items()}
        if record.lines:
            self._resume(plan)
        else:
            for old in (self._folder / _STATE, *self._folder.glob(f"*{_TOLD}")):
                old.unlink(missing_ok=True)
            self._write(plan)
            self._tracker.settle()
        lines = list(read_record(record.path))
        lost = [line for line in lines if isinstance(line, LostLine)]
        self._done = {line.step for line in lines if isinstance(line, StepLine)}
        self._done |= {line.step for line in lost if line.left_out}
        self._lost = {_which(line) for line in lost}
        # what could not be read, or came late, is looked at again, and said once
        self._incoming = self._opened(self._done)

    @property
    def begun(self) -> bool:
        """Return whether any radiograph has come."""
        return bool(self._done)

    @property
    def waits(self) -> bool:
        """Return whether planned radiographs have neither come nor been given up."""
        return any(step not in self._done for step in range(len(self._setup.experiment.test)))

    def look(self) -> bool:
        """Take in what has come; return whether anything has."""
        arrived, given_up = self._incoming.look()
        for unreadable in given_up:
            self._say_lost(LostLine(step=unreadable.step, file=unreadable.file, reason=unreadable.reason))
            # a right line may follow a wrong one of the table
            if unreadable.file != TABLE:
                self._done.add(unreadable.step)
        for arrival in arrived:
            self._take(arrival)
        return bool(arrived or given_up)

    def recorded(self) -> Experiment:
        """Return the experiment with all radiographs that have come and show the sample, in the order of steps.

        Raises ExperimentError where none has, or one that was followed cannot be read any more.
        """
        lines = list(read_record(self._record.path))
        left_out = {line.step for line in lines if isinstance(line, LostLine) and line.left_out}
        followed = {line.step for line in lines if isinstance(line, StepLine)}
        arrived, _ = self._opened(left_out).look()
        gone = sorted(followed - {each.step for each in arrived})
        if gone or not arrived:
            found = f"that of step {listed(gone)} not any more" if gone else "none"
            raise ExperimentError(f"{self._radiographs}: expected the radiographs of the test, found {found}")
        return replace(self._setup.experiment, geometry=self._setup.told, test=series_of(arrived))

    def _opened(self, done: Iterable[int]) -> Incoming:
        geometry = self._setup.geometry
        size, steps = (geometry.rows, geometry.columns), len(self._setup.experiment.test)
        return Incoming(self._radiographs, size, steps, done=done)

    def _take(self, arrival: Arrival) -> None:
        started = time.perf_counter()
        self._done.add(arrival.step)
        seen = self._watch.seen(arrival)
        if any(alarm.spoils for alarm in seen):
            self._lose(arrival, "; ".join(alarm.reason for alarm in seen if alarm.spoils), seen)
            return
        try:
            taken = self._tracker.take(arrival)
        except Late as error:
            reason = f"{error}: only the measurement of the whole test has it"
            self._say_lost(LostLine(step=arrival.step, file=arrival.file, reason=reason))
            return
        except ValueError as error:
            # a radiograph that shows another thing than the sample is no reason to stop
            state = read_arrays(self._folder / _STATE)
            self._recall(self._blank if state is None else state)
            self._lose(arrival, str(error), seen)
            return
        line = step_line(self._setup, arrival, taken, time.perf_counter() - started)
        write_arrays(self._told_file(arrival.step), vars(taken.told))
        self._add(line, *self._new(arrival, (*seen, *self._watch.followed(line, taken))))
        self._see(arrival, taken)
        # after the motion is told, and not when there is time: what comes out must not depend on the clock
        self._tracker.settle()

    def _lose(self, arrival: Arrival, reason: str, alarms: tuple[Alarm, ...]) -> None:
        """Say that a radiograph shows no motion."""
        reason = f"step {arrival.step}: {reason}"
        line = LostLine(step=arrival.step, file=arrival.file, reason=reason, left_out=True)
        self._add(line, *self._new(arrival, alarms))

    def _new(self, arrival: Arrival, alarms: tuple[Alarm, ...]) -> list[Line]:
        return [alarm.line(arrival.step) for alarm in self._watch.new(arrival.step, alarms)]

    def _say_lost(self, line: LostLine) -> None:
        """Say that a radiograph cannot be used: once, however often the test is resumed."""
        if _which(line) not in self._lost:
            self._lost.add(_which(line))
            self._write(line)

    def _add(self, *lines: Line) -> None:
        """Keep what is needed to resume after some lines, and write them."""
        state = {**self._state(), "key": np.array(self._key), "lines": np.array([line.text() for line in lines])}
        write_arrays(self._folder / _STATE, state)
        needed = {self._told_file(t) for t in state["told"].tolist()}
        for old in set(self._folder.glob(f"*{_TOLD}")) - needed:
            old.unlink(missing_ok=True)
        self._write(*lines)

    def _write(self, *lines: Line) -> None:
        for line in lines:
            self._record.add(line)
            self._tell(line)

    def _state(self) -> Arrays:
        """Return what tracker and watch know; what steps told is kept apart."""
        watched = {_WATCH + name: values for name, values in self._watch.kept().items()}
        return {**self._tracker.kept(), **watched}

    def _resume(self, plan: PlanLine) -> None:
        """Know again what was known when the last lines were written, or were about to be.

        Whether they were told, too, nobody knows: they are told again.
        """
        path, written = self._folder / _STATE, list(self._record.lines)
        followed = any(isinstance(line, StepLine) for line in read_record(self._record.path))
        state = read_arrays(path)
        if written[0] != plan.text() or (followed and state is None):
            raise ValueError(
                f"{self._record.path}: expected the record of this test, found that of another one, or of other "
                "options: choose another file"
            )
        if state is None:
            self._tracker.settle()
            return
        texts = state["lines"].tolist()
        after = written[written.index(texts[0]) + 1 :] if texts[0] in written else []
        if str(state["key"]) != self._key or any(isinstance(line_of(text, ""), StepLine) for text in after):
            raise ValueError(
                f"{path}: expected the same reference scan, plan, options, folder and software as now, and as much as "
                "the record tells, found others: choose another file"
            )
        for text in texts:
            if text not in written:
                self._record.add_text(text)
            self._tell(line_of(text, str(path)))
        self._recall(state)

    def _recall(self, state: Arrays) -> None:
        """Let the tracker know what was kept; raises ValueError where what a step told is missing or damaged."""
        told = {}
        for step in state["told"].tolist():
            found = read_arrays(self._told_file(step))
            if found is None:
                raise ValueError(
                    f"{self._told_file(step)}: expected what step {step} told, whole: choose another file"
                )
            told[step] = Told(**found)
        self._tracker.restore(state, told)
        self._watch.restore({name[len(_WATCH) :]: state[name] for name in state if name.startswith(_WATCH)})
        self._tracker.settle()

    def _told_file(self, step: int) -> Path:
        return self._folder / f"{step:05d}{_TOLD}"


def _which(line: LostLine) -> tuple[int, str, str]:
    """Return what tells a lost radiograph, or a wrong line of the table, from others."""
    return line.step, line.file, line.reason if line.file == TABLE else ""


_STATE, _TOLD, _WATCH = "state.kept", ".told.kept", "watch_"


def step_line(setup: Setup, arrival: Arrival, taken: Taken, seconds: float) -> StepLine:
    """Return the line of a radiograph that was taken in, and `seconds` it took."""
    basis, voxel_mm, height = setup.sections, setup.geometry.voxel_mm, setup.sections.height_mm
    points = np.zeros((len(height), 3))
    points[:, 2] = height
    moved, ends = basis.displacement(taken.amplitude, points), [0, -1]
    rise = moved[:, 2] * voxel_mm
    return StepLine(
        step=arrival.step,
        file=arrival.file,
        angle_deg=float(np.rad2deg(arrival.angle_rad)),
        time_s=arrival.time_s,
        force_N=arrival.force_N,
        displacement_voxel=_rows(moved @ beam_frame(arrival.angle_rad).T),
        displacement_std=_rows(turned_std(basis, taken.covariance, arrival.angle_rad, points)),
        strain=tuple((np.diff(rise) / np.diff(height)).tolist()),
        strain_std=tuple(strain_std(basis, taken.covariance, height, voxel_mm).tolist()),
        mean_strain=float(np.diff(rise[ends])[0] / np.diff(height[ends])[0]),
        mean_strain_std=float(strain_std(basis, taken.covariance, height[ends], voxel_mm)[0]),
        chi2_reduced=taken.tests.chi2_reduced,
        passes=taken.passes,
        seconds=seconds,
        unix_s=time.time(),
    )


def _rows(values: Floats) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(a), float(b), float(c)) for a, b, c in values)
