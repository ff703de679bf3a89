"""One trial of a study: an experiment simulated, measured and scored, and what it shares with others.

Trials share through a folder, by content:

- ``clean/``: noise-free radiographs (`simulator.clean`), for all trials that differ in noise or in how they measure;
- ``bounds/``: the Cramer-Rao bound (`validation.scoring.bound`), for all repetitions;
- ``volumes-KEY/``: outline and reconstructed volumes, for all trials with the same reference scan, counts and all,
  whose options ask for the same scales and the same beam hardening. (Measurements also leave the modes they found
  there, a few kB each.)

At the size of `quick` a pair of clean stacks takes 28 MB and a set of volumes 3 MB; at the paper's size 1.2 GB and
0.2 GB. The experiment itself, counts and truth, is simulated into a folder of its own and removed after the
measurement. `validation.batch.engine` says when shared things are removed.
"""

from __future__ import annotations

import math
import shutil
import tempfile
import time
import types
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import Quantities
from pdvc.digest import digest, software
from pdvc.experiment import Experiment, read_experiment
from pdvc.measurement import Measurement
from pdvc.options import MeasureOptions
from pdvc.preparation import keep_volumes, volume_choices
from pdvc.protocol import measure
from simulator.clean import clean_file, clean_stack
from simulator.scanner import simulate
from simulator.scenario import Scenario
from simulator.stacks import Stack, stacks_of
from simulator.truth import Truth, read_truth
from validation.batch.engine import Part, Result, Scalar
from validation.scoring.bound import kept_bound
from validation.scoring.centre_line import centre_line
from validation.scoring.resolution import Recovery, recovery, strain_profile
from validation.scoring.scores import Scores, point_errors, score

CLEAN = "clean"
BOUND_COLUMNS = {
    each.name: f"bound_{each.name}" if each.name == "strain" else f"bound_voxel_{each.name}"
    for each in fields(Quantities)
}
"""The column of each part of the bound."""
RECOVERY_COLUMNS = tuple(each.name for each in fields(Recovery))
"""Of the amplitude of a strain sinusoidal in height; NaN where a scenario has none."""
PROFILE = "profile"
"""Array of a run with such a strain: the measured strain (step, interval) of `validation.scoring.resolution`."""
_NOT_SCORES = ("scenario", "peak_memory_gib")
"""Fields of `Scores` that a row has elsewhere, or that belong to a process which does many runs."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A scenario and how it is to be measured; a `validation.batch.engine.Run`."""

    scenario: Scenario
    options: MeasureOptions
    factors: Mapping[str, Scalar]
    """What a study varies, by the names of its columns."""

    @cached_property
    def key(self) -> str:
        """Return a digest of all that the result depends on: scenario, options and software; not names and factors."""
        return digest(
            self.scenario.model_dump_json(exclude={"name", "title", "material"}),
            # a spectrum may be a file: its content counts, not its name
            clean_file(self.scenario, Stack("reference")),
            self.options,
            self.options.motions,
            software("pdvc", "simulator", "validation"),
        )

    @property
    def columns(self) -> Mapping[str, Scalar]:
        """Return what says which run this is."""
        return {**self.factors, "seed": self.scenario.seed, "repetition": self.scenario.repetition}

    @property
    def score_columns(self) -> Mapping[str, type]:
        """Return names and types of what `carry_out` finds."""
        return {**score_columns(), **dict.fromkeys((*BOUND_COLUMNS.values(), *RECOVERY_COLUMNS), float)}

    def parts(self) -> tuple[Part, ...]:
        """Return what other trials may share: clean stacks, volumes, and the bound of the scenario."""
        return (
            *clean_parts(self.scenario),
            Volumes(self.scenario, self.options),
            LeastError(self.scenario, self.options),
        )

    def carry_out(self, shared: Path) -> Result:
        """Simulate, measure and score; raises ValueError where that cannot be done."""
        with simulated(self.scenario, shared) as (experiment, truth, simulate_s):
            work = shared / Volumes(self.scenario, self.options).name
            measurement = measure(experiment, self.options, work=work)
            result = with_wave(result_of(measurement, truth, simulate_s=simulate_s), measurement, truth, self.scenario)
        least = asdict(LeastError(self.scenario, self.options).read(shared))
        return replace(result, scores={**result.scores, **{BOUND_COLUMNS[name]: least[name] for name in least}})


@dataclass(frozen=True)
class CleanStack:
    """A noise-free stack in the shared folder; a `validation.batch.engine.Part`."""

    scenario: Scenario
    stack: Stack

    @cached_property
    def name(self) -> str:
        """Return its file in the shared folder."""
        return f"{CLEAN}/{clean_file(self.scenario, self.stack)}"

    def needs(self) -> tuple[Part, ...]:
        """Return nothing."""
        return ()

    def make(self, shared: Path) -> None:
        """Compute it unless it is there."""
        clean_stack(self.scenario, self.stack, shared / CLEAN, workers=1)


@dataclass(frozen=True)
class Volumes:
    """The outline and volumes of a reference scan in the shared folder; a `validation.batch.engine.Part`."""

    scenario: Scenario
    options: MeasureOptions

    @cached_property
    def name(self) -> str:
        """Return their folder in the shared folder: a digest of the counts' origin, and of the options that matter."""
        scenario = self.scenario
        key = digest(
            clean_file(scenario, Stack("reference")),
            scenario.detector,
            (scenario.repetition, scenario.loading.plateau_N, scenario.acquisition.force_noise_N),
            volume_choices(self.options, scenario.geometry.cone_beam()),
        )
        return f"volumes-{key}"

    def needs(self) -> tuple[Part, ...]:
        """Return the clean stacks from which the counts are made."""
        return clean_parts(self.scenario)

    def make(self, shared: Path) -> None:
        """Simulate the reference scan, reconstruct it and keep the volumes, unless they are there."""
        with simulated(self.scenario, shared) as (experiment, _, _):
            keep_volumes(experiment, self.options, shared / self.name)


_HOW_TO_SOLVE = {"rigid", "deformation", "weighting", "smooth_px", "subtract_systematic"}


@dataclass(frozen=True)
class LeastError:
    """The bound of a scenario in the shared folder; a `validation.batch.engine.Part`."""

    scenario: Scenario
    options: MeasureOptions

    @cached_property
    def name(self) -> str:
        """Return its file: a digest of the clean stacks, the detector, and the options on which unknowns depend."""
        key = digest(
            *(part.name for part in clean_parts(self.scenario)),
            self.scenario.detector,
            {
                name: getattr(self.options, name)
                for name in type(self.options).model_fields
                if name not in _HOW_TO_SOLVE
            },
            self.options.motions,
            software("pdvc", "simulator", "validation"),
        )
        return f"bounds/{key}.json"

    def needs(self) -> tuple[Part, ...]:
        """Return the clean stacks."""
        return clean_parts(self.scenario)

    def make(self, shared: Path) -> None:
        """Compute it unless it is there."""
        self.read(shared)

    def read(self, shared: Path) -> Quantities:
        """Return the bound."""
        return kept_bound(self.scenario, self.options, shared / self.name, shared / CLEAN)


def clean_parts(scenario: Scenario) -> tuple[CleanStack, ...]:
    """Return the noise-free stacks of a scenario."""
    return tuple(CleanStack(scenario, stack) for stack in stacks_of(scenario))


@contextmanager
def simulated(scenario: Scenario, shared: Path) -> Iterator[tuple[Experiment, Truth, float]]:
    """Simulate with the clean stacks of the shared folder; yield experiment, truth and the time it took, s.

    The experiment's files are removed at the end.
    """
    started = time.perf_counter()
    shared.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="experiment-", dir=shared))
    try:
        simulate(scenario, folder, workers=1, clean=shared / CLEAN)
        yield read_experiment(folder), read_truth(folder), time.perf_counter() - started
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def result_of(measurement: Measurement, truth: Truth, *, simulate_s: float = math.nan) -> Result:
    """Score a measurement: one row of scores, and the errors themselves for means over repetitions."""
    scores = score(measurement, truth, simulate_s=simulate_s)
    return Result(scores=flattened(scores), arrays=compact_errors(measurement, truth))


def with_wave(result: Result, measurement: Measurement, truth: Truth, scenario: Scenario) -> Result:
    """Return the result with what was recovered of a scenario's `ripple`, and the profile that tells the noise."""
    if "ripple" not in scenario.motion.ingredients:
        return replace(result, scores={**result.scores, **dict.fromkeys(RECOVERY_COLUMNS, math.nan)})
    profile = strain_profile(measurement, truth)
    found = recovery(profile, measurement, truth, scenario.motion.ripple.wavelength_mm)
    arrays = {**result.arrays, PROFILE: profile.measured.astype(np.float32)}
    return Result(scores={**result.scores, **asdict(found)}, arrays=arrays)


def compact_errors(measurement: Measurement, truth: Truth) -> dict[str, NDArray[np.float32]]:
    """Return the errors at material points at heights about a section apart, and of the strain between them.

    ``points`` (step, point, direction): across the beam, vertical, along the beam, voxels, at five points for each
    height; ``strain`` (step, interval), on the axis. NaN where a point is not scored.
    """
    centre = centre_line(measurement, truth)
    assert centre.true is not None
    chosen = np.isclose(truth.point_mm[:, 2:], centre.level_mm).any(axis=1)
    some = replace(truth, point_mm=truth.point_mm[chosen], displacement_mm=truth.displacement_mm[:, chosen])
    return {
        "points": point_errors(measurement, some).components.astype(np.float32),
        "strain": (centre.strain(centre.measured) - centre.strain(centre.true)).astype(np.float32),
    }


def score_columns() -> dict[str, type]:
    """Return the columns that `flattened` makes of `Scores`, with their types."""
    return dict(_columns(Scores, ""))


def flattened(scores: Scores) -> dict[str, Scalar]:
    """Return the scores as scalars: parts of a part join its name, as in ``error_voxel_across_beam``."""
    return dict(_flat({name: value for name, value in asdict(scores).items() if name not in _NOT_SCORES}, ""))


def _flat(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Scalar]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}_")
        else:
            yield prefix + name, value


def _columns(record: Any, prefix: str) -> Iterator[tuple[str, type]]:
    for name, kind in typing.get_type_hints(record).items():
        if name in _NOT_SCORES and not prefix:
            continue
        if isinstance(kind, types.UnionType):  # a number that may be missing
            (kind,) = (part for part in kind.__args__ if part is not types.NoneType)
        if is_dataclass(kind):
            yield from _columns(kind, f"{prefix}{name}_")
        elif kind in (bool, int, float, str):
            yield prefix + name, kind
        else:
            raise TypeError(f"Scores.{prefix}{name}: expected a number, a text or a record of these, got {kind}")
