"""A test played into a folder and followed from there: latency, errors, intervals: python -m benchmarks.live SCENARIO.

`play` and `live` run as a user runs them, each a process of its own. Latency is counted from when the TIFF of a
radiograph was whole on the disk to when its motion was known; to write it down takes some hundredths of a second
more. SCENARIO is a name or a file; `benchmarks/long.toml` has eight times as many steps as usual, to see what memory
does. With `--kills N`, `live` is killed with SIGKILL N times, at moments drawn at random, and started again each
time. What is prepared is kept in the folder. The measurement of the whole test, at the end, is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil

from benchmarks.timing import machine
from pdvc.deviations import beam_frame
from pdvc.record import AlarmLine, LostLine, StepLine, read_record, record_of
from simulator.scanner import simulate
from simulator.scenario import course_of, load_scenario
from validation.report.figures import BLUE, TRUTH, new_figure, save

BENCH = (sys.executable, "-m", "validation.cli")


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("--pace", type=float, default=2.0, help="seconds between radiographs")
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("out/live"))
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    scenario = load_scenario(options.scenario)
    folder, experiment = options.folder / scenario.name, options.folder / scenario.name / "experiment"
    print(machine())
    started = time.perf_counter()
    simulate(scenario, experiment)
    print(f"simulate: {time.perf_counter() - started:.0f} s", flush=True)
    started = time.perf_counter()
    subprocess.run([*BENCH, "prepare", experiment, "--work", folder / "ready"], check=True, stderr=subprocess.DEVNULL)
    print(f"prepare: {time.perf_counter() - started:.0f} s", flush=True)
    arriving, file = folder / "arriving", folder / "motion.nc"
    for old in (arriving, file.with_name(file.name + ".live")):
        shutil.rmtree(old, ignore_errors=True)
    record_of(file).unlink(missing_ok=True)
    memory = _followed(experiment, arriving, folder / "ready", file, options.pace, options.kills)
    lines = list(read_record(record_of(file)))
    _tell(lines, arriving, memory)
    error, deviation, course = _against_truth(lines, scenario)
    _tell_errors(error, deviation)
    if options.figure:
        _draw(lines, course, options.figure)


def _followed(experiment: Path, arriving: Path, ready: Path, file: Path, pace_s: float, kills: int) -> list[float]:
    """Play and follow until the record holds all steps; return the memory of `live` second by second, GiB."""
    arriving.mkdir(parents=True)
    live = [*BENCH, "live", experiment, "--radiographs", arriving, "--work", ready, "-o", file]
    follower = subprocess.Popen(live, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    # the test begins once everything is loaded, and the plan is written
    while not (record_of(file).is_file() and record_of(file).stat().st_size):
        if follower.poll() is not None:
            raise RuntimeError(f"live: expected to follow, ended with exit code {follower.returncode}")
        time.sleep(0.1)
    player = subprocess.Popen(
        [*BENCH, "play", experiment, "--to", arriving, "--pace", str(pace_s)], stderr=subprocess.DEVNULL
    )
    rng, memory, wait_s, since = np.random.default_rng(0), list[float](), 0.0, time.monotonic()
    while not _whole(file) and follower.poll() is None:
        # not often: what is timed runs beside this
        time.sleep(1)
        memory.append(psutil.Process(follower.pid).memory_info().rss / 2**30)
        wait_s = wait_s or rng.uniform(5, 25)
        if kills and time.monotonic() > since + wait_s:
            os.kill(follower.pid, signal.SIGKILL)
            follower.wait()
            follower = subprocess.Popen(live, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            kills, wait_s, since = kills - 1, 0.0, time.monotonic()
            print(f"killed after {sum(isinstance(line, StepLine) for line in read_record(record_of(file)))} steps")
    follower.kill()
    for process in (follower, player):
        process.wait()
    return memory


def _whole(file: Path) -> bool:
    """Return whether each planned step has a line."""
    with record_of(file).open("rb") as record:
        plan, lines = record.readline(), sum(1 for line in record if b'"what": "alarm"' not in line)
    return bool(plan) and lines >= json.loads(plan)["steps"]


def _tell(lines: list, arriving: Path, memory: list[float]) -> None:
    steps = [line for line in lines if isinstance(line, StepLine)]
    latency = np.array([line.unix_s - (arriving / line.file).stat().st_mtime for line in steps])
    work = np.array([line.seconds for line in steps])
    print(f"steps: {len(steps)}, each once: {len({line.step for line in steps}) == len(steps)}; passes: ", end="")
    print(f"{np.mean([line.passes for line in steps]):.1f}")
    quarters = [max(part) for part in np.array_split(memory, 4) if len(part)]
    print(f"largest memory of live in each quarter of the time: {', '.join(f'{each:.2f}' for each in quarters)} GiB")
    alarms = [f"{line.alarm} at {line.step}" for line in lines if isinstance(line, AlarmLine)]
    print(f"alarms: {', '.join(alarms) or 'none'}")
    lost = [line.reason for line in lines if isinstance(line, LostLine)]
    print(f"lost: {', '.join(lost) or 'none'}")
    for name, seconds in (("latency", latency), ("work", work)):
        quantiles = np.quantile(seconds, (0.5, 0.99, 1))
        print(f"{name}: median {quantiles[0]:.2f} s, 99 % {quantiles[1]:.2f} s, largest {quantiles[2]:.2f} s")


def _against_truth(lines: list, scenario) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Return errors and stated deviations (step, section, 4), voxels and strain, and the true mean strain (step,)."""
    plan, motion = lines[0], course_of(scenario).motion
    height = np.array(plan.height_mm)
    points = np.zeros((len(height), 3))
    points[:, 2] = height
    errors, deviations, course = [], [], []
    for line in (line for line in lines if isinstance(line, StepLine)):
        moved = points - motion.inverse(points, line.step)
        truth = moved @ beam_frame(np.deg2rad(line.angle_deg)).T / plan.voxel_mm
        strain = np.diff(moved[:, 2]) / np.diff(height)
        course.append((moved[-1, 2] - moved[0, 2]) / (height[-1] - height[0]))
        errors.append([*(np.array(line.displacement_voxel) - truth).T, [*(np.array(line.strain) - strain), np.nan]])
        deviations.append([*np.array(line.displacement_std).T, [*line.strain_std, np.nan]])
    return np.array(errors), np.array(deviations), np.array(course)


def _tell_errors(error: np.ndarray, deviation: np.ndarray) -> None:
    share = error / deviation
    for k, name in enumerate(("across the beam, voxel", "vertical, voxel", "along the beam, voxel", "strain")):
        size, z = np.sqrt(np.nanmean(error[:, k] ** 2)), np.sqrt(np.nanmean(share[:, k] ** 2))
        inside = np.nanmean(np.where(np.isnan(share[:, k]), np.nan, np.abs(share[:, k]) < 1.96))
        print(f"{name}: error {size:.2g} rms, z {z:.2f}, 95 % intervals cover {100 * inside:.0f} %")


def _draw(lines: list, course: np.ndarray, path: Path) -> None:
    """Draw the mean strain of each step with its interval, the truth, and what is left of both."""
    steps = [line for line in lines if isinstance(line, StepLine)]
    step = np.array([line.step for line in steps])
    strain = 100 * np.array([line.mean_strain for line in steps])
    half = 196 * np.array([line.mean_strain_std for line in steps])
    figure, (top, bottom) = new_figure(6.3, 2.6, 2)
    for axes, middle in ((top, strain), (bottom, strain - 100 * course)):
        axes.fill_between(step, middle - half, middle + half, color=BLUE, alpha=0.3, linewidth=0)
        axes.plot(step, middle, color=BLUE, linewidth=1)
        axes.set_xlabel("step")
    top.plot(step, 100 * course, **TRUTH)
    bottom.axhline(0, **TRUTH)
    top.set_ylabel("mean strain (%)")
    bottom.set_ylabel("less the true one (%)")
    save(figure, path, dpi=150)


if __name__ == "__main__":
    main()
