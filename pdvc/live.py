"""Follow a test while it runs: radiographs come into a folder, their motion goes to a record, one line for each.

After the reference scan, `make_ready` prepares all that does not depend on the test and keeps it. `follow` takes each
radiograph as soon as it is whole (`pdvc.incoming`), finds the motion (`pdvc.tracker`), and adds it to the record
(`pdvc.record`); when all that are planned are in, the whole test is measured as in `pdvc.protocol`.

What the tracker knows is kept before a line is added to the record, line included: a process that is killed and
started again goes on with the radiograph that it had in hand, to the same numbers.
"""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.compilation import compile_kernels
from pdvc.deviations import beam_frame, strain_std, turned_std
from pdvc.digest import digest
from pdvc.experiment import Experiment, ExperimentError, Series
from pdvc.incoming import Arrival, Incoming
from pdvc.lagged import FITTED, Late, Told
from pdvc.lock import held
from pdvc.measurement import Measurement
from pdvc.options import DEFAULT, MeasureOptions
from pdvc.progress import Progress, silent
from pdvc.radiograph_table import TABLE
from pdvc.record import LostLine, MeasurementLine, PlanLine, Record, StepLine, read_record
from pdvc.resumable import measure_into
from pdvc.setup import Setup, set_up
from pdvc.store import experiment_digest
from pdvc.tracker import Taken, Tracker
from pdvc.whole import write_whole

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
    with held(work):
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
    tell: Callable[[StepLine | LostLine], None] = lambda _: None,
    idle_s: float = float("inf"),
) -> Measurement:
    """Follow the radiographs that come into a folder, until all that are planned are in, or none for `idle_s`.

    Adds to `record_of(file)`, then measures the whole test into `file`, and returns the measurement. `tell` is called
    with each line that is added. `work` as in `measure_into`, with what `make_ready` has kept there. Interrupted, it
    goes on where it was.
    Raises ExperimentError where the folder cannot be followed, ValueError where the test cannot be measured or the
    record belongs to another one, InUseError where another process is at the same file.
    """
    folder, kept = work or file.with_name(file.name + ".work"), file.with_name(file.name + ".live")
    with held(folder), held(kept), closing(Record(record_of(file))) as record:
        compile_kernels(progress=progress)
        setup = set_up(experiment, options, work=folder, progress=progress)
        follower = _Follower(setup, Tracker(setup, progress), radiographs, record, kept)
        heard = time.monotonic()
        while follower.missing and time.monotonic() < heard + idle_s:
            if follower.look(tell):
                heard = time.monotonic()
            else:
                time.sleep(POLL_S)
        started = time.perf_counter()
        measurement = measure_into(file, follower.recorded(), options, work=folder, progress=progress)
        record.add(MeasurementLine(file=file.name, seconds=time.perf_counter() - started))
    shutil.rmtree(kept, ignore_errors=True)
    if work is None:
        shutil.rmtree(folder, ignore_errors=True)
    return measurement


def record_of(file: Path) -> Path:
    """Return where the record of a test is, that is followed into a measurement file."""
    return file.with_name(file.name + ".record.jsonl")


class _Follower:
    """A test that is followed: what has come in, what the tracker knows, and the record."""

    def __init__(self, setup: Setup, tracker: Tracker, radiographs: Path, record: Record, folder: Path) -> None:
        """Begin, or go on where the record ends; raises ValueError where it belongs to another test."""
        self._setup, self._tracker, self._radiographs, self._folder = setup, tracker, radiographs, folder
        self._key = digest("live", experiment_digest(setup.experiment), setup.options)
        self._record = record
        first = PlanLine(
            title=setup.experiment.title,
            steps=len(setup.experiment.test),
            height_mm=tuple(setup.sections.height_mm.tolist()),
            voxel_mm=setup.geometry.voxel_mm,
        )
        if self._record.lines:
            self._go_on()
        else:
            self._record.add(first)
        lines = list(read_record(record.path))
        self._done = {line.step for line in lines if isinstance(line, StepLine)}
        self._lost = {line for line in lines if isinstance(line, LostLine)}
        # what was lost is looked at again, and said once
        self._incoming = self._opened(self._done)

    @property
    def missing(self) -> bool:
        """Return whether planned radiographs have neither come nor been given up."""
        return any(step not in self._done for step in range(len(self._setup.experiment.test)))

    def look(self, tell: Callable[[StepLine | LostLine], None]) -> bool:
        """Take in what has come; return whether anything has."""
        arrived, given_up = self._incoming.look()
        for unreadable in given_up:
            self._say_lost(LostLine(step=unreadable.step, file=unreadable.file, reason=unreadable.reason), tell)
            # a right line may follow a wrong one of the table
            if unreadable.file != TABLE:
                self._done.add(unreadable.step)
        for arrival in arrived:
            self._take(arrival, tell)
        return bool(arrived or given_up)

    def recorded(self) -> Experiment:
        """Return the experiment with all radiographs that have come, in the order of steps.

        Raises ExperimentError where none has.
        """
        arrived, _ = self._opened(()).look()
        if not arrived:
            raise ExperimentError(f"{self._radiographs}: expected radiographs of the test, found none")
        test = Series(
            counts=np.stack([each.counts for each in arrived]),
            angle_rad=np.array([each.angle_rad for each in arrived]),
            time_s=np.array([each.time_s for each in arrived]),
            force_N=np.array([each.force_N for each in arrived]),
        )
        return replace(self._setup.experiment, test=test)

    def _opened(self, done: Iterable[int]) -> Incoming:
        geometry = self._setup.geometry
        size, steps = (geometry.rows, geometry.columns), len(self._setup.experiment.test)
        return Incoming(self._radiographs, size, steps, done=done)

    def _take(self, arrival: Arrival, tell: Callable[[StepLine | LostLine], None]) -> None:
        started = time.perf_counter()
        try:
            taken = self._tracker.take(arrival)
        except Late as error:
            reason = f"{error}; it takes part in the measurement of the whole test"
            self._say_lost(LostLine(step=arrival.step, file=arrival.file, reason=reason), tell)
            self._done.add(arrival.step)
            return
        line = _line(self._setup, arrival, taken, time.perf_counter() - started)
        self._keep(arrival.step, taken.told, line)
        self._record.add(line)
        self._done.add(arrival.step)
        tell(line)
        # after the motion is told, and not when there is time: what comes out must not depend on the clock
        self._tracker.settle()

    def _say_lost(self, line: LostLine, tell: Callable[[StepLine | LostLine], None]) -> None:
        """Say that a radiograph cannot be used; once, however often the test is gone on with."""
        if line not in self._lost:
            self._record.add(line)
            self._lost.add(line)
            tell(line)

    def _keep(self, step: int, told: Told, line: StepLine) -> None:
        """Keep what is needed to go on after this step, whole or not at all."""
        write_whole(self._told_file(step), _packed(vars(told)))
        state = {**self._tracker.kept(), "key": np.array(self._key), "line": np.array(line.text())}
        write_whole(self._folder / _STATE, _packed(state))
        self._told_file(step - FITTED).unlink(missing_ok=True)

    def _go_on(self) -> None:
        """Know again what was known when the last line was written, or was about to be."""
        path = self._folder / _STATE
        if not path.is_file():
            # killed before the first radiograph was in, unless there are lines of some
            if len(self._record.lines) > 1:
                raise ValueError(
                    f"{path}: expected what is needed to go on with the record, found none: choose another file"
                )
            return
        state = _unpacked(path)
        if str(state["key"]) != self._key:
            raise ValueError(
                f"{path}: expected the same reference scan, plan and options as now, found others: choose another "
                "file for the measurement"
            )
        line = str(state["line"])
        if line not in self._record.lines[-2:]:
            self._record.add_text(line)
        told = {
            int(file.name.removesuffix(_TOLD)): Told(**_unpacked(file))
            for file in sorted(self._folder.glob(f"*{_TOLD}"))
        }
        self._tracker.restore(state, told)
        self._tracker.settle()

    def _told_file(self, step: int) -> Path:
        return self._folder / f"{step:05d}{_TOLD}"


_STATE, _TOLD = "state.npz", ".told.npz"


def _line(setup: Setup, arrival: Arrival, taken: Taken, seconds: float) -> StepLine:
    """Return the line of a radiograph that was taken in."""
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


def _packed(values: Mapping[str, NDArray[Any]]) -> memoryview:
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **values)
    return content.getbuffer()


def _unpacked(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path) as kept:
        return dict(kept)
