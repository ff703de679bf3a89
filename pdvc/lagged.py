"""A filter over steps that go on, of a process whose scales are known the better the more steps came after.

How large a bend, an apparent motion or a misfit of a step was (`pdvc.state_space`), the steps after it tell best: a
slip looks like noise at first. So the scales of the last `WINDOW` steps are found anew with each step, from few modes,
and the filter (`pdvc.filtering`) goes again over the last `LAG` of them. Other deviations are fitted now and then.

Before a step is taken in, the motion is sought in passes over its radiograph. Each gives what it tells of the states,
J and v, to be weighed against what is expected: x_p of covariance P, without a bend. With the bend w and its factor c,

    x = x_p + w / c + N(0, P)        w given J', v':  precision  M / c^2 + Q^-1,   M = (1 + J' P)^-1 J'

whose scale s in Q = s Q_1 is found in turn with w, so that a slip is followed in the radiograph that shows it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pdvc.apparent import reduced
from pdvc.filtering import Filter, bends_to
from pdvc.process import Process, Seen, bend_scales, unscaled
from pdvc.state_space import Deviations, StateSpace

Floats = NDArray[np.float64]

WINDOW = 40
"""Steps whose scales are found anew at each step."""
LAG = 20
"""Steps that the filter goes over again."""
FITTED = 64
"""Steps from which deviations are fitted, at most."""
FIRST, EVERY = 32, 16
"""Steps after which deviations are fitted first, and anew: from fewer they are anything."""
MEANWHILE = 3
"""Steps that go on while deviations are fitted, which takes as long as some of them."""
CHANGED = 0.1
"""Change of a step's scales, of their logarithm, from which on the filter goes over it again."""
ROUNDS = 4
"""Times that the scales of a bend are found in turn with the bend."""

_USED, _GIVEN = "used_", "given_"
"""Before the names of variances, and of deviations that are being fitted, where they are kept beside deviations."""


@dataclass(frozen=True, kw_only=True)
class Told:
    """What a radiograph told: white data y = X a + noise, and what errors that steps have in common add to y."""

    design: Floats
    """X (unknown, unknown)."""
    data: Floats
    """y (unknown,)."""
    errors: NDArray[np.float32] | Floats
    """(unknown, error)."""


@dataclass(frozen=True, kw_only=True)
class _Fit:
    """Deviations that are being fitted."""

    window: slice
    """The steps that tell them."""
    steps: tuple[int, ...]
    """Those of them that had told something."""
    about: Floats
    """Amplitudes (unknown,) about which those of the first step may be."""
    given: Deviations
    """Those from which the search starts, of these steps."""
    found: Future[Deviations]


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What is expected of the states of a step before its radiograph, were there no bend."""

    step: int
    mean: Floats
    """x_p (state,)."""
    covariance: Floats
    """P (state, state)."""


class Late(ValueError):
    """A step that the filter has left behind."""


class LaggedFilter:
    """What is known of each step from the steps so far, in any order within `LAG` of the newest."""

    def __init__(self, space: StateSpace, few: StateSpace, bend_voxel: float | Literal["fit"], errors: int) -> None:
        """Begin before the first step of a planned test.

        `space`, and the same with `few` modes, in which scales are found; `bend_voxel` as in `pdvc.smoother`; the
        number of errors that steps have in common.
        """
        self.space, self._few = space, few
        self._finds = bend_voxel == "fit"
        self._deviations = space.first_guess() if bend_voxel == "fit" else space.fixed(bend_voxel)
        self._told: dict[int, Told] = {}
        self._fitted = 0
        self._fit: _Fit | None = None
        self._thread = ThreadPoolExecutor(1)
        self.steps = 0
        """Steps so far: up to the newest one that told something."""
        self._passed = [Filter(space, space.end_variance(self._deviations), errors)]
        """The filter before the steps that it may go over again, and after each of them, as far as it has gone."""
        self._variances = _variances(space, self._deviations)
        """Those with which it went over each step."""

    def expected(self, step: int) -> Expected:
        """Return what is expected of a step; raises Late where it is more than `LAG` steps ago."""
        # by what it is to be taken in with
        self._take_over(max(self.steps, step + 1))
        mean, covariance = self._after(step).ahead()
        return Expected(step=step, mean=mean[:, 0], covariance=covariance)

    def weighed(self, expected: Expected, matrix: Floats, vector: Floats) -> tuple[Floats, Floats]:
        """Return mean (unknown,) and covariance (unknown, unknown) of a step's amplitudes, voxels.

        From what is expected and from what one pass tells: B (unknown, unknown) and c + B a (unknown,), over the
        variance of the noise. Scales are found on the way, and forgotten.
        """
        to, step = self.space.to_amplitude, expected.step
        apparent = self._variances.apparent[step]
        told = reduced((to.T @ matrix @ to)[None], (to.T @ vector)[None], apparent[None])
        information, left = told.information[0], told.vector[0] - told.information[0] @ expected.mean
        spread = expected.covariance + np.diag(self._bend(expected, information, left))
        gain = np.linalg.solve(np.eye(len(spread)) + spread @ information, spread)
        return to @ (expected.mean + gain @ left), to @ gain @ to.T

    def add(self, step: int, told: Told, expected: Expected | None = None) -> None:
        """Take in what the radiograph of a step told; raises Late where it is more than `LAG` steps ago.

        What is far from what was `expected` of it is a motion at once. Without, the steps after it tell whether it was
        one, or what the model of the image misses.
        """
        self._take_over(max(self.steps, step + 1))
        self._after(step)
        self._told[step] = told
        self._passed = self._passed[: step - self._first + 1]
        self.steps = max(self.steps, step + 1)
        if self._finds:
            window = slice(max(self.steps - WINDOW, 0), self.steps)
            process, given = self._process(window, self._about(), self._told), self._given(window)
            # nothing was known of a step before its radiograph
            given.misfit[step - window.start] = 1
            if expected is not None and step + 1 == self.steps and step - window.start >= 2:
                last = step - window.start - 2
                information, vector = self._informed(step, misfit=1.0)
                found = self._scales(expected, information, vector[:, 0] - information @ expected.mean)
                given.rigid_scale[last], given.own_scale[last] = found.rigid_scale[0], found.own_scale[0]
            self._adopt(_with_scales(self._deviations, process.rescaled(given), window))
        self._after(self.steps)
        self._passed = self._passed[max(self.steps - 1 - LAG - self._first, 0) :]
        self._told = {t: each for t, each in self._told.items() if t >= self.steps - FITTED - MEANWHILE}

    def at(self, step: int) -> tuple[Floats, Floats]:
        """Return a step's amplitudes and what errors in common do to them (unknown, 1 + error), and their covariance.

        From the steps up to it, voxels and voxel^2; raises Late where it is more than `LAG` steps ago.
        """
        mean, covariance = self._after(step + 1).now()
        to = self.space.to_amplitude
        return to @ mean, to @ covariance @ to.T

    def fit(self) -> None:
        """Begin to fit the deviations where it is time to, beside what comes next.

        They are taken over `MEANWHILE` steps later, when they are ready or waited for: what comes out does not depend
        on the clock.
        """
        over = self.steps >= self.space.shape[0]
        if self._finds and self._fit is None and not over and self.steps >= max(self._fitted + EVERY, FIRST):
            self._fitted = self.steps
            window = slice(max(self.steps - FITTED, 0), self.steps)
            self._fit = self._begun(window, tuple(sorted(self._told)), self._about(), self._given(window))

    def _take_over(self, steps: int) -> None:
        """Wait for deviations that are being fitted, and take them over, where so many steps have come."""
        if self._fit is not None and steps >= self._fitted + MEANWHILE:
            fit, self._fit = self._fit, None
            try:
                found = fit.found.result()
            except np.linalg.LinAlgError:
                # what could not be fitted stays as it is, whoever asked first
                return
            # the ends of a window are not those of the test
            shared = {name: getattr(found, name) for name in ("bend_voxel", "roughness", "apparent_voxel")}
            self._adopt(replace(self._deviations, **shared))

    def _begun(self, window: slice, steps: tuple[int, ...], about: Floats, given: Deviations) -> _Fit:
        found = self._thread.submit(self._process(window, about, steps).fitted, given, 1)
        return _Fit(window=window, steps=steps, about=about, given=given, found=found)

    def kept(self) -> dict[str, NDArray[Any]]:
        """Return all that it has to know to be restored, but for what steps told: `told` are those that it needs."""
        start, fit = self._passed[0], self._fit
        fitting = (
            {}
            if fit is None
            else {
                **{_GIVEN + name: values for name, values in vars(fit.given).items()},
                "window": np.array([fit.window.start, fit.window.stop]),
                "fitted_of": np.array(fit.steps, dtype=np.int64),
                "about": fit.about,
            }
        )
        return {
            **fitting,
            **vars(self._deviations),
            **{_USED + name: values for name, values in vars(self._variances).items()},
            "matrix": start.matrix,
            "vectors": start.vectors,
            "count": np.array([start.steps, self.steps, self._fitted]),
            "told": np.array(sorted(self._told), dtype=np.int64),
        }

    def restore(self, kept: Mapping[str, NDArray[Any]], told: Mapping[int, Told]) -> None:
        """Know again what it knew when `kept` was asked, with what steps told since."""
        first, self.steps, self._fitted = kept["count"].tolist()
        self._deviations = Deviations(**{name: kept[name] for name in vars(self._deviations)})
        self._told = {step: told[step] for step in kept["told"].tolist()}
        start = self._passed[0].copied()
        start.steps, start.matrix, start.vectors = first, kept["matrix"], kept["vectors"]
        self._passed = [start]
        self._variances = _Variances(**{name: kept[_USED + name] for name in vars(self._variances)})
        # as far as it had gone: what is fitted next changes only what comes after
        self._after(self.steps)
        self._fit = None
        if "window" in kept:
            given = Deviations(**{name: kept[_GIVEN + name] for name in vars(self._deviations)})
            window, steps = slice(*kept["window"].tolist()), tuple(kept["fitted_of"].tolist())
            self._fit = self._begun(window, steps, kept["about"], given)

    @property
    def _first(self) -> int:
        """Return the first step that the filter goes over again."""
        return self._passed[0].steps

    def _after(self, step: int) -> Filter:
        """Return the filter before a step, after all those before it."""
        if step < self._first:
            raise Late(f"step {step}: expected one that is at most {LAG} steps behind the newest")
        for t in range(self._passed[-1].steps, step):
            known = self._passed[-1].copied()
            known.add(*self._informed(t), self._variances.bend[t])
            self._passed.append(known)
        return self._passed[step - self._first]

    def _informed(self, step: int, misfit: float | None = None) -> tuple[Floats, Floats]:
        """Return J' (state, state) and v' (state, 1 + error) of a step; zeros where there is no radiograph.

        For the misfit that is known of it, unless another is given.
        """
        states = self.space.shape[1]
        if step not in self._told:
            return np.zeros((states, states)), np.zeros((states, self._passed[0].errors + 1))
        told, misfit = self._told[step], self._variances.misfit[step] if misfit is None else misfit
        design = told.design @ self.space.to_amplitude
        vectors = design.T @ np.column_stack([told.data, told.errors]) / misfit
        apparent = self._variances.apparent[step]
        found = reduced((design.T @ design / misfit)[None], vectors[None, :, 0], apparent[None])
        return found.information[0], found.of(vectors[None])[0]

    def _adopt(self, deviations: Deviations) -> None:
        """Take over deviations; the filter will go again from the first step for which they have changed."""
        self._deviations = deviations
        now, before = _variances(self.space, deviations), self._variances
        passed = slice(self._first, self._passed[-1].steps)
        changed = np.flatnonzero(now.differs(before)[passed])
        kept = self._first + int(changed[0]) if len(changed) else passed.stop
        self._passed = self._passed[: kept - self._first + 1]
        self._variances = before.then(now, kept)

    def _bend(self, expected: Expected, information: Floats, left: Floats) -> Floats:
        """Return the variance (state,) that the bend of a step adds to what is expected, as large as the step shows.

        From J' and v' - J' x_p. The first two steps end no bend.
        """
        bend = expected.step - 2
        if bend < 0:
            return np.zeros(len(left))
        space = self.space.within(slice(bend, bend + 3))
        deviations = self._scales(expected, information, left)
        return np.asarray(space.bend_variance(deviations)[0] / space.second_differences[0, 2] ** 2)

    def _scales(self, expected: Expected, information: Floats, left: Floats) -> Deviations:
        """Return the deviations of the three steps that a step's bend joins, its scales as large as the step shows."""
        three = slice(expected.step - 2, expected.step + 1)
        space, deviations = self.space.within(three), _within(self._deviations, three)
        factor, once = space.second_differences[0, 2], space.bend_variance(unscaled(deviations))
        if self._finds:
            both = np.column_stack([information, left])
            known = np.linalg.solve(np.eye(len(left)) + information @ expected.covariance, both)
            matrix, vector = known[:, :-1] / factor**2, known[:, -1] / factor
            for _ in range(ROUNDS):
                covariance = np.linalg.inv(matrix + np.diag(1 / space.bend_variance(deviations)[0]))
                squares = (covariance @ vector) ** 2 + np.diag(covariance)
                deviations = replace(deviations, **bend_scales(space, squares / once))
        return deviations

    def _about(self) -> Floats:
        """Return amplitudes (unknown,) about which those of the first step of a window may be."""
        if not self._first:
            return np.zeros(len(self.space.to_amplitude))
        return np.asarray(self.space.to_amplitude @ self._passed[0].now()[0][:, 0])

    def _given(self, window: slice) -> Deviations:
        """Return the deviations of some steps, of which the first may be anywhere."""
        given = _within(self._deviations, window)
        return replace(given, end_voxel=np.full_like(given.end_voxel, self.space.prior_voxel))

    def _process(self, window: slice, about: Floats, told_by: Collection[int]) -> Process:
        """Return the process of some steps, in few modes, about where its first step may be, from those that told."""
        space = self._few.within(window)
        steps, unknowns = space.shape[0], len(space.to_amplitude)
        design, data = np.zeros((steps, unknowns, unknowns)), np.zeros((steps, unknowns))
        for step, told in self._told.items():
            if window.start <= step < window.stop and step in told_by:
                design[step - window.start] = told.design
                data[step - window.start] = told.data - told.design @ about
        return Process(space, Seen(design=design, data=data))


@dataclass(frozen=True, kw_only=True)
class _Variances:
    """Variances of steps, as the filter takes them."""

    bend: Floats
    """Of the bend that ends at a step (step, state), voxel^2."""
    apparent: Floats
    """(step, state), voxel^2."""
    misfit: Floats
    """(step,)"""

    def differs(self, other: _Variances) -> NDArray[np.bool_]:
        """Return which steps have others by more than `CHANGED` (step,)."""
        least = np.finfo(float).tiny
        pairs = (
            (self.bend, other.bend),
            (self.apparent, other.apparent),
            (self.misfit[:, None], other.misfit[:, None]),
        )
        away = [np.abs(np.log((one + least) / (two + least))).max(axis=1) for one, two in pairs]
        return np.asarray(np.max(away, axis=0) > CHANGED)

    def then(self, other: _Variances, step: int) -> _Variances:
        """Return these before a step, and others from it on."""
        pairs = ((name, getattr(other, name)) for name in vars(self))
        return _Variances(**{name: np.concatenate([getattr(self, name)[:step], new[step:]]) for name, new in pairs})


def _variances(space: StateSpace, deviations: Deviations) -> _Variances:
    """Return the variances of all steps."""
    return _Variances(
        bend=bends_to(space, deviations),
        apparent=space.apparent_variance(deviations),
        misfit=deviations.misfit,
    )


def _within(deviations: Deviations, window: slice) -> Deviations:
    """Return the deviations of some steps, arrays of their own."""
    bends = slice(window.start, max(window.stop - 2, window.start))
    return replace(
        deviations,
        rigid_scale=deviations.rigid_scale[bends].copy(),
        own_scale=deviations.own_scale[bends].copy(),
        misfit=deviations.misfit[window].copy(),
        apparent_scale=deviations.apparent_scale[window].copy(),
    )


def _with_scales(deviations: Deviations, found: Deviations, window: slice) -> Deviations:
    """Return deviations with the scales that were found for some steps."""
    whole = _within(deviations, slice(0, len(deviations.misfit)))
    bends = slice(window.start, max(window.stop - 2, window.start))
    whole.rigid_scale[bends], whole.own_scale[bends] = found.rigid_scale, found.own_scale
    whole.misfit[window], whole.apparent_scale[window] = found.misfit, found.apparent_scale
    return whole
