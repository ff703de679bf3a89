"""The motion at each step from the radiographs so far, while the test goes on.

A radiograph that arrives is worked on as in `pdvc.protocol`, by itself: from where the filter (`pdvc.lagged`) expects
the sample, coarse to fine, each pass weighed against what is expected; at scale 1 with the noise V of its images, in
which the filter then takes it in. The detector's fixed pattern is taken from it as far as the radiographs before it
tell (`pdvc.pattern`).

Steps have errors in common, which no step's own V tells: of the flats, of views that several look along, and of the
model of the image. Whatever they are, they stay in their place on the sample or on the detector, so that blocks of
pixels err independently of each other (`pdvc.coherent`). What each block told, L^-1 c_b, goes through the filter
beside the data, as draws of white noise do. By how much more the blocks move the amplitudes of a motion than noise
does, its intervals are widened. e, believed to a share, errs alike in all blocks: it goes along by itself.

What the noise of views and flats does to a radiograph can be told before it comes, where the sample is expected and
from the reference view that looks along its direction: V changes little over a voxel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pdvc.coherent import by_block, excess
from pdvc.equations import Equations, linearise
from pdvc.geometry import nearest_angles
from pdvc.incoming import Arrival, series_of
from pdvc.lagged import Expected, LaggedFilter, Told
from pdvc.measurement import ResidualTests
from pdvc.noise import (
    BELIEF,
    ImageNoise,
    Noise,
    StepNoise,
    meeting_noise,
    registered_left,
    weighted_sensitivities,
)
from pdvc.pattern import GrowingPattern, Pattern
from pdvc.preparation import Prepared, at_rest, radiograph_noise, stated_noise, with_radiographs
from pdvc.process import FITTED_MODES
from pdvc.progress import Progress, silent
from pdvc.projection import Sensitivities
from pdvc.residual_tests import residual_tests
from pdvc.sensitivity_sums import adjoint, product
from pdvc.setup import Setup
from pdvc.smoother import WORSE, Smoother, seen
from pdvc.solution import SHORTER
from pdvc.state_space import StateSpace
from pdvc.walk import BAND_ROWS, BLOCK_COLUMNS

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

DRAWS = 32
"""Draws of white noise that go along."""
USUAL, LEAST_USUAL = 20, 5
"""Steps that tell which residual is usual, and as many as there have to be."""
EXPLAINED = 1.2
"""Rms residual over the usual one, up to which the motion explains a radiograph: what is far off then has moved."""
AWAITED_VOXEL = 1.0
"""Rms distance of the motion from the expected one, up to which V is that of the expected one."""
AWAITED_RAD = 2e-3
"""Difference of the angle from the planned one, up to which V is that of the planned one."""
MOST_BLOCKS = 300
"""Blocks of pixels that are followed one by one; where there are more, neighbours are taken together."""
MOST_CHANGES = 4
"""Changes of the motion at one scale, at most."""
COARSE_CHANGE = 0.1
"""Rms change of the amplitudes, over the pixel of a coarse scale, under which the next scale begins."""
NEAR = 2.0
"""Rms residual at the second finest scale, over the radiograph's noise, under which the sample is hardly far off."""
LEAST_CHANGE = 0.2
"""The same at scale 1, over their standard deviations, under which a pass was the last one."""


@dataclass(frozen=True, kw_only=True)
class Taken:
    """What became of a radiograph: the motion at its step, from the radiographs up to it."""

    amplitude: Floats
    """(section, motion), voxels."""
    covariance: Floats
    """(section * motion, the same), voxel^2."""
    expected: Floats
    """(section, motion), voxels: as the steps before it go on."""
    uncertain: Floats
    """The covariance of what was expected (section * motion, the same), voxel^2, should nothing be sudden."""
    told: Told
    residual: Image
    """Over its standard deviation (row, column), of the used window; zero where it is not used."""
    tests: ResidualTests
    """Whether it is the noise that was expected."""
    passes: int
    """Passes over the radiograph, of all scales."""


@dataclass(frozen=True, kw_only=True)
class _Awaited:
    """What a radiograph's noise meets, and what the noise of views and flats does."""

    step: int
    angle_rad: float
    amplitude: Floats
    """At which it is known (1, section, motion), voxels."""
    weighted: Sensitivities
    """W S, in the window."""
    covariance: Floats
    """V of views and flats (unknown, unknown)."""
    believed: Floats
    """What the belief in e does (unknown,)."""

    def fits(self, radiograph: Arrival, amplitude: Floats) -> bool:
        """Return whether it holds for a radiograph that was found at amplitudes."""
        away = np.sqrt(np.mean((amplitude - self.amplitude) ** 2))
        turned = abs(radiograph.angle_rad - self.angle_rad)
        return self.step == radiograph.step and turned <= AWAITED_RAD and bool(away <= AWAITED_VOXEL)


class Tracker:
    """Follows a test of which angles and times are planned, from radiographs in nearly any order."""

    def __init__(self, setup: Setup, progress: Progress = silent) -> None:
        """Make ready what the reference scan tells; raises ValueError where a test cannot be followed step by step."""
        solver = setup.options.deformation[-1].solver
        if not isinstance(solver, Smoother):
            raise ValueError(
                f"deformation: expected kind = 'smoother' in the last stage, to follow a test, got {solver.kind!r}"
            )
        self._setup, self._basis = setup, setup.sections
        scales = setup.options.scales
        self._rest = {scale: at_rest(setup, scale, progress, all_views=True) for scale in scales}
        self._noise, self._detector = stated_noise(setup, self._rest[1].systematic)
        self._blurred = meeting_noise(self._rest[1].volume, self._noise.smooth_px)
        self._pattern = GrowingPattern(self._rest[1].systematic, self._noise)
        self._pool = ThreadPoolExecutor(numba.get_num_threads())
        space, few = _space(setup, solver, None), _space(setup, solver, FITTED_MODES)
        rows, columns = self._rest[1].systematic.shape
        blocks = len(_larger_blocks(-(-rows // BAND_ROWS), -(-columns // BLOCK_COLUMNS)).T)
        self._known = LaggedFilter(space, few, solver.bend_voxel, 1 + DRAWS + blocks)
        self._awaited: _Awaited | None = None
        self._rms: list[float] = []

    def take(self, radiograph: Arrival) -> Taken:
        """Take in a radiograph; raises Late of `pdvc.lagged` where its step is too far behind the newest."""
        pattern = self._pattern.found() if self._setup.options.remove_pattern else None
        images = self._images(radiograph, pattern)
        fine, noise = images(1), self._noise_of(radiograph, pattern)
        expected = self._known.expected(radiograph.step)
        amplitude, equations, passes = self._approached(images, expected)
        white = np.zeros_like(equations.residual)
        tests = self._pool.submit(
            residual_tests,
            *(fine.images, fine.systematic, self._basis, amplitude, noise, equations.residual, amplitude.size),
            see=white.__setitem__,
        )
        if self._awaited is None or not self._awaited.fits(radiograph, amplitude):
            self._awaited = self._meeting(fine, amplitude, noise, radiograph)
        told = self._told_by(self._awaited, amplitude, equations, noise.step(0))
        rms = equations.rms
        usual = float(np.median(self._rms)) if len(self._rms) >= LEAST_USUAL else 0.0
        self._known.add(radiograph.step, told, expected if rms < EXPLAINED * usual else None)
        self._rms = [*self._rms[1 - USUAL :], rms]
        found, covariance = self._known.at(radiograph.step)
        if pattern is not None:
            self._pattern.add(equations.residual[0], pattern.grey[fine.systematic.window], noise.step(0))
        to = self._known.space.to_amplitude
        return Taken(
            amplitude=found[:, 0].reshape(self._basis.shape),
            covariance=covariance + self._in_common(found[:, 1:]),
            expected=(to @ expected.mean).reshape(self._basis.shape),
            uncertain=to @ expected.covariance @ to.T,
            told=told,
            tests=tests.result(),
            residual=white[0],
            passes=passes,
        )

    def settle(self) -> None:
        """Do what can be done between radiographs: for the next one, and to know better what the process is like."""
        self._known.fit()
        self._awaited = self._expecting(self._known.steps)

    def kept(self) -> dict[str, NDArray[Any]]:
        """Return all that has to be known to be restored, but for what the steps `told` told."""
        return {
            **self._known.kept(),
            "pattern": self._pattern.sums,
            "pattern_steps": np.array(self._pattern.steps),
            "rms": np.array(self._rms),
        }

    def restore(self, kept: Mapping[str, NDArray[Any]], told: Mapping[int, Told]) -> None:
        """Know again what it knew when `kept` was asked, with what steps told since."""
        self._known.restore(kept, told)
        self._pattern.sums, self._pattern.steps = np.array(kept["pattern"]), int(kept["pattern_steps"])
        self._rms = kept["rms"].tolist()

    def _images(self, radiograph: Arrival, pattern: Pattern | None) -> Callable[[int], Prepared]:
        """Return the function that gives a radiograph at a scale, prepared when it is first asked for."""
        alone = series_of([radiograph])

        @cache
        def at(scale: int) -> Prepared:
            found = with_radiographs(self._setup, self._rest[scale], alone)
            return found.without(pattern.grey) if pattern is not None and scale == 1 else found

        return at

    def _noise_of(self, radiograph: Arrival, pattern: Pattern | None) -> Noise:
        """Return the noise of a radiograph, as that of step 0, of the views and of the flats."""
        own = radiograph_noise(self._setup, self._rest[1].systematic, self._detector, radiograph.counts)
        flat = self._noise.flat if pattern is None else self._noise.flat * pattern.left
        return replace(self._noise, step=lambda _: own, flat=flat)

    def _approached(self, images: Callable[[int], Prepared], expected: Expected) -> tuple[Floats, Equations, int]:
        """Return amplitudes (1, section, motion), voxels, the equations there at scale 1, and the number of passes."""
        step, passes = expected.step, 0
        starts = [self._known.space.to_amplitude @ expected.mean]
        if step:
            # after few steps what is expected may be further off than where the sample was
            starts.append(self._known.at(step - 1)[0][:, 0])

        def pass_at(scale: int, amplitude: Floats) -> Equations:
            nonlocal passes
            passes += 1
            return linearise(images(scale).images, self._basis, amplitude.reshape(1, *self._basis.shape))

        scales, tried = sorted(self._rest, reverse=True), []
        second = scales[-2:][0]
        close = NEAR * float(images(second).noise_rms or 1)
        for start in starts:
            tried.append((pass_at(second, start), start))
            if tried[-1][0].rms < close:
                break
        equations, start = min(tried, key=lambda each: float(each[0].chi2[0]))
        # coarser scales are for what is far off
        near, at = equations.rms < close, start
        for scale in scales[scales.index(second) if near else 0 :]:
            variance = float(images(scale).noise_rms or 1) ** 2
            if scale != second or at is not start:
                equations = pass_at(scale, at)
            for _ in range(MOST_CHANGES):
                matrix, vector = equations.matrix[0] / variance, equations.vector[0] / variance
                mean, covariance = self._known.weighed(expected, matrix, vector + matrix @ at)
                size = LEAST_CHANGE * np.sqrt(np.diag(covariance)) if scale == 1 else COARSE_CHANGE * scale
                small = np.sqrt(np.mean(((mean - at) / size) ** 2)) < 1
                if small and scale > 1:
                    at = mean
                if small:
                    break
                for share in SHORTER:
                    moved = at + share * (mean - at)
                    trial = pass_at(scale, moved)
                    if trial.chi2[0] <= equations.chi2[0] * (1 + WORSE):
                        break
                else:
                    break
                at, equations = moved, trial
        return at.reshape(1, *self._basis.shape), equations, passes

    def _expecting(self, step: int) -> _Awaited | None:
        """Return what can be told of a radiograph before it comes, if one is planned and does not weigh its pixels."""
        planned, options = self._setup.experiment.test, self._setup.options
        if step >= len(planned) or options.weighting == "noise":
            return None
        reference = self._setup.experiment.reference
        # it will look much like the view from there
        (view,) = nearest_angles(planned.angle_rad[step : step + 1], reference.angle_rad)
        alike = Arrival.of(planned, step, reference.counts[view])
        pattern = self._pattern.found() if options.remove_pattern else None
        amplitude = (self._known.space.to_amplitude @ self._known.expected(step).mean).reshape(1, *self._basis.shape)
        try:
            return self._meeting(self._images(alike, pattern)(1), amplitude, self._noise_of(alike, pattern), alike)
        except ValueError:
            # expected where it cannot be: the radiograph will tell
            return None

    def _meeting(self, fine: Prepared, amplitude: Floats, noise: Noise, radiograph: Arrival) -> _Awaited:
        """Return what the noise meets at amplitudes (1, section, motion), and what that of views and flats does."""
        images, systematic = replace(fine.images, volume=self._blurred), fine.systematic
        unknowns, rays = amplitude.size, images.rays
        sight = systematic.looked_along(slice(None), rays, self._basis, amplitude, images.voxel_mm)
        weighted = weighted_sensitivities(images, self._basis, amplitude, [0])[0]
        places = systematic.places(0, rays[0], self._basis, amplitude[0], images.voxel_mm)
        meets = StepNoise.of(noise, 0, sight.of_step(0), weighted, places, systematic.corner)
        covariance = meets.of_scan(noise.flat, unknowns, self._pool)
        left = registered_left(images, self._basis, amplitude, 0)
        return _Awaited(
            step=radiograph.step,
            angle_rad=radiograph.angle_rad,
            amplitude=amplitude,
            weighted=weighted,
            covariance=np.sum(list(covariance.values()), axis=0),
            believed=np.zeros(unknowns) if left is None else BELIEF * adjoint(weighted, left, unknowns),
        )

    def _told_by(self, awaited: _Awaited, amplitude: Floats, equations: Equations, image: ImageNoise) -> Told:
        """Return what a radiograph with a noise told, with the equations at amplitudes (1, section, motion)."""
        unknowns, weighted = amplitude.size, awaited.weighted
        covariance = awaited.covariance + product(weighted, weighted, image.variance, unknowns)
        data, white = seen(equations, covariance[None], amplitude.reshape(1, -1))
        draws = np.random.default_rng((0, awaited.step)).standard_normal((unknowns, DRAWS))
        each = by_block(equations.blocks, white, np.ones((1, 1)))[0]
        blocks = each @ _larger_blocks(*equations.blocks[0].values.shape[:2])
        errors = np.column_stack([white[0] @ awaited.believed, draws, blocks]).astype(np.float32)
        return Told(design=data.design[0], data=data.data[0], errors=errors)

    def _in_common(self, moved: Floats) -> Floats:
        """Return the covariance (unknown, unknown) of what steps have in common, from what errors do to amplitudes.

        `moved` (unknown, error).
        """
        believed, draws, blocks = np.split(moved, [1, 1 + DRAWS], axis=1)
        noise = draws @ draws.T / DRAWS
        more = np.sqrt(excess(blocks**2, np.diag(noise), self._basis.shape))
        larger = np.tile(more, self._basis.shape[0])
        return np.asarray(believed @ believed.T + noise * (np.outer(larger, larger) - 1))


@cache
def _larger_blocks(bands: int, columns: int) -> Floats:
    """Return which of bands x columns blocks of pixels (block, larger block) are taken together: squares of them."""
    side = int(np.ceil(np.sqrt(bands * columns / MOST_BLOCKS)))
    down, across = (np.eye(-(-count // side)).repeat(side, axis=0)[:count] for count in (bands, columns))
    return np.asarray(np.kron(down, across), dtype=np.float64)


def _space(setup: Setup, solver: Smoother, most_modes: int | None) -> StateSpace:
    """Return the states of a planned test; its trend is a sine and a cosine of the planned angle."""
    planned = setup.experiment.test
    trend = (
        np.stack([np.sin(planned.angle_rad), np.cos(planned.angle_rad)])
        if solver.trend
        else np.empty((0, len(planned)))
    )
    return solver.space(setup.sections, planned.time_s, trend, setup.options.prior_voxel, most_modes)
