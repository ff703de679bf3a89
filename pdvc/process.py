"""Motion of any history under all radiographs: the likeliest process, and what is known of each step.

What radiographs tell of a step are white data y = X (a + eta) + noise of variance k(t), of amplitudes a(t) that follow
`pdvc.state_space`. States of all steps, under given deviations, follow from one banded system.

Deviations q, e, n and roughnesses r are those of the largest marginal likelihood, with a broad prior of their own. Its
gradient comes from the posterior (Fisher's identity):

    d log p / d log q^2 = 1/2 sum_t (E[w^2] / var w - 1)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pdvc.apparent import Reduced, reduced
from pdvc.banded import Blocks, Factor, factored
from pdvc.state_space import LEAST_VARIANCE, TYPICAL_APPARENT_VOXEL, TYPICAL_VOXEL, Deviations, StateSpace

Floats = NDArray[np.float64]

FITTED_MODES = 12
"""Modes along z of each motion, at most, when deviations are found: how they fall off tells of all others."""
FREEDOM = 4.0
"""Degrees of freedom of Student's distribution of the bends of all modes together, and of the radiographs' misfit."""
RIGID_FREEDOM = 1.0
"""The same of the bends of one rigid motion, which may slip by many times what it usually does: Cauchy's."""
APPARENT_FREEDOM = 2.0
"""The same of the apparent motions of one kind at a step: what is far larger than others is rather a slip."""
ROUNDS = 4
"""Times that deviations and scales are found in turn."""
EVALUATIONS = 8
"""Of the marginal likelihood in each round."""
SPREAD = 2.5
"""Standard deviation of the broad priors' logarithms."""
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

    def told(self, deviations: Deviations) -> Reduced:
        """Return what the data of each step tell of its states, apparent motion eliminated."""
        weight, variance = 1 / deviations.misfit[:, None], self.space.apparent_variance(deviations)
        return reduced(self._information * weight[..., None], self._vector * weight, variance)

    def smoothed(self, deviations: Deviations) -> Smoothed:
        """Return the states under given deviations."""
        space, weight, told = self.space, 1 / deviations.misfit, self.told(deviations)
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
        space, vector = self.space, self._vectors(smoothed, deviations, noise)
        found = smoothed.factor.solved(vector)
        p = self._trend_response(smoothed, vector)
        return np.asarray(space.to_amplitude @ (found + (space.trend - smoothed.held) @ p))

    def trend_response(self, smoothed: Smoothed, deviations: Deviations, noise: Floats) -> Floats:
        """Return what errors of the data y (step, unknown, draw) do to the trend p (p, draw)."""
        return self._trend_response(smoothed, self._vectors(smoothed, deviations, noise))

    def _vectors(self, smoothed: Smoothed, deviations: Deviations, noise: Floats) -> Floats:
        """Return the right-hand sides (step, state, draw) of errors of the data."""
        return smoothed.reduced.of(self._design.transpose(0, 2, 1) / deviations.misfit[:, None, None] @ noise)

    def _trend_response(self, smoothed: Smoothed, vector: Floats) -> Floats:
        of_data = np.einsum("tmp,tmd->pd", self.space.trend - smoothed.held, vector)
        return np.asarray(smoothed.trend_covariance @ of_data)

    def fitted(self, deviations: Deviations, rounds: int = ROUNDS) -> Deviations:
        """Return deviations of the largest marginal likelihood: q, e, n and r, and the scales, in turn."""
        for _ in range(rounds):
            deviations = self.rescaled(self._likeliest(deviations))
        return deviations

    def rescaled(self, deviations: Deviations) -> Deviations:
        """Return deviations with the scales of steps as the data make them expected, once."""
        smoothed = self.smoothed(deviations)
        return self._rescaled(deviations, smoothed, smoothed.factor.inverted())

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
        share = bends / space.bend_variance(unscaled(deviations))
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
            **bend_scales(space, share),
            misfit=(FREEDOM + (left**2).sum(axis=1) + spread) / (FREEDOM + self.seen.unknowns),
            apparent_scale=apparent_scale,
        )

    def _total(self, smoothed: Smoothed) -> Floats:
        """Return the mean states with the trend (step, state)."""
        return np.asarray(smoothed.states + self.space.trend @ smoothed.trend)

    def _apparent(self, smoothed: Smoothed, inverse: Blocks) -> Floats:
        """Return E[eta^2] (step, state)."""
        return smoothed.reduced.apparent(self._total(smoothed), self._of_states(smoothed, inverse))


def unscaled(deviations: Deviations) -> Deviations:
    """Return deviations of which all bends have the scale one."""
    return replace(
        deviations,
        rigid_scale=np.ones_like(deviations.rigid_scale),
        own_scale=np.ones_like(deviations.own_scale),
    )


def bend_scales(space: StateSpace, share: Floats) -> dict[str, Floats]:
    """Return the scales of bends that are expected, by their names in `Deviations`, for E[w^2] (bend, state).

    `share` is E[w^2] over the variance at scale one.
    """
    rigid = space.group < space.rigid
    return {
        "rigid_scale": _expected(share[:, rigid, None], RIGID_FREEDOM),
        "own_scale": _expected(share[:, ~rigid], FREEDOM),
    }


def _slope(squares: Floats, variance: Floats) -> Floats:
    """Return d log p / d log of a deviation, of each variance that follows its square, but for the least one."""
    return np.asarray((squares / variance - 1) * (1 - LEAST_VARIANCE / variance))


def _expected(share: Floats, freedom: float) -> Floats:
    """Return scales (step, ...), from E[w^2] over its variance at scale one (step, ..., state)."""
    return np.asarray((freedom + share.sum(axis=-1)) / (freedom + share.shape[-1]))
