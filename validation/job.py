"""The whole job in one folder: simulate, measure, score, report; what is finished is not done again.

DIR/experiment/       the experiment folder, with its truth/
DIR/measurement.nc    what was measured
DIR/scores.json       how good it is
DIR/report.html       for a reader; DIR/figures/*.png holds its figures
DIR/work/             state.json, and intermediate results of an unfinished measurement
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pdvc.digest import digest
from pdvc.experiment import DESCRIPTION, Experiment, read_experiment
from pdvc.lock import held
from pdvc.measurement import Measurement, MeasurementError
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.progress import Progress, silent
from pdvc.store import experiment_digest
from pdvc.whole import write_whole
from validation.report.page import write_report
from validation.scoring.scores import Scores, score

if TYPE_CHECKING:
    from pdvc.options import MeasureOptions
    from simulator.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Job:
    """What is asked for."""

    scenario: Scenario
    options: MeasureOptions
    folder: Path
    """Where everything goes."""
    workers: int | None = None
    """Processes that simulate; None lets the simulator choose. Results do not depend on it."""

    @property
    def experiment(self) -> Path:
        """Return the experiment folder."""
        return self.folder / "experiment"

    @property
    def measurement(self) -> Path:
        """Return the measurement file."""
        return self.folder / "measurement.nc"

    @property
    def work(self) -> Path:
        """Return the folder for what only serves to go on after an interruption."""
        return self.folder / "work"


@dataclass
class State:
    """What earlier attempts did in a folder, so that the next one knows what still holds."""

    measurement: str = ""
    """Digest of software, options and experiment, every count of it, that measurement.nc belongs to."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time spent so far, s, all attempts together."""
    peak_memory_gib: float = 0.0

    @classmethod
    def read(cls, path: Path) -> State:
        """Read the state; an empty one where there is none or it cannot be read."""
        try:
            return cls(**json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return cls()

    def write(self, path: Path) -> None:
        """Write the state, whole or not at all."""
        write_text(path, json.dumps(asdict(self), indent=2) + "\n")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a run came to."""

    measurement: Measurement
    scores: Scores
    report: Path
    reused: tuple[str, ...]
    """Parts that were finished already: `experiment`, `measurement`."""


def run(job: Job, *, progress: Progress = silent) -> Outcome:
    """Do what is still to be done of a job; called again after an interruption, it goes on there.

    Raises SimulationError where the folder holds another scenario's experiment, InUseError where another process is
    at work in it.
    """
    with held(job.folder):
        return _run(job, progress)


def _run(job: Job, progress: Progress) -> Outcome:
    from simulator.truth import read_truth

    state_path = job.work / "state.json"
    state = State.read(state_path)
    reused = []
    if _simulate(job, state, state_path, progress):
        reused.append("experiment")
    experiment = read_experiment(job.experiment)
    measurement, kept = _measure(job, state, state_path, experiment, progress)
    if kept:
        reused.append("measurement")
    progress("score and report", 0, 1)
    truth = read_truth(job.experiment)
    scores = score(
        measurement,
        truth,
        scenario=job.scenario.name,
        simulate_s=state.seconds.get("simulate", math.nan),
        peak_memory_gib=state.peak_memory_gib,
    )
    write_text(job.folder / "scores.json", scores.to_json())
    report = write_report(job.folder, measurement, experiment=experiment, truth=truth, scores=scores)
    progress("score and report", 1, 1)
    return Outcome(measurement=measurement, scores=scores, report=report, reused=tuple(reused))


def _simulate(job: Job, state: State, state_path: Path, progress: Progress) -> bool:
    """Simulate unless that is done; returns whether it was."""
    from simulator.scanner import check_folder, simulate

    check_folder(job.scenario, job.experiment)
    if (job.experiment / DESCRIPTION).exists():
        return True
    if not job.experiment.exists():
        state.seconds.pop("simulate", None)
    with _noting("simulate", state, state_path):
        simulate(job.scenario, job.experiment, progress=progress, workers=job.workers)
    return False


def _measure(
    job: Job, state: State, state_path: Path, experiment: Experiment, progress: Progress
) -> tuple[Measurement, bool]:
    """Measure unless that is done with the same options; returns the measurement and whether it was."""
    wanted = digest(job.options, job.options.motions, experiment_digest(experiment), experiment.title)
    if job.measurement.exists() and state.measurement == wanted:
        # one that was damaged since is made again
        with suppress(MeasurementError):
            return read_measurement(job.measurement), True
    from pdvc.protocol import measure

    with _noting("measure", state, state_path):
        measurement = measure(experiment, job.options, progress=progress, work=job.work / "measure")
        write_measurement(measurement, job.measurement)
        state.measurement = wanted
    return measurement, False


@contextmanager
def _noting(part: str, state: State, path: Path) -> Iterator[None]:
    """Add the time that a part takes to the state, also when it is interrupted."""
    start = time.perf_counter()
    try:
        yield
    finally:
        state.seconds[part] = state.seconds.get(part, 0.0) + time.perf_counter() - start
        state.peak_memory_gib = max(state.peak_memory_gib, peak_memory_gib())
        state.write(path)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    write_whole(path, text.encode())


def peak_memory_gib() -> float:
    """Return the largest resident memory of this process so far, GiB."""
    import resource

    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size / 2**30 if sys.platform == "darwin" else size / 2**20
