"""Figure of a study of sensitivity: what each factor does to bias, random part and coverage, the strongest on top."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from validation.report.figures import BLUE, VERMILION
from validation.study.axis import StudyPicture
from validation.study.description import Study
from validation.study.sensitivity import COVERED, Influence, ranked
from validation.study.summary import QUANTITIES

TITLES = dict(zip(QUANTITIES, ("across the beam", "vertical", "along the beam", "axial strain"), strict=True))
UNITS = dict(zip(QUANTITIES, ("voxel", "voxel", "voxel", "10⁻³"), strict=True))
SHARES = (-0.25, 1.5)
"""What the axes of shares hold: intervals of few samples go far beyond, where no share can be."""
PART_NAMES = {"bias": "bias", "random": "random part", "error": "error, rms", COVERED: "covered by 95 %"}


def influence_picture(study: Study, found: Sequence[Influence]) -> StudyPicture:
    """Return the figure of a study's influences: a row of panels for each part, a column for each quantity."""
    parts = list(dict.fromkeys(each.part for each in found))
    order = ranked(found)
    labels = {factor.column: factor.axis_label for factor in study.factor}
    figure = Figure(figsize=(13, len(parts) * (0.19 * len(order) + 0.75)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(parts), len(QUANTITIES), squeeze=False, sharey=True)
    for row, part in zip(axes, parts, strict=True):
        for quantity, ax in zip(QUANTITIES, row, strict=True):
            if not any((each.part, each.quantity) == (part, quantity) for each in found):
                ax.set_frame_on(False)
                ax.set_xticks([])
                ax.tick_params(axis="y", length=0)
                continue
            some = {each.factor: each for each in found if (each.part, each.quantity) == (part, quantity)}
            draw_influences([some[name] for name in order], ax, scale=scale_of(study, part, quantity))
            if study.design == "sobol":
                ax.set_xlim(SHARES)
            said = "share of the variance: " if study.design == "sobol" else ""
            ax.set_xlabel(f"{said}{PART_NAMES[part]}{unit_of(study, part, quantity)}", fontsize=9)
    for quantity, ax in zip(QUANTITIES, axes[0], strict=True):
        ax.set_title(TITLES[quantity], fontsize=10)
    axes[0, 0].set_yticks(range(len(order)), [labels[name] for name in order], fontsize=8)
    axes[0, 0].set_ylim(len(order) - 0.4, -0.6)
    return StudyPicture(name="sensitivity", caption=_caption(study), figure=figure)


def draw_influences(found: Sequence[Influence], ax: Axes, *, scale: float = 1.0) -> Axes:
    """Draw a bar for each factor, from the top, with its interval, and a mark for what it does alone."""
    whole = np.array([each.whole.value for each in found]) * scale
    ends = np.array([(each.whole.low, each.whole.high) for each in found]).reshape(-1, 2).T * scale
    places = np.arange(len(found))
    ax.barh(places, whole, height=0.7, color="#a9c8de")
    ax.hlines(places, *ends, color=BLUE, linewidth=1.4)
    ax.plot([each.alone.value * scale for each in found], places, "|", color=VERMILION, ms=8)
    ax.axvline(0, color="black", linewidth=0.8)
    ax.grid(axis="x", color="#e5e5e5", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(axis="y", length=0, labelsize=8)
    ax.tick_params(axis="x", labelsize=8)
    ax.locator_params(axis="x", nbins=5)
    return ax


def scale_of(study: Study, part: str, quantity: str) -> float:
    """Return by what an influence is multiplied where it is shown: per cent of what is covered, 10⁻³ of strain.

    Sobol's are shares of a variance, and stay as they are.
    """
    if study.design == "sobol":
        return 1.0
    return 100.0 if part == COVERED else 1e3 if quantity == "strain" else 1.0


def unit_of(study: Study, part: str, quantity: str) -> str:
    """Return the unit of what is shown after a comma; nothing for a share."""
    if study.design == "sobol":
        return ""
    return ", points" if part == COVERED else f", {UNITS[quantity]}"


def _caption(study: Study) -> str:
    if study.design == "morris":
        return (
            "What each factor does, from one end of its range to the other, wherever the others are: bars are the "
            "mean size μ* of the change, lines its 95 % interval by SALib's bootstrap over "
            f"{study.samples} trajectories, red marks the mean change μ with its sign. Coverage is in points of "
            "per cent."
        )
    return (
        "Share of the variance in which each factor takes part, by itself and with others (bars: total index), and "
        "that which it has by itself (red marks: first-order index). Lines: 95 % interval of the total index, by "
        f"SALib's bootstrap over {study.samples} samples. Shares below 0 or above 1, and lines that leave the axes, "
        "tell that the samples are few."
    )
