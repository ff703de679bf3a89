"""Figures of a study: error against each factor, with bootstrap intervals and, where it is known, the bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from validation.report.figures import GREY
from validation.study.axis import (
    COLOURS,
    MARKERS,
    MOST_CURVES,
    StudyPicture,
    categories,
    mark_values,
    positions,
    short,
)
from validation.study.description import Factor, Study
from validation.study.resolution import BIAS, Resolution
from validation.study.summary import PARTS, QUANTITIES

Floats = NDArray[np.float64]

TITLES = ("across the beam", "vertical", "along the beam", "axial strain")
UNITS = ("voxel", "voxel", "voxel", "")
PART_NAMES = {"error": "error, rms", "bias": "bias", "random": "random part"}
BOUND: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.2}


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
        colour, marker = COLOURS[k % MOST_CURVES], MARKERS[k % MOST_CURVES]
        values = _positive(rows[f"{curve.part}_{quantity}"])
        low, high = (rows[f"{curve.part}_{quantity}_{end}"].to_numpy(dtype=float) for end in ("low", "high"))
        width = 1.4 if joined and not named and not rows[factor.column].duplicated().any() else 0
        ax.plot(x, values, color=colour, marker=marker, markersize=4.5, label=curve.name, linewidth=width)
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


def resolution_picture(found: Sequence[Resolution]) -> StudyPicture:
    """Return the figure of what each method recovers of a strain wave, and its noise beside it."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    draw_recovered(found, left)
    draw_strain_noise(found, right)
    handles, labels = left.get_legend_handles_labels()
    handles.append(Line2D([], [], color=GREY, **BOUND))
    figure.legend(handles, [*labels, "at best"], loc="outside right upper", frameon=False)
    caption = (
        "Share of the amplitude of a strain sinusoidal in height that each method recovers, with 95 % bootstrap "
        "intervals over the repetitions; dashed, what its sections and time functions could hold at best. Beyond the "
        f"spatial resolution a curve stays between {1 - BIAS:g} and {1 + BIAS:g}, grey. Right: the noise of the "
        "strain at a step, 1 sigma."
    )
    return StudyPicture(name="spatial_resolution", caption=caption, figure=figure)


def draw_recovered(found: Sequence[Resolution], ax: Axes) -> Axes:
    """Draw the shares that are recovered, and that could be, against the wavelength; a line for each method."""
    ax.axhspan(1 - BIAS, 1 + BIAS, color="#eeeeee", zorder=0)
    for k, each in enumerate(found):
        look = _look(k)
        value, low, high = (
            np.array([getattr(share, end) for share in each.recovered]) for end in ("value", "low", "high")
        )
        ax.plot(each.wavelength_mm, value, label=_called(each), **look)
        ax.plot(each.wavelength_mm, each.recoverable, color=look["color"], **BOUND)
        ax.vlines(each.wavelength_mm, low, high, color=look["color"], linewidth=1.2, alpha=0.75)
    ax.set(ylabel="amplitude recovered / true")
    return _against_wavelength(found, ax)


def draw_strain_noise(found: Sequence[Resolution], ax: Axes) -> Axes:
    """Draw the noise of the strain, in thousandths, against the wavelength; a line for each method."""
    for k, each in enumerate(found):
        ax.plot(each.wavelength_mm, 1e3 * each.noise, label=_called(each), **_look(k))
    ax.set(ylabel="noise of the strain, 1 sigma (10⁻³)")
    ax.set_ylim(bottom=0)
    return _against_wavelength(found, ax)


def _look(k: int) -> dict[str, Any]:
    return {"color": COLOURS[k % MOST_CURVES], "marker": MARKERS[k % MOST_CURVES], "markersize": 4.5, "linewidth": 1.4}


def _called(each: Resolution) -> str:
    return ", ".join(short(value) for value in each.combination.values()) or "all runs"


def _against_wavelength(found: Sequence[Resolution], ax: Axes) -> Axes:
    lengths = found[0].wavelength_mm.tolist()
    # limits of their own, as a logarithmic axis finds none where nothing was measured
    ax.set(xlabel="wavelength (mm)", xscale="log", xlim=(lengths[0] / 1.1, lengths[-1] * 1.1), xticks=lengths)
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.minorticks_off()
    ax.grid(axis="y", color="#e5e5e5", linewidth=0.8)
    ax.spines[["top", "right"]].set_visible(False)
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
