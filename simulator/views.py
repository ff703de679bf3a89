"""One radiograph at a time: the sample at rest and moved, its transmission, and the counts of the detector."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pdvc.geometry import ConeBeam
from simulator.detector import DetectorMaps, detector_maps, record, seen
from simulator.kinematics import Motion, rotation_matrix
from simulator.microstructure import place
from simulator.radiography import Body, path_lengths
from simulator.scenario import Course, Scenario
from simulator.specimen import dog_bone
from simulator.xray import TransmissionTable

Image = NDArray[np.uint16]
Clear = NDArray[np.float32]

_STREAMS = ("reference", "test", "flats", "darks", "nodules", "maps", "force", "interrupted", "interrupted force")
"""Random numbers are drawn from one stream for each of these; the order is part of every result."""
_NOISE = ("reference", "test", "flats", "darks", "force", "interrupted", "interrupted force")
"""Streams that a repetition draws anew."""


@dataclass(frozen=True)
class Stack:
    """Name one of the stacks of radiographs that a scenario makes with the sample in the beam."""

    kind: Literal["reference", "test", "interrupted"]
    step: int | None = None
    """Of an interrupted scan: the step at which the test was held."""

    def __str__(self) -> str:
        return self.kind if self.step is None else f"scan at step {self.step}"


def stacks_of(scenario: Scenario) -> tuple[Stack, ...]:
    """Return the stacks of a scenario, in the order in which they are made."""
    return Stack("reference"), Stack("test"), *(Stack("interrupted", step) for step in scenario.interrupted.steps)


@dataclass(frozen=True, kw_only=True)
class Scanner:
    """Hold what all radiographs of a scenario have in common."""

    scenario: Scenario
    course: Course
    body: Body
    """The sample at rest."""
    geometry: ConeBeam
    """The true geometry."""
    table: TransmissionTable
    maps: DetectorMaps


def prepare(scenario: Scenario, course: Course) -> Scanner:
    """Build the sample, the transmission table and the detector of a scenario."""
    body = rest_body(scenario)
    # no ray is longer inside the sample than its diagonal across; motion and slope of the ray add a little
    longest = 1.15 * 2 * float(np.hypot(*np.abs(body.vertices_mm[:, :2]).max(axis=0)))
    return Scanner(
        scenario=scenario,
        course=course,
        body=body,
        geometry=scenario.misalignment.true_geometry(scenario.geometry.cone_beam()),
        table=TransmissionTable.of(scenario.xray, (longest, longest)),
        maps=maps_of(scenario),
    )


def maps_of(scenario: Scenario) -> DetectorMaps:
    """Draw what differs from pixel to pixel of a scenario's detector."""
    size = scenario.geometry.rows, scenario.geometry.columns
    return detector_maps(scenario.detector, *size, stream(scenario, "maps"))


def rest_body(scenario: Scenario) -> Body:
    """Build the sample in its reference configuration."""
    surface = dog_bone(scenario.specimen)
    half = scenario.specimen.length_mm / 2
    nodules = place(scenario.graphite, scenario.specimen, stream(scenario, "nodules"), half)
    return Body(
        vertices_mm=np.asarray(surface.vertices, dtype=np.float64),
        faces=np.asarray(surface.faces, dtype=np.int64),
        centres_mm=nodules.centre_mm,
        shapes_mm=nodules.radius_mm[:, None, None] * np.eye(3),
    )


def moved_body(body: Body, motion: Motion, step: int) -> Body:
    """Carry the sample along: vertices and centres move, each nodule takes the local affine map."""
    return Body(
        vertices_mm=motion.forward(body.vertices_mm, step),
        faces=body.faces,
        centres_mm=motion.forward(body.centres_mm, step),
        shapes_mm=motion.gradient(body.centres_mm, step) @ body.shapes_mm,
    )


def transmission(scanner: Scanner, body: Body, angle_rad: float, turn_rad: float) -> NDArray[np.float32]:
    """Return the transmission at sub-pixel centres, the mean over the turn of the stage during exposure.

    `turn_rad` is the turn from one radiograph to the next.
    """
    plan = scanner.scenario.acquisition
    samples = plan.exposure_samples
    places = (np.arange(samples) + 0.5) / samples - 0.5
    total: NDArray[np.float32] | None = None
    for angle in angle_rad + turn_rad * plan.exposure_share * places:
        leaning = _lean(body, math.radians(scanner.scenario.misalignment.lean_deg), float(angle))
        lengths = path_lengths(leaning, scanner.geometry, float(angle), plan.subpixels)
        image = scanner.table.transmission(*lengths)
        total = image if total is None else total + image
    assert total is not None
    return total / np.float32(samples)


def view_image(scanner: Scanner, view: int) -> Image:
    """Make one radiograph of the reference scan, counts (row, column)."""
    return exposed(scanner.scenario, scanner.maps, clear_view(scanner, view), Stack("reference"), view)


def step_image(scanner: Scanner, step: int) -> Image:
    """Make one radiograph of the test, counts (row, column)."""
    return exposed(scanner.scenario, scanner.maps, clear_step(scanner, step), Stack("test"), step)


def clear_images(scanner: Scanner, stack: Stack) -> Callable[[int], Clear]:
    """Return the function that makes an image of a stack without noise, by its number."""
    if stack.step is not None:
        return partial(_clear_held, scanner, moved_body(scanner.body, scanner.course.motion, stack.step))
    return partial(clear_view if stack.kind == "reference" else clear_step, scanner)


def image_count(scenario: Scenario, stack: Stack) -> int:
    """Return how many images a stack of a scenario has."""
    plan = scenario.acquisition
    if stack.kind == "interrupted":
        return scenario.interrupted.views or plan.reference_views
    return plan.reference_views if stack.kind == "reference" else plan.test_steps


def clear_view(scanner: Scanner, view: int) -> Clear:
    """Make one radiograph of the reference scan without noise: share of the open beam (row, column)."""
    angles = scanner.course.reference_angle_rad
    return _seen(scanner, transmission(scanner, scanner.body, float(angles[view]), 2 * math.pi / len(angles)))


def clear_step(scanner: Scanner, step: int) -> Clear:
    """Make one radiograph of the test without noise: share of the open beam (row, column)."""
    body = moved_body(scanner.body, scanner.course.motion, step)
    turn = 2 * math.pi / scanner.scenario.acquisition.steps_per_turn
    return _seen(scanner, transmission(scanner, body, float(scanner.course.test_angle_rad[step]), turn))


def _clear_held(scanner: Scanner, held: Body, view: int) -> Clear:
    angles = scanner.course.interrupted_angle_rad
    return _seen(scanner, transmission(scanner, held, float(angles[view]), 2 * math.pi / len(angles)))


def exposed(scenario: Scenario, maps: DetectorMaps, image: Clear, stack: Stack, index: int) -> Image:
    """Take a clear image as number `index` of a stack, with its noise: counts (row, column)."""
    place = (index,) if stack.step is None else (stack.step, index)
    return record(image, scenario.detector, maps, stream(scenario, stack.kind, *place))


def _seen(scanner: Scanner, image: NDArray[np.float32]) -> Clear:
    scenario = scanner.scenario
    return seen(image, scenario.detector, scanner.maps, scenario.acquisition.subpixels)


def _lean(body: Body, lean_rad: float, angle_rad: float) -> Body:
    """Turn the sample about the horizontal across the beam, e_c of `pdvc.geometry`."""
    if lean_rad == 0.0:
        return body
    column = np.array([-math.sin(angle_rad), -math.cos(angle_rad), 0.0])
    matrix = rotation_matrix(lean_rad * column)
    return Body(
        vertices_mm=body.vertices_mm @ matrix.T,
        faces=body.faces,
        centres_mm=body.centres_mm @ matrix.T,
        shapes_mm=matrix @ body.shapes_mm,
    )


def stream(scenario: Scenario, name: str, *index: int) -> np.random.Generator:
    """Return the generator of one image, or of one other random thing; of the first one without an index."""
    key = (_STREAMS.index(name), *(index or (0,)))
    if scenario.repetition and name in _NOISE:
        key = (*key, scenario.repetition)
    return np.random.default_rng(np.random.SeedSequence(scenario.seed, spawn_key=key))
