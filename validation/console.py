"""What the command line shows: progress, the summary, and errors in one line."""

from __future__ import annotations

import math
import time
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from pdvc.lock import FULL_DISK
from pdvc.verdict import Doubt, Verdict
from validation.scoring.scores import Scores

if TYPE_CHECKING:
    import pandas as pd

    from pdvc.measurement import Measurement
    from simulator.scenario import Scenario
    from validation.study.coverage import Honesty
    from validation.study.description import Study
    from validation.study.resolution import Resolution

INTERRUPTED = 130
WRONG_INPUT = 2
FAILED = 1
NOT_BELIEVED = 3
"""A measurement was made and written, but its verdict is `failed`."""


class ProgressBars:
    """Draw a bar with the remaining time for each task; a line at its end where there is no terminal.

    Tasks that share what stands before a comma, as "rigid, pass 3" does, share a bar.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._started: dict[str, float] = {}
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            speed_estimate_period=120,
            disable=not console.is_terminal,
        )
        self._rows: dict[str, TaskID] = {}
        self._shown: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def __call__(self, task: str, done: int, total: int) -> None:
        """Draw that `done` of `total` parts of `task` are finished."""
        self._started.setdefault(task, time.monotonic())
        if self._console.is_terminal:
            self._draw(task, done, total)
        elif done >= total:
            seconds = time.monotonic() - self._started.pop(task)
            self._console.print(f"{task}: {total} of {total} in {seconds:.1f} s", highlight=False)

    def _draw(self, task: str, done: int, total: int) -> None:
        group = task.partition(",")[0]
        if group not in self._rows:
            self._bars.start()
            self._rows[group] = self._bars.add_task(task, total=total, completed=done)
        elif self._shown[group] != task:
            self._bars.reset(self._rows[group], total=total, completed=done, description=task)
        self._shown[group] = task
        self._bars.update(self._rows[group], completed=done, total=total)


@contextmanager
def one_line_errors(console: Console, *, resume: str, debug: bool = False) -> Iterator[None]:
    """Turn what a user can mend into one line on stderr and an exit code; `debug` shows where it came from.

    2: wrong input; 1: the machine failed (no space, no permission, no memory), or another process is at work in the
    folder; 130: interrupted. An error's notes are added.
    """
    try:
        yield
    except KeyboardInterrupt as error:
        _say(console, "; ".join(["interrupted", *_notes(error), *([] if _notes(error) else [resume])]))
        raise typer.Exit(INTERRUPTED) from None
    except (ValueError, MemoryError, OSError, ImportError) as error:
        if debug:
            raise
        _say(console, "; ".join([f"error: {_explain(error)}", *_notes(error)]))
        raise typer.Exit(WRONG_INPUT if isinstance(error, ValueError) else FAILED) from None


def _explain(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return f"not enough memory: {error}"
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename else ""
        advice = "; make room, then run the same command again" if error.errno in FULL_DISK else ""
        return f"{name}{error.strerror or error}{advice}"
    # a plain ValueError may be a fault of this program: then its place is wanted
    hint = " (pdvc-bench --debug COMMAND shows where)" if type(error) is ValueError else ""
    return " ".join(str(error).split()) + hint


def _notes(error: BaseException) -> list[str]:
    return getattr(error, "__notes__", [])


def _say(console: Console, text: str) -> None:
    # soft_wrap keeps it one line, which scripts can search
    console.print(
        text, style="red" if text.startswith("error") else None, markup=False, highlight=False, soft_wrap=True
    )


def used(measurement: Measurement) -> str:
    """Return in one line which part of the radiographs was used, and where loading begins."""
    top, bottom, left, right = measurement.recording.window
    parts = tomllib.loads(measurement.provenance.options).get("time", [])
    starts = [str(part["start"]) for part in parts if part["kind"] == "ramp" and isinstance(part["start"], int)]
    onset = f"; loading begins after step {', '.join(dict.fromkeys(starts))}" if starts else ""
    return f"used: rows {top} to {bottom - 1}, columns {left} to {right - 1}{onset}"


def inspection_table(title: str, lines: Iterable[tuple[str, str, str]]) -> Table:
    """Return what an inspection found as a table of one screen."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in ("", "found", "due"):
        table.add_column(name)
    for line in lines:
        table.add_row(*line)
    return table


def say_doubts(console: Console, doubts: Sequence[Doubt]) -> None:
    """Print what speaks against the data, and what to change; or that nothing does."""
    if not doubts:
        console.print("nothing speaks against these data", style="green")
    for doubt in doubts:
        style = "red" if doubt.fatal else "yellow"
        console.print(str(doubt), style=style, markup=False, highlight=False, soft_wrap=True)


def say_verdict(console: Console, verdict: Verdict) -> None:
    """Print the word of a verdict, and a line for each doubt."""
    console.print(f"verdict: {verdict.word}", style=_COLOURS[verdict.word], highlight=False)
    for doubt in verdict.doubts:
        console.print(f"  {doubt}", markup=False, highlight=False, soft_wrap=True)


_COLOURS = {"trusted": "green", "doubtful": "yellow", "failed": "red"}


def summary(scores: Scores, report: Path | None = None) -> Table:
    """Return the scores as a table of one screen."""
    table = Table(title=f"{scores.scenario}: {scores.steps} steps, {scores.unknowns} unknowns", title_justify="left")
    for name in ("", "here", "paper"):
        table.add_column(name, justify="left" if not name else "right")
    snr, modes = scores.snr_db, scores.modes
    table.add_row(
        "SNR re-projection / noise limit, dB", f"{snr.reprojection:.1f} / {snr.noise_limit:.1f}", "21.7 /  - "
    )
    table.add_row(
        "SNR initial / rigid / final, dB",
        f"{snr.initial:.1f} / {snr.rigid:.1f} / {snr.final:.1f}",
        "9.9 / 25.4 / 26.7",
    )
    table.add_row("modes rigid / deformation", f"{modes.rigid} / {modes.deformation}", "8 / 4")
    for key in ("across_beam", "vertical", "along_beam"):
        table.add_row(f"error {key.replace('_', ' ')}, voxel rms", f"{getattr(scores.error_voxel, key):.4f}", "")
    table.add_row("strain error, rms", f"{scores.strain_rms:.1e}", "")
    table.add_row(
        "largest strain measured / true, %",
        f"{scores.max_strain_measured * 100:.2f} / {scores.max_strain_true * 100:.2f}",
        "8 to 9",
    )
    seconds = scores.seconds
    table.add_row(
        "simulate / reconstruct / measure, s",
        f"{seconds.simulate:.0f} / {seconds.reconstruct:.0f} / {seconds.measure:.0f}",
        "",
    )
    table.add_row("peak memory, GiB", f"{scores.peak_memory_gib:.2f}", "")
    if report is not None:
        table.caption = f"report: {report}"
        table.caption_justify = "left"
    return table


def study_summary(study: Study, summary: pd.DataFrame) -> Table:
    """Return a study's errors as a table of one screen: bias and random part for each combination."""
    title = f"{study.name}: bias / random part, voxel rms; of the strain, rms"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for factor in study.factor:
        table.add_column(factor.axis_label, justify="right")
    quantities = ("voxel_across_beam", "voxel_vertical", "voxel_along_beam", "strain")
    for name in ("runs", "across beam", "vertical", "along beam", "strain"):
        table.add_column(name, justify="right", no_wrap=True)
    for _, row in summary.iterrows():
        which = [row[factor.column] for factor in study.factor]
        parts = [(row[f"bias_{quantity}"], row[f"random_{quantity}"]) for quantity in quantities]
        table.add_row(
            *(f"{each:g}" if isinstance(each, float) else str(each) for each in which),
            str(int(row["runs"])),
            *(f"{bias:.2g}/{random:.2g}" for bias, random in parts),
        )
    return table


def honesty_table(study: Study, found: Honesty) -> Table:
    """Return how often the intervals of pooled draws hold, as a table of one screen."""
    levels = dict.fromkeys(one.level for one in found.covered)
    title = f"{study.name}: {found.draws} draws; in brackets 95 % binomial intervals, each draw as one trial"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for heading in ("", "stated, rms", "z rms", *(f"{level} % cover" for level in levels)):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for direction in found.z_rms:
        covered = [one for one in found.covered if one.direction == direction]
        table.add_row(
            direction.replace("_", " "),
            f"{found.predicted[direction]:.2g}",
            f"{found.z_rms[direction]:.2f}",
            *(
                f"{one.found.value:.0%} ({one.binomial[0]:.0%} to {one.binomial[1]:.0%})".replace("%", "")
                for one in covered
            ),
        )
    return table


def resolved_table(study: Study, found: Sequence[Resolution]) -> Table:
    """Return what each method of a study resolves, as a table of one screen."""
    title = f"{study.name}: d, beyond which strains are recovered to a tenth; their noise s"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in found[0].combination:
        table.add_column(name.replace("_", " "), no_wrap=True)
    for name in ("d, mm", "at best, mm", "s, 1e-3", "s d, um", "s d², um mm"):
        table.add_column(name, justify="right", no_wrap=True)
    for each in found:
        d = each.resolution_mm
        interval = f" ({d.low:.2f} to {d.high:.2f})" if math.isfinite(d.low) else ""
        table.add_row(
            *(str(value) for value in each.combination.values()),
            each.outside or f"{d.value:.2f}{interval}",
            each.recoverable_outside or f"{each.recoverable_mm:.2f}",
            f"{1e3 * each.sigma:.2f}",
            f"{each.indicator_um:.2f}",
            f"{each.strain_indicator_um_mm:.2f}",
        )
    return table


def influence_tables(study: Study, heads: Sequence[tuple[str, str]], rows: Sequence[Sequence[str]]) -> Iterator[Table]:
    """Return a table for each part of the error: what each factor does to it, the one that matters most first."""
    what = "mean change over its range, mu*" if study.design == "morris" else "share of the variance, total index"
    for part in dict.fromkeys(part for part, _ in heads):
        table = Table(title=f"{study.name}: {part}: {what}", title_justify="left", box=None, pad_edge=False)
        chosen = [n for n, (each, _) in enumerate(heads) if each == part]
        for name in ("factor", *(heads[n][1] for n in chosen)):
            table.add_column(name, justify="left" if name == "factor" else "right")
        for label, *cells in rows:
            table.add_row(label, *(cells[n] for n in chosen))
        yield table


def study_table(studies: Iterable[Study]) -> Table:
    """Return the studies as a table, one line each."""
    table = Table(box=None, pad_edge=False)
    for name in ("name", "runs", "scenario", "what it asks"):
        table.add_column(name, justify="right" if name == "runs" else "left")
    for each in studies:
        table.add_row(each.name, str(each.repetitions * each.combinations), each.scenario, each.title)
    return table


def scenario_table(scenarios: Iterable[Scenario]) -> Table:
    """Return the scenarios as a table, one line each."""
    table = Table(box=None, pad_edge=False)
    for name in ("name", "detector, px", "views", "steps", "what it is"):
        table.add_column(name, justify="right" if name in ("detector, px", "views", "steps") else "left")
    for each in scenarios:
        size = f"{each.geometry.rows} x {each.geometry.columns}"
        plan = each.acquisition
        table.add_row(each.name, size, str(plan.reference_views), str(plan.test_steps), each.title)
    return table
