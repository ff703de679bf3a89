"""Give bad inputs to the command line, each in a process of its own, and record what a user would see."""

from __future__ import annotations

import html
import math
import multiprocessing
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bad_inputs.experiments import EXPERIMENTS
from benchmarks.bad_inputs.record import BadInput, Folder
from pdvc.measurement import Measurement, MeasurementError
from pdvc.measurement_file import read_measurement
from simulator.scanner import simulate
from validation.scoring.centre_line import centre_line

_PROGRESS = re.compile(r": \d+ of \d+ in [\d.]+ s$|^(measurement|report): ")
_RAW = re.compile(r"^Traceback |:\d+: \w*Warning: ")
_USAGE, _USAGE_ENDS = "╭─ Error", "╰"
"""What a frame begins and ends with, in which options that are wrong by themselves are told."""
_EXPLAINED = re.compile(
    r"expected|missing|unknown key|not valid TOML|truncated|in use by|Input should be|Missing|is due"
)
"""What every error of this software says: what was expected, or what is missing; and no dictionary of Python's."""
LOST = 255
"""What the server of processes says where it lost the exit code: then the command is given again."""
MEASURED = (0, 3)
"""Exit codes with which a result was written; 3: its verdict is `failed`."""
LARGE_STRAIN = 0.2
"""A strain above this is no measurement of a metal: the table marks it."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What the command line made of an input."""

    case: BadInput
    code: int | None
    """Exit code of `measure`; None where it did not end within the limit."""
    console: tuple[str, ...]
    """What `measure` printed beside its progress, line by line, folders left out."""
    verdict: str = ""
    """The verdict in the result; empty where there is none."""
    doubts: tuple[tuple[str, str, str], ...] = ()
    """Name, figure and advice of each reason of the verdict."""
    strain: float = math.nan
    """Largest strain of either sign, without unit; nan where there is none."""
    report: str | None = None
    """Text of the report; None where `report` failed, or was not asked for: a result without a verdict shows none."""
    left: tuple[str, ...] = ()
    """Files beside the experiment and the result."""
    seconds: float = 0.0
    """Time of `measure`, s."""

    @property
    def errors(self) -> tuple[str, ...]:
        """Return the lines of the console that say what is wrong."""
        return (*(line for line in self.console if line.startswith("error: ")), *_framed(self.console))

    @property
    def lost(self) -> tuple[str, ...]:
        """Return the lines of the console that say which radiograph, or line of a table, was lost."""
        return tuple(line for line in self.console if line.startswith("lost: "))

    @property
    def raw(self) -> tuple[str, ...]:
        """Return the lines of the console that are not meant for a user: tracebacks and Python's warnings."""
        return tuple(line for line in self.console if _RAW.search(line))

    @property
    def answer(self) -> str:
        """Return ``error``, ``warning``, ``trusted`` or ``nothing``."""
        if self.code not in MEASURED:
            return "error" if self.errors else "nothing"
        return {"": "nothing", "trusted": "trusted"}.get(self.verdict, "warning")

    @property
    def faults(self) -> tuple[str, ...]:
        """Return what is wrong with the answer; capitals where a user would not learn of the mistake."""
        return tuple(_faults(self))


def _framed(console: Sequence[str]) -> Iterator[str]:
    """Give what is told in frames, each in one line."""
    words: list[str] | None = None
    for line in console:
        if line.startswith(_USAGE):
            words = []
        elif words is not None and line.startswith(_USAGE_ENDS):
            yield " ".join(words)
            words = None
        elif words is not None:
            words += line.strip("│ ").split()


def _faults(seen: Outcome) -> Iterator[str]:
    due, answer = seen.case.due, seen.answer
    if seen.code is None:
        yield "NO END"
        return
    if seen.code not in (*MEASURED, seen.case.code) or (seen.code == seen.case.code and not seen.errors):
        yield f"CRASH, exit code {seen.code}"
    elif due == "told" and not seen.lost:
        yield "SILENT"
    elif due == "good" and answer == "error":
        yield "REFUSED"
    elif due == "good" and answer == "warning":
        yield "FALSE ALARM"
    elif due == "good" and answer == "nothing":
        yield "no verdict"
    elif due == "warning" and answer in ("trusted", "nothing"):
        yield "SILENT"
    elif due == "error" and answer != "error":
        yield "SILENT" if answer in ("trusted", "nothing") else "MEASURED, AN ERROR IS DUE"
    if seen.raw:
        yield "raw warnings on the console"
    if len(seen.errors) > 1 or any(not _EXPLAINED.search(line) or "{'" in line for line in (*seen.errors, *seen.lost)):
        yield "unclear error"
    if seen.left:
        yield f"leaves {', '.join(seen.left)}"
    if seen.code in MEASURED:
        yield from _hidden(seen)


def _hidden(seen: Outcome) -> Iterator[str]:
    """Give the places where the verdict of a result is not shown."""
    if seen.verdict and seen.report is None:
        yield "no report"
    if seen.answer == "warning":
        names = [name for name, _, _ in seen.doubts]
        if not names:
            yield "no reasons"
        if not all(map(all, seen.doubts)):
            yield "a reason without figure or advice"
        if not any(seen.verdict in line for line in seen.console):
            yield "verdict not on the console"
        if seen.report is not None and not all(word in seen.report for word in (seen.verdict, *names)):
            yield "verdict not in the report"


def carry_out(name: str, folder: Path) -> None:
    """Simulate an experiment of EXPERIMENTS in a folder, unless it is there."""
    simulate(EXPERIMENTS[name], folder)


class Bench:
    """A scratch folder in which experiments are simulated once, and cases carried out."""

    def __init__(
        self, scratch: Path, *, limit_s: float = 600.0, make: Callable[[str, Path], None] = carry_out
    ) -> None:
        self._scratch = scratch
        self._make = make
        self._making = threading.Lock()
        self._limit_s = limit_s
        # the server imports once what every command needs; it computes nothing, so that forking it is safe
        self._processes = multiprocessing.get_context("forkserver")
        self._processes.set_forkserver_preload(
            ["pdvc.protocol", "validation.cli", "validation.report.page", "simulator.scanner"]
        )

    def simulated(self, name: str) -> Path:
        """Return the folder of an experiment of EXPERIMENTS, made at the first call."""
        folder = self._scratch / "good" / name.replace(", ", "-").replace(" ", "-")
        with self._making:
            self._make(name, folder)
        return folder

    def carry_out(self, cases: Sequence[BadInput], jobs: int) -> Iterator[Outcome]:
        """Carry out cases, so many side by side, and give their outcomes as they come."""
        with ThreadPoolExecutor(jobs) as pool:
            for done in as_completed([pool.submit(self.outcome, case) for case in cases]):
                yield done.result()

    def changed(self, case: BadInput, folder: Path) -> None:
        """Write a copy of the case's experiment, without its truth, and change it."""
        shutil.copytree(self.simulated(case.experiment), folder, ignore=shutil.ignore_patterns("truth"))
        case.change(Folder(path=folder, simulated=self.simulated))

    def outcome(self, case: BadInput) -> Outcome:
        """Change a copy of the experiment, measure it, report it; nothing stays on disk."""
        place = self._scratch / case.name
        shutil.rmtree(place, ignore_errors=True)
        folder, result = place / "experiment", place / "motion.nc"
        self.changed(case, folder)
        if case.command != "measure":
            return self._followed(case, place)
        arguments = ["measure", str(folder), "-o", str(result), *case.arguments]
        if case.options:
            (place / "options.toml").write_text(case.options, encoding="utf-8")
            arguments += ["--options", str(place / "options.toml")]
        started = time.perf_counter()
        code = self._command(arguments, place / "console.log")
        seconds = time.perf_counter() - started
        known = {"experiment", "options.toml", "console.log", "motion.nc"}
        seen = partial(
            Outcome,
            case=case,
            code=code,
            console=_console(place),
            left=()
            if code is None
            else tuple(sorted(path.name for path in place.iterdir() if path.name not in known)),
            seconds=seconds,
        )
        found = seen() if code not in MEASURED or not result.is_file() else seen(**self._result(place))
        shutil.rmtree(place)
        return found

    def _followed(self, case: BadInput, place: Path) -> Outcome:
        """Give a command about a test while it runs; nothing stays on disk."""
        if "ready" in case.arguments and case.command != "prepare":
            shutil.copytree(self.ready(case.experiment), place / "ready")
        arguments = [case.command, *case.arguments]
        if case.options:
            (place / "options.toml").write_text(case.options, encoding="utf-8")
            arguments += ["--options", "options.toml"]
        # what was begun can be gone on with
        known = {"console.log", "ready", "motion.nc.live", "motion.nc.record.jsonl"}
        known |= {path.name for path in place.iterdir()}
        with case.meanwhile(place):
            started = time.perf_counter()
            code = self._command(arguments, place / "console.log", place)
            seconds = time.perf_counter() - started
        console = _console(place)
        measured = code in MEASURED and case.command == "live"
        left = () if measured else tuple(sorted(path.name for path in place.iterdir() if path.name not in known))
        shutil.rmtree(place)
        return Outcome(case=case, code=code, console=console, left=left, seconds=seconds)

    def ready(self, name: str) -> Path:
        """Return what prepare makes of an experiment of EXPERIMENTS, made at the first call."""
        experiment = self.simulated(name)
        work = experiment.with_name(f"{experiment.name}.ready")
        with self._making:
            if not work.is_dir():
                log = work.with_name(f"{work.name}.log")
                code = self._command(["prepare", str(experiment), "--work", str(work)], log)
                if code != 0:
                    raise RuntimeError(f"prepare: expected exit code 0, got {code}: {log.read_text(encoding='utf-8')}")
        return work

    def _result(self, place: Path) -> dict[str, Any]:
        """Return what a result and its report say."""
        measurement = read_measurement(place / "motion.nc")
        verdict = getattr(measurement, "verdict", None)
        strain = largest_strain(measurement)
        if verdict is None:
            return {"strain": strain}
        arguments = ["report", str(place / "motion.nc"), "-o", str(place / "report")]
        code = self._command([*arguments, "--experiment", str(place / "experiment")], place / "report.log")
        page = place / "report" / "report.html"
        return {
            "verdict": str(verdict.word),
            "doubts": tuple((str(doubt.name), str(doubt.figure), str(doubt.advice)) for doubt in verdict.doubts),
            "strain": strain,
            "report": html.unescape(page.read_text(encoding="utf-8")) if code == 0 else None,
        }

    def _command(self, arguments: list[str], log: Path, within: Path | None = None) -> int | None:
        """Run the command line in a process of its own; returns its exit code, or None beyond the limit."""
        log.touch()  # a process that is stopped early has not opened it
        for _ in range(3):
            process = self._processes.Process(target=_run, args=(arguments, str(log), within), daemon=True)
            process.start()
            process.join(self._limit_s)
            if process.is_alive():
                process.kill()
                process.join()
                return None
            if process.exitcode != LOST:
                break
        return process.exitcode


def largest_strain(measurement: Measurement) -> float:
    """Return the largest |du_z / dz| between observed sections at any step, without unit; nan where there are none."""
    try:
        history = centre_line(measurement)
    except MeasurementError:
        return math.nan
    strain = np.abs(history.strain(history.measured))
    return float(np.nanmax(strain)) if np.isfinite(strain).any() else math.nan


def _console(place: Path) -> tuple[str, ...]:
    """Return what a command printed beside its progress, line by line, folders left out."""
    text = (place / "console.log").read_text(encoding="utf-8", errors="replace").replace(f"{place}{os.sep}", "")
    return tuple(line for line in text.splitlines() if line and not _PROGRESS.search(line))


def _run(arguments: list[str], log: str, within: Path | None) -> None:
    """Run the command line as in a shell, in a folder, with its console in a file."""
    with open(log, "wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    if within is not None:
        os.chdir(within)
    from validation.cli import app

    app(arguments)
