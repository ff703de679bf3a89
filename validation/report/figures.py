"""Figures after the paper's 3 to 10: each `draw_x` draws data on axes that the caller gives.

Nothing here keeps state: figures are made by `new_figure` and written by `save`, without pyplot.
Colours are those of Okabe and Ito, which colour-blind readers tell apart.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import ArrayLike, NDArray

from validation.scoring.centre_line import CentreLine
from validation.scoring.deviations import CentreLineDeviation

Floats = NDArray[np.float64]

BLUE, ORANGE, GREEN, VERMILION, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#777777"
TRUTH = {"color": "black", "linewidth": 1.0, "linestyle": (0, (4, 2))}
UNOBSERVED = "#d9d9d9"


QUANTITIES = (
    "across the beam (voxel)",
    "vertical (voxel)",
    "along the beam (voxel)",
    r"strain $\varepsilon_{zz}$ (%)",
)


def new_figure(width_in: float, height_in: float, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """Make a figure with a row of axes."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(1, columns, squeeze=False)[0])


def save(figure: Figure, path: Path, *, dpi: int) -> str:
    """Write a figure as PNG, and return the file as base64, as a page holds it."""
    # Figure.savefig draws twice, the first time only to lay out: the same bytes, a third slower
    figure.set_dpi(dpi)
    FigureCanvasAgg(figure).print_png(path)  # type: ignore[no-untyped-call]
    return base64.b64encode(path.read_bytes()).decode("ascii")


def draw_radiographs(
    images: Sequence[NDArray[np.floating]],
    titles: Sequence[str],
    axes: Sequence[Axes],
    *,
    window: tuple[int, int, int, int] | None = None,
) -> AxesImage:
    """Draw normalised radiographs (row, column), air 0 and largest attenuation 1, and the used window."""
    for ax, image, title in zip(axes, images, titles, strict=True):
        shown = ax.imshow(image, cmap="gray_r", vmin=0, vmax=1, interpolation="nearest")
        _as_picture(ax, title)
        if window is not None:
            top, bottom, left, right = window
            x, y = (
                np.array([left, right, right, left, left]) - 0.5,
                np.array([top, top, bottom, bottom, top]) - 0.5,
            )
            ax.plot(x, y, color=VERMILION, linewidth=1.2)
    axes[0].figure.colorbar(shown, ax=list(axes), label="attenuation / largest", shrink=0.85)
    return shown


def draw_force(time_s: ArrayLike, force_N: ArrayLike, selected: Sequence[int], ax: Axes) -> Axes:
    """Draw the measured force against time, and the selected steps."""
    time, force = np.asarray(time_s), np.asarray(force_N)
    ax.plot(time, force, color=BLUE, marker=".", markersize=3, linewidth=1)
    ax.plot(time[list(selected)], force[list(selected)], "o", color=VERMILION, label="steps shown above")
    for k, step in enumerate(selected):
        # to either side in turn, because the last steps lie close together
        side: dict[str, Any] = {"xytext": (-8, 6), "ha": "right"} if k % 2 == 0 else {"xytext": (8, -14), "ha": "left"}
        ax.annotate(f"step {step}", (time[step], force[step]), textcoords="offset points", **side)
    ax.set(xlabel="time (s)", ylabel="force (N)")
    ax.margins(y=0.12)
    return _tidy(ax)


def draw_residuals(
    fields: Sequence[NDArray[np.floating]], titles: Sequence[str], axes: Sequence[Axes], *, limit: float
) -> AxesImage:
    """Draw residual fields (row, column) on one diverging scale from -limit to limit, grey levels."""
    for ax, field, title in zip(axes, fields, titles, strict=True):
        shown = ax.imshow(field, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
        _as_picture(ax, title)
    axes[0].figure.colorbar(
        shown, ax=list(axes), label="residual (grey levels: air 0, densest 1)", shrink=0.85, extend="both"
    )
    return shown


def scale_limit(fields: Sequence[NDArray[np.floating]], share: float = 0.998) -> float:
    """Return a round number that `share` of all |values| stay below."""
    sizes = np.abs(np.concatenate([np.ravel(field) for field in fields]))
    sizes = sizes[np.isfinite(sizes)]
    wanted = float(np.quantile(sizes, share)) if sizes.size else 0.0
    if wanted <= 0:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(next(step * decade for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * decade >= wanted * 0.999))


def draw_translations(centre: CentreLine, ax: Axes) -> Axes:
    """Draw the translation averaged over the axis against the step, beside the truth."""
    measured = centre.translation(centre.measured)
    for k, (name, colour) in enumerate(zip("xyz", (BLUE, ORANGE, GREEN), strict=True)):
        values = measured[:, k]
        ax.plot(values, color=colour, linewidth=2, label=rf"$\langle u_{name} \rangle$", marker=_marker(values))
    if centre.true is not None:
        for k, values in enumerate(centre.translation(centre.true).T):
            marker = _marker(values, "+")
            ax.plot(values, **TRUTH, label="truth" if k == 0 else None, marker=marker)  # type: ignore[arg-type]
    ax.set(xlabel="step", ylabel="mean translation (voxel)")
    micrometre = centre.voxel_mm * 1e3

    def to_micrometre(voxels: Any) -> Any:
        return voxels * micrometre

    def to_voxel(micrometres: Any) -> Any:
        return micrometres / micrometre

    second = ax.secondary_yaxis("right", functions=(to_micrometre, to_voxel))
    second.set_ylabel("(µm)")
    ax.legend(frameon=False, ncols=2)
    return _tidy(ax, right=True)


def draw_snr(
    initial: ArrayLike, rigid: ArrayLike, final: ArrayLike, noise: ArrayLike, reprojection: float, ax: Axes
) -> Axes:
    """Draw the SNR of each step (step,) at the three stages, dB, and the two limits."""
    curves = ((final, GREEN, "final"), (rigid, BLUE, "after rigid motions"), (initial, ORANGE, "initial"))
    for values, colour, name in curves:
        known = np.asarray(values, dtype=float)
        mean = known[np.isfinite(known)].mean() if np.isfinite(known).any() else np.nan
        ax.plot(known, color=colour, linewidth=1.6, label=f"{name}: mean {mean:.1f} dB", marker=_marker(known))
    limit = np.asarray(noise, dtype=float)
    if np.isfinite(limit).any():
        ax.plot(limit, **TRUTH, label="limit set by noise")  # type: ignore[arg-type]
    if np.isfinite(reprojection):
        ax.axhline(
            reprojection,
            color=GREY,
            linewidth=1.2,
            linestyle=":",
            label=f"re-projection: {reprojection:.1f} dB",
        )
    ax.set(xlabel="step", ylabel="SNR (dB)")
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return _tidy(ax)


def draw_errors(by_step: Floats, ax: Axes) -> Axes:
    """Draw the rms error of each step (step, direction), voxels, on a logarithmic scale."""
    names = ("across the beam", "vertical", "along the beam")
    for values, name, colour in zip(by_step.T, names, (BLUE, GREEN, VERMILION), strict=True):
        shown = np.where(values > 0, values, np.nan)
        ax.plot(shown, color=colour, linewidth=1.6, label=name, marker=_marker(shown))
    if np.isfinite(by_step).any() and np.nanmax(by_step) > 0:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set(xlabel="step", ylabel="rms error (voxel)")
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    ax.grid(axis="y", color="#e5e5e5", linewidth=0.8)
    return _tidy(ax)


def draw_noise_floor(level_mm: Floats, scatter: Floats, true_mm: Floats | None, true: Floats | None, ax: Axes) -> Axes:
    """Draw the scatter (level, direction), voxels, over the height, beside the true one at its own levels."""
    names = ("across the beam", "vertical", "along the beam")
    dashed: dict[str, Any] = {"linewidth": 1.0, "linestyle": (0, (4, 2))}
    for k, (name, colour) in enumerate(zip(names, (BLUE, GREEN, VERMILION), strict=True)):
        ax.plot(level_mm, scatter[:, k], color=colour, linewidth=1.6, label=name)
        if true is not None and true_mm is not None:
            ax.plot(true_mm, true[:, k], color=colour, **dashed)
    if true is not None:
        ax.plot([], [], color="black", label="of the true error", **dashed)
    ax.set(xlabel="height (mm)", ylabel="scatter over steps (voxel)")
    ax.set_ylim(bottom=0)
    ax.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return _tidy(ax)


def draw_maps(
    level_edges_mm: Floats,
    measured: Floats,
    true: Floats | None,
    axes: Sequence[Axes],
    *,
    label: str,
    cmap: str = "viridis",
) -> None:
    """Draw a field (step, level) over step and height, beside its truth and their difference.

    Measured and true share one scale; the difference has its own. Grey is what was not observed.
    """
    shown = [("measured", measured, cmap)]
    if true is not None:
        shown += [("truth", true, cmap), ("measured - truth", measured - true, "RdBu_r")]
    both = np.concatenate([measured.ravel(), measured.ravel() if true is None else true.ravel()])
    both = both[np.isfinite(both)] if np.isfinite(both).any() else np.zeros(1)
    low, high = float(both.min()), float(both.max())
    steps = np.arange(len(measured) + 1) - 0.5
    for ax, (title, values, colours) in zip(axes, shown, strict=True):
        limit = scale_limit([values], 1.0)
        span = (-limit, limit) if "truth" in title and "measured" in title else (low, high)
        mesh = ax.pcolormesh(steps, level_edges_mm, values.T, cmap=colours, vmin=span[0], vmax=span[1])
        ax.set_facecolor(UNOBSERVED)
        ax.set(title=title, xlabel="step")
        ax.figure.colorbar(mesh, ax=ax, label=label)
    axes[0].set_ylabel("height on the axis (mm)")


def stretch_maps(centre: CentreLine) -> tuple[Figure, Figure]:
    """Draw u_z without rigid motion, and the strain, as two figures with one or three maps."""
    columns = 1 if centre.true is None else 3
    true_u = None if centre.true is None else centre.stretch(centre.true)
    true_e = None if centre.true is None else centre.strain(centre.true) * 100
    first, axes = new_figure(3.9 * columns, 3.3, columns)
    draw_maps(_edges(centre.level_mm), centre.stretch(centre.measured), true_u, axes, label="$u_z$ (voxel)")
    second, axes = new_figure(3.9 * columns, 3.3, columns)
    draw_maps(
        centre.level_mm,
        centre.strain(centre.measured) * 100,
        true_e,
        axes,
        label=r"$\varepsilon_{zz}$ (%)",
        cmap="inferno",
    )
    return first, second


def draw_band(values: Floats, std: Floats, ax: Axes) -> Axes:
    """Draw a history (step,) with a band of 2 standard deviations (step,) on either side, in the values' unit."""
    steps = np.arange(len(values))
    if _marker(values) == "none":
        ax.fill_between(steps, values - 2 * std, values + 2 * std, color=BLUE, alpha=0.3, linewidth=0)
        ax.plot(steps, values, color=BLUE, linewidth=1.2)
    else:
        ax.errorbar(steps, values, 2 * std, color=BLUE, linewidth=1.2, marker=".", capsize=2)
    return _tidy(ax)


def error_bands(centre: CentreLineDeviation) -> Figure:
    """Draw the error at three heights (rows) of u in three directions and of the strain (columns), with its band."""
    assert centre.error is not None
    assert centre.strain_error is not None
    rows = _three_levels(centre)
    figure = Figure(figsize=(11.5, 1.7 * len(rows) + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(rows), 4, squeeze=False, sharex=True, sharey="col")
    for row, level in zip(grid, rows, strict=True):
        errors, stds = _at(centre.error, centre.strain_error, level), _at(centre.std, centre.strain_std, level)
        for column, (error, std) in enumerate(zip(errors, stds, strict=True)):
            row[column].axhline(0, color="black", linewidth=0.8)
            draw_band(error, std, row[column])
        row[0].set_ylabel(f"z = {centre.level_mm[level]:.2f} mm")
    for ax, title in zip(grid[0], QUANTITIES, strict=True):
        ax.set_title(title, fontsize=10)
    for ax in grid[-1]:
        ax.set_xlabel("step")
    return figure


def std_histories(centre: CentreLineDeviation) -> Figure:
    """Draw the standard deviations of u in three directions and of the strain against the step, at three heights."""
    figure, axes = new_figure(11.5, 2.8, 4)
    for level, colour in zip(_three_levels(centre), (BLUE, ORANGE, GREEN), strict=False):
        for ax, std in zip(axes, _at(centre.std, centre.strain_std, level), strict=True):
            ax.plot(
                std, color=colour, linewidth=1.6, marker=_marker(std), label=f"z = {centre.level_mm[level]:.2f} mm"
            )
    for ax, title in zip(axes, QUANTITIES, strict=True):
        ax.set_title(title, fontsize=10)
        ax.set_xlabel("step")
        ax.set_ylim(bottom=0)
        _tidy(ax)
    axes[0].set_ylabel("standard deviation")
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, ncols=3, loc="outside lower center")
    return figure


def std_maps(centre: CentreLineDeviation) -> Figure:
    """Draw the standard deviations of u in three directions and of the strain over step and height."""
    figure, axes = new_figure(15, 3.3, 4)
    steps = np.arange(len(centre.std) + 1) - 0.5
    fields = [centre.std[..., k] for k in range(3)] + [centre.strain_std * 100]
    edges = [_edges(centre.level_mm)] * 3 + [centre.level_mm]
    for ax, title, field, heights in zip(axes, QUANTITIES, fields, edges, strict=True):
        # a few steps, the last ones above all, would take up the whole scale
        known = field[np.isfinite(field)]
        high = float(np.quantile(known, 0.98)) if known.size else 1.0
        mesh = ax.pcolormesh(steps, heights, field.T, cmap="viridis", vmin=0, vmax=high)
        ax.set_facecolor(UNOBSERVED)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel("step")
        ax.figure.colorbar(mesh, ax=ax, extend="max" if known.size and known.max() > high else "neither")
    for ax in axes:
        ax.set_ylim(centre.level_mm[0], centre.level_mm[-1])
    axes[0].set_ylabel("height on the axis (mm)")
    return figure


def _three_levels(centre: CentreLineDeviation) -> list[int]:
    """Return a high, a middle and a low level among those most often observed, from the top down."""
    count = np.isfinite(centre.strain_std).sum(axis=0)
    usual = np.flatnonzero(count == count.max())
    return sorted({int(usual[round(share * (len(usual) - 1))]) for share in (5 / 6, 1 / 2, 1 / 6)}, reverse=True)


def _at(directions: Floats, strain: Floats, level: int) -> list[Floats]:
    """Return four histories (step,): u in three directions at a level, voxels, and the strain above it, %."""
    return [*directions[:, level].T, strain[:, level] * 100]


def _edges(level_mm: Floats) -> Floats:
    middle = (level_mm[1:] + level_mm[:-1]) / 2
    return np.concatenate([[1.5 * level_mm[0] - 0.5 * level_mm[1]], middle, [1.5 * level_mm[-1] - 0.5 * level_mm[-2]]])


def _marker(values: Floats, marker: str = ".") -> str:
    """Return the marker for a curve (step,) that has points alone between unknown ones, else none."""
    known = np.pad(np.isfinite(values), 1)
    alone = known[1:-1] & ~known[:-2] & ~known[2:]
    return marker if alone.any() else "none"


def _as_picture(ax: Axes, title: str) -> None:
    ax.set_title(title, fontsize=10)
    ax.set_xlabel("column (px)")
    if ax.get_subplotspec() is None or ax.get_subplotspec().is_first_col():  # type: ignore[union-attr]
        ax.set_ylabel("row (px)")


def _tidy(ax: Axes, *, right: bool = False) -> Axes:
    ax.spines["top"].set_visible(False)
    ax.spines["right"].set_visible(right)
    return ax
