"""The motion of a stretched beam as section amplitudes: what a law says that the sections of `pdvc.sections` do.

Material at height Z moves by U(Z) = int e dZ, from the middle of the sections, along the beam, and shrinks across it
to the share s(Z). The sample has moved as a whole meanwhile, so that a section at height z holds the material of
z = Z + d + U(Z), with d the height that a measured motion tells. There

    u_z(z) = U(Z)            u_xy(x) = (1 - 1 / s) x

of which hat functions take what is nearest by least squares over the height. What moves the whole, d among it, is left
to other unknowns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdvc.sections import CONTRACTION, TRANSLATION_Z, SectionBasis

Floats = NDArray[np.float64]

FINE = 8
"""Heights of each section at which what hats are fitted to is taken."""
_CLOSE = 1e-9
_ROUNDS = 30
"""Times that the material at a height is looked for: each is nearer by the strain."""


@dataclass(frozen=True, kw_only=True)
class Carrier:
    """Takes strains of a beam to the amplitudes of sections."""

    basis: SectionBasis
    voxel_mm: float
    height_mm: Floats
    """Material heights at which strains are given (height,), mm, equally spaced."""
    shift_mm: Floats
    """d (step,): how far the material in the middle of the sections has moved up, mm."""

    def amplitude(self, strain: Floats, stretch: Floats) -> Floats:
        """Return amplitudes (step, section, motion), voxels, of strains and transverse stretches (step, height)."""
        risen = self._risen(strain)
        found = self._material(risen)
        return self._fitted(_between(risen, found), _between((1 - 1 / stretch) * self.basis.radius_mm, found))

    def tangent(self, strain: Floats, stretch: Floats) -> Callable[[Floats, Floats], Floats]:
        """Return the function that makes changes of amplitudes of small changes of strain and stretch.

        As another material comes to a height, d u_z = dU / (1 + e), and dZ = -dU / (1 + e).
        """
        risen = self._risen(strain)
        found = self._material(risen)
        stretched = 1 + _between(strain, found)
        shrinks = (1 - 1 / stretch) * self.basis.radius_mm
        slope = _between(np.gradient(shrinks, self._spacing, axis=1), found)

        def changed(of_strain: Floats, of_stretch: Floats) -> Floats:
            up = _between(self._risen(of_strain), found) / stretched
            across = _between(of_stretch / stretch**2 * self.basis.radius_mm, found) - slope * up
            return self._fitted(up, across)

        return changed

    @property
    def _spacing(self) -> float:
        return float(np.mean(np.diff(self.height_mm)))

    def _risen(self, strain: Floats) -> Floats:
        """Return U (step, height), mm."""
        grown = (strain[:, 1:] + strain[:, :-1]) * (self._spacing / 2)
        risen = np.concatenate([np.zeros((len(strain), 1)), np.cumsum(grown, axis=1)], axis=1)
        middle = np.full((len(strain), 1), (middle_mm(self.basis) - self.height_mm[0]) / self._spacing)
        return np.asarray(risen - _between(risen, middle))

    def _material(self, risen: Floats) -> Floats:
        """Return which material is at the fine heights (step, fine height), as places among the heights."""
        place = (self._fit[0] - self.shift_mm[:, None] - self.height_mm[0]) / self._spacing
        found = place
        for _ in range(_ROUNDS):
            moved = place - _between(risen, found) / self._spacing
            far, found = np.abs(moved - found).max(), moved
            if far < _CLOSE:
                break
        return np.asarray(found)

    def _fitted(self, up_mm: Floats, across_mm: Floats) -> Floats:
        """Return amplitudes (step, section, motion) nearest to values at the fine heights (step, fine height)."""
        basis = self.basis
        moved = np.zeros((len(up_mm), *basis.shape))
        moved[:, :, basis.motions.index(TRANSLATION_Z)] = up_mm @ self._fit[1].T
        if CONTRACTION in basis.motions:
            moved[:, :, basis.motions.index(CONTRACTION)] = across_mm @ self._fit[1].T
        return moved / self.voxel_mm

    @cached_property
    def _fit(self) -> tuple[Floats, Floats]:
        """Return fine heights, and the matrix (section, fine height) that fits hats to values there."""
        sections = self.basis.height_mm
        fine = np.linspace(sections[0], sections[-1], FINE * (len(sections) - 1) + 1)
        return fine, np.asarray(np.linalg.pinv(self.basis.weights(fine)), dtype=float)


def shift_of(basis: SectionBasis, amplitude: Floats, voxel_mm: float) -> Floats:
    """Return how far the material in the middle of the sections has moved up (step,), mm.

    By amplitudes (step, section, motion), voxels: z - u_z(z) is the height that it was at.
    """
    axial = basis.motions.index(TRANSLATION_Z)
    fine = np.linspace(basis.height_mm[0], basis.height_mm[-1], FINE * (len(basis.height_mm) - 1) + 1)
    weights = basis.weights(fine)
    middle = middle_mm(basis)
    return np.array([np.interp(middle, fine - weights @ a[:, axial] * voxel_mm, fine) - middle for a in amplitude])


def middle_mm(basis: SectionBasis) -> float:
    """Return the height in the middle of the sections, mm."""
    return float(basis.height_mm[0] + basis.height_mm[-1]) / 2


def _between(values: Floats, place: Floats) -> Floats:
    """Return values (step, height), linear in between and constant beyond, at places (step, place) in heights."""
    held = np.clip(place, 0.0, values.shape[1] - 1.0)
    below = np.minimum(held.astype(np.intp), values.shape[1] - 2)
    rows = np.arange(len(values))[:, None]
    share = held - below
    return np.asarray((1 - share) * values[rows, below] + share * values[rows, below + 1])
