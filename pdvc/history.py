"""Time basis: functions of the step, of the angle and of the measured force (Table 1 and others).

Functions are made orthonormal over the steps, (1/N) sum_t s_i(t) s_j(t) = delta_ij, so that an amplitude in
voxels is an rms displacement in voxels, and the equations are well conditioned. Functions that the others
already span are dropped: over the paper's first turn, at constant force, T(t) and 1 are parallel, and only
the whole test tells them apart.

A further time function is a subclass of `TimeFunction` with a `kind` of its own: TOML finds it as soon as it is
defined.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.interpolate import BSpline

from pdvc.experiment import Series
from pdvc.onset import onset
from pdvc.settings import Choice

Floats = NDArray[np.float64]

INDEPENDENT = 1e-6
"""Functions whose part outside the others' span is below this share of their norm are dropped."""


class TimeFunction(Choice):
    """A kind of time function: one or more functions of the step, from what was recorded with each radiograph."""

    def functions(self, series: Series) -> Floats:
        """Return (function, step), neither orthogonal nor of any norm."""
        raise NotImplementedError

    def stretched(self, share: float) -> Self:
        """Return what follows the same course over `share` times as many steps; the same, unless it counts steps."""
        return self

    def settled(self, series: Series) -> Self:
        """Return the same with what it leaves to the data filled in, where the data tell it."""
        return self


class Force(TimeFunction):
    """T(t): the measured axial force."""

    kind: Literal["force"] = "force"
    """the measured axial force"""

    def functions(self, series: Series) -> Floats:
        """Return (1, step)."""
        return series.force_N[None]


class Angle(TimeFunction):
    """sin(k theta(t)) and cos(k theta(t)): what a sample off the axis, or tilted, does."""

    kind: Literal["angle"] = "angle"
    """sine and cosine of the stage angle"""
    harmonics: Annotated[int, Field(ge=1)] = 1
    """number of harmonics k"""

    def functions(self, series: Series) -> Floats:
        """Return (2 harmonics, step)."""
        k = np.arange(1, self.harmonics + 1)[:, None] * series.angle_rad
        # the sine of half turns is a rounding error, not a function
        return np.round(np.concatenate([np.sin(k), np.cos(k)]), 12)


class Polynomial(TimeFunction):
    """1, t, t^2 ..., with t the step."""

    kind: Literal["polynomial"] = "polynomial"
    """powers of the step"""
    degree: Annotated[int, Field(ge=0)] = 1
    """largest power"""

    def functions(self, series: Series) -> Floats:
        """Return (degree + 1, step): Legendre polynomials, which span the powers."""
        return np.asarray(np.polynomial.legendre.legvander(_unit(len(series)), self.degree).T, dtype=float)


class Ramp(TimeFunction):
    """max(t - start, 0)^p: what begins during the test."""

    kind: Literal["ramp"] = "ramp"
    """powers of the steps since a start"""
    start: Annotated[int, Field(ge=0)] | Literal["onset"] = "onset"
    """step at which the ramp leaves zero; onset: where the force leaves its plateau"""
    powers: tuple[Annotated[int, Field(ge=0)], ...] = (1, 2)
    """exponents; 0 makes a jump at the start"""

    def functions(self, series: Series) -> Floats:
        """Return (powers, step); zero everywhere where the force has no onset, or the start is after the last step."""
        start = onset(series.force_N) if self.start == "onset" else self.start
        if start is None:
            return np.zeros((len(self.powers), len(series)))
        since = (np.arange(len(series)) - start) / len(series)
        return np.stack([np.where(since > 0, since**power, 0.0) for power in self.powers])

    def stretched(self, share: float) -> Self:
        """Return the ramp with its start moved along; an onset is found in the force, wherever it is."""
        return self if self.start == "onset" else self.model_copy(update={"start": round(self.start * share)})

    def settled(self, series: Series) -> Self:
        """Return the ramp with the onset of loading as a step, where the force shows one."""
        found = onset(series.force_N) if self.start == "onset" else None
        return self if found is None else self.model_copy(update={"start": found})


class Splines(TimeFunction):
    """B-splines on equal intervals of steps; degree 1 makes tents, piecewise linear."""

    kind: Literal["splines"] = "splines"
    """B-splines over the steps; degree 1 makes tents"""
    intervals: Annotated[int, Field(ge=1)] = 6
    """number of equal intervals"""
    degree: Annotated[int, Field(ge=1, le=5)] = 3
    """degree of the pieces"""
    start: Annotated[int, Field(ge=0)] = 0
    """step at which the first interval begins; zero before"""

    def functions(self, series: Series) -> Floats:
        """Return (intervals + degree, step), less the first one where a start keeps them at zero before."""
        steps = np.arange(len(series), dtype=float)
        start, end = float(min(self.start, len(series) - 2)), float(len(series) - 1)
        inner = np.linspace(start, end, self.intervals + 1)
        knots = np.concatenate([np.full(self.degree, start), inner, np.full(self.degree, end)])
        values = BSpline.design_matrix(np.clip(steps, start, end), knots, self.degree).toarray().T
        # before the start the clipped splines stand still at (1, 0, 0, ...): without the first, at zero
        return np.asarray(values[1:] if self.start > 0 else values)

    def stretched(self, share: float) -> Self:
        """Return the splines with their start moved along."""
        return self.model_copy(update={"start": round(self.start * share)})


class Fourier(TimeFunction):
    """sin and cos of the step, over a period in steps."""

    kind: Literal["fourier"] = "fourier"
    """sine and cosine of the step"""
    period: Annotated[float, Field(gt=0)] = 127.0
    """longest period, steps"""
    harmonics: Annotated[int, Field(ge=1)] = 3
    """number of harmonics"""

    def functions(self, series: Series) -> Floats:
        """Return (2 harmonics, step)."""
        phase = 2 * np.pi * np.arange(1, self.harmonics + 1)[:, None] * np.arange(len(series)) / self.period
        return np.round(np.concatenate([np.sin(phase), np.cos(phase)]), 12)

    def stretched(self, share: float) -> Self:
        """Return the waves with their period, in whole steps, made longer."""
        return self.model_copy(update={"period": float(round(self.period * share))})


class Steps(TimeFunction):
    """One function for each step: no time regularisation at all."""

    kind: Literal["steps"] = "steps"
    """every step by itself"""

    def functions(self, series: Series) -> Floats:
        """Return (step, step)."""
        return np.eye(len(series))


PAPER: tuple[TimeFunction, ...] = (Force(), Angle(), Polynomial(degree=1), Ramp(start=50, powers=(1, 2)))
"""Table 1 of the paper: T(t), sin, cos, 1, t, max(t - 50, 0), max(t - 50, 0)^2."""


def time_basis(parts: tuple[TimeFunction, ...], series: Series) -> Floats:
    """Return orthonormal time functions (function, step) that span all parts.

    Raises ValueError where nothing is left of them.
    """
    functions = np.concatenate([part.functions(series) for part in parts]) if parts else np.empty((0, len(series)))
    kept: list[Floats] = []
    for function in functions:
        norm = np.linalg.norm(function)
        rest = function.astype(float)
        for _ in range(2):  # twice is enough (Kahan)
            for other in kept:
                rest = rest - other * (other @ rest)
        if norm > 0 and np.linalg.norm(rest) > INDEPENDENT * norm:
            kept.append(rest / np.linalg.norm(rest))
    if not kept:
        raise ValueError("time functions: expected at least one that is not zero over the steps")
    return np.asarray(np.stack(kept) * np.sqrt(len(series)))


def settled(parts: tuple[TimeFunction, ...], series: Series) -> tuple[TimeFunction, ...]:
    """Return the time functions with what they leave to the data filled in, where the data tell it."""
    return tuple(part.settled(series) for part in parts)


def _unit(count: int) -> Floats:
    return np.linspace(-1, 1, count) if count > 1 else np.zeros(1)
