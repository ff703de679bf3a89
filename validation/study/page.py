"""What a study leaves for a reader: summary, scores and coverage as CSV, figures, and one page, study.html."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

from validation.batch.doubts import doubted
from validation.batch.engine import FAILED
from validation.report.figures import save
from validation.report.template import template
from validation.scoring.bootstrap import Estimate
from validation.study.coverage import DIRECTIONS, Honesty, coverage_table, honesty, verdict
from validation.study.description import Study
from validation.study.figures import study_pictures
from validation.study.resolution import Resolution, resolution_table, resolutions
from validation.study.resolution_figures import resolution_picture
from validation.study.score_figures import score_pictures
from validation.study.sensitivity import Influence, influence_table, influences, ranked
from validation.study.sensitivity_figures import PART_NAMES, TITLES, influence_picture, scale_of, unit_of
from validation.study.summary import PARTS, QUANTITIES, mean_scores, summarise

HEADINGS = {
    "voxel_across_beam": "across the beam, voxel",
    "voxel_vertical": "vertical, voxel",
    "voxel_along_beam": "along the beam, voxel",
    "strain": "strain",
}


def write_study_report(
    folder: Path, study: Study, text: str, table: pd.DataFrame, *, where: str
) -> tuple[Path, pd.DataFrame]:
    """Write tables, figures and page of a finished study; returns the page's path and the summary.

    `text` is the study file, `where` says on what it ran.
    """
    summary = summarise(study, table, folder)
    scores = mean_scores(study, table)
    shown = honesty(study, table)
    resolved = resolutions(study, table, folder)
    mattering = influences(study, summary, scores)
    frames = {"summary": summary, "scores": scores, "coverage": coverage_table(shown)}
    if resolved:
        frames["resolution"] = resolution_table(resolved)
    if mattering:
        frames["sensitivity"] = influence_table(study, mattering)
    for name, frame in frames.items():
        partial = folder / f"{name}.csv.partial"
        frame.to_csv(partial, index=False)
        partial.replace(folder / f"{name}.csv")
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    pictures = []
    drawn = [resolution_picture(resolved)] if resolved else []
    drawn += [influence_picture(study, mattering)] if mattering else []
    for picture in (*drawn, *score_pictures(study, scores), *study_pictures(study, summary)):
        data = save(picture.figure, folder / "figures" / f"{picture.name}.png", dpi=120)
        pictures.append({"name": picture.name, "caption": picture.caption, "data": data})
    page = folder / "study.html"
    partial = page.with_name("study.html.partial")
    content = _page(study, text, table, summary, scores, shown, resolved, mattering, pictures, where)
    partial.write_text(content, encoding="utf-8")
    partial.replace(page)
    return page, summary


def _page(
    study: Study,
    text: str,
    table: pd.DataFrame,
    summary: pd.DataFrame,
    scores: pd.DataFrame,
    shown: list[Honesty],
    resolved: list[Resolution],
    mattering: list[Influence],
    pictures: list[dict[str, str]],
    where: str,
) -> str:
    failed = table[table["status"] != "done"]
    factors = [factor.column for factor in study.factor]
    columns = [*factors, "repetition", "reason", "key"]
    number, reasons = doubted(table)
    return template("study.html").render(
        study=study,
        text=text,
        runs=len(table),
        failed=[[_cell(row[name]) for name in columns] for _, row in failed.iterrows()],
        failed_columns=columns,
        doubted=number,
        doubts=reasons,
        failed_folder=FAILED,
        factors=[factor.axis_label for factor in study.factor],
        parts=PARTS,
        quantities=[HEADINGS[quantity] for quantity in QUANTITIES],
        bounded=any(f"bound_{quantity}" in summary for quantity in QUANTITIES),
        rows=[_summary_row(row, factors) for _, row in summary.iterrows()],
        coverage=[
            {
                "which": [_cell(value) for value in each.combination.values()],
                "verdict": verdict(each),
                "rows": _covered(each),
            }
            for each in shown
        ],
        wavelengths=[f"{length:g}" for length in resolved[0].wavelength_mm] if resolved else [],
        resolved=[_resolved(each) for each in resolved],
        resolved_by=[name.replace("_", " ") for name in resolved[0].combination] if resolved else [],
        influenced=influence_heads(study, mattering),
        influence_rows=influence_rows(study, mattering),
        scores_columns=list(scores.columns),
        scores=[[_cell(value) for value in row] for row in scores.itertuples(index=False)],
        pictures=pictures,
        where=where,
        hours=table["seconds"].sum() / 3600,
        version=version("pdvc-bench"),
    )


def _covered(found: Honesty) -> list[list[str]]:
    """Return a line for each direction: stated deviation, z, and the coverages with their binomial intervals."""
    lines = []
    for direction in DIRECTIONS:
        shares = [
            f"{100 * one.found.value:.1f} ({100 * one.binomial[0]:.0f} to {100 * one.binomial[1]:.0f})"
            for one in found.covered
            if one.direction == direction
        ]
        name = HEADINGS["strain" if direction == "strain" else f"voxel_{direction}"]
        lines.append([name, _cell(found.predicted[direction]), _cell(found.z_rms[direction]), *shares])
    return lines


def _resolved(found: Resolution) -> list[str]:
    """Return the cells of one method: what it recovers at each wavelength, its resolutions and the indicators."""
    return [
        *(_cell(value) for value in found.combination.values()),
        *(_interval(share) for share in found.recovered),
        found.outside or _interval(found.resolution_mm),
        found.recoverable_outside or _cell(found.recoverable_mm),
        _cell(1e3 * found.sigma),
        _cell(found.indicator_um),
        _cell(found.strain_indicator_um_mm),
    ]


def influence_heads(study: Study, found: list[Influence]) -> list[tuple[str, str]]:
    """Return part and quantity, with the unit in which they are shown, of each column of `influence_rows`."""
    return [
        (PART_NAMES[part], f"{TITLES[quantity]}{unit_of(study, part, quantity)}")
        for part, quantity in _asked_of(found)
    ]


def influence_rows(study: Study, found: list[Influence]) -> list[list[str]]:
    """Return a line for each factor, the one that matters most first: its influences as they are shown."""
    labels = {factor.column: factor.axis_label for factor in study.factor}
    told = {(each.factor, each.part, each.quantity): each for each in found}
    return [
        [labels[name], *(_influence(study, told[name, part, quantity]) for part, quantity in _asked_of(found))]
        for name in (ranked(found) if found else [])
    ]


def _asked_of(found: list[Influence]) -> list[tuple[str, str]]:
    return list(dict.fromkeys((each.part, each.quantity) for each in found))


def _influence(study: Study, found: Influence) -> str:
    scale = scale_of(study, found.part, found.quantity)
    half = f" ± {_cell(scale * found.whole.half_width)}" if np.isfinite(found.whole.low) else ""
    return f"{_cell(scale * found.whole.value)}{half}"


def _interval(estimate: Estimate) -> str:
    value = _cell(estimate.value)
    return f"{value} ({_cell(estimate.low)} to {_cell(estimate.high)})" if np.isfinite(estimate.low) else value


def _summary_row(row: pd.Series, factors: list[str]) -> dict[str, list[str]]:
    """Return the cells of one combination: its factors and counts, then for each quantity the three parts."""
    cells = []
    for quantity in QUANTITIES:
        cells += [_with_interval(row, f"{part}_{quantity}") for part in PARTS]
        if f"bound_{quantity}" in row:
            cells.append(_cell(row[f"bound_{quantity}"]))
    which = [row[name] for name in (*factors, "runs", "failed")]
    return {"which": [f"{each:g}" if isinstance(each, float) else str(each) for each in which], "cells": cells}


def _with_interval(row: pd.Series, name: str) -> str:
    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    return _interval(Estimate(value=value, low=low, high=high))


def _cell(value: object) -> str:
    if isinstance(value, (float, np.floating)):
        return f"{value:.3g}" if np.isfinite(value) else "—"
    return str(value)
