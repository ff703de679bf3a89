"""Each step from the radiographs so far: the filter form of `pdvc.process`, as a measurement that goes on needs it.

What is known after step t of the states x(t-1) and x(t), and of the trend p, is one information matrix and vector. A
new step adds its bend w, which joins three steps, and its data; the oldest state is then eliminated,

    J <- J_bb - J_ba J_aa^-1 J_ab        v <- v_b - J_ba J_aa^-1 v_a            a: x(t-2),  b: x(t-1), x(t), p

at a cost that does not grow with the number of steps. The step in hand is the last one so far, and has the prior of
ends: the filter at step t is the smoother of a test that ended there, and at the last step the smoother itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdvc.process import Process
from pdvc.state_space import Deviations, StateSpace

Floats = NDArray[np.float64]


class Filter:
    """What is known of the states after some steps."""

    def __init__(self, space: StateSpace, deviations: Deviations) -> None:
        """Begin before the first step; deviations are of all bends that will be asked for."""
        self._space = space
        self._weight = 1 / space.bend_variance(deviations)
        self._end = 1 / space.end_variance(deviations)
        self._steps = 0
        parameters = space.trend.shape[2]
        self._matrix = np.eye(parameters) / space.prior_voxel**2
        """Information of the last two states, fewer at the beginning, and p."""
        self._vector = np.zeros(parameters)

    def add(self, information: Floats, vector: Floats) -> None:
        """Take in the next step: what its data tell, J' (state, state) and v' (state,) of `pdvc.apparent.Reduced`."""
        states, t = len(vector), self._steps
        if t >= self._space.shape[0]:
            raise ValueError(f"step: expected at most {t}, as many as the state space has, got another one")
        # the new state goes between the older ones and the trend
        at = min(t, 2) * states
        for axis in (0, 1):
            self._matrix = np.insert(self._matrix, [at] * states, 0.0, axis=axis)
        self._vector = np.insert(self._vector, [at] * states, 0.0)
        new, trend = slice(at, at + states), self._space.trend[t]
        if t == 0:
            self._matrix[new, new] += np.diag(self._end)
        if t >= 2:
            self._bend(t - 2, states)
        of_trend = information @ trend
        rest = slice(at + states, None)
        self._matrix[new, new] += information
        self._matrix[new, rest] += of_trend
        self._matrix[rest, new] += of_trend.T
        self._matrix[rest, rest] += trend.T @ of_trend
        self._vector[new] += vector
        self._vector[rest] += trend.T @ vector
        if t >= 2:
            self._forget(states)
        self._steps += 1

    def now(self) -> tuple[Floats, Floats]:
        """Return mean (state,) and covariance (state, state) of the states of the last step so far, trend included."""
        states, t = self._space.shape[1], self._steps - 1
        matrix, at = self._matrix.copy(), min(t, 1) * states
        new = np.arange(at, at + states)
        if t > 0:
            matrix[new, new] += self._end
        covariance = linalg.inv(matrix)
        picked = np.concatenate([np.eye(states), self._space.trend[t]], axis=1)
        mean, covariance = (covariance @ self._vector)[at:], covariance[at:, at:]
        return np.asarray(picked @ mean), np.asarray(picked @ covariance @ picked.T)

    def _bend(self, index: int, states: int) -> None:
        """Add the prior of a bend of three states, the first ones held."""
        factors, i = self._space.second_differences[index], np.arange(states)
        for k, one in enumerate(factors):
            for m, other in enumerate(factors):
                self._matrix[i + k * states, i + m * states] += one * other * self._weight[index]

    def _forget(self, states: int) -> None:
        """Eliminate the first state held."""
        old, kept = slice(0, states), slice(states, None)
        lower = linalg.cholesky(self._matrix[old, old], lower=True)
        joint = linalg.solve_triangular(lower, self._matrix[old, kept], lower=True)
        own = linalg.solve_triangular(lower, self._vector[old], lower=True)
        self._matrix = self._matrix[kept, kept] - joint.T @ joint
        self._vector = self._vector[kept] - joint.T @ own


def filtered(process: Process, deviations: Deviations) -> tuple[Floats, Floats]:
    """Return mean (step, unknown) and covariance (step, unknown, unknown) of each step's amplitudes, voxels.

    Each from the data of that step and those before it, under given deviations.
    """
    told, to = process.told(deviations), process.space.to_amplitude
    known = Filter(process.space, deviations)
    mean, covariance = [], []
    for information, vector in zip(told.information, told.vector, strict=True):
        known.add(information, vector)
        x, spread = known.now()
        mean.append(to @ x)
        covariance.append(to @ spread @ to.T)
    return np.stack(mean), np.stack(covariance)
