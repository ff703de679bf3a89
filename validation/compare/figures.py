"""Figures of a comparison: errors of methods against what they cost, and step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from validation.compare.paired import QUANTITIES
from validation.report.figures import BLUE, GREEN, GREY, ORANGE, VERMILION, new_figure
from validation.scoring.bootstrap import Estimate

Floats = NDArray[np.float64]

TITLES = {
    "across_beam": "across the beam (voxel)",
    "vertical": "vertical (voxel)",
    "along_beam": "along the beam (voxel)",
    "strain": r"strain $\varepsilon_{zz}$",
}
_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, "#CC79A7", "#56B4E9", "#F0E442", GREY)
_MARKERS = "osD^vPX*"


@dataclass(frozen=True, kw_only=True)
class Point:
    """A method's place in a figure of error against cost."""

    method: str
    cost: float
    error: Estimate


def style_of(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour and marker of each method, by name; they repeat after eight."""
    return {
        name: {"color": _COLOURS[k % len(_COLOURS)], "marker": _MARKERS[k % len(_MARKERS)]}
        for k, name in enumerate(methods)
    }


def draw_cost(points: Sequence[Point], ax: Axes, *, style: dict[str, dict[str, Any]], cost: str, error: str) -> Axes:
    """Draw errors with their intervals against a cost, both on logarithmic axes."""
    for point in points:
        known = np.isfinite(point.error.low)
        below, above = (point.error.value - point.error.low, point.error.high - point.error.value) if known else (0, 0)
        ax.errorbar(
            point.cost,
            point.error.value,
            yerr=[[max(below, 0)], [max(above, 0)]],
            linestyle="none",
            markersize=7,
            markeredgecolor="white",
            capsize=3,
            label=point.method,
            **style[point.method],
        )
    ax.set(xlabel=cost, xscale="log", yscale="log", title=error)
    _room(ax, [point.cost for point in points], "x")
    _room(ax, [bound for p in points for bound in (p.error.value, p.error.low, p.error.high)], "y")
    return _tidy(ax)


def draw_steps(errors: dict[str, Floats], ax: Axes, *, style: dict[str, dict[str, Any]], error: str) -> Axes:
    """Draw each method's errors (step,) on a logarithmic axis; steps that it did not measure are left out."""
    for name, values in errors.items():
        steps = np.flatnonzero(np.isfinite(values) & (values > 0))
        # a line joins what was measured one step after the other; scans apart stand alone
        alone = len(steps) < 0.5 * len(values)
        look = {"linestyle": "none", "markersize": 7} if alone else {"linewidth": 1.2, "marker": ""}
        ax.plot(steps, values[steps], label=name, zorder=3 if alone else 2, **{**style[name], **look})
    ax.set(xlabel="step", yscale="log", title=error)
    _room(ax, [float(value) for values in errors.values() for value in values], "y")
    return _tidy(ax)


def cost_figure(points: dict[str, list[Point]], methods: Sequence[str], cost: str) -> Figure:
    """Draw errors against a cost, a panel for each quantity (`paired.QUANTITIES`)."""
    figure, axes = new_figure(13.0, 3.6, len(QUANTITIES))
    style = style_of(methods)
    for ax, name in zip(axes, QUANTITIES, strict=True):
        draw_cost(points[name], ax, style=style, cost=cost, error=TITLES[name])
    axes[0].set_ylabel("rms error")
    _legend(figure, axes)
    return figure


def steps_figure(errors: dict[str, Floats], methods: Sequence[str]) -> Figure:
    """Draw errors (step, quantity) of each method against the step, a panel for each quantity."""
    figure, axes = new_figure(13.0, 3.6, len(QUANTITIES))
    style = style_of(methods)
    for k, (ax, name) in enumerate(zip(axes, QUANTITIES, strict=True)):
        draw_steps({each: values[:, k] for each, values in errors.items()}, ax, style=style, error=TITLES[name])
    axes[0].set_ylabel("rms error")
    _legend(figure, axes)
    return figure


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 8), frameon=False)


def _room(ax: Axes, values: Sequence[float], which: str) -> None:
    """Show at least a decade, and label ticks with plain numbers where the decades are few."""
    # a logarithmic axis needs something to show, even where nothing was measured
    known = np.array([value for value in values if np.isfinite(value) and value > 0] or [1.0])
    low, high = float(known.min()) / 1.5, float(known.max()) * 1.5
    if high < 10 * low:
        middle = np.sqrt(low * high)
        low, high = middle / np.sqrt(10), middle * np.sqrt(10)
    axis = ax.xaxis if which == "x" else ax.yaxis
    (ax.set_xlim if which == "x" else ax.set_ylim)(low, high)
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _tidy(ax: Axes) -> Axes:
    ax.spines[["top", "right"]].set_visible(False)
    ax.title.set_fontsize(10)
    return ax
