"""The sample: at rest, as it is moved at a step of the test, leaning with the rotation axis, and anywhere else."""

from __future__ import annotations

import math

import numpy as np

from simulator.crack import NONE, Crack, keep_clear, spheroids
from simulator.each_point import products
from simulator.kinematics import Floats, Motion, rotation_matrix
from simulator.microstructure import place
from simulator.radiography import Body
from simulator.scenario import Scenario
from simulator.specimen import dog_bone
from simulator.streams import stream


def rest_body(scenario: Scenario) -> Body:
    """Build the sample in its reference configuration."""
    surface = dog_bone(scenario.specimen)
    half = scenario.specimen.length_mm / 2
    placed = place(scenario.graphite, scenario.specimen, stream(scenario, "nodules"), half)
    nodules = keep_clear(placed, scenario.crack, scenario.graphite.gap_mm)
    return Body(
        vertices_mm=np.asarray(surface.vertices, dtype=np.float64),
        faces=np.asarray(surface.faces, dtype=np.int64),
        centres_mm=nodules.centre_mm,
        shapes_mm=nodules.radius_mm[:, None, None] * np.eye(3),
    )


def moved_body(body: Body, motion: Motion, step: int, crack: Crack = NONE) -> Body:
    """Carry the sample along: vertices and centres move, each nodule and the crack take the local affine map."""
    centres, gradient = motion.carry(body.centres_mm, step)
    crack_centres, crack_shapes = spheroids(crack, crack.opened_mm(step))
    if len(crack_centres):
        crack_centres, crack_gradient = motion.carry(crack_centres, step)
        crack_shapes = products(crack_gradient, crack_shapes)
    return Body(
        vertices_mm=motion.forward(body.vertices_mm, step),
        faces=body.faces,
        centres_mm=centres,
        shapes_mm=products(gradient, body.shapes_mm),
        crack_centres_mm=crack_centres,
        crack_shapes_mm=crack_shapes,
    )


def leaning_body(body: Body, lean_rad: float, angle_rad: float) -> Body:
    """Turn the sample about the horizontal across the beam, e_c of `pdvc.geometry`, at a stage angle."""
    if lean_rad == 0.0:
        return body
    column = np.array([-math.sin(angle_rad), -math.cos(angle_rad), 0.0])
    matrix = rotation_matrix(lean_rad * column)
    return placed(body, matrix, np.zeros(3))


def placed(body: Body, matrix: Floats, place_mm: Floats) -> Body:
    """Turn a sample by a matrix (3, 3), and shift it (3,), mm."""
    return Body(
        vertices_mm=body.vertices_mm @ matrix.T + place_mm,
        faces=body.faces,
        centres_mm=body.centres_mm @ matrix.T + place_mm,
        shapes_mm=matrix @ body.shapes_mm,
        crack_centres_mm=body.crack_centres_mm @ matrix.T + place_mm,
        crack_shapes_mm=matrix @ body.crack_shapes_mm,
    )
