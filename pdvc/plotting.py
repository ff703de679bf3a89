"""One picture of a measurement: how the middle of the sample moved, and how it stretched, with two deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pdvc.deviations import BEAM
from pdvc.measurement import Measurement
from pdvc.points import displacement, strain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {"across": "#0072b2", "vertical": "#e69f00", "along": "#009e73"}
"""Told apart by colour-blind readers, too."""


def plot(measurement: Measurement) -> Figure:
    """Draw the motion of mid-height against the step, a map of the strain, and its profile at the last step.

    Bands are two standard deviations wide on either side; the title tells the verdict, and its doubts.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 3.8), layout="constrained")
    motion, picture, profile = figure.subplots(1, 3)
    heights = measurement.motion.basis.height_mm
    height = float((heights[0] + heights[-1]) / 2)
    middle = displacement(measurement, [[0.0, 0.0, height]]).isel(point=0)
    for name in BEAM:
        one = middle.sel(direction=name)
        line, spread = one["turned"].values * 1e3, 2e3 * one["deviation"].values
        motion.plot(middle["step"], line, color=COLOURS[name], label=name)
        motion.fill_between(middle["step"], line - spread, line + spread, color=COLOURS[name], alpha=0.25, linewidth=0)
    motion.set(xlabel="step", ylabel="displacement (µm)", title=f"z = {height:.2f} mm")
    motion.legend(frameon=False)
    if len(heights) > 1:
        found = strain(measurement)
        percent, spread = 100 * found["strain"].values, 200 * found["deviation"].values
        edges = np.arange(len(percent) + 1) - 0.5
        mesh = picture.pcolormesh(edges, heights, percent.T, cmap="viridis", shading="flat")
        figure.colorbar(mesh, ax=picture, label="axial strain (%)")
        z, last = found["z"].values, percent[-1]
        profile.plot(last, z, color="black")
        profile.fill_betweenx(z, last - spread[-1], last + spread[-1], color="black", alpha=0.25, linewidth=0)
    picture.set(xlabel="step", ylabel="z (mm)")
    profile.set(xlabel="axial strain (%)", ylabel="z (mm)", title=f"step {measurement.recording.steps - 1}")
    doubts = ", ".join(measurement.verdict.names)
    figure.suptitle(f"{measurement.recording.title}   verdict: {measurement.verdict.word} {doubts}".strip())
    return figure
