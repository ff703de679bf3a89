"""Figures of a study: scores of a single run against each factor, for studies that ask for them (``draw``)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from validation.study.axis import MOST_CURVES, StudyPicture, categories, look, mark_values, positions, short
from validation.study.description import Factor, Study


def score_pictures(study: Study, scores: pd.DataFrame) -> list[StudyPicture]:
    """Return for each score that a study draws a figure against each factor, from its mean scores.

    In a grid of three factors or more there is a panel for each value of the last of the others.
    """
    return [_picture(study, name, factor, scores) for name in study.draw for factor in study.factor]


def draw_score(factor: Factor, name: str, curves: Sequence[tuple[str, pd.DataFrame]], ax: Axes) -> Axes:
    """Draw a score against a factor: a line for each curve, or points where a factor is no number or rows scatter."""
    named = categories(pd.concat([rows[factor.column] for _, rows in curves]))
    for k, (said, rows) in enumerate(curves):
        ordered = rows if named else rows.sort_values(factor.column)
        x = positions(factor, ordered[factor.column], named, (k - (len(curves) - 1) / 2) * 0.012)
        joined = not named and not ordered[factor.column].duplicated().any()
        ax.plot(x, ordered[name], label=said, **look(k, joined=joined))
    mark_values(factor, named, ax)
    return ax


def _picture(study: Study, name: str, factor: Factor, scores: pd.DataFrame) -> StudyPicture:
    others = [each for each in study.factor if each is not factor] if study.design == "grid" else []
    panels = list(_panels(others[-1] if len(others) > 1 else None, scores))
    figure = Figure(figsize=(3.4 * len(panels) + 2.2, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    told = others[:-1] if len(others) > 1 else others
    for ax, (title, rows) in zip(axes, panels, strict=True):
        draw_score(factor, name, list(_curves(told, rows)), ax)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel(factor.axis_label)
    axes[0].set_ylabel(name.replace("_", " "))
    legend = ", ".join(other.axis_label for other in told)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper", frameon=False, title=legend)
    caption = f"{name} ({'mean over the repetitions' if study.repetitions > 1 else 'one run each'})"
    caption += f" against {factor.axis_label}"
    if others:
        caption += f", for each {' and '.join(other.axis_label for other in others)}"
    return StudyPicture(name=f"{name}_against_{factor.column}", caption=f"{caption}.", figure=figure)


def _panels(factor: Factor | None, scores: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    if factor is None:
        yield "", scores
        return
    for value, rows in scores.groupby(factor.column, sort=False, dropna=False):
        yield f"{factor.axis_label}: {short(value)}", rows


def _curves(others: Sequence[Factor], scores: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Return a curve for each combination of the other factors; one cloud of points where those are too many."""
    groups = list(scores.groupby([other.column for other in others], sort=False, dropna=False)) if others else []
    if not 0 < len(groups) <= MOST_CURVES:
        yield "all combinations" if groups else "", scores
        return
    for values, rows in groups:
        yield ", ".join(short(value) for value in values), rows
