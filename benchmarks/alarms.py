"""Alarms of `live` on clean and on faulty tests, drawn anew each time: python -m benchmarks.alarms --draws 10.

How often each alarm is raised where nothing is wrong, after how many steps where something is, and for cracks of
several sizes how often they are found, against how often the same limit is passed without a crack. Scenarios are a
quarter of the paper's size (`quick` and what is named beside it). Faults of the scanner are made from the counts of a
clean test.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np

from benchmarks.timing import machine
from pdvc.alarms import Watch
from pdvc.cells import CRACK
from pdvc.compilation import compile_kernels
from pdvc.experiment import Experiment, read_experiment
from pdvc.incoming import Arrival
from pdvc.live import step_line
from pdvc.options import DEFAULT
from pdvc.setup import set_up
from pdvc.tracker import Tracker
from simulator.scanner import simulate
from simulator.scenario import Scenario, load_scenario
from validation.report.figures import TRUTH, new_figure, save

BEGINS = 80
"""Step at which faults made from counts begin."""
FOUND_WITHIN = 20
"""Steps after a crack began to open within which it is found, or counts as missed; it is open after ten."""
RADII_MM, OPENINGS_MM = (0.2, 0.3, 0.4), (0.005, 0.01, 0.02, 0.04)
"""Of cracks; a voxel is 0.043 mm."""


@dataclass(frozen=True)
class Watched:
    """What became of a test."""

    raised: list[tuple[int, str, tuple[float, float, float]]]
    """Step, name and place of each alarm."""
    scores: list[float]
    """What is compared with the limit of `crack`, at each step."""


Fault = Callable[[Experiment, int], Arrival]


def arrival(experiment: Experiment, step: int) -> Arrival:
    """Return the radiograph of a step, as it is."""
    return Arrival.of(experiment.test, step)


def dimmed(experiment: Experiment, step: int, share: float) -> Arrival:
    """Return the radiograph in a beam of which a share is left."""
    as_it_is, dark = arrival(experiment, step), np.mean(experiment.darks, axis=0)
    if step < BEGINS:
        return as_it_is
    return replace(as_it_is, counts=np.rint(dark + share * (as_it_is.counts - dark)).astype(np.uint16))


def clipped(experiment: Experiment, step: int) -> Arrival:
    """Return the radiograph of a detector that stores counts up to nine tenths of the open beam's."""
    as_it_is, most = arrival(experiment, step), int(0.9 * np.median(experiment.flats))
    return replace(as_it_is, counts=np.minimum(as_it_is.counts, most)) if step >= BEGINS else as_it_is


def leaving(experiment: Experiment, step: int) -> Arrival:
    """Return the radiograph of a sample that goes to the right by two pixels a step."""
    as_it_is, moved = arrival(experiment, step), 2 * max(step - BEGINS + 1, 0)
    air = np.repeat(as_it_is.counts[:, :1], moved, axis=1)
    return replace(as_it_is, counts=np.concatenate([air, as_it_is.counts], axis=1)[:, : as_it_is.counts.shape[1]])


def stopped(experiment: Experiment, step: int) -> Arrival:
    """Return the radiograph of a stage that stands still: that of the step before it did, with other noise."""
    as_it_is, dark = arrival(experiment, step), np.mean(experiment.darks, axis=0)
    if step < BEGINS:
        return as_it_is
    signal = np.maximum(experiment.test.counts[BEGINS - 1] - dark, 0)
    photons = experiment.photons_per_count or 1.0
    # its own noise is in it already: twice as much in all makes the alarm harder, not easier
    again = np.random.default_rng(step).poisson(signal * photons) / photons
    return replace(as_it_is, counts=np.rint(dark + again).astype(np.uint16))


FAULTS: dict[str, Fault] = {
    "beam off": partial(dimmed, share=0.0),
    "beam at 96 %": partial(dimmed, share=0.96),
    "clipped counts": clipped,
    "sample leaves": leaving,
    "stage stopped": stopped,
}
SHOULD = {
    "beam off": "beam",
    "beam at 96 %": "beam",
    "clipped counts": "saturation",
    "sample leaves": "out-of-view",
    "stage stopped": "stage",
    "slip": "sudden",
    "neck": "localisation",
    "crack": "crack",
}


def watched(scenario: Scenario, fault: Fault = arrival, last: int | None = None) -> Watched:
    """Simulate a test, follow it and watch it, up to a step."""
    numba.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        simulate(scenario, Path(folder) / "experiment")
        experiment = read_experiment(Path(folder) / "experiment")
        compile_kernels()
        setup = set_up(experiment, DEFAULT, work=Path(folder) / "work")
        tracker, watch = Tracker(setup), Watch(setup)
        raised: list[tuple[int, str, tuple[float, float, float]]] = []
        scores = []
        for step in range(len(experiment.test) if last is None else last):
            radiograph = fault(experiment, step)
            found, score = watch.seen(radiograph), 0.0
            if not any(alarm.spoils for alarm in found):
                taken = tracker.take(radiograph)
                found += watch.followed(step_line(setup, radiograph, taken, 0.0), taken)
                tracker.settle()
                score = watch.spot.score if watch.spot else 0.0
            scores.append(score)
            raised += [(step, alarm.name, alarm.place_mm) for alarm in watch.new(step, found)]
    return Watched(raised=raised, scores=scores)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=10, help="clean tests; of each fault a fifth as many")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    few = max(options.draws // 5, 1)
    clean, moved = load_scenario("quick"), {name: load_scenario(name) for name in ("slip", "neck")}
    cracked = {(r, d): _crack(r, d) for r in RADII_MM for d in OPENINGS_MM}
    jobs = [("clean", 0, seeded(clean, k), arrival, None) for k in range(options.draws)]
    for name, scenario in moved.items():
        jobs += [(name, _begins(scenario), seeded(scenario, 100 + k), arrival, None) for k in range(few)]
    for name, fault in FAULTS.items():
        jobs += [(name, BEGINS, seeded(clean, 200 + k), fault, BEGINS + 15) for k in range(few)]
    for size, scenario in cracked.items():
        begins = scenario.crack.first_step
        jobs += [(size, begins, seeded(scenario, 300 + k), arrival, begins + FOUND_WITHIN) for k in range(few)]
    print(machine())
    started = time.perf_counter()
    with ProcessPoolExecutor(options.workers) as pool:
        found = [pool.submit(watched, scenario, fault, last) for _, _, scenario, fault, last in jobs]
        results = []
        for (name, begins, *_), each in zip(jobs, found, strict=True):
            results.append((name, begins, each.result()))
            print(f"{len(results)} of {len(jobs)}, {time.perf_counter() - started:.0f} s: {name}", file=sys.stderr)
    _tell_clean([each for name, _, each in results if name == "clean"])
    _tell_faults(results)
    _tell_cracks(results, options.figure)


def seeded(scenario: Scenario, seed: int) -> Scenario:
    """Return a scenario with another texture and other noise."""
    return scenario.model_copy(update={"seed": seed})


def _crack(radius_mm: float, opening_mm: float) -> Scenario:
    scenario = load_scenario("crack")
    return scenario.model_copy(
        update={"crack": scenario.crack.model_copy(update={"radius_mm": radius_mm, "opening_mm": opening_mm})}
    )


def _begins(scenario: Scenario) -> int:
    """Return the step at which the motion of a scenario becomes unusual."""
    slip = scenario.motion.slip.step if "slip" in scenario.motion.ingredients else None
    return scenario.acquisition.test_steps - 1 - scenario.loading.necking_steps if slip is None else slip


def _tell_clean(tests: list[Watched]) -> None:
    """Print how often alarms were raised where nothing is wrong; the onset of loading is a sudden motion."""
    steps = sum(len(test.scores) for test in tests)
    print(f"clean: {len(tests)} tests, {steps} steps")
    for name in dict.fromkeys(SHOULD.values()):
        at = [step for test in tests for step, raised, _ in test.raised if raised == name]
        print(f"  {name}: raised {len(at)} times, at steps {sorted(at)}")
    scores = np.concatenate([test.scores for test in tests])
    print(
        f"  score of crack: median {np.median(scores):.1f}, 99 % {np.quantile(scores, 0.99):.1f}, "
        f"largest {scores.max():.1f}; limit {CRACK:.0f}"
    )


def _tell_faults(results: list[tuple[Any, int, Watched]]) -> None:
    """Print after how many steps each fault is found."""
    for fault in dict.fromkeys(name for name, _, _ in results if name in SHOULD):
        delays = [_delay(test, begins, SHOULD[fault]) for name, begins, test in results if name == fault]
        others = [
            f"{raised} at {step - begins:+d}"
            for name, begins, test in results
            if name == fault
            for step, raised, _ in test.raised
            if raised != SHOULD[fault] and step >= begins
        ]
        print(f"{fault}: {SHOULD[fault]} after {delays} steps; besides: {', '.join(others) or 'none'}")


def _delay(test: Watched, begins: int, name: str) -> int | None:
    """Return the steps from the first that is faulty to the first alarm of a name, or None."""
    after = [step - begins for step, raised, _ in test.raised if raised == name and step >= begins]
    return min(after, default=None)


def _tell_cracks(results: list[tuple[Any, int, Watched]], path: Path | None) -> None:
    """Print how cracks of each size are found, and draw it against false alarms."""
    scores = [test.scores for name, _, test in results if name == "clean"]
    clean = np.array([max(each[k : k + FOUND_WITHIN]) for each in scores for k in range(0, len(each), FOUND_WITHIN)])
    limits = np.linspace(3, 12, 91)
    false, at_once = (clean[:, None] > limits).mean(axis=0), 0
    figure, (axes,) = new_figure(4.2, 3.2, 1)
    for size in dict.fromkeys(name for name, _, _ in results if isinstance(name, tuple)):
        tests = [(begins, test) for name, begins, test in results if name == size]
        best = np.array([max(test.scores[begins:]) for begins, test in tests])
        delays = [_delay(test, begins, "crack") for begins, test in tests]
        off = [
            float(np.linalg.norm(np.subtract(place, _crack(*size).crack.centre_mm)))
            for begins, test in tests
            for step, raised, place in test.raised
            if raised == "crack" and step >= begins
        ]
        away = f", {np.median(off):.2f} mm from its middle" if off else ""
        print(
            f"crack of radius {size[0]} mm, opening {size[1]} mm: scores {np.round(best, 1).tolist()}, "
            f"found after {delays} steps{away}"
        )
        if best.min() > clean.max():
            at_once += 1
        else:
            axes.step(false, (best[:, None] > limits).mean(axis=0), where="post", label=f"{size[0]} mm, {size[1]} mm")
    axes.step(false, np.ones_like(false), where="post", color=TRUTH["color"], label=f"the {at_once} others")
    axes.set_xlabel(f"false alarms in {FOUND_WITHIN} clean steps (share)")
    axes.set_ylabel("cracks found (share)")
    axes.legend(fontsize="x-small", title="radius, opening")
    if path:
        save(figure, path, dpi=150)


if __name__ == "__main__":
    main()
