"""The stacks of radiographs that a scenario makes with the sample in the beam, and each of their images."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from simulator.alignment import Moment
from simulator.detector import Conditions, DetectorMaps, record
from simulator.images import Clear, Scanner, clear_image
from simulator.lag import Late
from simulator.radiography import Body
from simulator.sample import moved_body
from simulator.scenario import Scenario
from simulator.streams import stream

Image = NDArray[np.uint16]
Kind = Literal["reference", "test", "interrupted"]


@dataclass(frozen=True)
class Stack:
    """The name of one of the stacks of a scenario."""

    kind: Kind
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


def image_s(scenario: Scenario, stack: Stack) -> float:
    """Return the time from one image of a stack to the next, s."""
    plan = scenario.acquisition
    if stack.kind == "interrupted":
        return scenario.interrupted.view_s or plan.reference_view_s
    return plan.reference_view_s if stack.kind == "reference" else plan.step_s


def clock_s(scenario: Scenario, stack: Stack, index: int) -> float:
    """Return when an image is taken, s since the flats, which the reference scan and then the test follow at once.

    The test's own clock stands still during an interrupted scan, this one goes on.
    """
    here = image_s(scenario, stack) * index
    if stack.kind == "reference":
        return here
    start = image_count(scenario, Stack("reference")) * image_s(scenario, Stack("reference"))
    step = index if stack.step is None else stack.step
    for held in (Stack("interrupted", each) for each in scenario.interrupted.steps if each < step):
        start += image_count(scenario, held) * image_s(scenario, held)
    return start + here + (0.0 if stack.step is None else stack.step * scenario.acquisition.step_s)


def moment_of(scenario: Scenario, stack: Stack, index: int) -> Moment:
    """Return when an image is taken, and draw what the stage does to it."""
    place = (get_args(Kind).index(stack.kind), *_place(stack, index))
    in_test = stack.kind != "reference"
    angle_rad, shift_mm = scenario.scanner.stage.drawn(stream(scenario, "stage", *place), in_test=in_test)
    x, y, z = shift_mm
    time_s = clock_s(scenario, stack, index)
    return Moment(time_s=time_s, angle_error_rad=angle_rad, shift_mm=(float(x), float(y), float(z)))


def conditions_of(scenario: Scenario, time_s: float, exposure_s: float) -> Conditions:
    """Return what an image is taken with."""
    return Conditions(
        beam=scenario.scanner.open_beam,
        panel=scenario.scanner.panel,
        pixel_mm=scenario.geometry.pixel_mm,
        time_s=time_s,
        exposure_s=exposure_s,
    )


def clear_images(scanner: Scanner, stack: Stack) -> Callable[[int], Clear]:
    """Return the function that makes an image of a stack without noise, by its number."""
    if stack.step is not None:
        return partial(_clear_held, scanner, stack, _loaded(scanner, stack.step))
    return partial(clear_view if stack.kind == "reference" else clear_step, scanner)


def late_images(
    scenario: Scenario, stack: Stack, clear_of: Callable[[Stack], Callable[[int], Clear]]
) -> Callable[[int], Clear]:
    """Return the images of a stack with the light that the panel gives back late, from all images without noise."""
    clear, lag = clear_of(stack), scenario.scanner.lag
    if lag.none:
        return clear

    def before() -> Clear:
        if stack.kind == "reference":
            return np.ones((scenario.geometry.rows, scenario.geometry.columns), dtype=np.float32)
        if stack.step is not None:
            return clear_of(Stack("test"))(stack.step)
        return clear_of(Stack("reference"))(scenario.acquisition.reference_views - 1)

    return Late(clear, before, lag.parts(image_s(scenario, stack)))


def clear_view(scanner: Scanner, view: int) -> Clear:
    """Make one radiograph of the reference scan without noise: share of the open beam (row, column)."""
    angles = scanner.course.reference_angle_rad
    moment = moment_of(scanner.scenario, Stack("reference"), view)
    return clear_image(scanner, scanner.body, float(angles[view]), 2 * math.pi / len(angles), moment)


def clear_step(scanner: Scanner, step: int) -> Clear:
    """Make one radiograph of the test without noise: share of the open beam (row, column)."""
    body = _loaded(scanner, step)
    turn = 2 * math.pi / scanner.scenario.acquisition.steps_per_turn
    moment = moment_of(scanner.scenario, Stack("test"), step)
    return clear_image(scanner, body, float(scanner.course.test_angle_rad[step]), turn, moment)


def _loaded(scanner: Scanner, step: int) -> Body:
    """Return the sample at a step of the test."""
    return moved_body(scanner.body, scanner.course.motion, step, scanner.scenario.crack)


def _clear_held(scanner: Scanner, stack: Stack, held: Body, view: int) -> Clear:
    angles = scanner.course.interrupted_angle_rad
    moment = moment_of(scanner.scenario, stack, view)
    return clear_image(scanner, held, float(angles[view]), 2 * math.pi / len(angles), moment)


def _place(stack: Stack, index: int) -> tuple[int, ...]:
    """Return the numbers by which the random numbers of an image are found."""
    return (index,) if stack.step is None else (stack.step, index)


def exposed(scenario: Scenario, maps: DetectorMaps, image: Clear, stack: Stack, index: int) -> Image:
    """Take a clear image as number `index` of a stack, with its noise: counts (row, column)."""
    conditions = conditions_of(scenario, clock_s(scenario, stack, index), image_s(scenario, stack))
    return record(image, scenario.detector, maps, stream(scenario, stack.kind, *_place(stack, index)), conditions)


def view_image(scanner: Scanner, view: int) -> Image:
    """Make one radiograph of the reference scan, counts (row, column)."""
    return _image(scanner, Stack("reference"), view)


def step_image(scanner: Scanner, step: int) -> Image:
    """Make one radiograph of the test, counts (row, column)."""
    return _image(scanner, Stack("test"), step)


def _image(scanner: Scanner, stack: Stack, index: int) -> Image:
    late = late_images(scanner.scenario, stack, partial(clear_images, scanner))
    return exposed(scanner.scenario, scanner.maps, late(index), stack, index)
