"""Measurements and truths in closed form, to test what is made of them without simulating anything."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdvc.measurement import Fit, MeasuredMotion, Measurement, Provenance, Recording, Stage
from pdvc.sections import SectionBasis
from pdvc.verdict import Stop

Floats = NDArray[np.float64]
VOXEL_MM = 0.0107
STEPS = 24
HEIGHT_MM = np.linspace(-4.0, 3.6, 9)
POINT_HEIGHT_MM = np.linspace(-4.4, 4.0, 43)


@dataclass(frozen=True)
class ClosedFormTruth:
    """True motion; has what `simulator.truth.Truth` has, as far as scores ask for it."""

    point_mm: Floats
    displacement_mm: Floats


def angles(steps: int = STEPS) -> Floats:
    return np.arange(steps) * (2 * np.pi / 10)


def material_points(heights: ArrayLike = POINT_HEIGHT_MM) -> Floats:
    """Return points X (point, 3) on the axis and at four places around it."""
    plane = np.array([[0, 0], [0.5, 0.1], [-0.5, 0.2], [0.1, -0.4], [0.3, 0.4]])
    return np.array([[x, y, z] for z in np.asarray(heights) for x, y in plane])


def stretched(
    strain: ArrayLike, offset_mm: ArrayLike, points_mm: Floats | None = None
) -> tuple[ClosedFormTruth, Floats]:
    """Return a truth of uniform strain (step,) and translation (step, 3), and its exact section amplitudes.

    x = X + e Z e_z + d is inverted by u(x) = d + (e / (1 + e)) (z - d_z) e_z: hat functions hold it exactly.
    """
    strain, offset = np.asarray(strain, dtype=float), np.asarray(offset_mm, dtype=float)
    points = material_points() if points_mm is None else points_mm
    displacement = np.repeat(offset[:, None, :], len(points), axis=1)
    displacement[..., 2] += strain[:, None] * points[:, 2]
    amplitude = np.zeros((len(strain), len(HEIGHT_MM), 6))
    amplitude[..., :3] = offset[:, None, :]
    inverse = strain / (1 + strain)
    amplitude[..., 2] += inverse[:, None] * (HEIGHT_MM - offset[:, 2:])
    return ClosedFormTruth(points, displacement), amplitude / VOXEL_MM


def tensile_history(steps: int = STEPS) -> tuple[Floats, Floats]:
    """Return strain (step,) up to 8 % and translation (step, 3) up to 15 voxels, mm."""
    load = np.clip(np.arange(steps) / (steps - 1) * 2 - 1, 0, None)
    turn = angles(steps)
    offset = np.stack([0.4 * load + 0.03 * np.cos(turn), 0.03 * np.sin(turn), 15 * VOXEL_MM * load], axis=1)
    offset[:, 0] *= 15 * VOXEL_MM / 0.43
    return 0.08 * load, offset


def measurement(amplitude: Floats, *, unobserved: tuple[int, ...] = (), title: str = "synthetic") -> Measurement:
    """Return a complete record around section amplitudes (step, section, motion), voxels."""
    steps, sections, motions = amplitude.shape
    rng = np.random.default_rng(3)
    observed = np.ones(sections, dtype=bool)
    observed[list(unobserved)] = False
    amplitude = amplitude.copy()
    amplitude[:, ~observed] = np.nan
    rows = np.arange(60)[:, None] / 60
    stripes = np.sin(40 * rows + np.arange(28)[None] / 5)
    load = np.linspace(0.2, 1, steps)[:, None, None]

    def residual(level: float) -> NDArray[np.float32]:
        noise = rng.normal(0, 0.004, (steps, 60, 28))
        return (level * load * stripes + noise).astype(np.float32)

    def stage(name: str, modes: int, count: int) -> Stage:
        return Stage(
            name=name,
            scale=2 if name == "rigid" else 1,
            solver="pgd",
            unknowns=7 * count * motions,
            temporal=rng.normal(size=(modes, steps)),
            spatial=rng.normal(size=(modes, count, motions)),
            rms=np.geomspace(0.1, 0.01, modes + 1),
            stop=Stop.NO_GAIN,
            stop_reason="the residual no longer decreases",
        )

    functions = np.sqrt(steps) * np.linalg.qr(rng.normal(size=(steps, 7)))[0].T
    return Measurement(
        recording=Recording(
            title=title,
            voxel_mm=VOXEL_MM,
            source_axis_mm=28.57,
            angle_rad=angles(steps),
            time_s=2.0 * np.arange(steps),
            force_N=250 + 500 * np.clip(np.arange(steps) / (steps - 1) * 2 - 1, 0, None),
            window=(10, 70, 6, 34),
        ),
        motion=MeasuredMotion(
            basis=SectionBasis(height_mm=HEIGHT_MM[:sections], radius_mm=0.6),
            time_functions=functions,
            amplitude=amplitude,
            amplitude_std=np.full_like(amplitude, 0.02),
            covariance=4e-4 / steps * np.eye(len(functions) * sections * motions),
            data_share=np.broadcast_to(np.linspace(0.2, 1, motions), amplitude.shape).copy(),
            observed=observed,
        ),
        fit=Fit(
            stages=(stage("rigid", 5, 1), stage("deformation", 3, sections)),
            snr_reprojection_db=21 + rng.normal(0, 0.2, 40),
            snr_initial_db=10 + 3 * np.cos(np.arange(steps)),
            snr_rigid_db=25 - np.linspace(0, 3, steps),
            snr_final_db=27 + rng.normal(0, 0.2, steps),
            snr_noise_db=np.full(steps, 27.6),
            residual_initial=residual(0.2),
            residual_rigid=residual(0.02),
            residual_final=residual(0.002),
        ),
        provenance=Provenance(
            seconds={"reconstruct": 12.5, "measure": 60.25},
            options="scale = 2\n",
            versions="pdvc-bench 0.1.0, numpy 2",
        ),
    )


def altered(measurement: Measurement, **fields: object) -> Measurement:
    """Return the measurement with other values in some fields, of whichever part of the record."""
    changes: dict[str, object] = {}
    for name in ("recording", "motion", "fit", "provenance"):
        part = getattr(measurement, name)
        own = {key: fields.pop(key) for key in tuple(fields) if hasattr(part, key)}
        changes[name] = replace(part, **own)
    return replace(measurement, **changes, **fields)


def drawn(measurement: Measurement, rng: np.random.Generator) -> Measurement:
    """Return the measurement with an error of the covariance that it claims."""
    motion = measurement.motion
    error = np.linalg.cholesky(motion.covariance) @ rng.normal(size=len(motion.covariance))
    error = error.reshape(-1, *motion.amplitude.shape[1:])
    moved = motion.amplitude + np.einsum("ft,fjk->tjk", motion.time_functions, error)
    return altered(measurement, amplitude=moved)
