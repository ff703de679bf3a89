"""The paper's claim by number: two orders of magnitude less time on the machine than full scans take.

What is compared is what one measured step costs, radiographs and minutes of scanner time, by three definitions:

1. each further step: what is added to the reference scan, over the measured steps. One radiograph against a scan.
2. as carried out: everything, the reference scan included, over the measured steps of each method.
3. step for step: everything, had both measured the same steps, as many as the radiographs have.

Loading, and what it takes to stop and start it, is in none of them.
"""

from __future__ import annotations

from dataclasses import dataclass

from validation.compare.paired import MethodScores

CLAIM = 100
"""Two orders of magnitude."""


@dataclass(frozen=True, kw_only=True)
class PerStep:
    """What one measured step costs."""

    radiographs: float
    minutes: float


@dataclass(frozen=True, kw_only=True)
class Gain:
    """The cost of a step by radiographs of the test, and by full scans."""

    definition: str
    projections: PerStep
    volumes: PerStep

    @property
    def radiographs(self) -> float:
        """Return how many times more radiographs a step by full scans takes."""
        return self.volumes.radiographs / self.projections.radiographs

    @property
    def minutes(self) -> float:
        """Return how many times more scanner time a step by full scans takes."""
        return self.volumes.minutes / self.projections.minutes

    @property
    def holds(self) -> bool:
        """Return whether the scanner time differs by two orders of magnitude."""
        return self.minutes >= CLAIM


def gains(projections: MethodScores, volumes: MethodScores) -> tuple[Gain, ...]:
    """Return the gain by each definition, from a method that looks at radiographs and one that looks at scans."""
    further = _further(projections), _further(volumes)
    every = projections.measured
    return (
        Gain(definition="each further step", projections=further[0], volumes=further[1]),
        Gain(definition="as carried out", projections=_all(projections), volumes=_all(volumes)),
        Gain(
            definition=f"step for step, {every} steps",
            projections=_all(projections),
            volumes=PerStep(
                radiographs=volumes.reference_radiographs / every + further[1].radiographs,
                minutes=volumes.reference_minutes / every + further[1].minutes,
            ),
        ),
    )


def _further(scores: MethodScores) -> PerStep:
    return PerStep(
        radiographs=(scores.radiographs - scores.reference_radiographs) / scores.measured,
        minutes=(scores.minutes - scores.reference_minutes) / scores.measured,
    )


def _all(scores: MethodScores) -> PerStep:
    return PerStep(radiographs=scores.radiographs / scores.measured, minutes=scores.minutes / scores.measured)
