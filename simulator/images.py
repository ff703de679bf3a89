"""One image without noise: from a sample and a stage angle to the share of the open beam that each pixel sees.

A scanner that does nothing but what a `ConeBeam` says takes the shorter way: its counts are what they were before
there was another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.geometry import ConeBeam
from simulator.alignment import Aligner, Moment
from simulator.detector import Detector, DetectorMaps, detector_maps, faulty, seen
from simulator.radiography import Body, path_lengths
from simulator.sample import leaning_body, rest_body
from simulator.scenario import Course, Scenario
from simulator.streams import stream
from simulator.xray import TransmissionTable

Clear = NDArray[np.float32]
UNDISTURBED = Moment()


@dataclass(frozen=True, kw_only=True)
class Scanner:
    """The scanner with the sample on its stage: what all radiographs of a scenario have in common."""

    scenario: Scenario
    course: Course
    body: Body
    """The sample at rest."""
    geometry: ConeBeam
    """The true geometry, but for what only the aligner tells."""
    aligner: Aligner
    optics: Detector
    """The detector, as blurred as focal spot and scintillator make it."""
    table: TransmissionTable
    maps: DetectorMaps


def prepare(scenario: Scenario, course: Course) -> Scanner:
    """Build the sample, the transmission table and the detector of a scenario."""
    body = rest_body(scenario)
    # no ray is longer inside the sample than its diagonal across; motion and slope of the ray add a little
    longest = 1.15 * 2 * float(np.hypot(*np.abs(body.vertices_mm[:, :2]).max(axis=0)))
    aligner = aligner_of(scenario)
    geometry = scenario.misalignment.true_geometry(aligner.recorded)
    return Scanner(
        scenario=scenario,
        course=course,
        body=body,
        geometry=geometry,
        aligner=aligner,
        optics=_optics(scenario, geometry),
        table=TransmissionTable.of(scenario.xray, (longest, longest)),
        maps=maps_of(scenario),
    )


def aligner_of(scenario: Scenario) -> Aligner:
    """Return how a scenario's true scanner stands at any angle and time."""
    return Aligner(
        recorded=scenario.geometry.cone_beam(),
        misalignment=scenario.misalignment,
        stage=scenario.scanner.stage,
        spot=scenario.scanner.focal_spot,
    )


def _optics(scenario: Scenario, geometry: ConeBeam) -> Detector:
    """Return the detector with the blur of focal spot and scintillator added to its own, by squares."""
    more = scenario.scanner.focal_spot.blur_px(geometry), scenario.scanner.panel.scintillator_blur_px
    if not any(more):
        return scenario.detector
    return scenario.detector.model_copy(update={"blur_px": math.hypot(scenario.detector.blur_px, *more)})


def maps_of(scenario: Scenario) -> DetectorMaps:
    """Draw what differs from pixel to pixel of a scenario's detector, and lay out its open beam."""
    size = scenario.geometry.rows, scenario.geometry.columns
    maps = detector_maps(scenario.detector, *size, stream(scenario, "maps"))
    maps = faulty(maps, scenario.scanner.panel, stream(scenario, "panel"))
    heel = scenario.scanner.open_beam.heel(scenario.geometry.cone_beam())
    return maps if heel is None else replace(maps, beam=maps.beam * heel)


def clear_image(
    scanner: Scanner, body: Body, angle_rad: float, turn_rad: float, moment: Moment = UNDISTURBED
) -> Clear:
    """Make the image of a sample at a stage angle: share of the open beam (row, column).

    `turn_rad` is the turn from one radiograph to the next.
    """
    scenario = scanner.scenario
    image = transmission(scanner, body, angle_rad, turn_rad, moment)
    primary = seen(image, scanner.optics, scanner.maps, scenario.acquisition.subpixels)
    return scenario.scanner.scatter.on(primary, scanner.geometry.pixel_mm)


def transmission(
    scanner: Scanner, body: Body, angle_rad: float, turn_rad: float, moment: Moment = UNDISTURBED
) -> NDArray[np.float32]:
    """Return the transmission at sub-pixel centres, the mean over the turn of the stage during exposure.

    `turn_rad` is the turn from one radiograph to the next.
    """
    plan = scanner.scenario.acquisition
    samples = plan.exposure_samples
    places = (np.arange(samples) + 0.5) / samples - 0.5
    total: NDArray[np.float32] | None = None
    for angle in angle_rad + turn_rad * plan.exposure_share * places:
        image = scanner.table.transmission(*_path_lengths(scanner, body, float(angle), moment))
        total = image if total is None else total + image
    assert total is not None
    return total / np.float32(samples)


def _path_lengths(
    scanner: Scanner, body: Body, angle_rad: float, moment: Moment
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the lengths of every ray in matrix and in graphite, mm, as the true scanner stands."""
    subpixels = scanner.scenario.acquisition.subpixels
    if scanner.aligner.plain:
        leaning = leaning_body(body, math.radians(scanner.scenario.misalignment.lean_deg), angle_rad)
        return path_lengths(leaning, scanner.geometry, angle_rad, subpixels)
    return path_lengths(*scanner.aligner.at(angle_rad, moment).seen(body, scanner.geometry), 0.0, subpixels)
