"""Plan a test: what to expect of its own design, and of others around it.

Designs differ in radiographs a turn, turns, frames, flats and sections. The test lasts as long: more radiographs are
taken faster, and the loading is the same. `pdvc.plan` works out what is expected; `validation.plan.simulated` plans
the test of a scenario, which needs no reference scan.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.data_checks import doubts_of_reference, usable
from pdvc.deviations import Knowledge, Quantities
from pdvc.experiment import Experiment
from pdvc.history import settled
from pdvc.options import MeasureOptions
from pdvc.plan import PlannedTest, Planner, WeakMotion, weakest
from pdvc.progress import Progress, silent
from pdvc.verdict import Doubt

Floats = NDArray[np.float64]

BEFORE_VOXEL, LAST_VOXEL = 4.0, 10.0
"""How far a sample is taken to move before a test that is only planned, and during it, voxels; the paper's: more."""
INVISIBLE_VOXEL = 0.5
"""A motion that is expected to be known no better than this, voxels rms, is called invisible."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """How a test is made and measured."""

    steps_per_turn: int
    turns: float
    frames: int
    flats: int
    sections: int

    @property
    def steps(self) -> int:
        """Return the number of radiographs."""
        return round(self.steps_per_turn * self.turns)


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What is expected of a design."""

    design: Design
    deviation: Quantities
    """rms standard deviations over steps and material points, voxels; of the strain between sections, without unit"""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A test's own design, others around it, and what would stay invisible in its own."""

    own: Expected
    others: tuple[Expected, ...]
    doubts: tuple[Doubt, ...] = ()
    """What speaks against the reference scan; of a simulated one nothing does."""
    weak: tuple[WeakMotion, ...]
    """The weakest motions, the weakest first."""

    @property
    def invisible(self) -> tuple[WeakMotion, ...]:
        """Return the weak motions that are expected to be known to no better than half a voxel."""
        return tuple(each for each in self.weak if np.linalg.norm(each.deviation_voxel) > INVISIBLE_VOXEL)


def designs_around(own: Design) -> tuple[Design, ...]:
    """Return designs that differ from one in one thing at a time."""
    others = [
        *(replace(own, steps_per_turn=max(round(own.steps_per_turn * f), 3)) for f in (0.25, 0.5, 2, 4)),
        *(
            replace(own, turns=own.turns * f, steps_per_turn=max(round(own.steps_per_turn / f), 3))
            for f in (0.5, 2, 4)
        ),
        *(replace(own, frames=frames) for frames in (1, 2 * own.frames, 4 * own.frames)),
        *(replace(own, flats=flats) for flats in (5 * own.flats, 25 * own.flats)),
        *(replace(own, sections=max(round(own.sections * f), 2)) for f in (0.5, 2)),
    ]
    return tuple(dict.fromkeys(other for other in others if other != own))


def plan_experiment(
    experiment: Experiment,
    options: MeasureOptions,
    designs: Sequence[Design] | None = None,
    *,
    count: int = 6,
    progress: Progress = silent,
) -> Plan:
    """Return what is expected of a test like that of an experiment, from its real reference scan.

    The course of angle and force is the experiment's, made denser, longer or shorter. How far the sample will move is
    not known: it is taken to have moved by `BEFORE_VOXEL` along each axis before the test, and to go on upwards by
    `LAST_VOXEL`. What matters is that a pixel does not see what it saw in the reference scan, or the flats' noise
    would cancel. Raises ValueError where the description does not tell the noise, or the reference
    scan cannot be used.
    """
    alone = replace(experiment, test=experiment.reference, interrupted=())
    doubts = doubts_of_reference(usable(alone, progress=progress), alone)
    # where the load begins is the same in all designs; in forces that are interpolated noise would hide it
    options = options.model_copy(update={"time": settled(options.time, experiment.test)})
    planner = Planner(experiment, options, progress=progress)
    own = design_of_experiment(experiment, options)

    def test(design: Design) -> PlannedTest:
        return planned_like(experiment, design, own)

    found = compared(planner, own, designs, test, lambda _: planner.points_mm(), count, progress)
    return replace(found, doubts=doubts)


def design_of_experiment(experiment: Experiment, options: MeasureOptions) -> Design:
    """Return the design of an experiment, by its recorded angles; a test of one step stands for a turn of one."""
    angle = np.unwrap(experiment.test.angle_rad)
    step = float(np.median(np.abs(np.diff(angle)))) if len(angle) > 1 else 2 * np.pi
    steps_per_turn = max(round(2 * np.pi / step), 1) if step > 0 else 1
    return Design(
        steps_per_turn=steps_per_turn,
        turns=len(angle) / steps_per_turn,
        frames=experiment.frames,
        flats=len(experiment.flats),
        sections=options.sections_for(experiment.geometry.rows),
    )


def planned_like(experiment: Experiment, design: Design, own: Design) -> PlannedTest:
    """Return a test as a design makes it, of the same duration and loading as an experiment's.

    With as many steps as the experiment's `own` design angles, times and forces are those recorded; with more or fewer
    they are interpolated, and with more turns the angles run faster.
    """
    test, steps = experiment.test, design.steps
    share = np.linspace(0, 1, steps)
    recorded = np.linspace(0, 1, len(test))
    angle = np.unwrap(test.angle_rad)
    voxel_mm = experiment.geometry.voxel_mm
    turned = np.interp(share, recorded, angle - angle[0]) * (design.turns / own.turns)
    return PlannedTest(
        angle_rad=angle[0] + turned,
        time_s=np.interp(share, recorded, test.time_s),
        force_N=np.interp(share, recorded, test.force_N),
        moved_mm=voxel_mm * (BEFORE_VOXEL + LAST_VOXEL * share[:, None] * np.array([0.0, 0.0, 1.0])),
        share=steps / len(test),
        sections=design.sections,
        frames=design.frames / experiment.frames,
        flats=design.flats / len(experiment.flats),
    )


def compared(
    planner: Planner,
    own: Design,
    designs: Sequence[Design] | None,
    test: Callable[[Design], PlannedTest],
    points: Callable[[Knowledge], Floats],
    count: int,
    progress: Progress,
) -> Plan:
    """Return what is expected of a design and of others, by default `designs_around` it.

    `test` makes a test of a design, `points` says at which points (point, 3), mm, deviations are taken.
    """
    others = designs_around(own) if designs is None else tuple(designs)

    def expected(known: Knowledge, design: Design) -> Expected:
        at = points(known)
        still = np.zeros((len(known.angle_rad), *at.shape))
        return Expected(design=design, deviation=known.quantities(at, still))

    of_own = planner.expected(test(own))
    found = []
    for n, design in enumerate(others):
        found.append(expected(planner.expected(test(design)), design))
        progress("designs", n + 1, len(others))
    return Plan(
        own=expected(of_own, own),
        others=tuple(found),
        weak=weakest(of_own, points(of_own), planner.prior_voxel, count),
    )
