"""Prescribed motion of every material point, with its exact inverse and its deformation gradient.

A material point X of the reference configuration (the sample during the reference scan) is found at
x = X + U(X, t) in the sample frame of `pdvc.geometry` at test step t. Rotations are finite: a rotation
vector r turns by |r| rad about r (Rodrigues). Lengths in mm, arrays of points (point, 3).

========================  ==========================================================================
`BeamMotion`              sections of a beam, carried with the material (Lagrangian)
`RigidMotion`             the whole sample as one
`SectionMotion`           sections fixed in space (Eulerian), inside the solver's own space (Eq. 18)
`Composition`             one motion after another
========================  ==========================================================================
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import reduce
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from simulator.each_point import along_beam, on_spline, products, turned, turns

Floats = NDArray[np.float64]

TOLERANCE_MM = 1e-11
"""Iterative maps stop when no point moves by more than this."""


class Motion(Protocol):
    """A motion of material points: to where they are at a step, and back."""

    def forward(self, points_mm: Floats, step: int) -> Floats:
        """Return the positions x of material points X, (point, 3) in mm."""

    def inverse(self, points_mm: Floats, step: int) -> Floats:
        """Return the material points X found at positions x, (point, 3) in mm."""

    def gradient(self, points_mm: Floats, step: int) -> Floats:
        """Return the deformation gradient dx/dX at material points X, (point, 3, 3)."""

    def carry(self, points_mm: Floats, step: int) -> tuple[Floats, Floats]:
        """Return the positions and the deformation gradient at once, for less than they cost one by one."""


class MotionError(ValueError):
    """A prescribed motion that cannot be carried out: which, and why."""


@dataclass(frozen=True, kw_only=True)
class RigidMotion:
    """A turn and a shift of the whole sample: x = centre + R(r) (X - centre) + t."""

    rotation_rad: Floats
    """Rotation vector r (step, 3), rad."""
    translation_mm: Floats
    """Translation t (step, 3), mm."""
    centre_mm: Floats = field(default_factory=lambda: np.zeros(3))
    """Point about which the sample turns (3,), mm."""

    def forward(self, points_mm: Floats, step: int) -> Floats:
        """Return the positions x of material points X."""
        matrix = rotation_matrix(self.rotation_rad[step])
        return np.asarray(turned(points_mm, matrix, self.centre_mm, self.translation_mm[step] + self.centre_mm))

    def inverse(self, points_mm: Floats, step: int) -> Floats:
        """Return the material points X found at positions x."""
        matrix = rotation_matrix(self.rotation_rad[step])
        arm = points_mm - (self.translation_mm[step] + self.centre_mm)
        return np.asarray(np.einsum("ba,pb->pa", matrix, arm) + self.centre_mm)

    def gradient(self, points_mm: Floats, step: int) -> Floats:
        """Return R for every point."""
        return np.broadcast_to(rotation_matrix(self.rotation_rad[step]), (len(points_mm), 3, 3))

    def carry(self, points_mm: Floats, step: int) -> tuple[Floats, Floats]:
        """Return positions and R for every point."""
        return self.forward(points_mm, step), self.gradient(points_mm, step)


@dataclass(frozen=True, kw_only=True)
class BeamMotion:
    """The motion of a slender sample, section by section: x = Z e_z + d(Z) + R(Z) s(Z) [X, Y, 0].

    Profiles are given at knots and joined by natural cubic splines, so that the deformation gradient is
    smooth; beyond the outermost knots they go on linearly.
    """

    knot_mm: Floats
    """Material heights Z of the knots (knot,), mm, increasing."""
    displacement_mm: Floats
    """Displacement d of the centre line (step, knot, 3), mm."""
    rotation_rad: Floats
    """Rotation vector r of the section (step, knot, 3), rad."""
    stretch: Floats
    """Transverse stretch s (step, knot), without unit: below 1 where the section shrinks."""

    def forward(self, points_mm: Floats, step: int) -> Floats:
        """Return the positions x of material points X."""
        return self.carry(points_mm, step)[0]

    def inverse(self, points_mm: Floats, step: int) -> Floats:
        """Return the material points X found at positions x.

        Newton's method on the height Z of the section that holds x: (x - c(Z)) . n(Z) = 0, with n = R e_z.
        """
        height = points_mm[:, 2] - self._sections(points_mm[:, 2], step).shift[:, 2]
        for _ in range(50):
            section = self._sections(height, step)
            offset = points_mm - section.centre
            normal = section.matrix[:, :, 2]
            distance = np.sum(offset * normal, axis=1)
            slope = np.sum(offset * np.cross(section.spin, normal) - section.tangent * normal, axis=1)
            change = distance / slope
            height = height - change
            if not np.all(np.isfinite(change)):
                break
            if np.max(np.abs(change), initial=0.0) < TOLERANCE_MM:
                section = self._sections(height, step)
                local = np.einsum("pba,pb->pa", section.matrix, points_mm - section.centre)
                return np.column_stack([local[:, :2] / section.stretch[:, None], height])
        raise MotionError(f"beam motion at step {step}: the sections cross, no unique material point")

    def gradient(self, points_mm: Floats, step: int) -> Floats:
        """Return dx/dX at material points X."""
        return self.carry(points_mm, step)[1]

    def carry(self, points_mm: Floats, step: int) -> tuple[Floats, Floats]:
        """Return positions and dx/dX at material points X: columns s R e_x, s R e_y and dx/dZ."""
        section = self._sections(points_mm[:, 2], step)
        moved, gradient = along_beam(
            points_mm, section.centre, section.tangent, section.matrix, section.spin, section.stretch, section.growth
        )
        return moved, gradient

    def _sections(self, height_mm: Floats, step: int) -> _Sections:
        profile = np.column_stack([self.displacement_mm[step], self.rotation_rad[step], self.stretch[step][:, None]])
        spline = CubicSpline(self.knot_mm, profile, bc_type="natural")
        value, slope = on_spline(self.knot_mm, spline.c, height_mm)
        centre, tangent = value[:, :3].copy(), slope[:, :3].copy()
        centre[:, 2] += height_mm
        tangent[:, 2] += 1.0
        matrix, spin = turns(value[:, 3:6], slope[:, 3:6])
        return _Sections(
            shift=value[:, :3],
            centre=centre,
            tangent=tangent,
            matrix=matrix,
            spin=spin,
            stretch=value[:, 6],
            growth=slope[:, 6],
        )


@dataclass(frozen=True)
class _Sections:
    """The state of one section for each point, and its derivatives along Z."""

    shift: Floats
    centre: Floats
    tangent: Floats
    matrix: Floats
    spin: Floats
    stretch: Floats
    growth: Floats


@dataclass(frozen=True, kw_only=True)
class SectionMotion:
    """A motion by sections fixed in space: X = x - u(x), u(x) = sum_j p_j(z) [t_j + w_j x (x - z_j e_z)].

    p_j are the hat functions of Eq. 18, constant beyond the outermost sections; x is the *current*
    position. The inverse is closed; the forward map solves x - u(x) = X by Newton's method.
    """

    height_mm: Floats
    """Heights z_j of the sections (section,), mm, increasing."""
    translation_mm: Floats
    """t_j (step, section, 3), mm."""
    rotation_rad: Floats
    """w_j (step, section, 3), rad; small rotations: u is linear in them."""

    def forward(self, points_mm: Floats, step: int) -> Floats:
        """Return the positions x of material points X."""
        x = points_mm + self.displacement(points_mm, step)
        for _ in range(100):
            excess = x - self.displacement(x, step) - points_mm
            change = np.linalg.solve(self._inverse_gradient(x, step), excess[..., None])[..., 0]
            x = x - change
            if not np.all(np.isfinite(x)):
                break
            if np.max(np.abs(change), initial=0.0) < TOLERANCE_MM:
                return x
        raise MotionError(f"section motion at step {step}: the sections cross, no unique position")

    def inverse(self, points_mm: Floats, step: int) -> Floats:
        """Return the material points X = x - u(x) found at positions x."""
        return points_mm - self.displacement(points_mm, step)

    def gradient(self, points_mm: Floats, step: int) -> Floats:
        """Return dx/dX = (I - du/dx)^-1 at material points X."""
        return self.carry(points_mm, step)[1]

    def carry(self, points_mm: Floats, step: int) -> tuple[Floats, Floats]:
        """Return positions and dx/dX at material points X."""
        x = self.forward(points_mm, step)
        return x, np.asarray(np.linalg.inv(self._inverse_gradient(x, step)), dtype=np.float64)

    def displacement(self, points_mm: Floats, step: int) -> Floats:
        """Return u (point, 3), mm, at current positions x."""
        lower, weight, _ = self._hats(points_mm[:, 2])
        below = self._of_section(points_mm, lower, step)
        above = self._of_section(points_mm, lower + 1, step)
        return below + weight[:, None] * (above - below)

    def _inverse_gradient(self, x: Floats, step: int) -> Floats:
        lower, weight, slope = self._hats(x[:, 2])
        below = self._of_section(x, lower, step)
        above = self._of_section(x, lower + 1, step)
        turn = self.rotation_rad[step]
        result = np.eye(3) - cross_matrix(turn[lower] + weight[:, None] * (turn[lower + 1] - turn[lower]))
        result[:, :, 2] -= slope[:, None] * (above - below)
        return result

    def _of_section(self, x: Floats, section: NDArray[np.intp], step: int) -> Floats:
        arm = x.copy()
        arm[:, 2] -= self.height_mm[section]
        return np.asarray(self.translation_mm[step, section] + np.cross(self.rotation_rad[step, section], arm))

    def _hats(self, z: Floats) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Return the section below, the weight of the one above, and that weight's slope along z."""
        heights = self.height_mm
        lower = np.clip(np.searchsorted(heights, z, side="right") - 1, 0, len(heights) - 2)
        gap = heights[lower + 1] - heights[lower]
        weight = (z - heights[lower]) / gap
        inside = (weight >= 0.0) & (weight <= 1.0)
        return lower, np.clip(weight, 0.0, 1.0), np.where(inside, 1.0 / gap, 0.0)


@dataclass(frozen=True)
class Composition:
    """Several motions carried out one after the other, the first one first; none at all is rest."""

    motions: tuple[Motion, ...] = ()

    def forward(self, points_mm: Floats, step: int) -> Floats:
        """Return the positions x of material points X."""
        return reduce(lambda points, motion: motion.forward(points, step), self.motions, points_mm)

    def inverse(self, points_mm: Floats, step: int) -> Floats:
        """Return the material points X found at positions x."""
        return reduce(lambda points, motion: motion.inverse(points, step), self.motions[::-1], points_mm)

    def gradient(self, points_mm: Floats, step: int) -> Floats:
        """Return dx/dX by the chain rule."""
        return self.carry(points_mm, step)[1]

    def carry(self, points_mm: Floats, step: int) -> tuple[Floats, Floats]:
        """Return positions, and dx/dX by the chain rule."""
        result: Floats = np.broadcast_to(np.eye(3), (len(points_mm), 3, 3))
        for motion in self.motions:
            points_mm, gradient = motion.carry(points_mm, step)
            result = products(gradient, result)
        return points_mm, result


def rotation_matrix(vector_rad: ArrayLike) -> Floats:
    """Return exp([r]x), the rotation by |r| rad about r: (..., 3) to (..., 3, 3)."""
    vector = np.asarray(vector_rad, dtype=np.float64)
    matrix, _ = turns(vector.reshape(-1, 3), np.zeros((vector.size // 3, 3)))
    return np.asarray(matrix.reshape(*vector.shape, 3))


def cross_matrix(vector: ArrayLike) -> Floats:
    """Return [v]x, the matrix that takes a to v x a: (..., 3) to (..., 3, 3)."""
    x, y, z = np.moveaxis(np.asarray(vector, dtype=float), -1, 0)
    zero = np.zeros_like(x)
    rows = [np.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, axis=-2)
