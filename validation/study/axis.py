"""The axis of a factor in the figures of a study: where its values are, and what is written there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from validation.report.figures import BLUE, GREEN, GREY, ORANGE, VERMILION
from validation.study.description import Factor

Floats = NDArray[np.float64]

COLOURS = ("black", BLUE, VERMILION, GREEN, ORANGE, "#CC79A7", "#56B4E9", GREY)
"""Okabe and Ito's, in the order in which curves take them."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
MOST_CURVES = len(COLOURS)
BOUND: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.2}
"""How what is possible at best is drawn."""


@dataclass(frozen=True, kw_only=True)
class StudyPicture:
    """A figure with what a reader has to know."""

    name: str
    caption: str
    figure: Figure


def categories(values: pd.Series) -> list[object]:
    """Return the values of a factor that is no number, in the order of the study; none of one that is."""
    if all(isinstance(value, (int, float, np.number)) and not isinstance(value, bool) for value in values):
        return []
    return list(dict.fromkeys(values))


def positions(factor: Factor, values: pd.Series, named: list[object], aside: float) -> Floats:
    """Return where to draw on the axis, a share of its length aside, so that intervals do not cover each other."""
    if named:
        return np.array([named.index(value) for value in values], dtype=float) + 10 * aside
    x = values.to_numpy(dtype=float)
    if factor.log:
        return np.asarray(x * (x.max() / x.min()) ** aside)
    return np.asarray(x + aside * np.ptp(x))


def mark_values(factor: Factor, named: list[object], ax: Axes) -> None:
    """Mark the values of the factor, and leave no more lines than are read."""
    if named:
        ax.set_xticks(range(len(named)), [short(value) for value in named], rotation=30, ha="right")
        ax.set_xlim(-0.5, len(named) - 0.5)
    elif factor.log:
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
    if not named and 0 < len(factor.values) <= 7:
        ax.set_xticks([float(row[0]) for row in factor.rows()] if not factor.names else list(factor.names))
    bare(ax)


def bare(ax: Axes) -> None:
    """Leave no more lines than are read."""
    ax.grid(axis="y", color="#e5e5e5", linewidth=0.8)
    ax.spines[["top", "right"]].set_visible(False)


def look(k: int, *, joined: bool = True) -> dict[str, Any]:
    """Return how the k-th curve of a figure is drawn: its points, joined or not."""
    colour, marker = COLOURS[k % MOST_CURVES], MARKERS[k % MOST_CURVES]
    return {"color": colour, "marker": marker, "markersize": 4.5, "linewidth": 1.4 if joined else 0}


def short(value: object) -> str:
    """Return a value as figures say it."""
    return f"{value:g}" if isinstance(value, (float, np.floating)) else str(value)
