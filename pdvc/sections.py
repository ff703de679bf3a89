"""Spatial basis: beam sections along z, each with a few affine motions, joined by hat functions (Eq. 18).

    u(x) = sum_j p_j(z) sum_k a_jk psi_jk(x),      psi_jk(x) = t_k + G_k (x - z_j e_z) / radius

with p_j the hat function of section j (constant beyond the outermost sections), a_jk in voxels and
psi_jk without unit. Rotations turn about the axis point of their own section and are scaled by a radius,
so that every amplitude is a displacement in voxels at that radius. The space spanned is the paper's,
whose rotations all turn about one point: hat functions reproduce what is linear in z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

RIGID = ("translation_x", "translation_y", "translation_z", "rotation_x", "rotation_y", "rotation_z")
"""The paper's six motions of a section."""
CONTRACTION = "contraction"
"""One more: the section grows or shrinks alike in x and y, as plastic flow makes it."""

_PATTERNS: dict[str, NDArray[np.float64]] = {
    # each row: [G | t], so that psi = G (x - z_j e_z) / radius + t
    "translation_x": np.array([[0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=float),
    "translation_y": np.array([[0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]], dtype=float),
    "translation_z": np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]], dtype=float),
    "rotation_x": np.array([[0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0]], dtype=float),
    "rotation_y": np.array([[0, 0, 1, 0], [0, 0, 0, 0], [-1, 0, 0, 0]], dtype=float),
    "rotation_z": np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]], dtype=float),
    "contraction": np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=float),
}


@dataclass(frozen=True, kw_only=True)
class SectionBasis:
    """Hold the heights of the sections and the motions that each may make."""

    height_mm: Floats
    """Heights z_j of the sections, mm, increasing; one alone makes the whole sample move as one."""
    radius_mm: float
    """Distance from the axis at which a unit rotation amplitude moves a point by a voxel."""
    motions: tuple[str, ...] = RIGID
    """Names of the motions of each section."""

    def __post_init__(self) -> None:
        height = np.asarray(self.height_mm, dtype=float)
        if height.ndim != 1 or len(height) < 1 or np.any(np.diff(height) <= 0):
            raise ValueError(f"section heights: expected increasing numbers in mm, got {self.height_mm}")
        unknown = [name for name in self.motions if name not in _PATTERNS]
        if unknown or not self.motions:
            raise ValueError(f"section motions: expected some of {sorted(_PATTERNS)}, got {self.motions}")
        if not self.radius_mm > 0:
            raise ValueError(f"section radius: expected a positive length in mm, got {self.radius_mm}")
        object.__setattr__(self, "height_mm", height)

    @property
    def shape(self) -> tuple[int, int]:
        """Return (sections, motions): the shape of one step's amplitudes."""
        return len(self.height_mm), len(self.motions)

    def patterns(self) -> Floats:
        """Return psi_jk as affine maps [G | t] of x in mm: (section, motion, 3, 4), unit amplitude."""
        pattern = np.stack([_PATTERNS[name] for name in self.motions])
        result = np.repeat(pattern[None], len(self.height_mm), axis=0)
        result[..., :3] /= self.radius_mm
        result[..., 3] -= result[..., 2] * self.height_mm[:, None, None]
        return result

    def affine(self, amplitude: ArrayLike) -> Floats:
        """Return each section's displacement as an affine map of x in mm.

        `amplitude` (..., section, motion) in voxels; returns (..., section, 3, 4) = [G | t] in voxels.
        """
        return np.einsum("...jk,jkab->...jab", np.asarray(amplitude, dtype=float), self.patterns())

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
        return np.einsum("pab,pb->pa", maps[..., :3], points) + maps[..., 3]

    def rigid(self, amplitude: ArrayLike, single: SectionBasis) -> Floats:
        """Return the amplitudes of this basis that reproduce a motion of `single`, a basis of one section.

        `amplitude` (..., 1, motion of single) in voxels; returns (..., section, motion). Exact, because hat
        functions reproduce linear fields.
        """
        moved = single.affine(amplitude)[..., 0, :, :]
        result = np.zeros((*moved.shape[:-2], *self.shape))
        at_axis = moved[..., None, :, 3] + moved[..., None, :, 2] * self.height_mm[:, None]
        gradient = moved[..., :3] * self.radius_mm
        for k, name in enumerate(self.motions):
            kind, _, axis = name.partition("_")
            if kind == "translation":
                result[..., k] = at_axis[..., "xyz".index(axis)]
            elif kind == "rotation":
                row, column = {"x": (2, 1), "y": (0, 2), "z": (1, 0)}[axis]
                result[..., k] = gradient[..., row, column][..., None]
            else:
                result[..., k] = gradient[..., 0, 0][..., None]
        return result
