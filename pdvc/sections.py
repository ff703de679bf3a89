"""Spatial basis: beam sections along z, each with a few affine motions, joined by hat functions (Eq. 18).

    u(x) = sum_j p_j(z) sum_k a_jk psi_jk(x),      psi_jk(x) = t_k + G_k (x - z_j e_z) / radius

with p_j the hat function of section j (constant beyond the outermost sections), a_jk in voxels and
psi_jk without unit. Rotations turn about the axis point of their own section and are scaled by a radius,
so that every amplitude is a displacement in voxels at that radius. The space spanned is the paper's,
whose rotations all turn about one point: hat functions reproduce what is linear in z.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

Row = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class SectionPattern:
    """A motion that a section may make, by its unit amplitude: psi(x) = G (x - z_j e_z) / radius + t."""

    name: str
    """What options and results call it."""
    gradient: tuple[Row, Row, Row] = ((0, 0, 0), (0, 0, 0), (0, 0, 0))
    """G, without unit."""
    shift: Row = (0, 0, 0)
    """t, without unit."""

    def __post_init__(self) -> None:
        gradient, shift = np.array(self.gradient, dtype=float), np.array(self.shift, dtype=float)
        finite = gradient.shape == (3, 3) and shift.shape == (3,) and np.isfinite([*gradient.ravel(), *shift]).all()
        if not self.name or not finite:
            raise ValueError(
                f"section motion {self.name!r}: expected a name, 3 x 3 numbers as gradient and 3 as shift, got "
                f"{self.gradient} and {self.shift}"
            )
        object.__setattr__(self, "gradient", tuple(tuple(row) for row in gradient.tolist()))
        object.__setattr__(self, "shift", tuple(shift.tolist()))

    @classmethod
    def of(cls, name: str, pattern: ArrayLike) -> SectionPattern:
        """Return the motion with a pattern [G | t] (3, 4)."""
        rows = [tuple(float(value) for value in row) for row in np.asarray(pattern)]
        first, second, third = ((x, y, z) for x, y, z, _ in rows)
        x, y, z = (row[3] for row in rows)
        return cls(name=name, gradient=(first, second, third), shift=(x, y, z))

    def pattern(self) -> Floats:
        """Return [G | t] (3, 4)."""
        return np.column_stack([np.array(self.gradient, dtype=float), np.array(self.shift, dtype=float)])


TRANSLATION_X = SectionPattern(name="translation_x", shift=(1, 0, 0))
TRANSLATION_Y = SectionPattern(name="translation_y", shift=(0, 1, 0))
TRANSLATION_Z = SectionPattern(name="translation_z", shift=(0, 0, 1))
ROTATION_X = SectionPattern(name="rotation_x", gradient=((0, 0, 0), (0, 0, -1), (0, 1, 0)))
ROTATION_Y = SectionPattern(name="rotation_y", gradient=((0, 0, 1), (0, 0, 0), (-1, 0, 0)))
ROTATION_Z = SectionPattern(name="rotation_z", gradient=((0, -1, 0), (1, 0, 0), (0, 0, 0)))
RIGID = (TRANSLATION_X, TRANSLATION_Y, TRANSLATION_Z, ROTATION_X, ROTATION_Y, ROTATION_Z)
"""The paper's six motions of a section."""
CONTRACTION = SectionPattern(name="contraction", gradient=((1, 0, 0), (0, 1, 0), (0, 0, 0)))
"""One more: the section grows or shrinks alike in x and y, as plastic flow makes it."""

_OFFERED = {motion.name: motion for motion in (*RIGID, CONTRACTION)}


def offer_motion(motion: SectionPattern) -> None:
    """Offer a motion of one's own to the option `section_motions`, under its name.

    Raises ValueError where another motion has that name.
    """
    if _OFFERED.setdefault(motion.name, motion) != motion:
        raise ValueError(f"section motion {motion.name!r}: expected a name that is free, another motion has it")


def names_of(motions: Iterable[SectionPattern]) -> tuple[str, ...]:
    """Return the names of motions."""
    return tuple(motion.name for motion in motions)


def offered_motions() -> tuple[str, ...]:
    """Return the names of all motions that are offered."""
    return tuple(_OFFERED)


def motions_named(names: Iterable[str]) -> tuple[SectionPattern, ...]:
    """Return motions by their names; raises ValueError where one is not offered."""
    wanted = tuple(names)
    unknown = [name for name in wanted if name not in _OFFERED]
    if unknown or not wanted:
        raise ValueError(
            f"section motions: expected some of {sorted(_OFFERED)}, or what an installed plug-in offers, got {wanted}"
        )
    return tuple(_OFFERED[name] for name in wanted)


NEARLY = 1e-9
"""Share of a motion that may be missed where it counts as represented: what rounding leaves."""


@dataclass(frozen=True, kw_only=True)
class SectionBasis:
    """Sections at some heights, and the motions that each may make."""

    height_mm: Floats
    """Heights z_j of the sections, mm, increasing; one alone makes the whole sample move as one."""
    radius_mm: float
    """Distance from the axis at which a unit rotation amplitude moves a point by a voxel."""
    motions: tuple[SectionPattern, ...] = RIGID
    """The motions of each section, none of them a sum of others."""

    def __post_init__(self) -> None:
        height = np.asarray(self.height_mm, dtype=float)
        if height.ndim != 1 or len(height) < 1 or np.any(np.diff(height) <= 0):
            raise ValueError(f"section heights: expected increasing numbers in mm, got {self.height_mm}")
        if not self.motions or np.linalg.matrix_rank(self._patterns()) < len(self.motions):
            raise ValueError(f"section motions: expected some, none a sum of others, got {self.names}")
        if not self.radius_mm > 0:
            raise ValueError(f"section radius: expected a positive length in mm, got {self.radius_mm}")
        object.__setattr__(self, "height_mm", height)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the motions."""
        return names_of(self.motions)

    @property
    def shape(self) -> tuple[int, int]:
        """Return (sections, motions): the shape of one step's amplitudes."""
        return len(self.height_mm), len(self.motions)

    def patterns(self) -> Floats:
        """Return psi_jk as affine maps [G | t] of x in mm: (section, motion, 3, 4), unit amplitude."""
        result = np.repeat(self._patterns().reshape(1, -1, 3, 4), len(self.height_mm), axis=0)
        result[..., :3] /= self.radius_mm
        result[..., 3] -= result[..., 2] * self.height_mm[:, None, None]
        return result

    def affine(self, amplitude: ArrayLike) -> Floats:
        """Return each section's displacement as an affine map of x in mm.

        `amplitude` (..., section, motion) in voxels; returns (..., section, 3, 4) = [G | t] in voxels.
        """
        return np.asarray(np.einsum("...jk,jkab->...jab", np.asarray(amplitude, dtype=float), self.patterns()))

    def weights(self, z_mm: ArrayLike) -> Floats:
        """Return the hat functions p_j at heights z, mm: (..., section); they add up to one."""
        z = np.asarray(z_mm, dtype=float)
        identity = np.eye(len(self.height_mm))
        if len(self.height_mm) == 1:
            return np.ones((*z.shape, 1))
        return np.stack([np.interp(z, self.height_mm, row) for row in identity], axis=-1)

    def shapes(self, points_mm: ArrayLike) -> Floats:
        """Return what each unit amplitude moves at points x (point, 3), mm: (point, 3, section, motion), voxels."""
        points = np.asarray(points_mm, dtype=float)
        patterns = self.patterns()
        moved = np.einsum("jkab,pb->pajk", patterns[..., :3], points) + np.moveaxis(patterns[..., 3], 2, 0)
        return np.asarray(moved * self.weights(points[:, 2])[:, None, :, None])

    def displacement(self, amplitude: ArrayLike, points_mm: ArrayLike) -> Floats:
        """Return u, in voxels, at points x (point, 3) in mm of the *current* configuration.

        `amplitude` (section, motion) in voxels; returns (point, 3), NaN where a section with NaN takes part.
        """
        points = np.asarray(points_mm, dtype=float)
        weights, affine = self.weights(points[:, 2]), self.affine(amplitude)
        maps = np.einsum("pj,jab->pab", weights, np.nan_to_num(affine))
        # 0 x NaN is NaN, but a section that takes no part in a point must not spoil it
        maps[(weights[:, np.isnan(affine).any(axis=(1, 2))] > 0).any(axis=1)] = np.nan
        return np.asarray(np.einsum("pab,pb->pa", maps[..., :3], points) + maps[..., 3])

    def reproduced(self, amplitude: ArrayLike, single: SectionBasis) -> Floats:
        """Return the amplitudes of this basis that reproduce a motion of `single`, a basis of one section.

        `amplitude` (..., 1, motion of single) in voxels; returns (..., section, motion). Exact, because hat
        functions reproduce linear fields. Raises ValueError where the sections cannot move so.
        """
        moved = single.affine(amplitude)[..., 0, :, :]
        wanted = np.zeros((*moved.shape[:-2], len(self.height_mm), 3, 4))
        # each section has its own origin on the axis, and its rotations are displacements at the radius
        wanted[..., :3] = moved[..., None, :, :3] * self.radius_mm
        wanted[..., 3] = moved[..., None, :, 3] + moved[..., None, :, 2] * self.height_mm[:, None]
        flat, patterns = wanted.reshape(*wanted.shape[:-2], 12), self._patterns()
        # the least-squares answer by its normal equations: without rounding for patterns that share no entry
        found = np.linalg.solve(patterns @ patterns.T, (flat @ patterns.T)[..., None])[..., 0]
        missed = np.abs(found @ patterns - flat).max(initial=0.0)
        if missed > NEARLY * max(np.abs(flat).max(initial=0.0), 1.0):
            raise ValueError(
                f"section motions: expected motions that can follow the sample as one rigid body, but {self.names} "
                f"miss up to {missed:.2g} voxel of what {single.names} make"
            )
        return np.asarray(found)

    def reproduces(self, single: SectionBasis) -> bool:
        """Return whether these sections can follow every motion of `single`, a basis of one section."""
        try:
            self.reproduced(np.eye(len(single.motions))[:, None], single)
        except ValueError:
            return False
        return True

    def _patterns(self) -> Floats:
        """Return [G | t] of each motion, flat (motion, 12)."""
        return np.stack([motion.pattern().ravel() for motion in self.motions])
