"""Each step from the radiographs so far: the filter form of `pdvc.process`, as a measurement that goes on needs it.

What is known after step t of the states x(t-1) and x(t), and of the trend p, is one information matrix and vector. A
new step adds its bend w, which joins three steps, and its data; the oldest state is then eliminated,

    J <- J_bb - J_ba J_aa^-1 J_ab        v <- v_b - J_ba J_aa^-1 v_a            a: x(t-2),  b: x(t-1), x(t), p

at a cost that does not grow with the number of steps. The step in hand is the last one so far, and has the prior of
ends: the filter at step t is the smoother of a test that ended there, and at the last step the smoother itself.

Whatever data do to the states is linear in them: errors that steps have in common go through the same sums as further
right-hand sides, and come out as what they do to the motion.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdvc.process import Process
from pdvc.state_space import Deviations, StateSpace

Floats = NDArray[np.float64]


class Filter:
    """What is known of the states after some steps."""

    def __init__(self, space: StateSpace, end_variance: Floats, errors: int = 0) -> None:
        """Begin before the first step, with the variance of the ends (state,) and a number of errors to follow."""
        self.steps = 0
        """Steps taken in so far."""
        self._space, self._end = space, 1 / end_variance
        parameters = space.trend.shape[2]
        self.matrix = np.eye(parameters) / space.prior_voxel**2
        """Information of the last two states, fewer at the beginning, and p."""
        self.vectors = np.zeros((parameters, 1 + errors))
        """Information vectors of the same, of the data and of each error."""

    @property
    def errors(self) -> int:
        """Return the number of errors that are followed."""
        return self.vectors.shape[1] - 1

    def copied(self) -> Filter:
        """Return another filter that knows the same."""
        # matrix and vectors are replaced, never written into
        return copy(self)

    def add(self, information: Floats, vectors: Floats, bend_variance: Floats) -> None:
        """Take in the next step: what its data tell, J' (state, state) and v' (state, 1 + error) of `pdvc.apparent`.

        `bend_variance` (state,), voxel^2, of the bend that ends at this step; of the first two steps it is not used.
        A step without a radiograph has no information, and zeros for vectors.
        """
        states, t = len(vectors), self.steps
        if t >= self._space.shape[0]:
            raise ValueError(f"step: expected at most {t}, as many as the state space has, got another one")
        at, trend, i = min(t, 2) * states, self._space.trend[t], np.arange(states)
        matrix, both = self._with_room(at, states)
        if t == 0:
            matrix[i, i] += self._end
        if t >= 2:
            factors = self._space.second_differences[t - 2]
            for k, one in enumerate(factors):
                for m, other in enumerate(factors):
                    matrix[i + k * states, i + m * states] += one * other / bend_variance
        of_trend = information @ trend
        new, rest = slice(at, at + states), slice(at + states, None)
        matrix[new, new] += information
        matrix[new, rest] += of_trend
        matrix[rest, new] += of_trend.T
        matrix[rest, rest] += trend.T @ of_trend
        both[new] += vectors
        both[rest] += trend.T @ vectors
        self.matrix, self.vectors = _without(matrix, both, states) if t >= 2 else (matrix, both)
        self.steps += 1

    def _with_room(self, at: int, states: int) -> tuple[Floats, Floats]:
        """Return information with room for a new state, between the older ones and the trend."""
        size = len(self.matrix) + states
        matrix, vectors = np.zeros((size, size)), np.zeros((size, self.vectors.shape[1]))
        new, old = (slice(0, at), slice(at + states, None)), (slice(0, at), slice(at, None))
        for to, rows in zip(new, old, strict=True):
            vectors[to] = self.vectors[rows]
            for across, columns in zip(new, old, strict=True):
                matrix[to, across] = self.matrix[rows, columns]
        return matrix, vectors

    def now(self) -> tuple[Floats, Floats]:
        """Return means (state, 1 + error) and covariance (state, state) of the last step's states, trend included."""
        states, t = self._space.shape[1], self.steps - 1
        picked = np.zeros((states, len(self.matrix)))
        at = min(t, 1) * states
        picked[:, at : at + states] = np.eye(states)
        picked[:, at + states :] = self._space.trend[t]
        return self._of(picked)

    def ahead(self) -> tuple[Floats, Floats]:
        """Return the same of the next step, before its data, as if it had no bend.

        A second step is where the first one was, anywhere around it that the prior of ends allows, and so is a first.
        """
        states, t = self._space.shape[1], self.steps
        picked, i = np.zeros((states, len(self.matrix))), np.arange(states)
        if t >= 2:
            a, b, c = self._space.second_differences[t - 2]
            picked[i, i], picked[i, states + i] = -a / c, -b / c
        elif t == 1:
            picked[i, i] = 1
        picked[:, min(t, 2) * states :] = self._space.trend[t]
        mean, covariance = self._of(picked)
        if t < 2:
            covariance[i, i] += 1 / self._end
        return mean, covariance

    def _of(self, picked: Floats) -> tuple[Floats, Floats]:
        """Return means and covariance of combinations (state, held) of what is held, the last state an end."""
        matrix, states = self.matrix.copy(), self._space.shape[1]
        if self.steps > 1:
            last = np.arange(states, 2 * states)
            matrix[last, last] += self._end
        covariance = picked @ linalg.inv(matrix)
        return np.asarray(covariance @ self.vectors), np.asarray(covariance @ picked.T)


def _without(matrix: Floats, vectors: Floats, states: int) -> tuple[Floats, Floats]:
    """Return information matrix and vectors once the first state held is eliminated."""
    old, kept = slice(0, states), slice(states, None)
    lower = linalg.cholesky(matrix[old, old], lower=True)
    joint = linalg.solve_triangular(lower, matrix[old, kept], lower=True)
    own = linalg.solve_triangular(lower, vectors[old], lower=True)
    return matrix[kept, kept] - joint.T @ joint, vectors[kept] - joint.T @ own


def filtered(process: Process, deviations: Deviations) -> tuple[Floats, Floats]:
    """Return mean (step, unknown) and covariance (step, unknown, unknown) of each step's amplitudes, voxels.

    Each from the data of that step and those before it, under given deviations.
    """
    space, to, told = process.space, process.space.to_amplitude, process.told(deviations)
    known, bends = Filter(space, space.end_variance(deviations)), bends_to(space, deviations)
    mean, covariance = [], []
    for information, vector, bend in zip(told.information, told.vector, bends, strict=True):
        known.add(information, vector[:, None], bend)
        x, spread = known.now()
        mean.append(to @ x[:, 0])
        covariance.append(to @ spread @ to.T)
    return np.stack(mean), np.stack(covariance)


def bends_to(space: StateSpace, deviations: Deviations) -> Floats:
    """Return the variance of the bend that ends at each step (step, state), voxel^2; the first two end none."""
    steps = space.shape[0]
    return np.concatenate([np.ones((min(steps, 2), space.shape[1])), space.bend_variance(deviations)])
