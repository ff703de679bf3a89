"""Errors of several methods on the same data, where all of them measured, and their differences.

A method that measures a few steps cannot be compared with one that measures all of them by the rms over each one's own
steps: errors grow with the load. So every error is also taken over the material points and steps that all methods
measured in that repetition, and differences are taken between the same repetitions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.measurement import Measurement
from validation.batch.doubts import counted
from validation.batch.engine import ERRORS, Scalar
from validation.scoring.bootstrap import Estimate, bootstrapped, mean, rms
from validation.scoring.centre_line import TruePoints, centre_line
from validation.scoring.scores import point_errors

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

QUANTITIES = ("across_beam", "vertical", "along_beam", "strain")
"""Whose rms errors are compared: three displacements in voxels, and a strain without unit."""


@dataclass(frozen=True, kw_only=True)
class FieldErrors:
    """The errors of one measurement; NaN where it did not measure."""

    points: NDArray[np.float32]
    """(step, point, direction): across the beam, vertical, along the beam, voxels."""
    strain: NDArray[np.float32]
    """(step, interval) of material levels on the axis."""

    @property
    def known(self) -> tuple[Mask, Mask]:
        """Return where there is a number: points (step, point), strain (step, interval)."""
        return np.asarray(np.isfinite(self.points).all(axis=2)), np.isfinite(self.strain)

    @property
    def steps(self) -> Mask:
        """Return the steps (step,) at which any point was measured."""
        return np.asarray(self.known[0].any(axis=1))

    def rms(self, where: tuple[Mask, Mask]) -> Floats:
        """Return the rms errors (quantity,) over some points and intervals; NaN where there are none."""
        points, strain = where
        return np.array([*_rms(self.points[points]), *_rms(self.strain[strain][:, None])])

    def by_step(self) -> Floats:
        """Return the rms errors (step, quantity)."""
        points, strain = self.known
        rows = []
        for step in range(len(self.points)):
            here = points & False, strain & False
            here[0][step], here[1][step] = points[step], strain[step]
            rows.append(self.rms(here))
        return np.stack(rows)


def _rms(values: NDArray[np.float32]) -> Floats:
    """Return the rms over the first axis."""
    if not len(values):
        return np.full(values.shape[1], math.nan)
    return np.asarray(np.sqrt((values.astype(np.float64) ** 2).mean(axis=0)))


def errors_of(measurement: Measurement, truth: TruePoints, *, spacing_mm: float) -> FieldErrors:
    """Return the errors of a measurement, of strain between material levels about `spacing_mm` apart."""
    centre = centre_line(measurement, truth, spacing_mm=spacing_mm)
    assert centre.true is not None
    return FieldErrors(
        points=point_errors(measurement, truth).components.astype(np.float32),
        strain=(centre.strain(centre.measured) - centre.strain(centre.true)).astype(np.float32),
    )


def where_all(several: Sequence[FieldErrors]) -> tuple[Mask, Mask]:
    """Return the points and intervals that all measurements know."""
    points, strain = zip(*(each.known for each in several), strict=True)
    return np.logical_and.reduce(points), np.logical_and.reduce(strain)


@dataclass(frozen=True, kw_only=True)
class MethodScores:
    """What one method did in one scenario, over the repetitions."""

    scenario: str
    method: str
    done: int
    """Repetitions measured."""
    failed: int
    reason: str
    """Why the first one failed, if any."""
    doubted: int
    """Repetitions whose own verdict is not `trusted`."""
    doubts: str
    """What speaks against them, and how often."""
    steps: int
    """Steps of the test."""
    measured: int
    """Steps that the method measured."""
    common: int
    """Steps that all methods measured."""
    radiographs: int
    """All that the method looked at, the reference scan included."""
    minutes: float
    """Scanner time in which these were taken, min."""
    reference_radiographs: int
    reference_minutes: float
    seconds: Estimate
    """Computing time on one thread, reconstruction included, s."""
    error: Mapping[str, Estimate]
    """Rms errors, by quantity, over the points and steps that all methods measured."""
    own_error: Mapping[str, Estimate]
    """Rms errors over all that the method measured."""

    @property
    def minutes_per_step(self) -> float:
        """Return the scanner time for each measured step, the reference scan included, min."""
        return self.minutes / self.measured if self.measured else math.nan


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How much larger one method's errors are than another's, over the repetitions that both measured."""

    scenario: str
    method: str
    other: str
    error: Mapping[str, Estimate]
    """Mean difference of rms errors, by quantity, over what all methods measured."""


@dataclass(frozen=True, kw_only=True)
class StepErrors:
    """One method's rms errors at each step, over the repetitions."""

    scenario: str
    method: str
    error: Floats
    """(step, quantity)"""


@dataclass(frozen=True, kw_only=True)
class Summary:
    """What a comparison found."""

    methods: tuple[MethodScores, ...]
    differences: tuple[Difference, ...]
    by_step: tuple[StepErrors, ...]


def summarised(rows: Sequence[Mapping[str, Scalar]], folder: Path) -> Summary:
    """Summarise the rows of a comparison, in their order; the errors are read from the folder of the runs."""
    scenarios = list(dict.fromkeys(str(row["scenario"]) for row in rows))
    methods: list[MethodScores] = []
    differences: list[Difference] = []
    by_step: list[StepErrors] = []
    for scenario in scenarios:
        group = _Group([row for row in rows if row["scenario"] == scenario], folder)
        names = list(dict.fromkeys(str(row["method"]) for row in group.rows))
        methods += [_scores(scenario, name, group) for name in names]
        able = [name for name in names if group.repetitions_of(name)]
        differences += [_difference(scenario, *pair, group) for pair in combinations(able, 2)]
        by_step += [StepErrors(scenario=scenario, method=name, error=group.by_step(name)) for name in able]
    return Summary(methods=tuple(methods), differences=tuple(differences), by_step=tuple(by_step))


class _Group:
    """The runs of one scenario, and their errors over what all methods of each repetition measured."""

    def __init__(self, rows: Sequence[Mapping[str, Scalar]], folder: Path) -> None:
        self.rows = rows
        self._errors = {
            (str(row["method"]), int(str(row["repetition"]))): _read_errors(folder, str(row["key"]))
            for row in rows
            if row["status"] == "done"
        }
        self._where = {
            repetition: where_all([errors for (_, r), errors in self._errors.items() if r == repetition])
            for repetition in {r for _, r in self._errors}
        }

    @property
    def common_steps(self) -> int:
        """Return the number of steps at which all methods measured points, in all repetitions."""
        if not self._where:
            return 0
        return int(np.logical_and.reduce([points.any(axis=1) for points, _ in self._where.values()]).sum())

    def repetitions_of(self, method: str) -> list[int]:
        """Return the repetitions that a method measured."""
        return sorted(repetition for name, repetition in self._errors if name == method)

    def common(self, method: str, repetition: int) -> Floats:
        """Return the rms errors (quantity,) over what all methods measured."""
        return self._errors[method, repetition].rms(self._where[repetition])

    def own(self, method: str, repetition: int) -> Floats:
        """Return the rms errors (quantity,) over what the method measured."""
        errors = self._errors[method, repetition]
        return errors.rms(errors.known)

    def by_step(self, method: str) -> Floats:
        """Return the rms errors (step, quantity) over the repetitions."""
        each = np.stack([self._errors[method, repetition].by_step() for repetition in self.repetitions_of(method)])
        return rms(np.moveaxis(each, 0, -1))


def _read_errors(folder: Path, key: str) -> FieldErrors:
    with np.load(folder / ERRORS / f"{key}.npz") as kept:
        return FieldErrors(points=kept["points"], strain=kept["strain"])


def _scores(scenario: str, method: str, group: _Group) -> MethodScores:
    rows = [row for row in group.rows if row["method"] == method]
    done = [row for row in rows if row["status"] == "done"]
    failed = [row for row in rows if row["status"] != "done"]
    repetitions = group.repetitions_of(method)

    def middle(name: str) -> float:
        # costs do not change from one repetition to the next; what a method measures may
        return float(np.median([_number(row, name) for row in done])) if done else 0.0

    return MethodScores(
        scenario=scenario,
        method=method,
        done=len(done),
        failed=len(failed),
        reason=str(failed[0]["reason"]) if failed else "",
        doubted=sum(row["verdict"] != "trusted" for row in done),
        doubts=counted(str(row["doubts"]) for row in done),
        steps=int(middle("steps")),
        measured=int(middle("steps_measured")),
        common=group.common_steps,
        radiographs=int(middle("radiographs")),
        minutes=middle("scanner_minutes"),
        reference_radiographs=int(middle("reference_radiographs")),
        reference_minutes=middle("reference_minutes"),
        seconds=bootstrapped([_number(row, "seconds_method") for row in done]),
        error=_estimates([group.common(method, each) for each in repetitions], rms),
        own_error=_estimates([group.own(method, each) for each in repetitions], rms),
    )


def _difference(scenario: str, method: str, other: str, group: _Group) -> Difference:
    both = sorted(set(group.repetitions_of(method)) & set(group.repetitions_of(other)))
    values = [group.common(method, each) - group.common(other, each) for each in both]
    return Difference(scenario=scenario, method=method, other=other, error=_estimates(values, mean))


def _estimates(values: Sequence[Floats], statistic: Callable[[Floats], Floats]) -> dict[str, Estimate]:
    """Return estimates by quantity, from values (quantity,) of each repetition."""
    columns = np.array(values, dtype=float).reshape(-1, len(QUANTITIES)).T
    return {name: bootstrapped(column, statistic) for name, column in zip(QUANTITIES, columns, strict=True)}


def _number(row: Mapping[str, Scalar], name: str) -> float:
    value = row[name]
    assert isinstance(value, int | float), f"{name} of a run that is done"
    return float(value)
