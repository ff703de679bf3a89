"""The stacks of radiographs that a scenario makes with the sample in the beam, and each of their images."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simulator.detector import DetectorMaps, record
from simulator.images import Clear, Scanner, clear_image
from simulator.radiography import Body
from simulator.sample import moved_body
from simulator.scenario import Scenario
from simulator.streams import stream

Image = NDArray[np.uint16]


@dataclass(frozen=True)
class Stack:
    """The name of one of the stacks of a scenario."""

    kind: Literal["reference", "test", "interrupted"]
    step: int | None = None
    """Of an interrupted scan: the step at which the test was held."""

    def __str__(self) -> str:
        return self.kind if self.step is None else f"scan at step {self.step}"


def stacks_of(scenario: Scenario) -> tuple[Stack, ...]:
    """Return the stacks of a scenario, in the order in which they are made."""
    return Stack("reference"), Stack("test"), *(Stack("interrupted", step) for step in scenario.interrupted.steps)


def image_count(scenario: Scenario, stack: Stack) -> int:
    """Return how many images a stack of a scenario has."""
    plan = scenario.acquisition
    if stack.kind == "interrupted":
        return scenario.interrupted.views or plan.reference_views
    return plan.reference_views if stack.kind == "reference" else plan.test_steps


def clear_images(scanner: Scanner, stack: Stack) -> Callable[[int], Clear]:
    """Return the function that makes an image of a stack without noise, by its number."""
    if stack.step is not None:
        return partial(_clear_held, scanner, _loaded(scanner, stack.step))
    return partial(clear_view if stack.kind == "reference" else clear_step, scanner)


def clear_view(scanner: Scanner, view: int) -> Clear:
    """Make one radiograph of the reference scan without noise: share of the open beam (row, column)."""
    angles = scanner.course.reference_angle_rad
    return clear_image(scanner, scanner.body, float(angles[view]), 2 * math.pi / len(angles))


def clear_step(scanner: Scanner, step: int) -> Clear:
    """Make one radiograph of the test without noise: share of the open beam (row, column)."""
    body = _loaded(scanner, step)
    turn = 2 * math.pi / scanner.scenario.acquisition.steps_per_turn
    return clear_image(scanner, body, float(scanner.course.test_angle_rad[step]), turn)


def _loaded(scanner: Scanner, step: int) -> Body:
    """Return the sample at a step of the test."""
    return moved_body(scanner.body, scanner.course.motion, step, scanner.scenario.crack)


def _clear_held(scanner: Scanner, held: Body, view: int) -> Clear:
    angles = scanner.course.interrupted_angle_rad
    return clear_image(scanner, held, float(angles[view]), 2 * math.pi / len(angles))


def exposed(scenario: Scenario, maps: DetectorMaps, image: Clear, stack: Stack, index: int) -> Image:
    """Take a clear image as number `index` of a stack, with its noise: counts (row, column)."""
    place = (index,) if stack.step is None else (stack.step, index)
    return record(image, scenario.detector, maps, stream(scenario, stack.kind, *place))


def view_image(scanner: Scanner, view: int) -> Image:
    """Make one radiograph of the reference scan, counts (row, column)."""
    return exposed(scanner.scenario, scanner.maps, clear_view(scanner, view), Stack("reference"), view)


def step_image(scanner: Scanner, step: int) -> Image:
    """Make one radiograph of the test, counts (row, column)."""
    return exposed(scanner.scenario, scanner.maps, clear_step(scanner, step), Stack("test"), step)
