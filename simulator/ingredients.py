"""What makes the sample move: ingredients named in a scenario, built into one `Motion`.

They are carried out in this order, from the material outwards:

1. ``tension``, ``bending`` and ``torsion``: the sample is deformed between its grips (`BeamMotion`). Its centre
   line is c(Z) = integral from 0 of (1 + eps) R e_z: sections stay normal to it, and the ligament stays in place;
2. ``compliance``: the machine gives way to the force, by a shift and a tilt;
3. ``backlash``: it moves between reference scan and test, and again when the stroke starts;
4. ``wobble``: the stage turns about another axis than during the reference scan. Fixed in the lab, this is a
   sine and a cosine of the stage angle in the sample frame.

The default amplitudes give the paper's initial SNR, before any correction: 9.9 dB expected as the mean over steps
(10.1 dB for an ideal reference), against the 9.94 dB reported. Its mean translations are drawn, but not told in
numbers.

`into_sections` replaces the whole by its like in the solver's space: 15 sections fixed in space, each with six
rigid motions, each the sum of the paper's seven time functions (Table 1).
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from pdvc.settings import Settings
from simulator.kinematics import BeamMotion, Composition, Motion, RigidMotion, SectionMotion
from simulator.loading import LoadHistory

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
Ingredient = Literal["tension", "bending", "torsion", "compliance", "backlash", "wobble"]
Poisson = Annotated[float, Field(ge=0, le=0.5)]

ZERO: Vector = (0.0, 0.0, 0.0)


class Tension(Settings):
    """Stretch by the strains of the loading law."""

    contraction: bool = True
    """whether sections shrink as they stretch"""
    poisson_elastic: Poisson = 0.28
    """transverse over axial elastic strain"""
    poisson_plastic: Poisson = 0.5
    """transverse over axial plastic strain; 0.5 keeps the volume"""


class Bending(Settings):
    """Bend in proportion to the force gained, more where the section is small."""

    angle_deg: float = 0.2
    """angle between the ends of the field of view at the last step, degrees"""
    direction_deg: float = 30.0
    """horizontal direction towards which the top leans, from x towards y, degrees"""


class Torsion(Settings):
    """Twist about z in proportion to the force gained, more where the section is small."""

    angle_deg: float = 0.15
    """twist between the ends of the field of view at the last step, degrees"""


class Compliance(Settings):
    """Give way to the force: the machine between the sample and the stage."""

    shift_mm: Vector = (0.14, 0.02, -0.18)
    """shift (x, y, z) reached at the last step, in proportion to the force gained, mm"""
    tilt_deg: Vector = (0.03, 0.08, 0.02)
    """rotation vector (x, y, z) reached at the last step, about the origin, degrees"""


class Backlash(Settings):
    """Move between the reference scan and the test, and when the stroke starts."""

    before_mm: Vector = (0.18, 0.03, 0.03)
    """shift between the reference scan and the test, mm"""
    before_deg: Vector = (0.01, 0.02, 0.03)
    """rotation vector between the reference scan and the test, degrees"""
    start_mm: Vector = (0.006, -0.002, -0.01)
    """further shift when the stroke starts, mm"""
    start_deg: Vector = (0.0, 0.01, 0.0)
    """further rotation vector when the stroke starts, degrees"""
    start_steps: Annotated[int, Field(ge=1)] = 3
    """steps that the motion at the start of the stroke takes"""


class Wobble(Settings):
    """Turn about another axis than during the reference scan; fixed in the lab."""

    across_mm: float = 0.05
    """shift of the axis across the beam, to the right of the image, mm"""
    along_mm: float = 0.01
    """shift of the axis along the beam, away from the source, mm"""
    roll_deg: float = 0.01
    """turn of the axis about the beam, degrees"""
    lean_deg: float = 0.01
    """turn of the axis about the horizontal across the beam, degrees"""


class MotionOptions(Settings):
    """Motion of the sample during the test; the reference scan is made at rest."""

    ingredients: tuple[Ingredient, ...] = (
        "tension",
        "bending",
        "torsion",
        "compliance",
        "backlash",
        "wobble",
    )
    """which of the parts below take place, in any order; none leaves the sample at rest"""
    sections: Annotated[int, Field(ge=0)] = 0
    """replace the motion by its like in the solver's space, with this many sections; 0 leaves it"""
    tension: Tension = Tension()
    """stretch by the loading law"""
    bending: Bending = Bending()
    """bending with the force"""
    torsion: Torsion = Torsion()
    """twist with the force"""
    compliance: Compliance = Compliance()
    """the machine gives way to the force"""
    backlash: Backlash = Backlash()
    """motion before the test and at the start of the stroke"""
    wobble: Wobble = Wobble()
    """another axis of rotation than in the reference scan"""

    @field_validator("sections")
    @classmethod
    def _none_or_several(cls, value: int) -> int:
        if value == 1:
            raise ValueError("0, or at least 2 sections")
        return value


def build_motion(
    options: MotionOptions,
    history: LoadHistory,
    area_mm2: Floats,
    angle_rad: Floats,
    start_step: int,
    view_mm: float,
) -> Composition:
    """Build the motion of a scenario.

    `area_mm2` (height,) goes with the heights of the history, `angle_rad` (step,) is the stage angle, the
    stroke starts at `start_step`, and the field of view reaches from -view_mm to +view_mm.
    """
    active = set(options.ingredients)
    parts: list[Motion] = []
    if active & {"tension", "bending", "torsion"}:
        parts.append(beam_motion(options, history, area_mm2, view_mm))
    if "compliance" in active:
        parts.append(compliance_motion(options.compliance, history))
    if "backlash" in active:
        parts.append(backlash_motion(options.backlash, len(angle_rad), start_step))
    if "wobble" in active:
        parts.append(wobble_motion(options.wobble, angle_rad))
    return Composition(tuple(parts))


def beam_motion(options: MotionOptions, history: LoadHistory, area_mm2: Floats, view_mm: float) -> BeamMotion:
    """Build tension, bending and torsion, those that are active, into one motion of beam sections."""
    active = set(options.ingredients)
    tension = options.tension
    height, load = history.height_mm, history.load_fraction
    strain = history.strain * ("tension" in active)
    plastic = history.plastic * ("tension" in active)
    nu = np.array([tension.poisson_elastic, tension.poisson_plastic]) * tension.contraction
    # a section gives way to a moment like 1 / area^2: exact for a section that keeps its shape
    share = _from_origin(height, 1 / area_mm2**2)
    share /= np.interp(view_mm, height, share) - np.interp(-view_mm, height, share)
    lean = np.deg2rad(options.bending.direction_deg)
    about = np.array([-np.sin(lean), np.cos(lean), 0.0])
    bend = np.deg2rad(options.bending.angle_deg) * ("bending" in active) * share[:, None] * about
    twist = np.deg2rad(options.torsion.angle_deg) * ("torsion" in active) * share[:, None] * [0.0, 0.0, 1.0]
    turns = [Rotation.from_rotvec(part * bend) * Rotation.from_rotvec(part * twist) for part in load]
    upward = np.stack([turn.apply([0.0, 0.0, 1.0]) for turn in turns])
    centre = _from_origin(height, (1 + strain)[..., None] * upward)
    return BeamMotion(
        knot_mm=height,
        displacement_mm=centre - height[:, None] * np.array([0.0, 0.0, 1.0]),
        rotation_rad=np.stack([turn.as_rotvec() for turn in turns]),
        stretch=1 - nu[0] * (strain - plastic) - nu[1] * plastic,
    )


def compliance_motion(options: Compliance, history: LoadHistory) -> RigidMotion:
    """Build the shift and tilt that follow the force."""
    load = history.load_fraction[:, None]
    return RigidMotion(
        rotation_rad=load * np.deg2rad(options.tilt_deg), translation_mm=load * np.array(options.shift_mm)
    )


def backlash_motion(options: Backlash, steps: int, start_step: int) -> RigidMotion:
    """Build the jump before the test and the short motion at the start of the stroke."""
    ramp = np.clip((np.arange(steps) - start_step) / options.start_steps, 0.0, 1.0)[:, None]
    return RigidMotion(
        rotation_rad=np.deg2rad(options.before_deg) + ramp * np.deg2rad(options.start_deg),
        translation_mm=np.array(options.before_mm) + ramp * np.array(options.start_mm),
    )


def wobble_motion(options: Wobble, angle_rad: Floats) -> RigidMotion:
    """Build the motion of an axis displaced in the lab: along e_c and e_b of `pdvc.geometry`."""
    c, s, zero = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad)
    beam, column = np.column_stack([c, -s, zero]), np.column_stack([-s, -c, zero])
    return RigidMotion(
        rotation_rad=np.deg2rad(options.roll_deg) * beam + np.deg2rad(options.lean_deg) * column,
        translation_mm=options.across_mm * column + options.along_mm * beam,
    )


def time_functions(force_N: Floats, angle_rad: Floats, start_step: int) -> Floats:
    """Return the seven time functions of the paper's Table 1, (step, 7), each scaled to about one."""
    t = np.arange(len(force_N)) / max(len(force_N) - 1, 1)
    ramp = np.maximum(t - start_step / max(len(force_N) - 1, 1), 0.0)
    columns = [force_N / force_N.max(), np.sin(angle_rad), np.cos(angle_rad), np.ones_like(t), t, ramp, ramp**2]
    return np.column_stack(columns)


def into_sections(motion: Motion, height_mm: Floats, time: Floats) -> SectionMotion:
    """Return the motion of sections fixed at `height_mm` that is nearest to another one.

    Each section takes the displacement and the mean rotation found at its centre (0, 0, z_j) of the current
    configuration, and each of its six histories the nearest sum of the `time` functions (step, function).
    """
    arm = 1e-3
    steps = len(time)
    centres = height_mm[:, None] * np.array([0.0, 0.0, 1.0])
    offsets = arm * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    probes = (centres[:, None] + offsets).reshape(-1, 3)
    histories = np.empty((steps, len(height_mm), 6))
    for step in range(steps):
        u = (probes - motion.inverse(probes, step)).reshape(len(height_mm), 5, 3)
        by_x, by_y = (u[:, 1] - u[:, 2]) / (2 * arm), (u[:, 3] - u[:, 4]) / (2 * arm)
        histories[step, :, :3] = u[:, 0]
        histories[step, :, 3] = by_y[:, 2]
        histories[step, :, 4] = -by_x[:, 2]
        histories[step, :, 5] = (by_x[:, 1] - by_y[:, 0]) / 2
    flat = histories.reshape(steps, -1)
    fitted = (time @ np.linalg.lstsq(time, flat, rcond=None)[0]).reshape(histories.shape)
    return SectionMotion(height_mm=height_mm, translation_mm=fitted[..., :3], rotation_rad=fitted[..., 3:])


def _from_origin(height_mm: Floats, slope: Floats) -> Floats:
    """Integrate along z, from 0 at height 0: heights on axis 0 of a profile, or on axis 1 of (step, ...)."""
    integral = CubicSpline(height_mm, slope, axis=0 if slope.ndim == 1 else 1).antiderivative()
    from_zero = integral(height_mm) - np.expand_dims(integral(0.0), 0 if slope.ndim == 1 else 1)
    return np.asarray(from_zero, dtype=np.float64)
