"""What a comparison leaves: one self-contained page, figures, and tables for a spreadsheet and for a paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import pyarrow as pa
from matplotlib.figure import Figure
from pyarrow import csv, parquet

from simulator.scenario import Scenario
from validation.compare.figures import Point, cost_figure, steps_figure
from validation.compare.machine_time import CLAIM, Gain, gains
from validation.compare.paired import QUANTITIES, MethodScores, Summary
from validation.compare.tables import (
    Row,
    TextTable,
    difference_row,
    difference_table,
    gain_table,
    method_row,
    number,
    own_table,
    ratio_text,
    score_table,
    step_rows,
)
from validation.methods.registry import Method
from validation.report.figures import save
from validation.report.template import template
from validation.scoring.bootstrap import LEAST_REPETITIONS

PAGE = "comparison.html"


@dataclass(frozen=True, kw_only=True)
class Chapter:
    """What the page says about one scenario."""

    scenario: Scenario
    note: str
    """What was added to the scenario, if anything."""
    tables: tuple[TextTable, ...]
    differences: TextTable | None
    gain: TextTable | None
    verdict: str
    failures: tuple[tuple[str, str], ...]
    doubts: tuple[tuple[str, str], ...]
    """Method and reason."""
    pictures: tuple[Picture, ...]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A figure as the page shows it."""

    name: str
    caption: str
    data: str
    """PNG, base64."""


def write_comparison(
    folder: Path,
    scenarios: Sequence[Scenario],
    methods: Sequence[Method],
    summary: Summary,
    notes: Mapping[str, str],
    where: str,
) -> Path:
    """Write tables, figures and page into the folder; returns the page's path.

    `notes` are by scenario's name; `where` says in words on which machine it ran.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = [method_row(each) for each in summary.methods]
    _whole(folder / "methods.parquet", lambda path: parquet.write_table(pa.Table.from_pylist(rows), path))
    _write_csv(folder / "methods.csv", rows)
    _write_csv(folder / "differences.csv", [difference_row(each) for each in summary.differences])
    _write_csv(folder / "by_step.csv", [row for each in summary.by_step for row in step_rows(each)])
    chapters = [_chapter(folder / "figures", each, methods, summary, notes.get(each.name, "")) for each in scenarios]
    printed = [table for chapter in chapters for table in chapter.tables]
    _write_text(folder / "methods.md", "\n".join(table.markdown() for table in printed))
    _write_text(folder / "methods.tex", "\n".join(table.latex() for table in printed))
    _write_text(folder / PAGE, _page(methods, chapters, summary, where))
    return folder / PAGE


def _chapter(figures: Path, scenario: Scenario, methods: Sequence[Method], summary: Summary, note: str) -> Chapter:
    scores = [each for each in summary.methods if each.scenario == scenario.name]
    differences = [each for each in summary.differences if each.scenario == scenario.name]
    tables = [score_table(scores)]
    if any(each.measured != each.common for each in scores if each.done):
        tables.append(own_table(scores))
    gain, verdict = _gain(methods, scores)
    return Chapter(
        scenario=scenario,
        note=note,
        tables=tuple(tables),
        differences=difference_table(differences) if differences else None,
        gain=gain,
        verdict=verdict,
        failures=tuple((each.method, each.reason) for each in scores if each.failed),
        doubts=tuple(
            (each.method, f"{each.doubted} of {each.done}: {each.doubts}") for each in scores if each.doubted
        ),
        pictures=tuple(_pictures(figures, scenario.name, methods, summary)),
    )


def _gain(methods: Sequence[Method], scores: Sequence[MethodScores]) -> tuple[TextTable | None, str]:
    """Return the table of what a step costs, and what that says of the paper's claim; nothing without both kinds."""
    by_name = {each.method: each for each in scores if each.measured}
    kinds = {
        kind: [by_name[method.name] for method in methods if method.looks_at == kind and method.name in by_name]
        for kind in ("projections", "volumes")
    }
    if not all(kinds.values()):
        return None, ""
    # those that look at the same cost the same; of several, those that measured most
    best = {
        kind: [each for each in found if each.measured == max(e.measured for e in found)]
        for kind, found in kinds.items()
    }
    found = gains(best["projections"][0], best["volumes"][0])
    names = {kind: ", ".join(each.method for each in found) for kind, found in best.items()}
    # without a common step there are no errors to compare
    compared = {kind: [each for each in some if each.common] for kind, some in kinds.items()}
    exactness = (
        " Exactness, over the steps that all measured: the smallest rms error by radiographs is the smallest by full "
        f"scans times {ratio_text(compared['projections'], compared['volumes'])}."
        if all(compared.values())
        else ""
    )
    return gain_table(found, names["projections"], names["volumes"]), _verdict(found) + exactness


def _verdict(found: Sequence[Gain]) -> str:
    kept = [each.definition for each in found if each.holds]
    missed = [each.definition for each in found if not each.holds]
    smallest = min(each.minutes for each in found)
    if not missed:
        return (
            f"Two orders of magnitude in acquisition time, a factor of {CLAIM}, hold by every definition: "
            f"the smallest factor is {number(smallest)}."
        )
    held = f"hold for: {'; '.join(kept)}" if kept else "hold by no definition"
    return (
        f"Two orders of magnitude in acquisition time, a factor of {CLAIM}, {held}. "
        f"They are missed for: {'; '.join(missed)}, by which the smallest factor is {number(smallest)}."
    )


def _pictures(folder: Path, scenario: str, methods: Sequence[Method], summary: Summary) -> list[Picture]:
    names = [method.name for method in methods]
    scores = [each for each in summary.methods if each.scenario == scenario and each.done]
    if not scores:
        return []

    def points(cost: Callable[[MethodScores], float]) -> dict[str, list[Point]]:
        return {
            name: [Point(method=each.method, cost=cost(each), error=each.error[name]) for each in scores]
            for name in QUANTITIES
        }

    steps = {each.method: each.error for each in summary.by_step if each.scenario == scenario}
    common = "over the steps that all methods measured"
    drawn = (
        (
            "machine_time",
            f"Rms errors {common}, against the scanner time that each measured step takes, reference scan included.",
            cost_figure(points(lambda each: each.minutes_per_step), names, "scanner time per step (min)"),
        ),
        (
            "computing_time",
            f"Rms errors {common}, against the computing time of the whole test on one thread.",
            cost_figure(points(lambda each: each.seconds.value), names, "computing time (s)"),
        ),
        (
            "steps",
            "Rms errors at each step, over all points that the method measured. Scans that were taken at a few steps "
            "only stand alone.",
            steps_figure(steps, names),
        ),
    )
    folder.mkdir(parents=True, exist_ok=True)
    return [_picture(folder / f"{scenario}_{name}.png", caption, figure) for name, caption, figure in drawn]


def _picture(path: Path, caption: str, figure: Figure) -> Picture:
    return Picture(name=path.stem, caption=caption, data=save(figure, path, dpi=120))


def _page(methods: Sequence[Method], chapters: Sequence[Chapter], summary: Summary, where: str) -> str:
    repetitions = max((each.done + each.failed for each in summary.methods), default=0)
    return template("comparison.html").render(
        methods=methods,
        chapters=chapters,
        repetitions=repetitions,
        intervals=repetitions >= LEAST_REPETITIONS,
        least=LEAST_REPETITIONS,
        version=version("pdvc-bench"),
        where=where,
    )


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    _whole(path, lambda partial: csv.write_csv(pa.Table.from_pylist(list(rows)), partial))


def _write_text(path: Path, text: str) -> None:
    _whole(path, lambda partial: partial.write_text(text, encoding="utf-8"))


def _whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under its name only when it is complete."""
    partial = path.with_name(path.name + ".partial")
    write(partial)
    partial.replace(path)
