"""Apparent motion: what the model of a radiograph misses, as far as it looks like a motion of that radiograph alone.

A face along the beam, texture between voxels: what the model of the image misses pulls at the motion that one
radiograph tells, and not at that of the next one, taken from another direction. Data y of a step tell states x by

    y = X (x + eta) + noise of unit variance,        eta ~ N(0, Lambda),  Lambda diagonal

With J = X^T X and v = X^T y, eta is eliminated from what they tell of x,

    C = (J + Lambda^-1)^-1        J' = J - J C J        v' = v - J C v

and given x, of covariance P, it is C v - K x with K = C J, of covariance C + K P K^T.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.banded import inverse_of

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Reduced:
    """What the data of each step tell of the states, apparent motion eliminated."""

    information: Floats
    """J' (step, state, state)."""
    vector: Floats
    """v' (step, state)."""
    log_determinant: float
    """Of I + Lambda J, of all steps together."""
    squares: float
    """v^T C v: what apparent motion takes of the data's squares where nothing moves."""
    mean: Floats
    """C v (step, state)."""
    covariance: Floats
    """C (step, state, state)."""
    gain: Floats
    """K (step, state, state)."""

    def of(self, vector: Floats) -> Floats:
        """Return what is left of right-hand sides v (step, state, draw)."""
        return np.asarray(vector - self.gain.transpose(0, 2, 1) @ vector)

    def apparent(self, states: Floats, covariance: Floats) -> Floats:
        """Return E[eta^2] (step, state) for states (step, state) of a covariance (step, state, state)."""
        found = self.mean - np.einsum("tmn,tn->tm", self.gain, states)
        spread = np.einsum("tmn,tmn->tm", self.gain @ covariance, self.gain)
        return np.asarray(found**2 + np.einsum("tmm->tm", self.covariance) + spread)

    def seen(self, states: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Return mean (step, state) and covariance (step, state, state) of x + eta, which the radiographs show."""
        kept = np.eye(self.gain.shape[1]) - self.gain
        mean = np.einsum("tmn,tn->tm", kept, states) + self.mean
        return mean, np.asarray(self.covariance + kept @ covariance @ kept.transpose(0, 2, 1))


def reduced(information: Floats, vector: Floats, variance: Floats) -> Reduced:
    """Return what J (step, state, state) and v (step, state) tell, eta of a variance (step, state) eliminated."""
    deviation = np.sqrt(variance)
    scaled = information * deviation[:, :, None] * deviation[:, None]
    diagonal = np.arange(scaled.shape[1])
    scaled[:, diagonal, diagonal] += 1
    lower = np.linalg.cholesky(scaled)
    covariance = np.stack([inverse_of(each) for each in lower]) * deviation[:, :, None] * deviation[:, None]
    gain = covariance @ information
    left = information - information @ gain
    mean = np.einsum("tmn,tn->tm", covariance, vector)
    return Reduced(
        information=(left + left.transpose(0, 2, 1)) / 2,
        vector=vector - np.einsum("tmn,tm->tn", gain, vector),
        log_determinant=2 * float(np.log(np.einsum("tmm->tm", lower)).sum()),
        squares=float((vector * mean).sum()),
        mean=mean,
        covariance=covariance,
        gain=gain,
    )
