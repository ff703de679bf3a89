"""What a method asks of the machine: radiographs, and minutes of scanner time.

Counted are the radiographs that a method looks at and the time in which they were taken: for a stack, their number
times the mean time from one to the next. Flats and darks, which all methods share, are left out, and so is what the
loading takes between interrupted scans: nothing recorded tells it.
"""

from __future__ import annotations

from dataclasses import dataclass

from pdvc.experiment import Experiment, Series


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a method used."""

    radiographs: int
    minutes: float
    """Scanner time, min."""

    def __add__(self, other: Cost) -> Cost:
        return Cost(radiographs=self.radiographs + other.radiographs, minutes=self.minutes + other.minutes)


def cost_of_projections(experiment: Experiment) -> Cost:
    """Return the cost of a measurement by projections: the reference scan, and a radiograph for each step."""
    return cost_of_stack(experiment.reference) + cost_of_stack(experiment.test)


def cost_of_volumes(experiment: Experiment) -> Cost:
    """Return the cost of volume correlation: the reference scan, and a full scan at each interruption."""
    return sum((cost_of_stack(scan.series) for scan in experiment.interrupted), cost_of_stack(experiment.reference))


def cost_of_stack(series: Series) -> Cost:
    """Return the cost of one stack; a single radiograph has no recorded duration, and counts zero minutes."""
    count = len(series)
    if count == 1:
        return Cost(radiographs=1, minutes=0.0)
    interval_s = float(series.time_s[-1] - series.time_s[0]) / (count - 1)
    return Cost(radiographs=count, minutes=count * interval_s / 60)
