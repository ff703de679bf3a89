"""Motion of any history: a Gaussian process over the steps, its deviations found in the data.

The amplitudes of all sections at step t are

    a(t) = Phi x(t) + Phi_r sum_i h_i(t) p_i

with h_i a trend of few time functions, of which the sample's rigid motions p_i are hardly limited, and a state x of
six rigid motions of the whole sample and, for each motion of the sections, of modes along z. Modes are the
eigenvectors of a Matern 3/2 covariance as long as half the sections' height, nearly polynomials, with eigenvalues
l_j. States bend at random from step to step: with gaps g of time between steps, in units of their median,

    w(t) = [x(t+1) - x(t)] / g(t) - [x(t) - x(t-1)] / g(t-1)       N(0, q^2 s(t) [g(t) + g(t-1)] / 2)

    q_j^2 = q^2 (l_j / l_0)^r        of mode j of a motion, with roughness r

A slip, or the onset of loading, is a w far larger than others. s(t) is therefore drawn, too, so that w has Student's
distribution, by itself for each of the six rigid motions and once for all modes; an event is found where the data
show one. First and last step alone keep the state from anywhere, N(0, e^2 (l_j / l_0)^r): time has no direction. With
bends as large as one likes the model is a(t) of each step by itself.

Where sections contract as much as they are stretched, the contraction is a part of the state's axial motion,

    contraction = -nu R d(u_z)/dz + its own modes           R: where an amplitude of one moves a point by a voxel

(nu = 1/2: no volume change), and its own modes are what this leaves: how much that is, the data tell.

What radiographs tell of a step is c = B (a + eta - a_0) + noise of covariance k(t) V(t), with k drawn as s is, and
with eta = Phi N(0, n^2 m(t)) an apparent motion (`pdvc.apparent`): what the model of the image misses at that step, a
face along the beam, counts the less, and only the motions that it looks like. m(t) is drawn as s is, by itself for
each motion.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdvc.banded import Blocks
from pdvc.sections import CONTRACTION, RIGID, TRANSLATION_Z, SectionBasis

Floats = NDArray[np.float64]

LONGEST_GAP = 4.0
"""Gap between steps, in median gaps, beyond which the sample is held rather than moved."""
TYPICAL_VOXEL = 0.01
"""Median of the broad prior of deviations q, voxels."""
TYPICAL_APPARENT_VOXEL = 0.003
"""Median of the broad prior of deviations n, voxels."""
LEAST_VARIANCE = 1e-12
"""voxel^2, of any bend and any end: less would be lost in rounding, and moves nothing in a thousand steps."""


@dataclass(frozen=True, kw_only=True)
class Deviations:
    """What the process is like: deviations of bends and of ends, roughness, and scales of steps."""

    bend_voxel: Floats
    """q (group,): of the six rigid motions, then of each section motion."""
    end_voxel: Floats
    """e (section motion,)."""
    roughness: Floats
    """r (section motion,)."""
    rigid_scale: Floats
    """s of each rigid motion (step - 2, rigid motion)."""
    own_scale: Floats
    """s of all others (step - 2,)."""
    misfit: Floats
    """k (step,)."""
    apparent_voxel: Floats
    """n (group,)."""
    apparent_scale: Floats
    """m (step, group)."""


class StateSpace:
    """States of all steps, and their prior."""

    def __init__(
        self,
        basis: SectionBasis,
        time_s: Floats,
        trend: Floats,
        *,
        contraction_of_strain: float | None,
        prior_voxel: float,
        most_modes: int | None = None,
    ) -> None:
        """Set up for a section basis, times (step,), a trend (function, step), and nu; deviations in voxels.

        `most_modes` of each motion along z, the smoothest; None: as many as there are sections.
        """
        sections, motions = basis.shape
        self.basis, self.prior_voxel = basis, prior_voxel
        single = replace(basis, height_mm=np.array([basis.height_mm.mean()]), motions=RIGID)
        followed = [k for k in range(len(RIGID)) if basis.reproduces(replace(single, motions=(RIGID[k],)))]
        each = [replace(single, motions=(RIGID[k],)) for k in followed]
        rigid = np.stack([basis.reproduced(np.ones((1, 1)), one).ravel() for one in each], axis=1)
        modes, value = _modes(basis.height_mm, sections if most_modes is None else most_modes)
        self.log_value = np.log(value / value[0])
        """log(l_j / l_0) of the modes."""
        own = np.einsum("jm,kl->jklm", modes, np.eye(motions)).reshape(sections * motions, -1)
        if contraction_of_strain and {CONTRACTION, TRANSLATION_Z} <= set(basis.motions):
            axial, contraction = basis.motions.index(TRANSLATION_Z), basis.motions.index(CONTRACTION)
            slope = _slopes(basis.height_mm, modes) if sections > 1 else np.zeros_like(modes)
            tied = own.reshape(sections, motions, motions, -1)
            tied[:, contraction, axial] -= contraction_of_strain * basis.radius_mm * slope
        self.to_amplitude = np.concatenate([rigid, own], axis=1)
        """Phi (unknown, state)."""
        self.rigid = len(followed)
        self.group = np.concatenate([np.arange(self.rigid), self.rigid + np.repeat(np.arange(motions), len(value))])
        """Which deviation each state has."""
        self.trend = np.zeros((trend.shape[1], self.to_amplitude.shape[1], len(trend) * self.rigid))
        for i, function in enumerate(trend):
            for j in range(self.rigid):
                self.trend[:, j, i * self.rigid + j] = function
        gap = _gaps(time_s)
        self.second_differences = _second_differences(gap)
        """Factors of x(t-1), x(t) and x(t+1) in w(t) (step - 2, 3)."""
        self._gap = (gap[1:] + gap[:-1]) / 2
        self.ends = np.unique([0, len(time_s) - 1])
        """The first and the last step."""

    def within(self, steps: slice) -> StateSpace:
        """Return the states of some steps that follow each other, by themselves."""
        part, bends = copy(self), slice(steps.start, max(steps.stop - 2, steps.start))
        part.trend = self.trend[steps]
        part.second_differences, part._gap = self.second_differences[bends], self._gap[bends]
        part.ends = np.unique([0, len(part.trend) - 1])
        return part

    def with_trend(self, columns: Floats) -> StateSpace:
        """Return the same with more of a trend: amplitudes (step, unknown, column), each times an unknown number.

        What modes along z cannot make of them, where they are few, is left out.
        """
        found = copy(self)
        found.trend = np.concatenate([self.trend, np.linalg.pinv(self.to_amplitude) @ columns], axis=2)
        return found

    @property
    def shape(self) -> tuple[int, int]:
        """Return (steps, states)."""
        return len(self.trend), self.to_amplitude.shape[1]

    def first_guess(self) -> Deviations:
        """Return deviations to start from."""
        steps, motions = self.shape[0], self.basis.shape[1]
        return Deviations(
            bend_voxel=np.full(self.rigid + motions, TYPICAL_VOXEL),
            end_voxel=np.full(motions, 1.0),
            roughness=np.ones(motions),
            rigid_scale=np.ones((max(steps - 2, 0), self.rigid)),
            own_scale=np.ones(max(steps - 2, 0)),
            misfit=np.ones(steps),
            apparent_voxel=np.full(self.rigid + motions, TYPICAL_APPARENT_VOXEL),
            apparent_scale=np.ones((steps, self.rigid + motions)),
        )

    def fixed(self, bend_voxel: float) -> Deviations:
        """Return the same deviation for all bends, ends as wide as the prior, and no apparent motion."""
        guess = self.first_guess()
        return replace(
            guess,
            bend_voxel=np.full_like(guess.bend_voxel, bend_voxel),
            end_voxel=np.full_like(guess.end_voxel, self.prior_voxel),
            apparent_voxel=np.zeros_like(guess.apparent_voxel),
        )

    def relative(self, deviations: Deviations) -> Floats:
        """Return the variance of each state over that of its group's first mode (state,)."""
        own = np.exp(deviations.roughness[:, None] * self.log_value).ravel()
        return np.concatenate([np.ones(self.rigid), own])

    def bend_variance(self, deviations: Deviations) -> Floats:
        """Return the prior variance of w (step - 2, state), voxel^2."""
        own = deviations.bend_voxel[self.group] ** 2 * self.relative(deviations)
        of_modes = np.repeat(deviations.own_scale[:, None], len(own) - self.rigid, axis=1)
        scale = np.concatenate([deviations.rigid_scale, of_modes], axis=1)
        return np.asarray(own * scale * self._gap[:, None] + LEAST_VARIANCE)

    def end_variance(self, deviations: Deviations) -> Floats:
        """Return the prior variance of the first and the last state (state,), voxel^2."""
        deviation = np.concatenate([np.full(self.rigid, self.prior_voxel), deviations.end_voxel])[self.group]
        return np.asarray(deviation**2 * self.relative(deviations) + LEAST_VARIANCE)

    def apparent_variance(self, deviations: Deviations) -> Floats:
        """Return the variance of eta (step, state), voxel^2."""
        return np.asarray((deviations.apparent_voxel**2 * deviations.apparent_scale)[:, self.group])

    def precision(self, deviations: Deviations, information: Floats) -> Blocks:
        """Return the posterior precision of all states, with what the data tell of each (step, state, state)."""
        steps, states = self.shape
        own = information.copy()
        near, far = np.zeros((max(steps - 1, 0), states, states)), np.zeros((max(steps - 2, 0), states, states))
        i = np.arange(states)
        for t, (weight, (a, b, c)) in enumerate(
            zip(1 / self.bend_variance(deviations), self.second_differences, strict=True)
        ):
            own[t, i, i] += a * a * weight
            own[t + 1, i, i] += b * b * weight
            own[t + 2, i, i] += c * c * weight
            near[t, i, i] += a * b * weight
            near[t + 1, i, i] += b * c * weight
            far[t, i, i] += a * c * weight
        for t in self.ends:
            own[t, i, i] += 1 / self.end_variance(deviations)
        return Blocks(own=own, next=near, after=far)

    def bends(self, states: Floats) -> Floats:
        """Return w (step - 2, ...) of states (step, ...)."""
        a, b, c = (self.second_differences[:, k].reshape(-1, *(1,) * (states.ndim - 1)) for k in range(3))
        return np.asarray(a * states[:-2] + b * states[1:-1] + c * states[2:])

    def bend_variances(self, inverse: Blocks) -> Floats:
        """Return the variance of w (step - 2, state) under a covariance of states."""
        own, near, far = (np.einsum("tmm->tm", part) for part in (inverse.own, inverse.next, inverse.after))
        a, b, c = (self.second_differences[:, k, None] for k in range(3))
        squares = a**2 * own[:-2] + b**2 * own[1:-1] + c**2 * own[2:]
        return np.asarray(squares + 2 * (a * b * near[:-1] + b * c * near[1:] + a * c * far))

    def log_prior(self, deviations: Deviations) -> float:
        """Return the logarithm of the determinant of the prior's precision, up to a constant."""
        ends = len(self.ends) * np.log(self.end_variance(deviations)).sum()
        return -float(np.log(self.bend_variance(deviations)).sum() + ends)


def _modes(height_mm: Floats, most: int) -> tuple[Floats, Floats]:
    """Return modes along z (section, mode), each of norm sqrt(sections), and their eigenvalues, largest first."""
    span = max(float(np.ptp(height_mm)), 1e-9)
    away = np.sqrt(3) * np.abs(height_mm[:, None] - height_mm) / (span / 2)
    value, vector = linalg.eigh((1 + away) * np.exp(-away))
    kept = np.argsort(value)[::-1][:most]
    return vector[:, kept] * np.sqrt(len(height_mm)), value[kept]


def _slopes(height_mm: Floats, values: Floats) -> Floats:
    """Return at each section (section, ...) the slope along z, per mm, of values that are linear in between.

    It jumps at sections, where contraction does not: the slopes, linear in between, are nearest to it by least squares
    over the height, which the mean of the two beside a section is not where a neck is narrow.
    """
    gap = np.diff(height_mm)
    mass = np.diag(np.append(gap, 0) + np.append(0, gap)) / 3 + (np.diag(gap, 1) + np.diag(gap, -1)) / 6
    risen = np.zeros_like(values)
    risen[:-1] += np.diff(values, axis=0) / 2
    risen[1:] += np.diff(values, axis=0) / 2
    return np.asarray(np.linalg.solve(mass, risen))


def _gaps(time_s: Floats) -> Floats:
    """Return the gaps between steps, in their median, none longer than `LONGEST_GAP`."""
    gap = np.abs(np.diff(time_s))
    if len(gap) == 0 or not np.median(gap) > 0:
        return np.ones(len(gap))
    return np.asarray(np.clip(gap / np.median(gap), 1 / LONGEST_GAP, LONGEST_GAP))


def _second_differences(gap: Floats) -> Floats:
    """Return the factors of x(t-1), x(t) and x(t+1) in w(t), (step - 2, 3)."""
    before, following = 1 / gap[:-1], 1 / gap[1:]
    return np.stack([before, -before - following, following], axis=1)
