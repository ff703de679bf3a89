"""One draw of an identification study: another texture, other noise of all images and forces, the same motion and law.

What intervals hold beside noise, as what re-projection leaves of the texture, does not differ from one draw of noise
to the next: a coverage of these alone would be that of one texture's luck. So each draw is another sample of nodules,
of the same shape.

The first one is measured in full (`First`, a part that all draws share), and tells the deviations of the processes to
start from. Each draw is made ready by itself, counts, volume, areas, pattern, noise and pass, at the motion that the
first one found: the true motion is the same, and what draws differ by is far within what is linear. Its own motion,
for the two-step methods, is one step of the smoother from there; the integrated identification seeks its process's
deviations once more, from those of the first.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.digest import digest, software
from pdvc.experiment import Experiment
from pdvc.identify.crosshead import from_crosshead
from pdvc.identify.integrated import free_motion, integrated, radiographs_at
from pdvc.identify.opening import Ready, ready
from pdvc.identify.options import IdentifyOptions
from pdvc.identify.result import CROSSHEAD, INTEGRATED, UNWEIGHTED, WEIGHTED
from pdvc.identify.two_step import LawEstimate
from pdvc.measurement import Measurement
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.options import DEFAULT
from pdvc.protocol import measure
from pdvc.smoother import Smoother
from pdvc.state_space import Deviations
from pdvc.store import read_arrays, write_arrays
from simulator.scenario import Scenario
from validation.batch.engine import Part, Result, Scalar
from validation.batch.trial import clean_parts, simulated

Floats = NDArray[np.float64]

METHODS = (INTEGRATED, WEIGHTED, UNWEIGHTED, CROSSHEAD)
_ROUNDS = 1
"""Times that a draw's deviations are sought, from those of the first."""


@dataclass(frozen=True)
class First:
    """The first draw, measured and identified in full, in the shared folder; a `validation.batch.engine.Part`."""

    scenario: Scenario
    options: IdentifyOptions

    @cached_property
    def name(self) -> str:
        """Return its folder in the shared folder: a digest of what it depends on."""
        first = self.scenario.model_copy(update={"repetition": 0})
        return f"first-{digest(first.model_dump_json(), self.options, software('pdvc', 'simulator', 'validation'))}"

    def needs(self) -> tuple[Part, ...]:
        """Return the clean stacks from which the counts are made."""
        return clean_parts(self.scenario)

    def make(self, shared: Path) -> None:
        """Simulate, measure, and find the processes with and without the law, unless that is there."""
        folder = shared / self.name
        if read_arrays(folder / "known.kept") is not None:
            return
        first = self.scenario.model_copy(update={"repetition": 0})
        with simulated(first, shared) as (experiment, _, _):
            measurement = measure(experiment, DEFAULT, work=folder)
            write_measurement(measurement, folder / "measurement.nc")
            opened = ready(experiment, measurement, self.options, work=folder)
        radiographs = radiographs_at(opened.problem, Smoother().spaces(opened.problem), opened.amplitude)
        *_, free = free_motion(radiographs)
        start = opened.two_steps(opened.amplitude, _covariances(measurement, opened))[UNWEIGHTED].vector
        found = integrated(opened.model, opened.force_N, start, radiographs)
        arrays: dict[str, NDArray[Any]] = {"vector": found.estimate.vector}
        for group, values in (("free", vars(free)), ("law", vars(found.deviations))):
            arrays |= {f"{group}:{name}": value for name, value in values.items()}
        write_arrays(folder / "known.kept", arrays)

    def read(self, shared: Path) -> tuple[Measurement, dict[str, Any]]:
        """Return its measurement, and what else was found, by groups."""
        self.make(shared)
        groups = _grouped(shared / self.name / "known.kept")
        return read_measurement(shared / self.name / "measurement.nc"), groups


@dataclass(frozen=True, kw_only=True)
class Draw:
    """One draw of a scenario whose law is identified; a `validation.batch.engine.Run`."""

    scenario: Scenario
    first: First

    @property
    def options(self) -> IdentifyOptions:
        """Return what is identified."""
        return self.first.options

    @cached_property
    def key(self) -> str:
        """Return a digest of all that the result depends on."""
        return digest(
            self.scenario.model_dump_json(exclude={"name", "title", "material"}),
            self.first.name,
            software("pdvc", "simulator", "validation"),
        )

    @property
    def columns(self) -> Mapping[str, Scalar]:
        """Return what says which run this is."""
        return {
            "scenario": self.scenario.name,
            "law": self.options.law.kind,
            "texture": self.scenario.seed,
            "repetition": self.scenario.repetition,
        }

    @property
    def score_columns(self) -> Mapping[str, type]:
        """Return names and types of the scores."""
        others = ("area_error", "share", "share_deviation", *(f"seconds_{part}" for part in (*METHODS, "ready")))
        return dict.fromkeys((*estimated(self.options.law.values()), *others), float)

    def parts(self) -> tuple[Part, ...]:
        """Return the clean stacks, and the first draw."""
        return *clean_parts(self.scenario), self.first

    def carry_out(self, shared: Path) -> Result:
        """Simulate, make ready and identify by every method; logarithms and their deviations are the scores."""
        measurement, first = self.first.read(shared)
        with simulated(self.scenario, shared) as (experiment, _, _):
            return Result(scores=self._identified(experiment, measurement, first))

    def _identified(
        self, experiment: Experiment, measurement: Measurement, first: dict[str, Any]
    ) -> dict[str, Scalar]:
        took: dict[str, float] = {}
        clock = time.perf_counter()

        def note(part: str) -> None:
            nonlocal clock
            now = time.perf_counter()
            took[part], clock = now - clock, now

        opened = ready(experiment, measurement, self.options)
        radiographs = radiographs_at(opened.problem, Smoother().spaces(opened.problem), opened.amplitude)
        note("ready")
        amplitude, covariance, _ = free_motion(radiographs, Deviations(**first["free"]))
        found: dict[str, LawEstimate] = opened.two_steps(amplitude, covariance, first["vector"])
        note(UNWEIGHTED)
        took[WEIGHTED] = took[UNWEIGHTED]
        if opened.stroke_mm is not None:
            found[CROSSHEAD] = from_crosshead(
                opened.model, opened.force_N, opened.stroke_mm, opened.loaded, first["vector"]
            )
            note(CROSSHEAD)
        known = Deviations(**first["law"])
        law = integrated(opened.model, opened.force_N, first["vector"], radiographs, known, _ROUNDS)
        found[INTEGRATED] = law.estimate
        note(INTEGRATED)
        scores: dict[str, Scalar] = {f"seconds_{part}": seconds for part, seconds in took.items()}
        for method, estimate in found.items():
            deviation = np.sqrt(np.diag(estimate.covariance))
            for k, name in enumerate(opened.model.unknowns.names[: opened.model.unknowns.of_law]):
                scores[f"{method}:{name}"] = float(estimate.vector[k])
                scores[f"{method}:{name}_deviation"] = float(deviation[k])
        scores["area_error"] = self._area_error(opened)
        scores["share"], scores["share_deviation"] = law.share
        return scores

    def _area_error(self, opened: Ready) -> float:
        """Return by what share the smallest section was found too large."""
        from simulator.specimen import area_mm2

        true = float(area_mm2(self.scenario.specimen, 0.0))
        return float(opened.model.profile.area_mm2.min() / true - 1)


def draws(scenario: Scenario, options: IdentifyOptions, count: int) -> list[Draw]:
    """Return draws of a scenario, noise and textures numbered from its own; the crosshead's rate is told."""
    told = options.model_copy(update={"stroke_mm_per_s": scenario.loading.stroke_mm_per_s})
    first = First(scenario, told)
    changes = ({"seed": scenario.seed + n, "repetition": n} for n in range(1, count + 1))
    return [Draw(scenario=scenario.model_copy(update=each), first=first) for each in changes]


def estimated(names: Iterable[str]) -> tuple[str, ...]:
    """Return the columns of what every method makes of a law's parameters: logarithms, and their deviations."""
    return tuple(f"{method}:{name}{what}" for method in METHODS for name in names for what in ("", "_deviation"))


def _grouped(path: Path) -> dict[str, Any]:
    """Return kept arrays, those named ``group:name`` by groups."""
    kept = read_arrays(path)
    assert kept is not None, "it was made"
    groups: dict[str, Any] = {}
    for name, value in kept.items():
        group, _, rest = name.partition(":")
        if rest:
            groups.setdefault(group, {})[rest] = value
        else:
            groups[name] = value
    return groups


def _covariances(measurement: Measurement, opened: Ready) -> Floats:
    return np.stack([measurement.motion.step_covariance(t) for t in range(len(opened.force_N))])
