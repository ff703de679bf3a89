"""Time every stage at full size, beside RTK and beside a plain implementation: the table of `make bench`."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks import history, rtk, stored
from benchmarks.case import Case, amplitude, case
from benchmarks.timing import Seconds, in_turns, machine, once, with_threads
from pdvc.experiment import read_experiment
from pdvc.noise import ImageNoise, StepNoise
from pdvc.options import MeasureOptions
from pdvc.projection import normal_equations, sensitivities
from pdvc.protocol import measure
from pdvc.reconstruction import fdk
from pdvc.sensitivity_sums import Spread
from simulator.images import prepare
from simulator.radiography import path_lengths
from simulator.scanner import simulate
from simulator.scenario import course_of, load_scenario
from simulator.stacks import step_image, view_image

Floats = NDArray[np.float64]
Image = NDArray[np.float32]
ANGLE_RAD = float(np.deg2rad(33.0))
"""Stage angle of the radiograph that is timed: neither along x nor along y, nor halfway between."""


NONE = Seconds(np.nan, np.nan)


class Rows:
    """Print a table row by row, as they come, then all together."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._table = Table(
            "stage", "size", "threads", "time", "CPU", "compared with", "its time", "CPU", "ratio", "agreement"
        )
        self._yardstick = history.yardstick()
        self._entries: list[history.Entry] = []

    def add(
        self, stage: str, size: str, threads: int, taken: Seconds, other: str = "", its: Seconds = NONE, note: str = ""
    ) -> None:
        """Add a row; the ratio is this software's time over the other's."""
        ratio = "" if np.isnan(its.wall) else f"{taken.wall / its.wall:.3f}"
        times = _time(taken.wall), _time(taken.cpu), other, _time(its.wall), _time(its.cpu)
        self._table.add_row(stage, size, str(threads), *times, ratio, note)
        self._console.print(f"  {stage}, {size}, {threads} thread(s): {' '.join(times)} {ratio} {note}", style="dim")
        if other and not np.isnan(its.wall):
            compared = other.partition(",")[0]
        else:
            compared, its = history.YARDSTICK, in_turns([self._yardstick], 3)[0]
        self._entries.append(history.entry(stage, size, threads, taken.wall, compared, its.wall))

    def show(self) -> None:
        """Print the table, and what became slower than it was; keep it."""
        self._console.print(self._table)
        for line in history.losses(self._entries, history.read()):
            self._console.print(line, style="bold", markup=False)
        history.add(self._entries)
        self._console.print(f"kept in {history.FILE}", markup=False)


def _time(seconds: float) -> str:
    if np.isnan(seconds):
        return ""
    return (
        f"{seconds:.1f} s" if seconds >= 10 else f"{seconds * 1e3:.0f} ms" if seconds >= 1e-2 else f"{seconds:.1e} s"
    )


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="reconstruct from all 600 views (RTK: five minutes)")
    parser.add_argument("--repeats", type=int, default=7, help="times each short job is run (default: 7)")
    parser.add_argument("--views", type=int, default=60, help="views of the FDK comparison (default: 60)")
    options = parser.parse_args()
    console = Console(width=170)
    console.print(machine())
    if not rtk.available():
        console.print(rtk.MISSING, markup=False)
    rows = Rows(console)
    full = case("jailin2018")
    _radiograph(rows, full, options.repeats)
    _reconstruction(rows, full, 600 if options.full else options.views)
    _noise(rows, full, options.repeats)
    _stored(rows)
    _simulation(rows)
    _measurement(rows)
    rows.show()
    console.print(machine())


def _radiograph(rows: Rows, full: Case, repeats: int) -> None:
    """Time one radiograph's equations and projection, each beside RTK's Joseph of the same volume and window."""
    volume, voxel = full.volume, full.volume.grid.voxel_mm
    for name, window in (("whole detector", full.geometry), ("used window", full.window)):
        shape = (1, window.rows, window.columns)
        rays = full.rays(window, ANGLE_RAD)
        blank, weight = np.zeros(shape, np.float32), np.ones(shape, np.float32)

        def equations(motions: int, rays=rays, blank=blank, weight=weight) -> Callable[[], Any]:  # type: ignore[no-untyped-def]
            basis = full.basis(15, motions)
            trial = amplitude(basis, 3.0)[None]
            return lambda: normal_equations(volume, rays, basis, trial, blank, weight, voxel_mm=voxel)

        def plain(window=window) -> Image:  # type: ignore[no-untyped-def]
            return full.project(window, ANGLE_RAD)

        for threads in (2, 1):
            jobs = [with_threads(threads, job) for job in (equations(6), equations(7), plain)]
            note = ""
            if rtk.available():
                rtk.set_threads(threads)
                joseph = rtk.Joseph(volume.values, volume.grid, window, np.array([ANGLE_RAD]), threads)
                jobs.append(joseph.run)
            times = in_turns(jobs, repeats)
            other, its = ("RTK Joseph", times[3]) if rtk.available() else ("", NONE)
            if rtk.available():
                # above and below the used window rays leave the volume through its cut ends
                rows_seen = slice(full.corner[0], -full.corner[0]) if window is full.geometry else slice(None)
                ours, theirs = plain()[rows_seen], joseph.result()[0][rows_seen]
                note = f"rms {np.sqrt(np.mean((ours - theirs) ** 2)) / theirs.max():.1e} of the largest"
            size = f"{shape[1]} x {shape[2]} px, {name}"
            rows.add("equations, 15 sections x 6 motions", size, threads, times[0], other, its)
            rows.add("equations, 15 sections x 7 motions", size, threads, times[1], other, its)
            rows.add("projection alone", size, threads, times[2], other, its, note)


def _reconstruction(rows: Rows, full: Case, count: int) -> None:
    """Time FDK of exact path lengths through the sample, nodules and all, beside RTK's, over the same box."""
    geometry, grid = full.geometry, full.volume.grid
    body = prepare(full.scenario, course_of(full.scenario)).body
    angle = 2 * np.pi * np.arange(count) / count
    views = np.stack([path_lengths(body, geometry, float(a), 1)[0] for a in angle]).astype(np.float32)
    # compiled first, on a few views
    few = angle[:: max(1, count // 20)]
    fdk(lambda i: views[i], geometry, few, grid, full.sample)
    seconds, ours = once(lambda: fdk(lambda i: views[i], geometry, angle, grid, full.sample))
    other, its, note = "", NONE, ""
    if rtk.available():
        rtk.set_threads(2)
        run, result = rtk.fdk(views, geometry, angle, grid)
        its, _ = once(run)
        again, _ = once(lambda: fdk(lambda i: views[i], geometry, angle, grid, full.sample))
        seconds = Seconds((seconds.wall + again.wall) / 2, (seconds.cpu + again.cpu) / 2)
        theirs = result()
        inside = ours != 0
        level = float(theirs[theirs > 0.5 * np.percentile(theirs, 99)].mean(dtype=float))
        apart = np.sqrt(np.mean((ours[inside] - theirs[inside]) ** 2, dtype=float)) / level
        other, note = "RTK FDK, whole box", f"rms {apart:.1e} of the sample's mean, in the hull"
    size = f"{count} views, {' x '.join(str(n) for n in grid.shape)} voxels"
    rows.add("FDK", size, 2, seconds, other, its, note)


def _noise(rows: Rows, full: Case, repeats: int) -> None:
    """Time what noise of a radiograph, its views and the flats does to one step, beside the step's equations."""
    window, volume, voxel = full.window, full.volume, full.volume.grid.voxel_mm
    shape, detector = (window.rows, window.columns), (full.geometry.rows, full.geometry.columns)
    basis, rays = full.basis(29, 7), full.rays(window, ANGLE_RAD)
    trial, blank = amplitude(basis, 3.0)[None], np.zeros((1, *shape), np.float32)
    (field,) = sensitivities(volume, rays, shape, basis, trial, voxel_mm=voxel)
    # moved down and to the right, the less the farther up
    row, column = np.indices(shape)
    places = np.stack(
        [1.005 * row + full.corner[0] - 3.3, column + full.corner[1] + 2.7 + 1e-3 * row, 1 + 0 * row], -1
    )
    image, view = (
        ImageNoise(variance=np.ones(s, np.float32), slope=np.ones(s, np.float32)) for s in (shape, detector)
    )

    def noise() -> Any:
        spread = Spread(weighted=field, places=places, corner=full.corner, shape=detector)
        return StepNoise(image=image, view=view, spread=spread).own(view.variance, trial.size)

    def equations() -> Any:
        return normal_equations(volume, rays, basis, trial, blank, np.ones_like(blank), voxel_mm=voxel)

    taken, its = in_turns([with_threads(1, noise), with_threads(1, equations)], repeats)
    size = f"{window.rows} x {window.columns} px, used window"
    rows.add("noise of a step, 29 sections x 7 motions", size, 1, taken, "equations", its)


def _stored(rows: Rows) -> None:
    """Time the same equations from a stored S, at a quarter of the size."""
    small = case("quick")
    window, volume, voxel = small.window, small.volume, small.volume.grid.voxel_mm
    basis = small.basis(15, 6)
    trial = amplitude(basis, 0.7)
    rays = small.rays(window, ANGLE_RAD)
    start = small.project(window, ANGLE_RAD)[None]
    weight = np.ones_like(start)
    mine, plain = (
        lambda: normal_equations(volume, rays, basis, trial[None], start, weight, voxel_mm=voxel),
        lambda: stored.normal_equations(volume, rays[0], basis, trial, start[0], voxel),
    )
    times = in_turns([mine, plain], 3)
    ours, (matrix, vector, size) = mine(), plain()
    exact = stored.by_differences(volume, rays[0], basis, trial, start[0], voxel)

    def apart(b: Floats, c: Floats) -> str:
        pairs = ((ours.matrix[0], b), (ours.vector[0], c))
        return ", ".join(f"{np.linalg.norm(mine - other) / np.linalg.norm(other):.1e}" for mine, other in pairs)

    rows.add(
        "equations, 15 sections x 6 motions",
        f"{window.rows} x {window.columns} px, one step of quick",
        2,
        times[0],
        f"S stored, {size / 1e6:.0f} MB a step",
        times[1],
        f"B, c {apart(matrix, vector)}; to S by finite differences {apart(*exact)}",
    )


def _simulation(rows: Rows) -> None:
    scenario = load_scenario("jailin2018")
    scanner = prepare(scenario, course_of(scenario))
    plan = scenario.geometry
    size = f"{plan.rows} x {plan.columns} px, {scenario.acquisition.subpixels} x {scenario.acquisition.subpixels} rays"
    times = in_turns([lambda: view_image(scanner, 7), lambda: step_image(scanner, 90)], 3)
    rows.add("simulate a reference view", size, 1, times[0])
    rows.add("simulate a test radiograph", size, 1, times[1])


def _measurement(rows: Rows) -> None:
    with tempfile.TemporaryDirectory() as folder:
        scenario = load_scenario("quick")
        plan = scenario.acquisition
        seconds, _ = once(lambda: simulate(scenario, Path(folder)))
        rows.add("simulate quick", f"{plan.reference_views} + {plan.test_steps} radiographs", 2, seconds)
        result = measure(read_experiment(Path(folder)), MeasureOptions())
    for name, wall in result.provenance.seconds.items():
        size = f"{plan.test_steps} steps, 15 sections x 7 motions"
        rows.add(f"measure quick: {name}", size, 2, Seconds(wall, np.nan))


if __name__ == "__main__":
    main()
