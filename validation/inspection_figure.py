"""One picture of what an inspection found: radiographs and window, air, opposite views, likeness, onset of loading."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pdvc.experiment import REFERENCE, TEST, Experiment
from pdvc.radiographs import grey_levels
from validation.figures import BLUE, VERMILION, draw_radiographs, new_figure
from validation.inspection import Inspection


def inspection_figure(inspection: Inspection, experiment: Experiment) -> Figure:
    """Draw six panels: a reference view, the last step, air, opposite views, likeness, and the force."""
    figure, axes = new_figure(17.0, 4.6, 6)
    calibration = inspection.found.calibration
    shown = experiment.reference.counts[0], experiment.test.counts[-1]
    images = [grey_levels(counts, calibration) for counts in shown]
    largest = max(float(np.quantile(image, 0.999)) for image in images)
    titles = ["first reference view", "last step"]
    draw_radiographs([image / largest for image in images], titles, axes[:2], window=inspection.window)
    _air(axes[2], inspection)
    _opposite(axes[3], inspection)
    _alike(axes[4], inspection)
    _force(axes[5], inspection, experiment)
    return figure


def _air(ax: Axes, inspection: Inspection) -> None:
    for name, colour in ((REFERENCE, BLUE), (TEST, VERMILION)):
        air = inspection.found.stacks[name].air
        ax.plot(np.linspace(0, 1, len(air)), air, color=colour, linewidth=1, label=name.partition("/")[0])
    ax.axhline(1, color="0.7", linewidth=0.8)
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, 0.98), max(high, 1.02))
    ax.set(title="air beside the sample", xlabel="image, share of the stack", ylabel="transmission")
    ax.legend(frameon=False, fontsize=8)


def _opposite(ax: Axes, inspection: Inspection) -> None:
    twice = inspection.found.seen_twice
    if twice is not None:
        factors, mismatch = twice.curve
        ax.plot(factors, mismatch, color=BLUE)
        ax.axvline(1, color="0.7", linewidth=0.8)
        ax.plot([twice.factor], [twice.mismatch], "o", color=VERMILION)
    ax.set(title="opposite views", xlabel="fan angle / stated", ylabel="mismatch, attenuation")


def _alike(ax: Axes, inspection: Inspection) -> None:
    like = inspection.found.likeness
    if like is not None:
        ax.plot(like.recorded, color=BLUE, linewidth=1, label="at the recorded angle")
        ax.plot(like.steps, like.best, "o", color=VERMILION, markersize=4, label="with any view")
        ax.set_ylim(0, 1.02)
        ax.legend(frameon=False, fontsize=8, loc="lower left")
    ax.set(title="test like reference", xlabel="step", ylabel="correlation")


def _force(ax: Axes, inspection: Inspection, experiment: Experiment) -> None:
    ax.plot(experiment.test.force_N, color=BLUE, linewidth=1)
    onset = inspection.found.onset
    if onset is not None:
        ax.axvline(onset, color=VERMILION, linewidth=1)
        ax.set_title(f"onset: step {onset}")
    else:
        ax.set_title("no onset found")
    ax.set(xlabel="step", ylabel="force, N")
