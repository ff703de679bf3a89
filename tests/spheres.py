"""A sample of spheres, whose radiographs have a closed form: an oracle for looks at angles.

The attenuation of a ray is mu times the chord 2 sqrt(r^2 - d^2) of every sphere that it passes at a distance d.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdvc.experiment import Experiment, Series
from pdvc.geometry import ConeBeam
from pdvc.rays import ray_vectors

BEAM = ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.9, rows=60, columns=40)
"""A voxel is 0.09 mm; the fan is 7 degrees wide."""
OPEN, DARK = 40_000.0, 400.0


def sample(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (sphere, 3) and radii (sphere,), mm, of ninety spheres in a bar of 2 x 1.6 x 5 mm."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform([-0.8, -0.6, -2.4], [0.8, 0.6, 2.4], size=(90, 3))
    return centre, rng.uniform(0.1, 0.25, size=90)


def attenuation(beam: ConeBeam, angle_rad: np.ndarray, spheres: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return attenuations (view, row, column)."""
    source, corner, down, right = np.moveaxis(ray_vectors(beam, angle_rad).stacked(), 1, 0)
    row, column = np.arange(beam.rows)[:, None, None], np.arange(beam.columns)[None, :, None]
    result = np.empty((len(angle_rad), beam.rows, beam.columns))
    for k in range(len(angle_rad)):
        along = corner[k] + row * down[k] + column * right[k] - source[k]
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        total = np.zeros((beam.rows, beam.columns))
        for centre, radius in zip(*spheres, strict=True):
            to = centre - source[k]
            square = radius**2 - (to @ to - (along @ to) ** 2)
            total += 2 * np.sqrt(np.maximum(square, 0))
        result[k] = total
    return result


def experiment(seed: int = 0, *, views: int = 48, steps: int = 12, beam: ConeBeam = BEAM) -> Experiment:
    """Return an experiment in which nothing moves, without noise but for the rounding of counts.

    The step angles go round once and a bit; the force leaves its plateau after a third of the steps.
    """
    spheres = sample(seed)
    gain = OPEN * np.random.default_rng(1).uniform(0.97, 1.03, size=(beam.rows, beam.columns))

    def series(angle: np.ndarray) -> Series:
        counts = DARK + gain * np.exp(-attenuation(beam, angle, spheres))
        step = np.arange(len(angle), dtype=float)
        return Series(
            counts=np.round(counts).astype(np.uint16),
            angle_rad=angle,
            time_s=step,
            force_N=100 + 20 * np.maximum(step - steps // 3, 0),
        )

    shape = (beam.rows, beam.columns)
    return Experiment(
        title="spheres",
        material="air and spheres",
        geometry=beam,
        frames=1,
        photons_per_count=None,
        readout_noise_counts=None,
        reference=series(2 * np.pi * np.arange(views) / views),
        test=series(2 * np.pi * np.arange(steps) / steps * 1.25),
        flats=np.round(np.stack([gain + DARK] * 2)).astype(np.uint16),
        darks=np.full((1, *shape), round(DARK), dtype=np.uint16),
    )


def with_test(here: Experiment, **changes: object) -> Experiment:
    """Return an experiment with another test."""
    return replace(here, test=replace(here.test, **changes))


def with_reference(here: Experiment, **changes: object) -> Experiment:
    """Return an experiment with another reference scan."""
    return replace(here, reference=replace(here.reference, **changes))
