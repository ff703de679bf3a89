"""What an inspection found, as lines to print and as one picture."""

from __future__ import annotations

import numpy as np
import psutil
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pdvc.experiment import REFERENCE, TEST, Experiment
from pdvc.inspection import Inspection
from pdvc.radiographs import grey_levels
from validation.report.figures import BLUE, VERMILION, draw_radiographs, new_figure

Line = tuple[str, str, str]
"""What was looked at, what was found, and what is due or where it comes from."""


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


def lines_of(inspection: Inspection, experiment: Experiment) -> list[Line]:
    """Return what to print: a line for each thing that was looked at."""
    found, geometry = inspection.found, experiment.geometry
    reference, test = found.stacks[REFERENCE], found.stacks[TEST]
    lines: list[Line] = [
        ("radiographs", f"{len(experiment.reference)} reference views, {len(experiment.test)} steps", ""),
        ("detector", f"{geometry.rows} x {geometry.columns} px; a voxel is {geometry.voxel_mm * 1e3:.4g} um", ""),
        (
            "counts, reference",
            f"{reference.lowest} to {reference.highest}, median {reference.median:.0f}",
            f"{len(experiment.flats)} flats, {len(experiment.darks)} darks",
        ),
        ("counts, test", f"{test.lowest} to {test.highest}, median {test.median:.0f}", ""),
        ("transmission of air", f"{_range(reference.air)} reference, {_range(test.air)} test", "1"),
        ("pixels at the largest count", f"{max(reference.at_top.max(), test.at_top.max()):.2%}", "next to none"),
        ("bad pixels", f"{found.bad_share:.2%}", "few"),
        ("variance between flats / stated", _number(found.noise_ratio), "1; —: not stated, or one flat"),
        ("largest gap of reference angles", f"{np.rad2deg(found.largest_gap_rad):.2f} degrees", "a few"),
    ]
    twice = found.seen_twice
    if twice is not None:
        lines += [
            (
                "fan angle seen / stated",
                f"{twice.factor:.2f} +- {twice.factor_std:.2f} (mismatch {twice.mismatch:.2g}; "
                f"{twice.mismatch_reversed:.2g} turning the other way)",
                "1; -1: the stage turned the other way",
            ),
            ("axis off the stated column", f"{twice.axis_px:+.2f} px", "0"),
            ("source off the stated row", f"{_signed(twice.plane_px)} px", "0, within a few"),
        ]
    like = found.likeness
    if like is not None:
        off = np.rad2deg(np.median(np.abs(like.off_rad)))
        lines += [
            (
                "test like reference",
                f"correlation {np.median(like.recorded):.2f} at the recorded angles, lowest {like.recorded.min():.2f}",
                "near 1",
            ),
            (
                "most like view, off by",
                f"{off:.1f} degrees, median",
                f"under {np.rad2deg(like.spacing_rad):.0f}",
            ),
        ]
    top, bottom, left, right = inspection.window
    cost, free = inspection.cost, psutil.virtual_memory().available / 2**30
    return [
        *lines,
        ("loading begins after step", "not found" if found.onset is None else str(found.onset), "from the force"),
        ("window proposed", f"discard_rows = {top}, discard_columns = {left}", f"rows {top} to {bottom - 1}, "
         f"columns {left} to {right - 1}"),
        ("unknowns", str(cost.unknowns), ""),
        ("time to expect", _duration(cost.seconds), "on this machine as busy as now, to a factor of two"),
        ("memory to expect", f"{cost.memory_gib:.1f} GiB", f"{free:.1f} GiB free"),
    ]  # fmt: skip


def _range(values: np.ndarray) -> str:
    return f"{values.min():.3f} to {values.max():.3f}"


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "—"


def _signed(value: float | None) -> str:
    return "—" if value is None else f"{value:+.1f}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
