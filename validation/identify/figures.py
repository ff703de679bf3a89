"""Figures of an identification: the law with its band, where it fails, and what the parameters have in common."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from pdvc.identify.laws import Law
from pdvc.identify.result import Identification
from validation.report.figures import BLUE, TRUTH, UNOBSERVED

Floats = NDArray[np.float64]


def draw_law(found: Identification, *, ax: Axes, truth: Law | None = None) -> Axes:
    """Draw the flow stress against the plastic strain with its 95 % band, beside the true one where it is known."""
    plastic, flow, low, high = found.curve
    ax.fill_between(100 * plastic, low, high, color=BLUE, alpha=0.25, linewidth=0, label="95 %")
    ax.plot(100 * plastic, flow, color=BLUE, label=found.law)
    if truth is not None:
        (line,) = ax.plot(100 * plastic, truth.flow_MPa(plastic), label="true")
        line.set(**TRUTH)
    ax.set_xlabel("plastic strain (%)")
    ax.set_ylabel("nominal stress (MPa)")
    ax.legend(frameon=False)
    return ax


def draw_missed(found: Identification, *, ax: Axes) -> Axes:
    """Draw what the law misses of the free measurement's strain, at each height and step, in its deviations."""
    missed = (found.strain_measured - found.strain_law) / found.strain_deviation
    ax.set_facecolor(UNOBSERVED)
    image = ax.pcolormesh(
        np.arange(len(missed)), found.section_mm, missed.T, cmap="RdBu_r", vmin=-4, vmax=4, rasterized=True
    )
    ax.figure.colorbar(image, ax=ax, label="measured less law (standard deviations)")
    ax.set_xlabel("step")
    ax.set_ylabel("height (mm)")
    return ax


def draw_correlation(found: Identification, *, ax: Axes) -> Axes:
    """Draw the correlations of all unknowns of the integrated identification."""
    deviation = np.maximum(found.best.deviation, 1e-300)
    image = ax.imshow(found.best.covariance / np.outer(deviation, deviation), cmap="RdBu_r", vmin=-1, vmax=1)
    ax.figure.colorbar(image, ax=ax, label="correlation")
    ax.set_xticks(range(len(found.names)), found.names, rotation=60, ha="right", fontsize=8)
    ax.set_yticks(range(len(found.names)), found.names, fontsize=8)
    return ax
