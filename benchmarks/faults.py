"""Commands killed at random moments and given again: python -m benchmarks.faults [moments] [name ...].

`run quick`, a study of six runs and a comparison of two methods are carried out undisturbed. Then they are killed
(SIGKILL) and the same command is given again, three times in a row in each folder, and then to the end. Its scores
have to be those of the undisturbed one to the last digit, but for times and memory, with no run twice and nothing
half-written left. The moments are spread over the time that the undisturbed command takes, one at random in each part
of equal length. Every other time the command's whole group of processes is killed; in between the command alone, whose
workers are left to themselves, and the same command is given at once.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import psutil

from validation.batch.machine import machine

MOMENTS = 30
IN_A_ROW = 3
"""Kills in one folder."""
SEED = 8
TIMES = ("seconds", "peak_memory_gib")
"""Scores that no two runs share."""
SCENARIO = Path(__file__).parent / "faults.toml"
STUDY = Path(__file__).parent / "faults-study.toml"


@dataclass(frozen=True, kw_only=True)
class Job:
    """A command of the command line that can be given again, and what it finds."""

    name: str
    arguments: tuple[str, ...]
    """All but the folder."""
    found: Callable[[Path], dict[str, Any]]
    """What it left in its folder that has to be the same, as plain values by name."""

    def start(self, folder: Path) -> subprocess.Popen[bytes]:
        """Begin it in a group of processes of its own; what it tells goes to FOLDER.log."""
        command = [sys.executable, "-m", "validation.cli", *self.arguments, "-o", str(folder)]
        with folder.with_name(folder.name + ".log").open("wb") as log:
            return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True)

    def finish(self, folder: Path) -> float:
        """Carry it out to the end and return how long that took, s; raises RuntimeError where it fails."""
        began = time.perf_counter()
        code = self.start(folder).wait()
        if code:
            raise RuntimeError(f"{self.name}: expected exit code 0, found {code}: {told(folder)}")
        return time.perf_counter() - began


def told(folder: Path) -> str:
    """Return the last line that a command told."""
    lines = folder.with_name(folder.name + ".log").read_text(encoding="utf-8").strip().splitlines()
    return lines[-1] if lines else "nothing yet"


def scores_of(folder: Path) -> dict[str, Any]:
    """Return the scores of a run, as text: all digits count, and one NaN is like another."""
    values = json.loads((folder / "scores.json").read_text(encoding="utf-8"))
    return {name: repr(value) for name, value in values.items() if name not in TIMES}


def rows_of(folder: Path) -> dict[str, Any]:
    """Return the rows and arrays of a study or comparison, by key; raises ValueError where a run is there twice."""
    table = pd.read_parquet(folder / "table.parquet")
    if table["key"].duplicated().any() or set(pd.read_parquet(folder / "runs")["key"]) != set(table["key"]):
        raise ValueError(f"{folder}: expected every run once, found {list(table['key'])}")
    if (table["status"] != "done").any():
        raise ValueError(f"{folder}: expected all runs done, found {list(table['reason'])}")
    kept = table[[name for name in table.columns if not name.startswith("seconds")]]
    found = {row["key"]: repr(row) for row in kept.to_dict("records")}
    for key in table["key"]:
        with np.load(folder / "errors" / f"{key}.npz") as arrays:
            found |= {f"{key}/{name}": arrays[name].tobytes() for name in arrays.files}
    return found


def jobs(scenario: str = "quick") -> tuple[Job, ...]:
    """Return what is killed: a run of a scenario, a small study, a small comparison."""
    compared = (str(SCENARIO), "--methods", "gauss-newton,weighted", "--repetitions", "2", "--workers", "2")
    return (
        Job(name=f"run {scenario}", arguments=("run", scenario), found=scores_of),
        Job(name="study", arguments=("study", str(STUDY), "--workers", "2"), found=rows_of),
        Job(name="compare", arguments=("compare", *compared), found=rows_of),
    )


def group(leader: int) -> list[psutil.Process]:
    """Return the processes of a group that are still alive."""
    found = []
    for process in psutil.process_iter():
        try:
            if os.getpgid(process.pid) == leader and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except (psutil.NoSuchProcess, ProcessLookupError):
            pass
    return found


def kill(job: Job, folder: Path, after_s: float, *, alone: bool) -> int | None:
    """Begin a job and kill it after some time, `alone` or with its group; returns the group, None where it had ended.

    A command that had ended before that has to have ended well.
    """
    started = job.start(folder)
    try:
        code = started.wait(timeout=after_s)
    except subprocess.TimeoutExpired:
        (os.kill if alone else os.killpg)(started.pid, signal.SIGKILL)
        started.wait()
        return started.pid
    if code:
        raise RuntimeError(f"{job.name}: expected exit code 0, found {code}: {told(folder)}")
    return None


def left_over(folder: Path) -> list[str]:
    """Return what a finished command should not have left in its folder."""
    names = ("*.partial", "*.count", ".in-use-by")
    return sorted(str(path.relative_to(folder)) for name in names for path in folder.rglob(name))


@dataclass
class Tally:
    """What became of a job at all moments."""

    job: str
    seconds: float
    """Of the undisturbed command, s."""
    killed: int = 0
    folders: int = 0
    same: int = 0
    """Folders in which all was as in the undisturbed one."""
    ended: int = 0
    """Times that the command had ended before its moment came."""
    wrong: list[str] = field(default_factory=list)
    after: Counter[str] = field(default_factory=Counter)
    """What the command had told last when it was killed."""
    orphans_s: float = 0.0
    """Longest time that a worker outlived its command, s."""


def disturb(job: Job, folder: Path, moments: int, rng: np.random.Generator, in_a_row: int = IN_A_ROW) -> Tally:
    """Kill a job so many times, some in a row in each folder, and compare what it finds when given again.

    The machine's pace changes: where a command had ended before its moment came, the time that it takes is corrected,
    and another folder makes up for the moment.
    """
    seconds = job.finish(folder / "undisturbed")
    expected, tally, begun = job.found(folder / "undisturbed"), Tally(job=job.name, seconds=seconds), to_begin_s()
    shares = (np.arange(moments) + rng.random(moments)) / moments
    # the first folder gets the first, the eleventh and the twenty-first of thirty, and so on
    planned = -(-moments // in_a_row)
    while tally.killed < moments and tally.folders < 4 * planned:
        n = tally.folders
        out, before, lived, leaders = folder / f"{n:03d}", 0.0, 0.0, []
        for k, share in enumerate(shares[n % planned :: planned]):
            alone, began = (n + k) % 2 == 1, time.perf_counter()
            leader = kill(job, out, (share - before) * seconds + (begun if k else 0), alone=alone)
            lived += time.perf_counter() - began
            before = share
            if leader is None:
                tally.ended += 1
                seconds = min(seconds, lived)
                break
            leaders.append(leader)
            tally.killed += 1
            tally.after[stage(out)] += 1
            if alone:
                tally.orphans_s = max(tally.orphans_s, outlived(leader))
        wrong = compared(job, out, expected)
        if any(group(leader) for leader in leaders):
            wrong.append("processes of a killed command are still there")
        tally.folders += 1
        tally.same += not wrong
        tally.wrong += [f"folder {n}: {reason}" for reason in wrong]
        print(f"{job.name}: folder {n + 1}, {tally.killed} kills, {tally.same} the same", file=sys.stderr, flush=True)
    return tally


def stage(folder: Path) -> str:
    """Return how far a killed command had come: the task that it told last, or the runs that it had finished."""
    if (folder / "runs").is_dir():
        return f"{len(list((folder / 'runs').glob('*.parquet')))} runs"
    return told(folder).partition(":")[0].partition(",")[0]


@cache
def to_begin_s() -> float:
    """Return how long a command takes before it does anything, s."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import pdvc.protocol, validation.job, simulator.scanner"], check=True)
    return time.perf_counter() - began


def outlived(leader: int, most_s: float = 0.5) -> float:
    """Watch for a moment what is left of a group, and return for how long it was, s."""
    began = time.perf_counter()
    while group(leader) and time.perf_counter() - began < most_s:
        time.sleep(0.02)
    return time.perf_counter() - began


def compared(job: Job, folder: Path, expected: dict[str, Any]) -> list[str]:
    """Give a command again and return what is wrong with what it leaves."""
    try:
        job.finish(folder)
        found = job.found(folder)
    except (RuntimeError, ValueError, OSError) as error:
        return [str(error)]
    differing = [name for name in expected | found if expected.get(name) != found.get(name)]
    left = [name for name in left_over(folder) if not name.startswith("work/")]
    return [f"{name} differs" for name in differing] + [f"{name} was left" for name in left]


def show(tally: Tally) -> str:
    """Return a row of the table in docs/faults.md."""
    after = ", ".join(f"{count} {task}" for task, count in tally.after.most_common())
    return (
        f"| `{tally.job}` | {tally.seconds:.0f} | {tally.killed} | {tally.ended} | {tally.same} of {tally.folders} "
        f"| {tally.orphans_s:.1f} | {after} |"
    )


HEAD = (
    "| command | undisturbed, s | kills | ended before | folders the same | workers alone, s | done when killed |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)


def main() -> None:
    """Disturb all jobs, or those named, and print a table."""
    moments = int(sys.argv[1]) if len(sys.argv) > 1 else MOMENTS
    chosen = [job for job in jobs() if len(sys.argv) < 3 or job.name.split()[0] in sys.argv[2:]]
    rng, tallies = np.random.default_rng(SEED), []
    for job in chosen:
        with tempfile.TemporaryDirectory() as folder:
            tallies.append(disturb(job, Path(folder), moments, rng))
    print(machine(None, None).partition(" on ")[2] + "\n")
    print("\n".join([HEAD, *map(show, tallies)]))
    wrong = [f"{tally.job}: {each}" for tally in tallies for each in tally.wrong]
    if wrong:
        raise SystemExit("\n".join(wrong))


if __name__ == "__main__":
    main()
