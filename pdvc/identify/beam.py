"""A beam of varying section under tension: strains, elongation and tangents from the force, or from the stroke.

A section of area A carries the nominal stress s = F / A, with the area at rest, and strains by e = s / E + p(s). With
`bridgman`, in a neck of radius a whose profile has the radius of curvature R, Bridgman's factor

    s_flow = s_mean / [(1 + 2 R / a) ln(1 + a / (2 R))]

takes off what the neck's hoop stress adds to the axial one.

Loading and unloading: a step whose force is below the largest one before it, by more than its noise explains, is
unloaded and keeps its plastic strain. Elsewhere the plastic strain is that of the stress now: noise of the recorded
force would else only ever add to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.identify.laws import Law, plastic_at

Floats = NDArray[np.float64]

UNLOADS = 6.0
"""Standard deviations of the force by which an unloaded step is below the largest force before it."""
_ROUNDS = 50
_CLOSE_N = 1e-9


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A beam's sections at rest."""

    height_mm: Floats
    """Heights of the material (height,), mm, increasing and equally spaced."""
    area_mm2: Floats
    """Area of each section (height,), mm2."""

    def scaled(self, share: float) -> Profile:
        """Return the profile with all areas larger by a share."""
        return Profile(height_mm=self.height_mm, area_mm2=self.area_mm2 * (1 + share))

    def stress_share(self, bridgman: bool) -> Floats:
        """Return the axial stress that makes material flow (height,), MPa for each N."""
        return (self.bridgman() if bridgman else 1.0) / self.area_mm2

    def bridgman(self) -> Floats:
        """Return Bridgman's factor (height,), at most one: one where the profile does not narrow to a neck."""
        radius = np.sqrt(self.area_mm2 / np.pi)
        spacing = float(np.mean(np.diff(self.height_mm)))
        curvature = np.maximum(np.gradient(np.gradient(radius, spacing), spacing), 0.0)
        return bridgman_factor(radius * curvature)


def bridgman_factor(radius_over_curvature: Floats) -> Floats:
    """Return 1 / [(1 + 2 R / a) ln(1 + a / (2 R))] for a / R (any shape, not negative); one at a / R = 0."""
    half = np.asarray(radius_over_curvature, dtype=float) / 2
    safe = np.maximum(half, 1e-9)
    return np.asarray(np.where(half > 1e-9, safe / ((1 + safe) * np.log1p(safe)), 1.0))


@dataclass(frozen=True, kw_only=True)
class Strains:
    """Strains of all sections at some steps, from the state at rest without force."""

    elastic: Floats
    """(step, height), without unit."""
    plastic: Floats
    """(step, height), without unit."""
    most_MPa: Floats
    """Largest stress so far, which the plastic strain follows (step, height), MPa."""
    plastic_per_MPa: Floats
    """d plastic / d most_MPa, consistent with what was solved (step, height), 1/MPa; zero where none is."""
    flows: NDArray[np.bool_]
    """(step, 1) whether the stress of a step is its largest so far."""

    @property
    def total(self) -> Floats:
        """Return elastic and plastic strain together (step, height)."""
        return self.elastic + self.plastic


def unloaded(force_N: Floats, noise_N: float) -> NDArray[np.bool_]:
    """Return which steps (step,) are below the largest force before them by more than its noise explains."""
    before = np.maximum.accumulate(force_N)
    return np.asarray(force_N < before - max(UNLOADS * noise_N, 1e-9 * float(np.abs(force_N).max(initial=0.0))))


def strains(law: Law, profile: Profile, force_N: Floats, *, noise_N: float = 0.0, bridgman: bool = False) -> Strains:
    """Return the strains of a beam at forces (step,), N, not negative, which follow each other in this order."""
    below = unloaded(force_N, noise_N)
    most = np.where(below, np.maximum.accumulate(np.where(below, 0.0, force_N)), force_N)
    share = profile.stress_share(bridgman)
    plastic = plastic_at(law, most[:, None] * share)
    return Strains(
        elastic=force_N[:, None] * share / law.young_MPa,
        plastic=plastic,
        most_MPa=most[:, None] * share,
        plastic_per_MPa=np.where(plastic > 0, 1 / np.maximum(law.slope_MPa(plastic), 1e-9), 0.0),
        flows=~below[:, None],
    )


def elongation_mm(strain: Floats, profile: Profile) -> Floats:
    """Return the integral of strains (step, height) over the height (step,), mm, by the trapezoidal rule."""
    return np.asarray(np.trapezoid(strain, profile.height_mm, axis=1))


def force_at_stroke(
    law: Law, profile: Profile, stroke_mm: Floats, *, start_N: float, compliance_mm_per_N: float
) -> Floats:
    """Return the forces (step,), N, at which machine and beam take up strokes that never fall, from `start_N`.

    Newton's method with the consistent tangent, each step from the one before:
    C (F - F_0) + e(F) - e(F_0) = stroke. Raises ValueError where it does not converge.
    """
    at_start = float(elongation_mm(strains(law, profile, np.array([start_N])).total, profile)[0])
    forces, force = np.empty(len(stroke_mm)), start_N
    for step, wanted in enumerate(stroke_mm):
        for _ in range(_ROUNDS):
            found = strains(law, profile, np.array([force]))
            taken = compliance_mm_per_N * (force - start_N) + elongation_mm(found.total, profile)[0] - at_start
            give = (
                compliance_mm_per_N
                + elongation_mm((1 / law.young_MPa + found.plastic_per_MPa) / profile.area_mm2, profile)[0]
            )
            change = (wanted - taken) / give
            # at the yield point the tangent jumps, and a long step would land far beyond it
            force += float(np.clip(change, -0.2 * force, 0.05 * force))
            if abs(change) < _CLOSE_N:
                break
        else:
            raise ValueError(
                f"stroke: expected one that beam and machine can follow, no force found for {wanted:.4g} mm"
            )
        forces[step] = force
    return forces
