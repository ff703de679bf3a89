"""Figure of a study of strain waves: what each method recovers, and its noise beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import StrMethodFormatter

from validation.report.figures import GREY
from validation.study.axis import BOUND, StudyPicture, bare, look, short
from validation.study.resolution import BIAS, Resolution


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
        style = look(k)
        value, low, high = (
            np.array([getattr(share, end) for share in each.recovered]) for end in ("value", "low", "high")
        )
        ax.plot(each.wavelength_mm, value, label=_called(each), **style)
        ax.plot(each.wavelength_mm, each.recoverable, color=style["color"], **BOUND)
        ax.vlines(each.wavelength_mm, low, high, color=style["color"], linewidth=1.2, alpha=0.75)
    ax.set(ylabel="amplitude recovered / true")
    return _against_wavelength(found, ax)


def draw_strain_noise(found: Sequence[Resolution], ax: Axes) -> Axes:
    """Draw the noise of the strain, in thousandths, against the wavelength; a line for each method."""
    for k, each in enumerate(found):
        ax.plot(each.wavelength_mm, 1e3 * each.noise, label=_called(each), **look(k))
    ax.set(ylabel="noise of the strain, 1 sigma (10⁻³)")
    ax.set_ylim(bottom=0)
    return _against_wavelength(found, ax)


def _called(each: Resolution) -> str:
    return ", ".join(short(value) for value in each.combination.values()) or "all runs"


def _against_wavelength(found: Sequence[Resolution], ax: Axes) -> Axes:
    lengths = found[0].wavelength_mm.tolist()
    # limits of their own, as a logarithmic axis finds none where nothing was measured
    ax.set(xlabel="wavelength (mm)", xscale="log", xlim=(lengths[0] / 1.1, lengths[-1] * 1.1), xticks=lengths)
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.minorticks_off()
    bare(ax)
    return ax
