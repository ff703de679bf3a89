"""What the lines of a record tell together: where the test is, and whether radiographs still come."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

from pdvc.radiograph_table import TABLE
from pdvc.record import AlarmLine, Line, LostLine, MeasurementLine, PlanLine, StepLine

HALF_95 = 1.96
"""Half of a 95 % interval, in standard deviations."""
LATE, LEAST_LATE_S = 3.0, 2.0
"""Usual times between radiographs without one, from which on they are late; and no less than so many seconds."""


@dataclass(frozen=True, kw_only=True)
class State:
    """A test, as far as its record goes."""

    plan: PlanLine
    steps: tuple[StepLine, ...] = ()
    """In the order in which they were told."""
    alarms: tuple[AlarmLine, ...] = ()
    lost: tuple[LostLine, ...] = ()
    measurement: MeasurementLine | None = None

    @classmethod
    def of(cls, lines: Iterable[Line]) -> Self:
        """Return what the lines of a record tell; raises ValueError where they do not begin with a plan."""
        plan, *others = lines
        if not isinstance(plan, PlanLine):
            raise ValueError(f"record: expected a plan first, found {plan.what}")
        return cls(
            plan=plan,
            steps=tuple(line for line in others if isinstance(line, StepLine)),
            alarms=tuple(line for line in others if isinstance(line, AlarmLine)),
            lost=tuple(line for line in others if isinstance(line, LostLine)),
            measurement=next((line for line in others if isinstance(line, MeasurementLine)), None),
        )

    @property
    def newest(self) -> StepLine | None:
        """Return the line of the largest step: a radiograph that came late is not the newest."""
        return max(self.steps, key=lambda line: line.step, default=None)

    @property
    def length_mm(self) -> float:
        """Return the length between the first section and the last."""
        return self.plan.height_mm[-1] - self.plan.height_mm[0]

    @property
    def complete(self) -> bool:
        """Return whether each planned radiograph has come or was lost."""
        # a right line may follow a wrong one of the table
        gone = {line.step for line in self.steps} | {line.step for line in self.lost if line.file != TABLE}
        return len(gone) >= self.plan.steps

    @property
    def interval_s(self) -> float:
        """Return the usual time between two radiographs; NaN before there are three."""
        heard = [line.unix_s for line in self.steps[-10:]]
        gaps = [after - before for before, after in pairwise(heard)]
        return statistics.median(gaps) if len(gaps) > 1 else math.nan

    def condition(self, now_s: float) -> str:
        """Return in words how the test is at a time, s since 1970."""
        if self.measurement is not None:
            return f"test over: measurement in {self.measurement.file}"
        if not self.steps:
            return "waiting for the first radiograph"
        if self.complete:
            return "all radiographs are in: the whole test is being measured"
        usual = self.interval_s
        if math.isfinite(usual) and now_s - self.steps[-1].unix_s > max(LEAST_LATE_S, LATE * usual):
            return "no new radiograph for a while"
        return "following"
