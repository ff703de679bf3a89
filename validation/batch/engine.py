"""Many runs on dask.distributed, each on disk as soon as it is finished, in one folder that can be resumed.

DIR/runs/KEY.parquet     one row for each finished run; the folder reads as one table
DIR/errors/KEY.npz       its arrays
DIR/failed/KEY.log       the traceback of a run that failed
DIR/table.parquet        at the end: all rows, in the order of the runs
DIR/work/                what runs share, while they need it; removed at the end

A run is anything with a key, columns that say which it is, and a way to be carried out (`Run`). What several runs
share is a `Part`: a dask task of its own on which they depend, made once, and removed as soon as no run needs it any
more. The parts in use, and so the disk space, are bounded: few more runs are handed out than there are workers.

A run whose worker dies is started again by dask. One that goes on killing its workers is tried by itself at the end,
and then given up. A run that raises becomes a row with its reason. Called again, runs that are done are not repeated;
those that failed are.
"""

from __future__ import annotations

import errno
import io
import logging
import math
import os
import shutil
import threading
import time
import traceback
import uuid
import zipfile
import zlib
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

from pdvc.lock import FULL_DISK, held
from pdvc.progress import Progress, silent
from pdvc.whole import write_whole

if TYPE_CHECKING:
    import pandas as pd
    from distributed import Client, Future

Scalar = str | int | float | bool | None

RUNS, ERRORS, FAILED, WORK, TABLE = "runs", "errors", "failed", "work", "table.parquet"
ANSWER_S = 10.0
"""How long to wait for a scheduler to answer, s."""
DEATHS_ALLOWED = 2
"""Workers that a run may lose before it is set aside."""
_ONE_AT_A_TIME = threading.Lock()
"""Numba's own threads end a process in which two parallel kernels run at once: a worker of a cluster that was given
several threads does one thing after the other."""
_TYPES = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}


class Part(Protocol):
    """What several runs share."""

    @property
    def name(self) -> str:
        """Return its file or folder in the shared folder, a name that holds all it depends on."""

    def needs(self) -> tuple[Part, ...]:
        """Return the parts it is made from."""

    def make(self, shared: Path) -> None:
        """Make it, unless it is there; whole or not at all."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a run found."""

    scores: Mapping[str, Scalar]
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


class Run(Protocol):
    """What is carried out once, anywhere."""

    @property
    def key(self) -> str:
        """Return a name for files, of all that the result depends on."""

    @property
    def columns(self) -> Mapping[str, Scalar]:
        """Return what says which run this is: the first columns of its row. The types are those of all runs."""

    @property
    def score_columns(self) -> Mapping[str, type]:
        """Return names and types of the scores."""

    def parts(self) -> tuple[Part, ...]:
        """Return the parts it uses; it makes those that it does not find."""

    def carry_out(self, shared: Path) -> Result:
        """Do it; what it raises is the reason in its row."""


def run_trials(
    trials: Sequence[Run],
    folder: Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Progress = silent,
) -> pd.DataFrame:
    """Carry out all runs that the folder does not hold yet; return the table of all, in their order.

    Runs go to the Dask scheduler at an address, whose workers see the folder under the same path, or else to `workers`
    local processes, by default one for each processor. The table depends on neither, but for columns whose name
    begins with ``seconds``. Raises ValueError where the scheduler does not answer, InUseError where another process is
    at work in the folder, and OSError where it cannot be written: then nothing is lost that was finished.
    """
    with held(folder):
        return _run_trials(trials, folder, scheduler, workers, progress)


def _run_trials(
    trials: Sequence[Run], folder: Path, scheduler: str | None, workers: int | None, progress: Progress
) -> pd.DataFrame:
    shared = (folder / WORK).resolve()
    waiting = {run.key: run for run in trials if not is_done(folder, run)}
    total = len({run.key for run in trials})
    if waiting:
        for name in (RUNS, ERRORS, FAILED, WORK):
            (folder / name).mkdir(parents=True, exist_ok=True)
        for left in shared.glob("experiment-*"):  # by runs that were killed
            shutil.rmtree(left, ignore_errors=True)
        if scheduler is None:  # no worker of a killed command outlives it here; on a cluster one may still be writing
            for left in (path for name in (RUNS, ERRORS, FAILED) for path in (folder / name).glob(".*.partial")):
                left.unlink(missing_ok=True)
        with connected(scheduler, workers, shared) as client:
            _Session(client, folder.resolve(), shared, total, progress).carry_out(list(waiting.values()))
    shutil.rmtree(shared, ignore_errors=True)
    table = collected(trials, folder)
    buffer = io.BytesIO()
    parquet.write_table(table, buffer)
    write_whole(folder / TABLE, buffer.getvalue())
    return table.to_pandas()


def is_done(folder: Path, run: Run) -> bool:
    """Return whether a folder holds row and arrays, undamaged, of a run that did not fail."""
    try:
        row = parquet.read_table(folder / RUNS / f"{run.key}.parquet")
        with zipfile.ZipFile(folder / ERRORS / f"{run.key}.npz") as arrays:
            return row["status"][0].as_py() == "done" and arrays.testzip() is None
    except (OSError, ValueError, LookupError, zipfile.BadZipFile, zlib.error):
        return False


def collected(trials: Sequence[Run], folder: Path) -> pa.Table:
    """Return the rows of finished runs, in the order of the runs."""
    rows = []
    for run in trials:
        found = parquet.read_table(folder / RUNS / f"{run.key}.parquet")
        # the row may have been written by a study that called its factors otherwise
        rows.append(_row(run, {name: found[name][0].as_py() for name in found.column_names}))
    return pa.concat_tables(rows, promote_options="permissive")


@contextmanager
def connected(scheduler: str | None, workers: int | None, scratch: Path) -> Iterator[Client]:
    """Connect to a scheduler, or start a cluster of single-threaded processes here for as long as it is needed."""
    import dask
    from distributed import Client, LocalCluster
    from distributed.system import MEMORY_LIMIT

    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=ANSWER_S)
        except (OSError, ValueError) as error:
            raise ValueError(f"--scheduler {scheduler}: expected the address of a Dask scheduler: {error}") from None
        with client:
            yield client
        return
    count = workers or os.cpu_count() or 1
    one_thread = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": DEATHS_ALLOWED}),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            memory_limit=MEMORY_LIMIT // count,
            env=one_thread,
            dashboard_address=":0",
            local_directory=str(scratch),
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


class _Session:
    """Hand out runs and the parts they share, and keep account of both."""

    def __init__(self, client: Client, folder: Path, shared: Path, total: int, progress: Progress) -> None:
        self._client, self._folder, self._shared = client, folder, shared
        self._total, self._progress = total, progress
        self._uses: Counter[str] = Counter()
        self._parts: dict[str, Future[Any]] = {}
        self._made: set[str] = set()
        self._failed = 0
        self._left = 0

    def carry_out(self, runs: list[Run]) -> None:
        from distributed import KilledWorker

        for run in runs:
            self._uses.update(part.name for part in _all_parts(run.parts()))
        runs = self._together(runs)
        self._left = len(runs)
        self._tell()
        aside: list[Run] = []
        for run, future in self._finished(runs, self._window):
            if future.status == "error" and isinstance(future.exception(), KilledWorker):
                aside.append(run)
            else:
                self._take(run, future)
        for run, future in self._finished(aside, lambda: 1):
            self._take(run, future)

    def _together(self, runs: list[Run]) -> list[Run]:
        """Return the runs in an order in which those that share a part follow each other: it is kept shortly.

        Of several parts the one that the fewest share counts; else the order stays.
        """
        first: dict[str, int] = {}
        places = []
        for place, run in enumerate(runs):
            shared = [part.name for part in run.parts() if self._uses[part.name] > 1]
            rarest = min(shared, key=lambda name: self._uses[name], default=run.key)
            places.append(first.setdefault(rarest, place))
        return [runs[place] for place in sorted(range(len(runs)), key=lambda place: places[place])]

    def _finished(self, runs: list[Run], window: Any) -> Iterator[tuple[Run, Future[Any]]]:
        """Submit runs, as many at a time as the window allows, and yield each when it is finished."""
        from distributed import as_completed

        waiting, finished = deque(enumerate(runs)), as_completed()
        submitted: dict[Future[Any], Run] = {}
        while waiting or submitted:
            while waiting and len(submitted) < window():
                place, run = waiting.popleft()
                future = self._submit(run, place)
                submitted[future] = run
                finished.add(future)
            future = next(finished)
            yield submitted.pop(future), future

    def _window(self) -> int:
        # one run more for each worker than it is busy with, so that it never waits
        threads: dict[str, int] = self._client.nthreads()
        return max(2 * sum(threads.values()), 4)

    def _submit(self, run: Run, place: int) -> Future[Any]:
        parts = self._parts_in_work(run.parts(), place)
        # not the run's own key: dask would answer a second attempt with the first one's failure
        key = f"run-{uuid.uuid4().hex}"
        return self._client.submit(
            _carry_out, run, self._folder, self._shared, parts, key=key, priority=-place, pure=False
        )

    def _parts_in_work(self, parts: tuple[Part, ...], place: int) -> list[Future[Any]]:
        """Return the futures of those parts that several runs share and that are not made yet."""
        shared = [part for part in parts if self._uses[part.name] > 1 and part.name not in self._made]
        for part in shared:
            if part.name not in self._parts or self._parts[part.name].status == "error":
                needed = self._parts_in_work(part.needs(), place)
                self._parts[part.name] = self._client.submit(
                    _make, part, self._shared, needed, key=f"part-{uuid.uuid4().hex}", priority=-place, pure=False
                )
        return [self._parts[part.name] for part in shared]

    def _take(self, run: Run, future: Future[Any]) -> None:
        """Take note of a run that is finished, or write its row where no worker could."""
        try:
            # waits where the worker has died since, for another to find the row on disk
            done = future.result()
        except CancelledError:
            raise OSError(f"the scheduler gave up run {run.key}: it was restarted, or its cluster closed") from None
        except Exception as error:
            if _of_the_machine(error):
                raise
            done = is_done(self._folder, run)
            if not done:
                trace = "".join(traceback.format_exception(error))
                _write_failure(run, self._folder, error, trace, math.nan)
        # a future kept longer would be computed anew, with its parts, when the worker that holds its result dies
        future.release()
        self._failed += not done
        self._left -= 1
        self._tell()
        for part in _all_parts(run.parts()):
            # it is on disk now
            self._made.add(part.name)
            self._parts.pop(part.name, None)
            self._uses[part.name] -= 1
            if not self._uses[part.name]:
                _remove(self._shared / part.name)

    def _tell(self) -> None:
        task = f"runs, {self._failed} failed" if self._failed else "runs"
        self._progress(task, self._total - self._left, self._total)


def _all_parts(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    """Return parts and those that they need, each once."""
    found = {part.name: part for part in parts}
    for part in parts:
        found.update({each.name: each for each in _all_parts(part.needs())})
    return tuple(found.values())


def _make(part: Part, shared: Path, needed: list[None]) -> None:
    """Make a part on a worker; where that fails, the runs that need it try by themselves and have a row to say so."""
    with _ONE_AT_A_TIME, suppress(Exception):
        part.make(shared)


def _carry_out(run: Run, folder: Path, shared: Path, parts: list[None]) -> bool:
    """Carry out a run on a worker and write its row; returns whether it succeeded."""
    import numba

    if is_done(folder, run):  # and its worker died before it could say so
        return True
    numba.set_num_threads(1)
    started = time.perf_counter()
    try:
        with _ONE_AT_A_TIME:
            result = run.carry_out(shared)
    except Exception as error:  # whatever it is, it is this row's reason
        if _of_the_machine(error):
            raise
        _write_failure(run, folder, error, traceback.format_exc(), time.perf_counter() - started)
        return False
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **result.arrays)
    _write_whole(folder / ERRORS / f"{run.key}.npz", buffer.getvalue())
    values = {"status": "done", "reason": "", **result.scores, "seconds": time.perf_counter() - started}
    _write_row(run, folder, values)
    (folder / FAILED / f"{run.key}.log").unlink(missing_ok=True)
    return True


def _of_the_machine(error: Exception) -> bool:
    """Return whether every other run would fail of the same: then none of them is given a row."""
    return isinstance(error, OSError) and error.errno in FULL_DISK | {errno.EROFS, errno.EIO}


def _write_failure(run: Run, folder: Path, error: Exception, trace: str, seconds: float) -> None:
    _write_whole(folder / FAILED / f"{run.key}.log", trace.encode())
    reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
    _write_row(run, folder, {"status": "failed", "reason": reason, "seconds": seconds})


def _write_row(run: Run, folder: Path, values: Mapping[str, Scalar]) -> None:
    buffer = io.BytesIO()
    parquet.write_table(_row(run, {**values, "version": version("pdvc-bench")}), buffer)
    _write_whole(folder / RUNS / f"{run.key}.parquet", buffer.getvalue())


def _row(run: Run, values: Mapping[str, Scalar]) -> pa.Table:
    """Return the one row of a run: what is not among the values is null."""
    kinds: dict[str, type] = {name: type(value) for name, value in run.columns.items()}
    kinds |= {"status": str, "reason": str, **run.score_columns, "seconds": float, "version": str, "key": str}
    values = {**values, **run.columns, "key": run.key}
    columns = {name: pa.array([values.get(name)], type=_TYPES[kind]) for name, kind in kinds.items()}
    return pa.table(columns)


def _write_whole(path: Path, content: bytes) -> None:
    # a name that begins with a dot is no part of the table that the folder is
    write_whole(path, content, partial=path.with_name(f".{path.name}.{os.getpid()}.partial"))


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
