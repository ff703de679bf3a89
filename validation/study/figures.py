"""Figures of a study: error against each factor, with bootstrap intervals and, where it is known, the bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from validation.report.figures import GREY
from validation.study.axis import BOUND, MOST_CURVES, StudyPicture, categories, look, mark_values, positions, short
from validation.study.description import Factor, Study
from validation.study.summary import PARTS, QUANTITIES

Floats = NDArray[np.float64]

TITLES = ("across the beam", "vertical", "along the beam", "axial strain")
UNITS = ("voxel", "voxel", "voxel", "")
PART_NAMES = {"error": "error, rms", "bias": "bias", "random": "random part"}


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One curve: which rows of the summary, of which part of the error, and how it is called."""

    rows: pd.DataFrame
    part: str
    name: str


def study_pictures(study: Study, summary: pd.DataFrame) -> list[StudyPicture]:
    """Return a figure for each factor of a study, from its summary."""
    return [_picture(study, factor, summary) for factor in study.factor]


def _picture(study: Study, factor: Factor, summary: pd.DataFrame) -> StudyPicture:
    others = [each for each in study.factor if each is not factor]
    known = [part for part in PARTS if any(summary[f"{part}_{quantity}"].notna().any() for quantity in QUANTITIES)]
    scattered = study.design != "grid" and bool(others)
    alone = scattered or not others
    parts = known or ["error"]
    figure = Figure(figsize=(13, 3.4 if alone else 2.6 * len(parts) + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(1 if alone else len(parts), len(QUANTITIES), squeeze=False, sharex=True)
    for row, axes in enumerate(grid):
        if alone:
            curves = [Curve(rows=summary, part=part, name=PART_NAMES[part]) for part in parts]
        else:
            curves = _by_others(summary, others, parts[row])
        for k, ax in enumerate(axes):
            draw_against(factor, curves, QUANTITIES[k], ax, joined=not scattered)
            ax.set_ylabel(_axis_text("" if alone else PART_NAMES[parts[row]], UNITS[k]))
            if row == 0:
                ax.set_title(TITLES[k], fontsize=10)
            if row == len(grid) - 1:
                ax.set_xlabel(factor.axis_label)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    if any(f"bound_{quantity}" in summary for quantity in QUANTITIES):
        handles.append(Line2D([], [], color=GREY, **BOUND))
        labels.append("Cramér-Rao bound\nof the random part")
    figure.legend(handles, labels, loc="outside right upper", frameon=False)
    caption = _caption(factor, others, scattered)
    return StudyPicture(name=f"error_against_{factor.column}", caption=caption, figure=figure)


def draw_against(factor: Factor, curves: Sequence[Curve], quantity: str, ax: Axes, *, joined: bool = True) -> Axes:
    """Draw parts of the error in one quantity against a factor, with their intervals, and the bound if it is known."""
    named = categories(pd.concat([curve.rows[factor.column] for curve in curves]))
    one_part = len({curve.part for curve in curves}) == 1
    for k, curve in enumerate(curves):
        rows = curve.rows if named else curve.rows.sort_values(factor.column)
        x = positions(factor, rows[factor.column], named, (k - (len(curves) - 1) / 2) * 0.012)
        values = _positive(rows[f"{curve.part}_{quantity}"])
        low, high = (rows[f"{curve.part}_{quantity}_{end}"].to_numpy(dtype=float) for end in ("low", "high"))
        own = look(k, joined=joined and not named and not rows[factor.column].duplicated().any())
        colour = own["color"]
        ax.plot(x, values, label=curve.name, **own)
        known = np.isfinite(values) & np.isfinite(low) & np.isfinite(high)
        floor = np.where(low > 0, low, values / 10)  # an interval down to zero runs out of a logarithmic axis
        ax.vlines(x[known], floor[known], high[known], color=colour, linewidth=1.2, alpha=0.75)
        # the bound holds for the random part, and so for the error; drawn once where both are there
        if f"bound_{quantity}" in rows and curve.part in (("random", "error") if one_part else ("random",)):
            style = BOUND if joined and not named else {"linestyle": "none", "marker": "_", "markersize": 9}
            ax.plot(x, _positive(rows[f"bound_{quantity}"]), color=colour if one_part else GREY, **style)
    _logarithmic_values(ax)
    mark_values(factor, named, ax)
    return ax


def _by_others(summary: pd.DataFrame, others: Sequence[Factor], part: str) -> list[Curve]:
    """Return a curve for each combination of the other factors; one cloud of points where those are too many."""
    names = [other.column for other in others]
    groups = list(summary.groupby(names, sort=False, dropna=False))
    if len(groups) > MOST_CURVES:
        return [Curve(rows=summary, part=part, name="all combinations")]
    return [
        Curve(
            rows=rows,
            part=part,
            name=", ".join(f"{o.axis_label}: {short(v)}" for o, v in zip(others, values, strict=True)),
        )
        for values, rows in groups
    ]


def _logarithmic_values(ax: Axes) -> None:
    drawn = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in ax.get_lines()] or [np.zeros(0)])
    drawn = drawn[np.isfinite(drawn)]
    if drawn.size:
        ax.set_yscale("log")
        ax.set_ylim(drawn.min() / 1.6, drawn.max() * 1.6)
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())


def _positive(values: pd.Series) -> Floats:
    found = values.to_numpy(dtype=float)
    return np.where(found > 0, found, np.nan)


def _axis_text(part: str, unit: str) -> str:
    return f"{part} ({unit})" if part and unit else part or unit


def _caption(factor: Factor, others: Sequence[Factor], scattered: bool) -> str:
    text = f"Error against {factor.axis_label}, in three directions and of the axial strain"
    if scattered:
        text += "; each point is one combination, and the other factors vary from point to point"
    elif others:
        text += f", for each {' and '.join(other.axis_label for other in others)}"
    return text + ". Bars: 95 % bootstrap intervals over the repetitions. No mark: zero, or not known."
