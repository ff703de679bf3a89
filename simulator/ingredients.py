"""What makes the sample move: ingredients named in a scenario, built into one `Motion`.

They are carried out in this order, from the material outwards:

1. ``tension``, ``bending`` and ``torsion``: the sample is deformed between its grips (`BeamMotion`). Its centre
   line is c(Z) = integral from 0 of (1 + eps) R e_z: sections stay normal to it, and the ligament stays in place;
2. ``compliance``: the machine gives way to the force, by a shift and a tilt;
3. ``backlash``: it moves between reference scan and test, and again when the stroke starts;
4. ``wobble``: the stage turns about another axis than during the reference scan. Fixed in the lab, this is a
   sine and a cosine of the stage angle in the sample frame;
5. only where a scenario asks for them: ``creep`` and ``ripple``, with the deformations; ``slip``, of the deformed
   sample in its grips, before the machine moves both; and ``wander``, a random motion of the whole. No time function
   follows creep, slip and wandering; a ripple asks what the sections follow.

One more is one more record here, a `Deforming` or a `Moving` one, and its field in `MotionOptions`.

The default amplitudes give the paper's initial SNR, before any correction: 9.9 dB expected as the mean over steps
(10.1 dB for an ideal reference), against the 9.94 dB reported. Its mean translations are drawn, but not told in
numbers.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, field_validator
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from pdvc.settings import Settings
from simulator.kinematics import BeamMotion, Composition, Motion, RigidMotion
from simulator.loading import LoadHistory

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
Poisson = Annotated[float, Field(ge=0, le=0.5)]

ZERO: Vector = (0.0, 0.0, 0.0)
HEIGHTS_A_WAVE = 8
"""Fewest heights in a wavelength: splines between them then miss the strain by half a per cent of its amplitude."""


@dataclass(frozen=True, kw_only=True)
class Drive:
    """What happens during the test, for the ingredients to follow."""

    history: LoadHistory
    """Force and strains at each step."""
    area_mm2: Floats
    """Area of the section at the heights of the history (height,), mm2."""
    angle_rad: Floats
    """Stage angle (step,), rad."""
    start_step: int
    """Step at which the stroke starts."""
    view_mm: float
    """The field of view reaches from -view_mm to +view_mm, mm."""

    def moment_share(self) -> Floats:
        """Return the part (height,) of a turn between the ends of the field of view that each section has made.

        A section gives way to a moment like 1 / area^2: exact for a section that keeps its shape.
        """
        height = self.history.height_mm
        share = _from_origin(height, 1 / self.area_mm2**2)
        share /= np.interp(self.view_mm, height, share) - np.interp(-self.view_mm, height, share)
        return share


@dataclass(frozen=True, kw_only=True)
class Deformation:
    """The deformation of a beam, section by section; several add up, and what one leaves out is left as it is."""

    strain: Floats = field(default_factory=lambda: np.zeros(()))
    """Axial strain (step, height), without unit."""
    stretch: Floats = field(default_factory=lambda: np.ones(()))
    """Transverse stretch (step, height), without unit."""
    bend_rad: Floats = field(default_factory=lambda: np.zeros(()))
    """Rotation vector of the section by bending (step, height, 3), rad."""
    twist_rad: Floats = field(default_factory=lambda: np.zeros(()))
    """Rotation vector of the section by torsion (step, height, 3), before it is bent, rad."""

    @classmethod
    def at_constant_volume(cls, strain: Floats) -> Self:
        """Return an axial strain (step, height) with the transverse stretch (1 + strain)^(-1/2)."""
        return cls(strain=strain, stretch=1 / np.sqrt(1 + strain))


class Ingredient(Settings):
    """Something that makes the sample move."""


class Deforming(Ingredient):
    """An ingredient that deforms the sample between its grips."""

    @abstractmethod
    def deformation(self, drive: Drive) -> Deformation:
        """Return what it does to the sections of the sample."""


class Moving(Ingredient):
    """An ingredient that moves the sample as it has been deformed."""

    @abstractmethod
    def motion(self, drive: Drive) -> Motion:
        """Return the motion."""


class Tension(Deforming):
    """A stretch by the strains of the loading law."""

    contraction: bool = True
    """whether sections shrink as they stretch"""
    poisson_elastic: Poisson = 0.28
    """transverse over axial elastic strain"""
    poisson_plastic: Poisson = 0.5
    """transverse over axial plastic strain; 0.5 keeps the volume"""

    def deformation(self, drive: Drive) -> Deformation:
        """Return the strain of the loading, and the contraction that goes with it."""
        strain, plastic = drive.history.strain, drive.history.plastic
        elastic_ratio, plastic_ratio = np.array([self.poisson_elastic, self.poisson_plastic]) * self.contraction
        return Deformation(strain=strain, stretch=1 - elastic_ratio * (strain - plastic) - plastic_ratio * plastic)


class Bending(Deforming):
    """A bend in proportion to the force gained, more where the section is small."""

    angle_deg: float = 0.2
    """angle between the ends of the field of view at the last step, degrees"""
    direction_deg: float = 30.0
    """horizontal direction towards which the top leans, from x towards y, degrees"""

    def deformation(self, drive: Drive) -> Deformation:
        """Return rotations about the horizontal that the top leans over."""
        lean = np.deg2rad(self.direction_deg)
        about = np.array([-np.sin(lean), np.cos(lean), 0.0])
        bend = np.deg2rad(self.angle_deg) * drive.moment_share()[:, None] * about
        return Deformation(bend_rad=drive.history.load_fraction[:, None, None] * bend)


class Torsion(Deforming):
    """A twist about z in proportion to the force gained, more where the section is small."""

    angle_deg: float = 0.15
    """twist between the ends of the field of view at the last step, degrees"""

    def deformation(self, drive: Drive) -> Deformation:
        """Return rotations about z."""
        twist = np.deg2rad(self.angle_deg) * drive.moment_share()[:, None] * np.array([0.0, 0.0, 1.0])
        return Deformation(twist_rad=drive.history.load_fraction[:, None, None] * twist)


class Slip(Moving):
    """A single sudden slip of the sample in its grips: from a step on it stays where it slipped to."""

    step: Annotated[int, Field(ge=0)] = 80
    """first step, counted from 0, at which the sample has slipped"""
    shift_mm: Vector = (0.0, 0.0, -0.05)
    """shift (x, y, z), mm"""
    turn_deg: Vector = (0.0, 0.0, 1.15)
    """rotation vector (x, y, z), about the origin, degrees"""

    def motion(self, drive: Drive) -> RigidMotion:
        """Return rest before the step, and from it on one rigid motion."""
        slipped = np.where(np.arange(len(drive.angle_rad)) < self.step, 0.0, 1.0)[:, None]
        return RigidMotion(
            rotation_rad=slipped * np.deg2rad(self.turn_deg), translation_mm=slipped * np.array(self.shift_mm)
        )


class Compliance(Moving):
    """The machine between the sample and the stage, which gives way to the force."""

    shift_mm: Vector = (0.14, 0.02, -0.18)
    """shift (x, y, z) reached at the last step, in proportion to the force gained, mm"""
    tilt_deg: Vector = (0.03, 0.08, 0.02)
    """rotation vector (x, y, z) reached at the last step, about the origin, degrees"""

    def motion(self, drive: Drive) -> RigidMotion:
        """Return the shift and tilt that follow the force."""
        load = drive.history.load_fraction[:, None]
        return RigidMotion(
            rotation_rad=load * np.deg2rad(self.tilt_deg), translation_mm=load * np.array(self.shift_mm)
        )


class Backlash(Moving):
    """A jump between the reference scan and the test, and a short motion when the stroke starts."""

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

    def motion(self, drive: Drive) -> RigidMotion:
        """Return the jump before the test and the short motion at the start of the stroke."""
        steps = np.arange(len(drive.angle_rad))
        ramp = np.clip((steps - drive.start_step) / self.start_steps, 0.0, 1.0)[:, None]
        return RigidMotion(
            rotation_rad=np.deg2rad(self.before_deg) + ramp * np.deg2rad(self.start_deg),
            translation_mm=np.array(self.before_mm) + ramp * np.array(self.start_mm),
        )


class Wobble(Moving):
    """Another axis of rotation than during the reference scan; fixed in the lab."""

    across_mm: float = 0.05
    """shift of the axis across the beam, to the right of the image, mm"""
    along_mm: float = 0.01
    """shift of the axis along the beam, away from the source, mm"""
    roll_deg: float = 0.01
    """turn of the axis about the beam, degrees"""
    lean_deg: float = 0.01
    """turn of the axis about the horizontal across the beam, degrees"""

    def motion(self, drive: Drive) -> RigidMotion:
        """Return the motion of an axis displaced in the lab: along e_c and e_b of `pdvc.geometry`."""
        c, s, zero = np.cos(drive.angle_rad), np.sin(drive.angle_rad), np.zeros_like(drive.angle_rad)
        beam, column = np.column_stack([c, -s, zero]), np.column_stack([-s, -c, zero])
        return RigidMotion(
            rotation_rad=np.deg2rad(self.roll_deg) * beam + np.deg2rad(self.lean_deg) * column,
            translation_mm=self.across_mm * column + self.along_mm * beam,
        )


class Creep(Deforming):
    """A stretch that goes on with the logarithm of time since the stroke started, where the section is small."""

    strain: float = 2e-3
    """strain of the smallest section at the last step, without unit"""
    time_s: Annotated[float, Field(gt=0)] = 20.0
    """time constant tau of log(1 + t / tau), s"""

    def deformation(self, drive: Drive) -> Deformation:
        """Return a strain that falls off with the fourth power of the section, at constant volume."""
        history = drive.history
        since = np.clip(history.time_s - history.time_s[drive.start_step], 0.0, None)
        course = np.log1p(since / self.time_s)
        course /= course[-1] if course[-1] > 0 else 1.0
        strain = self.strain * course[:, None] * (drive.area_mm2.min() / drive.area_mm2) ** 4
        return Deformation.at_constant_volume(strain)


class Ripple(Deforming):
    """A strain sinusoidal in height, at constant volume, in proportion to the force gained.

        eps(Z, t) = eps_a sin(2 pi Z / lambda + phi) (F(t) - F(0)) / (F(T) - F(0)),      s = (1 + eps)^(-1/2)

    with the height Z of the material, mm, zero in the middle of the ligament, the last step T, and the transverse
    stretch s. The amplitude is the same at all heights, whatever the section: it asks how fine a strain is recovered.
    """

    strain: Annotated[float, Field(ge=0, lt=1)] = 0.02
    """amplitude eps_a at the last step, without unit"""
    wavelength_mm: Annotated[float, Field(gt=0)] = 2.0
    """wavelength lambda along z, mm"""
    phase_deg: float = 0.0
    """phase phi in the middle of the ligament, degrees; 0: a sine, 90: a cosine"""

    def deformation(self, drive: Drive) -> Deformation:
        """Return the strain and the contraction; raises ValueError where the heights are too few for the wave."""
        height = drive.history.height_mm
        shortest = HEIGHTS_A_WAVE * float(np.diff(height).max())
        # a hair of room: a wavelength of just so many heights is not refused by rounding
        if self.wavelength_mm < (1 - 1e-9) * shortest:
            raise ValueError(
                f"motion.ripple.wavelength_mm: expected at least {shortest:.4g} mm, {HEIGHTS_A_WAVE} of the heights "
                f"at which strains are given, got {self.wavelength_mm} mm"
            )
        wave = np.sin(2 * np.pi * height / self.wavelength_mm + np.deg2rad(self.phase_deg))
        strain = self.strain * drive.history.load_fraction[:, None] * wave
        return Deformation.at_constant_volume(strain)


class Wander(Moving):
    """A random motion of the sample as a whole, which no time function describes: drift, slow wandering, and slips."""

    draw: Annotated[int, Field(ge=0)] = 0
    """which one: another number is another motion"""
    shift_mm: float = 0.01
    """rms of the slow part of the shift along each axis, mm"""
    tilt_deg: float = 0.01
    """the same of the rotation vector, degrees"""
    slow_steps: Annotated[float, Field(gt=0)] = 15.0
    """steps over which the slow part changes"""
    drift_mm: float = 0.01
    """rms of a steady drift along each axis, over the whole test, mm"""
    slips: Annotated[int, Field(ge=0, le=32)] = 2
    """sudden shifts, at random steps"""
    slip_mm: float = 0.01
    """rms of each slip along each axis, mm"""

    def motion(self, drive: Drive) -> RigidMotion:
        """Return a Gaussian process of squared-exponential covariance, zero at the first step, drift, and slips."""
        rng, count = np.random.default_rng(np.random.SeedSequence(self.draw)), len(drive.angle_rad)
        step = np.arange(count)
        covariance = np.exp(-(((step[:, None] - step) / self.slow_steps) ** 2) / 2) + 1e-9 * np.eye(count)
        slow = np.linalg.cholesky(covariance) @ rng.normal(size=(count, 6))
        slow -= slow[0]
        drift = rng.normal(size=3) * (step / max(count - 1, 1))[:, None]
        # drawn whether asked for or not, so that one more slip leaves the others as they were
        at, size = rng.integers(1, max(count, 2), size=32), rng.normal(size=(32, 3))
        slips = ((step[:, None] >= at[: self.slips])[..., None] * size[: self.slips]).sum(axis=1)
        return RigidMotion(
            rotation_rad=np.deg2rad(self.tilt_deg) * slow[:, 3:],
            translation_mm=self.shift_mm * slow[:, :3] + self.drift_mm * drift + self.slip_mm * slips,
        )


def _known(name: str) -> str:
    names = [repr(each) for each in MotionOptions.names()]
    if repr(name) not in names:
        raise ValueError(f"{', '.join(names[:-1])} or {names[-1]}")
    return name


class MotionOptions(Settings):
    """Motion of the sample during the test; the reference scan is made at rest."""

    ingredients: tuple[Annotated[str, AfterValidator(_known)], ...] = (
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
    slip: Slip = Slip()
    """sudden slip in the grips"""
    compliance: Compliance = Compliance()
    """the machine gives way to the force"""
    backlash: Backlash = Backlash()
    """motion before the test and at the start of the stroke"""
    wobble: Wobble = Wobble()
    """another axis of rotation than in the reference scan"""
    creep: Creep = Creep()
    """stretch that goes on with the logarithm of time"""
    ripple: Ripple = Ripple()
    """strain sinusoidal in height"""
    wander: Wander = Wander()
    """random motion of the sample as a whole"""

    @field_validator("sections")
    @classmethod
    def _none_or_several(cls, value: int) -> int:
        if value == 1:
            raise ValueError("0, or at least 2 sections")
        return value

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of all ingredients there are, in the order in which they are carried out."""
        return tuple(name for name, each in cls.model_fields.items() if isinstance(each.default, Ingredient))

    def motion(self, drive: Drive) -> Composition:
        """Return what the ingredients that take place do together: deformation first, then the motions."""
        active: list[Ingredient] = [getattr(self, name) for name in self.names() if name in self.ingredients]
        deformations = [each.deformation(drive) for each in active if isinstance(each, Deforming)]
        beam = [beam_motion(deformations, drive)] if deformations else []
        return Composition((*beam, *(each.motion(drive) for each in active if isinstance(each, Moving))))


def beam_motion(parts: Sequence[Deformation], drive: Drive) -> BeamMotion:
    """Return the motion of a beam that several ingredients deform."""
    height, steps = drive.history.height_mm, len(drive.angle_rad)
    strain, stretch = np.zeros((steps, len(height))), np.ones((steps, len(height)))
    bend, twist = np.zeros((2, steps, len(height), 3))
    for part in parts:
        strain, stretch = strain + part.strain, stretch * part.stretch
        bend, twist = bend + part.bend_rad, twist + part.twist_rad
    turns = [Rotation.from_rotvec(bend[t]) * Rotation.from_rotvec(twist[t]) for t in range(steps)]
    upward = np.stack([turn.apply([0.0, 0.0, 1.0]) for turn in turns])
    centre = _from_origin(height, (1 + strain)[..., None] * upward)
    return BeamMotion(
        knot_mm=height,
        displacement_mm=centre - height[:, None] * np.array([0.0, 0.0, 1.0]),
        rotation_rad=np.stack([turn.as_rotvec() for turn in turns]),
        stretch=stretch,
    )


def _from_origin(height_mm: Floats, slope: Floats) -> Floats:
    """Integrate along z, from 0 at height 0: heights on axis 0 of a profile, or on axis 1 of (step, ...)."""
    integral = CubicSpline(height_mm, slope, axis=0 if slope.ndim == 1 else 1).antiderivative()
    from_zero = integral(height_mm) - np.expand_dims(integral(0.0), 0 if slope.ndim == 1 else 1)
    return np.asarray(from_zero, dtype=np.float64)
