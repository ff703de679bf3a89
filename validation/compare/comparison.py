"""Compare methods: every method measures the same experiments, repetition by repetition.

DIR/comparison.html          for a reader; DIR/figures/*.png holds its figures
DIR/methods.csv, .parquet    one row for each scenario and method: errors with intervals, and costs
DIR/differences.csv          the same for each pair of methods
DIR/by_step.csv              errors of each method at each step
DIR/methods.md, methods.tex  the table, to be printed
DIR/table.parquet            one row for each run; DIR/runs, errors, failed: see `validation.batch.engine`

A repetition draws other noise for the same sample and motion, and its radiographs are the same for all methods, to the
bit. Methods that do not look at interrupted scans are not handed any.
"""

from __future__ import annotations

import functools
import inspect
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pdvc.digest import digest, software, source_of
from pdvc.experiment import Experiment
from pdvc.lock import held
from pdvc.measurement import Measurement
from pdvc.progress import Progress, silent
from pdvc.settings import SettingsError
from simulator.clean import clean_file
from simulator.scenario import Scenario
from simulator.stacks import stacks_of
from validation.batch.engine import Part, Result, Scalar, collected, run_trials
from validation.batch.machine import machine
from validation.batch.trial import clean_parts, flattened, score_columns, simulated
from validation.compare.page import write_comparison
from validation.compare.paired import errors_of, summarised
from validation.methods.cost import cost_of_projections, cost_of_stack, cost_of_volumes
from validation.methods.registry import LooksAt, Method, find_method
from validation.scoring.scores import score

SCANS = 6
"""Interrupted scans that a scenario without any gets where a method needs some."""


@dataclass(frozen=True, kw_only=True)
class MethodRun:
    """A scenario and the name of the method that is to measure it; a `validation.batch.engine.Run`."""

    scenario: Scenario
    method: str

    @cached_property
    def key(self) -> str:
        """Return a digest of all that the result depends on: scenario, method, its file, and software."""
        return digest(
            self.scenario.model_dump_json(exclude={"name", "title", "material"}),
            *(clean_file(self.scenario, stack) for stack in stacks_of(self.scenario)),
            self.method,
            _source(find_method(self.method)),
            software("pdvc", "simulator", "validation"),
        )

    @property
    def columns(self) -> Mapping[str, Scalar]:
        """Return what says which run this is."""
        scenario = self.scenario
        return {
            "scenario": scenario.name,
            "method": self.method,
            "seed": scenario.seed,
            "repetition": scenario.repetition,
        }

    @property
    def score_columns(self) -> Mapping[str, type]:
        """Return names and types of what `carry_out` finds."""
        return {
            **score_columns(),
            "steps_measured": int,
            "radiographs": int,
            "scanner_minutes": float,
            "reference_radiographs": int,
            "reference_minutes": float,
            "seconds_method": float,
        }

    def parts(self) -> tuple[Part, ...]:
        """Return what other runs may share: the clean stacks."""
        return clean_parts(self.scenario)

    def carry_out(self, shared: Path) -> Result:
        """Simulate, measure and score; raises ValueError where that cannot be done."""
        method = find_method(self.method)
        with simulated(self.scenario, shared) as (experiment, truth, simulate_s):
            started = time.perf_counter()
            measurement = method.measure(experiment)
            took = time.perf_counter() - started
            if not isinstance(measurement, Measurement):
                raise ValueError(
                    f"method {method.name!r}: expected it to return a Measurement, got {type(measurement).__name__}"
                )
            errors = errors_of(measurement, truth, spacing_mm=gauge_mm(self.scenario))
            scores = flattened(score(measurement, truth, simulate_s=simulate_s))
            costs = _costs(experiment, method.looks_at)
        return Result(
            scores={
                **scores,
                "steps_measured": int(errors.steps.sum()),
                **costs,
                # compiling happens once for each process, whichever method comes first
                "seconds_method": took - measurement.provenance.seconds.get("compile", 0.0),
            },
            arrays={"points": errors.points, "strain": errors.strain},
        )


def _costs(experiment: Experiment, looks_at: LooksAt) -> dict[str, Scalar]:
    cost = cost_of_volumes(experiment) if looks_at == "volumes" else cost_of_projections(experiment)
    reference = cost_of_stack(experiment.reference)
    return {
        "radiographs": cost.radiographs,
        "scanner_minutes": cost.minutes,
        "reference_radiographs": reference.radiographs,
        "reference_minutes": reference.minutes,
    }


def _source(method: Method) -> str:
    """Return the text of the file that holds a method: a method that is being worked on is run anew."""
    measure, given = method.measure, []
    while isinstance(measure, functools.partial):
        given.append(repr((measure.args, measure.keywords)))
        measure = measure.func
    function: Any = measure if inspect.isroutine(measure) else type(measure)
    return "\n".join([source_of(function), *given])


GAUGES = 14
"""Lengths into which the used height is divided for strains: the spacing of 15 sections."""


def gauge_mm(scenario: Scenario) -> float:
    """Return the length over which strains are compared, mm: the same whatever a method's sections."""
    return 2 * scenario.view_mm / GAUGES


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What is asked for; raises SettingsError where a name is given twice, or none at all."""

    scenarios: tuple[Scenario, ...]
    methods: tuple[Method, ...]
    repetitions: int

    def __post_init__(self) -> None:
        for what, names in (
            ("scenarios", [scenario.name for scenario in self.scenarios]),
            ("methods", [method.name for method in self.methods]),
        ):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice or not names:
                raise SettingsError(f"{what}: expected some, each of another name, given {', '.join(names) or 'none'}")

    def check(self) -> None:
        """Raise MethodError where a method cannot be used here, before any work is done."""
        for method in self.methods:
            method.check()

    def notes(self) -> dict[str, str]:
        """Return what was added to scenarios, a sentence by the scenario's name."""
        if not any(method.looks_at == "volumes" for method in self.methods):
            return {}
        scans = {
            each.name: with_scans(each).interrupted.steps for each in self.scenarios if not each.interrupted.steps
        }
        return {
            name: f"It has no interrupted scans; {len(steps)} were added, at steps {', '.join(map(str, steps))}."
            for name, steps in scans.items()
        }

    def runs(self) -> list[MethodRun]:
        """Return all runs; scans are added to scenarios where they are needed, and dropped where they are not."""
        return [
            MethodRun(
                scenario=_for_method(scenario, method).model_copy(update={"repetition": repetition}),
                method=method.name,
            )
            for scenario in self.scenarios
            for repetition in range(self.repetitions)
            for method in self.methods
        ]


def _for_method(scenario: Scenario, method: Method) -> Scenario:
    if method.looks_at == "volumes":
        return with_scans(scenario)
    return scenario.model_copy(update={"interrupted": scenario.interrupted.model_copy(update={"steps": ()})})


def with_scans(scenario: Scenario) -> Scenario:
    """Return the scenario with interrupted scans: its own, or else a few spread over the loading."""
    if scenario.interrupted.steps:
        return scenario
    last = scenario.acquisition.test_steps - 1
    first = min(scenario.loading.plateau_steps, last)
    steps = {first + math.ceil((last - first) * part / SCANS) for part in range(1, SCANS + 1)}
    interrupted = scenario.interrupted.model_copy(update={"steps": tuple(sorted(steps))})
    return scenario.model_copy(update={"interrupted": interrupted})


def compare(
    comparison: Comparison,
    folder: Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Progress = silent,
) -> Path:
    """Carry out what the folder does not hold yet, and write tables, figures and page; returns the page's path.

    A method that fails is a row with its reason. `scheduler` and `workers` as in `validation.batch.engine.run_trials`.
    """
    runs = comparison.runs()
    with held(folder):
        run_trials(runs, folder, scheduler=scheduler, workers=workers, progress=progress)
        rows: Sequence[Mapping[str, Scalar]] = collected(runs, folder).to_pylist()
        return write_comparison(
            folder,
            comparison.scenarios,
            comparison.methods,
            summarised(rows, folder),
            comparison.notes(),
            machine(scheduler, workers),
        )
