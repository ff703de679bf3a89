"""One image without noise: from a sample and a stage angle to the share of the open beam that each pixel sees."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.geometry import ConeBeam
from simulator.detector import DetectorMaps, detector_maps, seen
from simulator.radiography import Body, path_lengths
from simulator.sample import leaning_body, rest_body
from simulator.scenario import Course, Scenario
from simulator.streams import stream
from simulator.xray import TransmissionTable

Clear = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Scanner:
    """The scanner with the sample on its stage: what all radiographs of a scenario have in common."""

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


def clear_image(scanner: Scanner, body: Body, angle_rad: float, turn_rad: float) -> Clear:
    """Make the image of a sample at a stage angle: share of the open beam (row, column).

    `turn_rad` is the turn from one radiograph to the next.
    """
    scenario = scanner.scenario
    image = transmission(scanner, body, angle_rad, turn_rad)
    return seen(image, scenario.detector, scanner.maps, scenario.acquisition.subpixels)


def transmission(scanner: Scanner, body: Body, angle_rad: float, turn_rad: float) -> NDArray[np.float32]:
    """Return the transmission at sub-pixel centres, the mean over the turn of the stage during exposure.

    `turn_rad` is the turn from one radiograph to the next.
    """
    plan = scanner.scenario.acquisition
    samples = plan.exposure_samples
    places = (np.arange(samples) + 0.5) / samples - 0.5
    total: NDArray[np.float32] | None = None
    for angle in angle_rad + turn_rad * plan.exposure_share * places:
        leaning = leaning_body(body, math.radians(scanner.scenario.misalignment.lean_deg), float(angle))
        lengths = path_lengths(leaning, scanner.geometry, float(angle), plan.subpixels)
        image = scanner.table.transmission(*lengths)
        total = image if total is None else total + image
    assert total is not None
    return total / np.float32(samples)
