"""A movie of a measured test: radiograph, residual, and profiles with their 95 % band, step by step."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pdvc.progress import Progress, silent
from validation.report.figures import BLUE, TRUTH, draw_radiographs, draw_residuals
from validation.report.steps import Profile, Steps

SHOWN = ("vertical", "axial strain")
"""Profiles beside the images."""
DPI = 80
KINDS = (".gif", ".mp4")


def movie_writer(path: Path, steps_per_s: float) -> AbstractMovieWriter:
    """Return the writer of a kind of file: GIF by Pillow, MP4 by ffmpeg; raises ValueError where there is none."""
    if path.suffix.lower() == ".gif":
        return PillowWriter(fps=steps_per_s)  # type: ignore[arg-type]
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path}: expected a name that ends with {' or '.join(KINDS)}, found {path.suffix!r}")
    if not FFMpegWriter.isAvailable():
        raise ValueError(f"{path}: expected the program ffmpeg for MP4, found none: install it, or ask for a .gif")
    # every player knows yuv420p, which asks for even sizes
    filters = ["-pix_fmt", "yuv420p", "-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2"]
    return FFMpegWriter(fps=steps_per_s, codec="h264", extra_args=filters)  # type: ignore[arg-type]


def write_movie(
    path: Path, steps: Steps, *, every: int = 1, steps_per_s: float = 10.0, progress: Progress = silent
) -> None:
    """Write one of `every` steps as a frame; what is at the path is replaced once all are written.

    Raises ValueError where ffmpeg cannot write what is asked of it.
    """
    writer = movie_writer(path, steps_per_s)
    chosen = range(0, steps.measurement.recording.steps, every)
    frame = Frame.of(steps)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        with writer.saving(frame.figure, str(partial), DPI):
            for done, step in enumerate(chosen, 1):
                frame.show(step)
                writer.grab_frame()
                progress("frames", done, len(chosen))
        partial.replace(path)
    except subprocess.CalledProcessError as error:
        raise ValueError(
            f"{path}: expected ffmpeg to write H.264, it ended with code {error.returncode}: ask for a .gif"
        ) from None
    finally:
        partial.unlink(missing_ok=True)


@dataclass(frozen=True, kw_only=True)
class Frame:
    """The figure of which each step is a frame."""

    figure: Figure
    steps: Steps
    images: Sequence[Axes]
    """Those of the radiograph and of the residual."""
    profiles: Sequence[Axes]

    @classmethod
    def of(cls, steps: Steps) -> Frame:
        """Draw what stays from step to step: axes, scales, and the used window."""
        figure = Figure(figsize=(12, 5), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(1, 2 + len(SHOWN))
        draw_radiographs([steps.radiograph(0)], ["radiograph"], axes[:1], window=steps.measurement.recording.window)
        draw_residuals([_residual(steps, 0)], ["residual"], axes[1:2], limit=steps.limit)
        frame = cls(figure=figure, steps=steps, images=axes[:2], profiles=axes[2:])
        frame.show(0)
        # the layout is found once: axes that move from frame to frame would be seen
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        return frame

    def show(self, step: int) -> None:
        """Show a step instead of the one before."""
        self.figure.suptitle(self.steps.words(step), fontsize=11)
        for ax, image in zip(self.images, (self.steps.radiograph(step), _residual(self.steps, step)), strict=True):
            ax.images[0].set_data(image)
        shown = {profile.name: profile for profile in self.steps.profiles}
        for ax, name in zip(self.profiles, SHOWN, strict=True):
            for old in (*ax.lines, *ax.collections):
                old.remove()
            draw_profile(shown[name], step, ax)


def draw_profile(profile: Profile, step: int, ax: Axes) -> Axes:
    """Draw a profile of a step over the height, with its 95 % band, and the truth where it is known."""
    value, half = profile.value[step], profile.half[step]
    ax.fill_betweenx(profile.height_mm, value - half, value + half, color=BLUE, alpha=0.25, linewidth=0)
    ax.plot(value, profile.height_mm, color=BLUE, linewidth=1.6, marker=".", markersize=4)
    if profile.true is not None:
        ax.plot(profile.true[step], profile.height_mm, **TRUTH)  # type: ignore[arg-type]
    ax.set_title(profile.name, fontsize=10)
    ax.set(xlim=profile.limits, ylim=(profile.height_mm[0], profile.height_mm[-1]))
    ax.set(xlabel=profile.unit, ylabel="height on the axis (mm)")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def _residual(steps: Steps, step: int) -> np.ndarray:
    """Return the residual of a step, or nothing to be seen where it was not measured."""
    found = steps.residual(step)
    return np.full(steps.measurement.fit.residual_final.shape[1:], np.nan) if found is None else found
