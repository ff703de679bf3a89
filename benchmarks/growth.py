"""Time of a pass against steps, pixels, sections, motions and threads: a figure, and the slopes in log-log axes.

Processor times, which other programs disturb less; by the clock against threads.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np

from benchmarks.case import Case, amplitude, case
from benchmarks.timing import in_turns, machine, with_threads
from pdvc.projection import normal_equations


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figure", type=Path, default=Path("docs/figures/performance-growth.png"))
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    print(machine())
    half = case("jailin2018", rows=477)
    sizes = [case("jailin2018", rows=rows) for rows in (119, 238, 477, 954)]
    curves = {
        "steps": _curve([(n, one_pass(half, steps=n)) for n in (1, 2, 4, 8, 16)], options.repeats),
        "pixels": _curve([(c.window.rows * c.window.columns, one_pass(c)) for c in sizes], options.repeats),
        "sections": _curve([(n, one_pass(half, sections=n)) for n in (5, 10, 15, 30, 60)], options.repeats),
        "motions of a section": _curve([(n, one_pass(half, motions=n)) for n in (1, 3, 6, 7)], options.repeats),
        "threads, by the clock": _curve(
            [(n, with_threads(n, one_pass(half))) for n in (1, 2)], options.repeats, "wall"
        ),
    }
    for name, (x, seconds) in curves.items():
        print(f"{name}: slope {_slope(x, seconds):+.2f}; ", end="")
        print(", ".join(f"{a:g}: {1e3 * t:.1f} ms" for a, t in zip(x, seconds, strict=True)))
    _draw(curves, options.figure)
    print(machine())


def one_pass(on: Case, *, steps: int = 1, sections: int = 15, motions: int = 6) -> Callable[[], None]:
    """Return a pass over some steps of a case's used window."""
    basis = on.basis(sections, motions)
    trial = np.stack([amplitude(basis, 3.0 * on.geometry.rows / 954)] * steps)
    rays = on.rays(on.window, 0.4 + 2 * np.pi * np.arange(steps) / 50)
    blank = np.zeros((steps, on.window.rows, on.window.columns), np.float32)
    weight = np.ones_like(blank[:1])

    def run() -> None:
        normal_equations(on.volume, rays, basis, trial, blank, weight, voxel_mm=on.volume.grid.voxel_mm)

    return run


def _curve(
    jobs: Sequence[tuple[float, Callable[[], None]]], repeats: int, clock: str = "cpu"
) -> tuple[np.ndarray, np.ndarray]:
    taken = in_turns([job for _, job in jobs], repeats)
    return np.array([x for x, _ in jobs], dtype=float), np.array([getattr(each, clock) for each in taken])


def _slope(x: np.ndarray, seconds: np.ndarray) -> float:
    return float(np.polyfit(np.log(x), np.log(seconds), 1)[0])


def _draw(curves: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(curves), figsize=(14, 3.2), layout="constrained")
    for axis, (name, (x, seconds)) in zip(axes, curves.items(), strict=True):
        axis.loglog(x, seconds * 1e3, "o-", color="tab:blue", label=f"measured, slope {_slope(x, seconds):+.2f}")
        power = {"steps": 1, "pixels": 1.5, "threads, by the clock": -1}.get(name, 0)
        axis.loglog(x, seconds[-1] * 1e3 * (x / x[-1]) ** power, "--", color="0.6", label=f"slope {power:+g}")
        axis.set_xlabel(name)
        axis.set_xticks(x, [f"{value:g}" if value < 1000 else f"{value:.1e}" for value in x], minor=False)
        axis.xaxis.set_minor_formatter("")
        axis.yaxis.set_minor_formatter("")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.set_ylim(0.5 * seconds.min() * 1e3, 3 * seconds.max() * 1e3)
        axis.legend(fontsize="x-small", loc="upper left")
        axis.grid(True, which="both", alpha=0.3)
    axes[0].set_ylabel("processor time of a pass, ms")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
