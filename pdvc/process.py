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

Deviations q, e, n and roughnesses r are those of the largest marginal likelihood, with a broad prior of their own. Its
gradient comes from the posterior (Fisher's identity):

    d log p / d log q^2 = 1/2 sum_t (E[w^2] / var w - 1)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.optimize import minimize

from pdvc.apparent import Reduced, reduced
from pdvc.banded import Blocks, Factor, factored
from pdvc.sections import CONTRACTION, RIGID, TRANSLATION_Z, SectionBasis

Floats = NDArray[np.float64]

FITTED_MODES = 12
"""Modes along z of each motion, at most, when deviations are found: how they fall off tells of all others."""
FREEDOM = 4.0
"""Degrees of freedom of Student's distribution of the bends of all modes together, and of the radiographs' misfit."""
RIGID_FREEDOM = 1.0
"""The same of the bends of one rigid motion, which may slip by many times what it usually does: Cauchy's."""
APPARENT_FREEDOM = 2.0
"""The same of the apparent motions of one kind at a step: what is far larger than others is rather a slip."""
LONGEST_GAP = 4.0
"""Gap between steps, in median gaps, beyond which the sample is held rather than moved."""
ROUNDS = 4
"""Times that deviations and scales are found in turn."""
EVALUATIONS = 8
"""Of the marginal likelihood in each round."""
TYPICAL_VOXEL = 0.01
"""Median of the broad prior of deviations q, voxels."""
SPREAD = 2.5
"""Standard deviation of the broad priors' logarithms."""
TYPICAL_APPARENT_VOXEL = 0.003
"""Median of the broad prior of deviations n, voxels."""
LEAST_VARIANCE = 1e-12
"""voxel^2, of any bend and any end: less would be lost in rounding, and moves nothing in a thousand steps."""
_RANGE = np.log([1e-5, 10.0]), np.log([1e-4, 30.0]), np.log([1e-5, 1.0]), np.array([0.2, 3.0])
"""Limits of log q, log e, log n, and r."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What the radiographs tell: white data y = X a + noise of variance k(t), at each step."""

    design: Floats
    """X (step, unknown, unknown)."""
    data: Floats
    """y (step, unknown)."""

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns, and of data, of a step."""
        return int(self.design.shape[2])


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
            slope = np.gradient(modes, basis.height_mm, axis=0) if sections > 1 else np.zeros_like(modes)
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
        self._second = _second_differences(gap)
        self._gap = (gap[1:] + gap[:-1]) / 2
        self.ends = np.unique([0, len(time_s) - 1])
        """The first and the last step."""

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
        for t, (weight, (a, b, c)) in enumerate(zip(1 / self.bend_variance(deviations), self._second, strict=True)):
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
        a, b, c = (self._second[:, k].reshape(-1, *(1,) * (states.ndim - 1)) for k in range(3))
        return np.asarray(a * states[:-2] + b * states[1:-1] + c * states[2:])

    def bend_variances(self, inverse: Blocks) -> Floats:
        """Return the variance of w (step - 2, state) under a covariance of states."""
        own, near, far = (np.einsum("tmm->tm", part) for part in (inverse.own, inverse.next, inverse.after))
        a, b, c = (self._second[:, k, None] for k in range(3))
        squares = a**2 * own[:-2] + b**2 * own[1:-1] + c**2 * own[2:]
        return np.asarray(squares + 2 * (a * b * near[:-1] + b * c * near[1:] + a * c * far))

    def log_prior(self, deviations: Deviations) -> float:
        """Return the logarithm of the determinant of the prior's precision, up to a constant."""
        ends = len(self.ends) * np.log(self.end_variance(deviations)).sum()
        return -float(np.log(self.bend_variance(deviations)).sum() + ends)


@dataclass(frozen=True, kw_only=True)
class Smoothed:
    """States under all data, with what is needed for their uncertainty."""

    states: Floats
    """Means (step, state), without the trend."""
    trend: Floats
    """p."""
    factor: Factor
    """Of the posterior precision without the trend."""
    held: Floats
    """A^-1 times the information of the trend (step, state, p)."""
    reduced: Reduced
    """What the data tell of the states."""
    trend_covariance: Floats
    log_likelihood: float
    """Marginal likelihood, up to a constant."""


class Process:
    """A state space with data."""

    def __init__(self, space: StateSpace, seen: Seen) -> None:
        """Take in what the radiographs tell."""
        self.space, self.seen = space, seen
        self._design = seen.design @ space.to_amplitude
        information = self._design.transpose(0, 2, 1) @ self._design
        self._information = (information + information.transpose(0, 2, 1)) / 2
        self._vector = np.einsum("tnm,tn->tm", self._design, seen.data)

    def smoothed(self, deviations: Deviations) -> Smoothed:
        """Return the states under given deviations."""
        space, weight = self.space, 1 / deviations.misfit
        told = reduced(
            self._information * weight[:, None, None],
            self._vector * weight[:, None],
            space.apparent_variance(deviations),
        )
        vector, of_trend = told.vector, told.information @ space.trend
        factor = factored(space.precision(deviations, told.information))
        found = factor.solved(np.concatenate([vector[..., None], of_trend], axis=2))
        held, wide = found[..., 1:], np.eye(of_trend.shape[2]) / space.prior_voxel**2
        matrix = wide + np.einsum("tmp,tmq->pq", space.trend, of_trend) - np.einsum("tmp,tmq->pq", of_trend, held)
        of_data = np.einsum("tmp,tm->p", space.trend, vector)
        p = np.linalg.solve(matrix, of_data - np.einsum("tmp,tm->p", of_trend, found[..., 0]))
        states = found[..., 0] - held @ p
        squares = float((vector * states).sum() + of_data @ p)
        misfit = float(
            (self.seen.data**2 * weight[:, None]).sum() + self.seen.unknowns * np.log(deviations.misfit).sum()
        )
        misfit += told.log_determinant - told.squares
        log = squares - misfit - factor.log_determinant - np.linalg.slogdet(matrix)[1] + space.log_prior(deviations)
        return Smoothed(
            states=states,
            trend=p,
            factor=factor,
            held=held,
            reduced=told,
            trend_covariance=np.linalg.inv(matrix),
            log_likelihood=float(log / 2),
        )

    def amplitude(self, smoothed: Smoothed) -> Floats:
        """Return the mean amplitudes (step, unknown), voxels."""
        return np.asarray(self._total(smoothed) @ self.space.to_amplitude.T)

    def covariance(self, smoothed: Smoothed, inverse: Blocks) -> Floats:
        """Return the posterior covariance of each step's amplitudes (step, unknown, unknown), voxel^2."""
        to = self.space.to_amplitude
        return np.asarray(to @ self._of_states(smoothed, inverse) @ to.T)

    def _of_states(self, smoothed: Smoothed, inverse: Blocks) -> Floats:
        """Return the posterior covariance of each step's states, trend included (step, state, state), voxel^2."""
        trend = self.space.trend - smoothed.held
        return np.asarray(inverse.own + trend @ smoothed.trend_covariance @ trend.transpose(0, 2, 1))

    def response(self, smoothed: Smoothed, deviations: Deviations, noise: Floats) -> Floats:
        """Return what errors of the data y (step, unknown, draw) do to the amplitudes (the same), voxels."""
        space = self.space
        vector = smoothed.reduced.of(self._design.transpose(0, 2, 1) / deviations.misfit[:, None, None] @ noise)
        found = smoothed.factor.solved(vector)
        of_data = np.einsum("tmp,tmd->pd", space.trend - smoothed.held, vector)
        p = smoothed.trend_covariance @ of_data
        return np.asarray(space.to_amplitude @ (found + (space.trend - smoothed.held) @ p))

    def fitted(self, deviations: Deviations, rounds: int = ROUNDS) -> Deviations:
        """Return deviations of the largest marginal likelihood: q, e, n and r, and the scales, in turn."""
        for _ in range(rounds):
            deviations = self._likeliest(deviations)
            smoothed = self.smoothed(deviations)
            deviations = self._rescaled(deviations, smoothed, smoothed.factor.inverted())
        return deviations

    def _squares(self, smoothed: Smoothed, inverse: Blocks) -> tuple[Floats, Floats]:
        """Return E[w^2] (step - 2, state), and E[x^2] of the ends (end, state)."""
        space = self.space
        ends = space.ends

        def of_trend(held: Floats) -> Floats:
            return np.asarray(np.einsum("tmp,pq,tmq->tm", held, smoothed.trend_covariance, held, optimize=True))

        bends = (
            space.bends(smoothed.states) ** 2 + space.bend_variances(inverse) + of_trend(space.bends(smoothed.held))
        )
        own = np.einsum("tmm->tm", inverse.own)[ends]
        return bends, smoothed.states[ends] ** 2 + own + of_trend(smoothed.held[ends])

    def _likeliest(self, deviations: Deviations) -> Deviations:
        """Return deviations whose q, e, n and r have the largest marginal likelihood, for given scales."""
        space = self.space
        groups, motions = len(deviations.bend_voxel), len(deviations.end_voxel)
        counts = (groups, motions, groups, motions)
        typical = np.repeat([np.log(TYPICAL_VOXEL), 0.0, np.log(TYPICAL_APPARENT_VOXEL), 1.0], counts)
        spread = np.repeat([SPREAD, SPREAD, SPREAD, 0.5], counts)

        def unpacked(x: Floats) -> Deviations:
            q, e, n, r = np.split(x, np.cumsum(counts)[:-1])
            return replace(
                deviations, bend_voxel=np.exp(q), end_voxel=np.exp(e), apparent_voxel=np.exp(n), roughness=r
            )

        def minus_log(x: Floats) -> tuple[float, Floats]:
            trial = unpacked(x)
            smoothed = self.smoothed(trial)
            inverse = smoothed.factor.inverted()
            bends, ends = self._squares(smoothed, inverse)
            of_bends = _slope(bends, space.bend_variance(trial)).sum(axis=0)
            of_ends = _slope(ends, space.end_variance(trial)).sum(axis=0)
            q = np.bincount(space.group, of_bends, minlength=groups)
            e = np.bincount(space.group, of_ends, minlength=groups)[space.rigid :]
            own = (of_bends + of_ends)[space.rigid :].reshape(motions, -1)
            of_apparent = self._apparent(smoothed, inverse) / space.apparent_variance(trial) - 1
            n = np.bincount(space.group, of_apparent.sum(axis=0), minlength=groups)
            away = (x - typical) / spread
            gradient = np.concatenate([q, e, n, own @ space.log_value / 2]) - away / spread
            return -smoothed.log_likelihood + float(away @ away) / 2, -gradient

        logs = [np.log(each) for each in (deviations.bend_voxel, deviations.end_voxel, deviations.apparent_voxel)]
        start = np.concatenate([*logs, deviations.roughness])
        limits = np.repeat(np.stack(_RANGE), counts, axis=0)
        options = {"maxiter": EVALUATIONS, "maxfun": EVALUATIONS}
        found = minimize(minus_log, start, jac=True, method="L-BFGS-B", bounds=limits, options=options)
        return unpacked(found.x)

    def _rescaled(self, deviations: Deviations, smoothed: Smoothed, inverse: Blocks) -> Deviations:
        """Return deviations with scales as expected under Student's distribution."""
        space = self.space
        bends, _ = self._squares(smoothed, inverse)
        flat = replace(deviations, rigid_scale=np.ones((len(bends), space.rigid)), own_scale=np.ones(len(bends)))
        share = bends / space.bend_variance(flat)
        rigid = space.group < space.rigid
        apparent = self._apparent(smoothed, inverse)
        mean, covariance = smoothed.reduced.seen(self._total(smoothed), self._of_states(smoothed, inverse))
        left = self.seen.data - np.einsum("tnm,tm->tn", self._design, mean)
        spread = np.einsum("tmk,tmk->t", self._information, covariance)
        groups = np.arange(len(deviations.apparent_voxel))
        of_groups = np.maximum(deviations.apparent_voxel, 1e-300) ** 2
        share_of = [(apparent[:, space.group == g] / of_groups[g])[:, None] for g in groups]
        apparent_scale = np.concatenate([_expected(each, APPARENT_FREEDOM) for each in share_of], axis=1)
        # with neighbours on one side only it could as well be a motion
        apparent_scale[space.ends] = 1
        return replace(
            deviations,
            rigid_scale=_expected(share[:, rigid, None], RIGID_FREEDOM),
            own_scale=_expected(share[:, ~rigid], FREEDOM),
            misfit=(FREEDOM + (left**2).sum(axis=1) + spread) / (FREEDOM + self.seen.unknowns),
            apparent_scale=apparent_scale,
        )

    def _total(self, smoothed: Smoothed) -> Floats:
        """Return the mean states with the trend (step, state)."""
        return np.asarray(smoothed.states + self.space.trend @ smoothed.trend)

    def _apparent(self, smoothed: Smoothed, inverse: Blocks) -> Floats:
        """Return E[eta^2] (step, state)."""
        return smoothed.reduced.apparent(self._total(smoothed), self._of_states(smoothed, inverse))


def _slope(squares: Floats, variance: Floats) -> Floats:
    """Return d log p / d log of a deviation, of each variance that follows its square, but for the least one."""
    return np.asarray((squares / variance - 1) * (1 - LEAST_VARIANCE / variance))


def _expected(share: Floats, freedom: float) -> Floats:
    """Return scales (step, ...), from E[w^2] over its variance at scale one (step, ..., state)."""
    return np.asarray((freedom + share.sum(axis=-1)) / (freedom + share.shape[-1]))


def _modes(height_mm: Floats, most: int) -> tuple[Floats, Floats]:
    """Return modes along z (section, mode), each of norm sqrt(sections), and their eigenvalues, largest first."""
    span = max(float(np.ptp(height_mm)), 1e-9)
    away = np.sqrt(3) * np.abs(height_mm[:, None] - height_mm) / (span / 2)
    value, vector = linalg.eigh((1 + away) * np.exp(-away))
    kept = np.argsort(value)[::-1][:most]
    return vector[:, kept] * np.sqrt(len(height_mm)), value[kept]


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
