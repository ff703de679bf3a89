"""The process over steps: against the same Gaussian model written out, and by laws of time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize, stats

from pdvc import process as room
from pdvc.filtering import Filter, filtered
from pdvc.process import Process, Seen, Smoothed
from pdvc.sections import CONTRACTION, RIGID, TRANSLATION_X, TRANSLATION_Z, SectionBasis
from pdvc.state_space import LONGEST_GAP, Deviations, StateSpace
from tests.laws import law

HEIGHT = np.array([-1.1, -0.4, 0.5, 1.2])
RADIUS = 0.6
ALL = (*RIGID, CONTRACTION)
TWO = (TRANSLATION_X, TRANSLATION_Z)
NU = 0.4
PRIOR = 20.0

seeds = st.integers(0, 10**6)
lengths = st.integers(1, 9)
several = st.integers(3, 9)
motions = st.sampled_from((ALL, TWO))


# The model written out


def rigid_motions(names: tuple[str, ...]) -> np.ndarray:
    """Return the amplitudes (section, motion, rigid motion) of the sample moved as a whole, those that can be made.

    Rotations are about the point of the axis at the sections' mean height.
    """
    above, found = (HEIGHT - HEIGHT.mean()) / RADIUS, []
    swung = {"rotation_x": ("translation_y", -above), "rotation_y": ("translation_x", above)}
    for motion in RIGID:
        amplitude = np.zeros((len(HEIGHT), len(names)))
        parts = {motion.name: np.ones(len(HEIGHT))}
        if motion.name in swung:
            other, size = swung[motion.name]
            parts[other] = size
        if set(parts) <= set(names):
            for name, size in parts.items():
                amplitude[:, names.index(name)] = size
            found.append(amplitude)
    return np.stack(found, axis=-1)


def modes() -> tuple[np.ndarray, np.ndarray]:
    """Return modes (section, mode) and eigenvalues l_j of a Matern 3/2 covariance as long as half the height."""
    away = np.sqrt(3) * np.abs(np.subtract.outer(HEIGHT, HEIGHT)) / ((HEIGHT[-1] - HEIGHT[0]) / 2)
    value, vector = np.linalg.eigh((1 + away) * np.exp(-away))
    return vector[:, ::-1] * np.sqrt(len(HEIGHT)), value[::-1]


def slopes(along: np.ndarray) -> np.ndarray:
    """Return d/dz (section, ...) of what is linear between sections: hats fitted to it at many heights."""
    edges = np.concatenate([np.linspace(*pair, 2001) for pair in pairwise(HEIGHT)])
    z = ((edges[1:] + edges[:-1]) / 2)[np.diff(edges) > 0]
    hats = np.stack([np.interp(z, HEIGHT, row) for row in np.eye(len(HEIGHT))], axis=1)
    interval = np.searchsorted(HEIGHT, z) - 1
    steep = (np.diff(along, axis=0) / np.diff(HEIGHT).reshape(-1, *(1,) * (along.ndim - 1)))[interval]
    weight = np.sqrt(np.diff(HEIGHT)[interval])[:, None]
    found = np.linalg.lstsq(hats * weight, steep.reshape(len(z), -1) * weight, rcond=None)[0]
    return found.reshape(along.shape)


@dataclass(frozen=True)
class Case:
    """A process of a few steps, with data; `tied` is nu."""

    basis: SectionBasis
    time_s: np.ndarray
    trend: np.ndarray
    tied: float | None
    seen: Seen
    deviations: Deviations

    @cached_property
    def space(self) -> StateSpace:
        return StateSpace(self.basis, self.time_s, self.trend, contraction_of_strain=self.tied, prior_voxel=PRIOR)

    @property
    def process(self) -> Process:
        return Process(self.space, self.seen)

    def gaps(self) -> np.ndarray:
        gap = np.abs(np.diff(self.time_s))
        return gap / np.median(gap) if len(gap) else gap

    def in_time(self, bend: float, end: float, scale: np.ndarray) -> np.ndarray:
        """Return the covariance (step, step) of one state: of bends, and of the first and the last step, all apart."""
        steps, gap, rows, variances = len(self.time_s), self.gaps(), [], []
        for t in range(1, steps - 1):
            row = np.zeros(steps)
            row[[t + 1, t]] += np.array([1, -1]) / gap[t]
            row[[t, t - 1]] -= np.array([1, -1]) / gap[t - 1]
            rows.append(row)
            variances.append(bend**2 * scale[t - 1] * (gap[t] + gap[t - 1]) / 2)
        for t in {0, steps - 1}:
            rows.append(np.eye(steps)[t])
            variances.append(end**2)
        way = np.linalg.inv(np.stack(rows))
        return way * np.array(variances) @ way.T

    def prior(self, given: Deviations) -> np.ndarray:
        """Return the covariance (step * unknown, step * unknown) of all amplitudes before there are data."""
        names, (along, value) = self.basis.names, modes()
        rigid = rigid_motions(names)
        moved = rigid.reshape(-1, rigid.shape[-1])
        total = np.zeros((len(self.time_s), self.basis.height_mm.size * len(names)) * 2)

        def add(time: np.ndarray, shape: np.ndarray) -> None:
            nonlocal total
            total += np.einsum("tu,n,m->tnum", time, shape.ravel(), shape.ravel())

        for i in range(rigid.shape[-1]):
            add(self.in_time(given.bend_voxel[i], PRIOR, given.rigid_scale[:, i]), moved[:, i])
            add(PRIOR**2 * self.trend.T @ self.trend, moved[:, i])
        for k, name in enumerate(names):
            for j in range(len(value)):
                rough = (value[j] / value[0]) ** (given.roughness[k] / 2)
                bend, end = given.bend_voxel[rigid.shape[-1] + k] * rough, given.end_voxel[k] * rough
                shape = np.zeros((len(HEIGHT), len(names)))
                shape[:, k] = along[:, j]
                if name == "translation_z" and self.tied is not None and "contraction" in names:
                    shape[:, names.index("contraction")] -= self.tied * RADIUS * slopes(along[:, j])
                add(self.in_time(bend, end, given.own_scale), shape)
        return total.reshape((len(self.time_s) * moved.shape[0],) * 2)

    def stacked(self) -> tuple[np.ndarray, np.ndarray]:
        """Return X and y of all steps together."""
        steps, unknowns = self.seen.data.shape
        whole = np.zeros((steps, unknowns, steps, unknowns))
        for t in range(steps):
            whole[t, :, t] = self.seen.design[t]
        return whole.reshape((steps * unknowns,) * 2), self.seen.data.ravel()

    def of_data(self, given: Deviations) -> np.ndarray:
        """Return the covariance of all data before they were taken."""
        x, _ = self.stacked()
        moved = self.prior(given) + self.apparent(given)
        return x @ moved @ x.T + np.diag(np.repeat(given.misfit, self.seen.unknowns))

    def apparent(self, given: Deviations) -> np.ndarray:
        """Return the covariance (step * unknown, step * unknown) of apparent motions: each step by itself."""
        steps, (shape, states) = len(self.time_s), self.space.to_amplitude.shape
        total = np.zeros((steps, shape, steps, shape))
        for t in range(steps):
            for i in range(states):
                of, group = self.space.to_amplitude[:, i], self.space.group[i]
                size = given.apparent_voxel[group] ** 2 * given.apparent_scale[t, group]
                total[t, :, t] += size * np.outer(of, of)
        return total.reshape((steps * shape,) * 2)

    def expected(self, given: Deviations) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean (step, unknown) and the covariance of all amplitudes under the data."""
        (x, y), before = self.stacked(), self.prior(given)
        gain = np.linalg.solve(self.of_data(given), x @ before).T
        return (gain @ y).reshape(self.seen.data.shape), before - gain @ x @ before

    def log_density(self, given: Deviations) -> float:
        covariance = self.of_data(given)
        return float(stats.multivariate_normal(np.zeros(len(covariance)), covariance).logpdf(self.seen.data.ravel()))


def deviations(rng: np.random.Generator, steps: int, names: tuple[str, ...]) -> Deviations:
    bends = max(steps - 2, 0)
    rigid = rigid_motions(names).shape[-1]
    groups = rigid + len(names)

    def around(size: float, count: int) -> np.ndarray:
        return size * np.exp(0.5 * rng.normal(size=count))

    return Deviations(
        bend_voxel=around(0.3, groups),
        end_voxel=around(1.0, len(names)),
        roughness=rng.uniform(0.3, 2.0, len(names)),
        rigid_scale=around(1.0, bends * rigid).reshape(bends, rigid),
        own_scale=around(1.0, bends),
        misfit=around(1.0, steps),
        apparent_voxel=around(0.2, groups),
        apparent_scale=around(1.0, steps * groups).reshape(steps, groups),
    )


def case(seed, steps, section_motions=ALL, *, trend=2, tied=NU, even=False) -> Case:
    """Return random data of random designs, of a size where prior and data weigh alike."""
    rng = np.random.default_rng(seed)
    basis = SectionBasis(height_mm=HEIGHT, radius_mm=RADIUS, motions=section_motions)
    unknowns = len(HEIGHT) * len(section_motions)
    gaps = np.ones(steps - 1) if even else rng.uniform(0.7, 1.4, steps - 1)
    return Case(
        basis=basis,
        time_s=5.0 + 3.0 * np.concatenate([[0], np.cumsum(gaps)]),
        trend=rng.normal(size=(trend, steps)),
        tied=tied,
        seen=Seen(
            design=2 * np.eye(unknowns) + rng.normal(size=(steps, unknowns, unknowns)) / np.sqrt(unknowns),
            data=5 * rng.normal(size=(steps, unknowns)),
        ),
        deviations=deviations(rng, steps, basis.names),
    )


def solved(of: Case, given: Deviations | None = None) -> tuple[np.ndarray, np.ndarray, Smoothed]:
    """Return amplitudes (step, unknown), each step's covariance, and all the rest."""
    process = of.process
    smoothed = process.smoothed(given or of.deviations)
    return process.amplitude(smoothed), process.covariance(smoothed, smoothed.factor.inverted()), smoothed


# Against the model written out


@law(40)
@given(seeds, lengths, motions, st.integers(0, 2), st.sampled_from((NU, None)))
def test_mean_and_covariance_are_those_of_the_model_written_out(seed, steps, section_motions, trend, tied):
    one = case(seed, steps, section_motions, trend=trend, tied=tied)
    mean, covariance, _ = solved(one)
    expected, whole = one.expected(one.deviations)
    np.testing.assert_allclose(mean, expected, atol=1e-6 * np.abs(expected).max())
    blocks = whole.reshape(*mean.shape, *mean.shape)
    own = np.stack([blocks[t, :, t] for t in range(steps)])
    np.testing.assert_allclose(covariance, own, atol=1e-6 * np.abs(own).max())


@law(30)
@given(seeds, lengths, motions, st.integers(0, 2))
def test_the_marginal_likelihood_is_that_of_the_model_written_out_up_to_a_constant(
    seed, steps, section_motions, trend
):
    one = case(seed, steps, section_motions, trend=trend)
    other = deviations(np.random.default_rng(seed + 1), steps, one.basis.names)
    found = solved(one)[2].log_likelihood - solved(one, other)[2].log_likelihood
    expected = one.log_density(one.deviations) - one.log_density(other)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-5)


@law(20)
@given(seeds, lengths, motions, st.integers(0, 2))
def test_the_response_to_errors_of_the_data_is_what_they_change(seed, steps, section_motions, trend):
    one = case(seed, steps, section_motions, trend=trend)
    errors = np.random.default_rng(seed + 1).normal(size=(*one.seen.data.shape, 2))
    mean, _, smoothed = solved(one)
    found = one.process.response(smoothed, one.deviations, errors)
    for draw in range(2):
        wrong = replace(one, seen=replace(one.seen, data=one.seen.data + errors[..., draw]))
        change = solved(wrong)[0] - mean
        np.testing.assert_allclose(found[..., draw], change, atol=1e-7 * np.abs(mean).max())


@law(20)
@given(seeds, lengths, motions, st.integers(0, 2))
def test_the_filter_at_each_step_is_the_smoother_of_a_test_that_ended_there(seed, steps, section_motions, trend):
    one = case(seed, steps, section_motions, trend=trend, even=True)
    mean, covariance = filtered(one.process, one.deviations)
    for last in range(1, steps + 1):
        so_far = ended(one, last)
        expected, spread, _ = solved(so_far)
        np.testing.assert_allclose(mean[last - 1], expected[-1], atol=1e-6 * np.abs(expected).max())
        np.testing.assert_allclose(covariance[last - 1], spread[-1], atol=1e-6 * np.abs(spread).max())


def ended(one: Case, steps: int) -> Case:
    """Return a case of its first steps alone."""
    given, bends = one.deviations, max(steps - 2, 0)
    return replace(
        one,
        time_s=one.time_s[:steps],
        trend=one.trend[:, :steps],
        seen=Seen(design=one.seen.design[:steps], data=one.seen.data[:steps]),
        deviations=replace(
            given,
            rigid_scale=given.rigid_scale[:bends],
            own_scale=given.own_scale[:bends],
            misfit=given.misfit[:steps],
            apparent_scale=given.apparent_scale[:steps],
        ),
    )


def test_a_filter_takes_no_more_steps_than_there_are():
    one = case(0, 2)
    told, known = one.process.told(one.deviations), Filter(one.space, one.space.end_variance(one.deviations))
    bend = np.ones(one.space.shape[1])
    for t in range(2):
        known.add(told.information[t], told.vector[t][:, None], bend)
    with pytest.raises(ValueError, match="step: expected at most 2"):
        known.add(told.information[0], told.vector[0][:, None], bend)


class Caught(Exception):
    """What is minimised, on its way."""


def minimised(one: Case, monkeypatch: pytest.MonkeyPatch):
    """Return what the process minimises for the likeliest deviations, with its slope, and where it starts."""

    def catch(function, start, **others):
        raise Caught(function, start)

    with monkeypatch.context() as patched:
        patched.setattr(room, "minimize", catch)
        with pytest.raises(Caught) as caught:
            one.process.fitted(one.deviations, rounds=1)
    return caught.value.args


@pytest.mark.parametrize(("steps", "section_motions"), [(1, ALL), (2, TWO), (3, ALL), (7, ALL), (9, TWO)])
def test_the_likelihood_s_slope_is_that_of_finite_differences(steps, section_motions, monkeypatch):
    """Of each deviation q, each e, each n and each r, with the broad priors of their logarithms."""
    function, start = minimised(case(3, steps, section_motions), monkeypatch)
    _, slope = function(start)
    found = optimize.approx_fprime(start, lambda x: function(x)[0], 1e-6)
    np.testing.assert_allclose(slope, found, atol=2e-4 * max(np.abs(found).max(), 1))


def test_what_is_minimised_is_the_likelihood_with_broad_priors(monkeypatch):
    one = case(4, 6)
    function, start = minimised(one, monkeypatch)
    groups, count = len(one.deviations.bend_voxel), len(ALL)
    np.testing.assert_allclose(np.exp(start[:groups]), one.deviations.bend_voxel)
    np.testing.assert_allclose(np.exp(start[groups : groups + count]), one.deviations.end_voxel)
    np.testing.assert_allclose(np.exp(start[groups + count : -count]), one.deviations.apparent_voxel)
    np.testing.assert_allclose(start[-count:], one.deviations.roughness)

    def written_out(x):
        given = replace(
            one.deviations,
            bend_voxel=np.exp(x[:groups]),
            end_voxel=np.exp(x[groups : groups + count]),
            apparent_voxel=np.exp(x[groups + count : -count]),
            roughness=x[-count:],
        )
        typical = np.repeat([np.log(0.01), 0.0, np.log(0.003)], [groups, count, groups])
        broad = (x[:-count] - typical) / 2.5
        rough = (x[-count:] - 1) / 0.5
        return -one.log_density(given) + (broad @ broad + rough @ rough) / 2

    elsewhere = start + 0.3 * np.random.default_rng(5).normal(size=len(start))
    difference = written_out(elsewhere) - written_out(start)
    assert function(elsewhere)[0] - function(start)[0] == pytest.approx(difference, rel=1e-6)


# Laws of time


@law(20)
@given(seeds, lengths, motions)
def test_time_has_no_direction(seed, steps, section_motions):
    one = case(seed, steps, section_motions)
    given = one.deviations
    back = replace(
        one,
        time_s=one.time_s[::-1],
        trend=one.trend[:, ::-1],
        seen=Seen(design=one.seen.design[::-1], data=one.seen.data[::-1]),
        deviations=replace(
            given,
            rigid_scale=given.rigid_scale[::-1],
            own_scale=given.own_scale[::-1],
            misfit=given.misfit[::-1],
            apparent_scale=given.apparent_scale[::-1],
        ),
    )
    mean, covariance, smoothed = solved(one)
    turned, spread, other = solved(back)
    np.testing.assert_allclose(turned[::-1], mean, atol=1e-7 * np.abs(mean).max())
    np.testing.assert_allclose(spread[::-1], covariance, atol=1e-7 * np.abs(covariance).max())
    assert other.log_likelihood == pytest.approx(smoothed.log_likelihood, abs=1e-6)


@law(15)
@given(seeds, lengths, motions, st.integers(0, 2))
def test_steps_that_may_bend_without_limit_are_solved_each_by_itself(seed, steps, section_motions, trend):
    one = case(seed, steps, section_motions, trend=trend, tied=None)
    free = replace(one.space.fixed(1e4), end_voxel=np.full(len(section_motions), 1e3), misfit=one.deviations.misfit)
    free = replace(free, roughness=np.zeros(len(section_motions)))
    mean, covariance, _ = solved(one, free)
    inverse = np.linalg.inv(one.seen.design)
    own = np.einsum("tnm,tm->tn", inverse, one.seen.data)
    np.testing.assert_allclose(mean, own, atol=1e-3 * np.abs(own).max())
    spread = one.deviations.misfit[:, None, None] * (inverse @ inverse.transpose(0, 2, 1))
    np.testing.assert_allclose(covariance, spread, atol=1e-3 * np.abs(spread).max())


@law(15)
@given(seeds, several, motions)
def test_steps_that_hardly_bend_move_steadily(seed, steps, section_motions):
    """A straight line in time for each amplitude: the one of least squares, where nothing else is known."""
    one = case(seed, steps, section_motions, trend=0, tied=None)
    stiff = replace(one.space.fixed(1e-5), misfit=one.deviations.misfit)
    wide = replace(stiff, end_voxel=np.full(len(section_motions), 1e2), roughness=np.zeros(len(section_motions)))
    mean, _, smoothed = solved(one, wide)
    assert np.abs(one.space.bends(smoothed.states)).max() < 1e-4
    line = np.stack([np.ones(steps), one.time_s - one.time_s.mean()], axis=1)
    weight = 1 / np.sqrt(np.repeat(one.deviations.misfit, one.seen.unknowns))
    whole = np.einsum("tnm,tk->tnkm", one.seen.design, line).reshape(len(weight), -1)
    factors = np.linalg.lstsq(weight[:, None] * whole, weight * one.seen.data.ravel(), rcond=None)[0]
    expected = line @ factors.reshape(2, -1)
    np.testing.assert_allclose(mean, expected, atol=1e-3 * np.abs(expected).max())


@law(20)
@given(seeds, motions)
def test_a_step_alone_is_solved_under_the_prior_of_ends(seed, section_motions):
    """Bends are nowhere in it; the wide prior of the rigid motions is."""
    one = case(seed, 1, section_motions, trend=0, tied=None)
    mean, covariance, _ = solved(one)
    steeper = replace(one.deviations, bend_voxel=100 * one.deviations.bend_voxel)
    np.testing.assert_array_equal(solved(one, steeper)[0], mean)
    along, value = modes()
    rigid = rigid_motions(one.basis.names).reshape(one.seen.unknowns, -1)
    before = PRIOR**2 * rigid @ rigid.T
    for k in range(len(section_motions)):
        spread = one.deviations.end_voxel[k] ** 2 * (value / value[0]) ** one.deviations.roughness[k]
        only = np.diag(np.eye(len(section_motions))[k])
        before += np.kron(along * spread @ along.T, only)
    x, noise = one.seen.design[0], one.deviations.misfit[0] * np.eye(one.seen.unknowns)
    noise = noise + x @ one.apparent(one.deviations) @ x.T
    weighed = np.linalg.solve(noise, x).T
    information = np.linalg.inv(before) + weighed @ x
    np.testing.assert_allclose(covariance[0] @ information, np.eye(len(x)), atol=1e-6)
    np.testing.assert_allclose(information @ mean[0], weighed @ one.seen.data[0], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("step", [0, 4, 8])
def test_a_step_without_data_is_less_known_and_those_near_it_a_little(step):
    one = case(6, 9, even=True, trend=0)
    design, data = one.seen.design.copy(), one.seen.data.copy()
    design[step], data[step] = 0, 0
    before, after = (
        np.einsum("tnn->tn", solved(each)[1]) for each in (one, replace(one, seen=Seen(design=design, data=data)))
    )
    wider = np.sqrt(after / before)
    assert (wider > 1 - 1e-9).all()
    away = np.abs(np.arange(9) - step)
    assert wider[step].min() > 1.05
    near, far = wider[away == 1], wider[away >= 4]
    assert 1.003 < near.mean() < 0.5 * (1 + wider[step].mean())
    assert far.max() < 1.02
    assert far.mean() - 1 < 0.1 * (near.mean() - 1)


@pytest.mark.parametrize("section_motions", [ALL, TWO], ids=["seven motions", "two motions"])
def test_what_is_drawn_from_the_prior_is_covered_as_stated(section_motions):
    one = case(7, 7, section_motions)
    tiny = 1e-10 * np.eye(one.seen.data.size)
    root, seeming = (np.linalg.cholesky(of(one.deviations) + tiny) for of in (one.prior, one.apparent))
    rng, squares = np.random.default_rng(8), []
    for _ in range(60):
        truth = (root @ rng.normal(size=len(root))).reshape(one.seen.data.shape)
        noise = np.sqrt(one.deviations.misfit)[:, None] * rng.normal(size=truth.shape)
        apparent = (seeming @ rng.normal(size=len(root))).reshape(truth.shape)
        data = np.einsum("tnm,tm->tn", one.seen.design, truth + apparent) + noise
        mean, covariance, _ = solved(replace(one, seen=replace(one.seen, data=data)))
        squares.append((mean - truth) ** 2 / np.einsum("tnn->tn", covariance))
    rms = np.sqrt(np.mean(squares, axis=0))
    # of 60 draws each is known to 9 %, of all together to 2 %
    assert np.sqrt(np.mean(squares)) == pytest.approx(1, abs=0.06)
    assert np.abs(rms - 1).max() < 0.5


@law(30)
@given(seeds, st.lists(st.floats(1 / LONGEST_GAP, LONGEST_GAP), min_size=2, max_size=8), st.booleans())
def test_a_state_linear_in_time_has_no_bends_whatever_the_gaps(seed, beside, backwards):
    """As long as none is over four times the median, or under a quarter of it."""
    gaps = np.array([*beside, *np.ones(len(beside) + 1)])  # the median is one
    time = np.cumsum([0.0, *np.random.default_rng(seed).permutation(gaps)])
    space = replace_time(-7.0 * time if backwards else 7.0 * time)
    bends = space.bends(np.outer(time, [1.0, -3.0]) + np.array([0.0, 2.0]))
    np.testing.assert_allclose(bends, 0, atol=1e-9)
    # in units of the median gap, what turns by one at a step bends by one there
    kink = np.maximum(time - time[3], 0)
    np.testing.assert_allclose(space.bends(kink), np.arange(1, len(time) - 1) == 3, atol=1e-9)


def replace_time(time_s: np.ndarray) -> StateSpace:
    basis = SectionBasis(height_mm=HEIGHT, radius_mm=RADIUS)
    return StateSpace(basis, time_s, np.empty((0, len(time_s))), contraction_of_strain=None, prior_voxel=PRIOR)


@pytest.mark.parametrize("pause", [4.0, 5.0, 1000.0])
def test_in_a_long_pause_the_sample_is_held(pause):
    """What bends may do across it does not grow with it for ever: as over four of the usual gaps."""
    time = np.array([0.0, 1, 2, 3, 4, 5, 6, 7])
    longer = np.where(time > 3, time + pause - 1, time)
    usual = np.where(time > 3, time + LONGEST_GAP - 1, time)
    found, expected = replace_time(longer), replace_time(usual)
    state = np.random.default_rng(1).normal(size=8)
    np.testing.assert_allclose(found.bends(state), expected.bends(state))
    guess = found.first_guess()
    np.testing.assert_allclose(found.bend_variance(guess), expected.bend_variance(guess))


def test_steps_without_times_are_evenly_apart():
    state = np.random.default_rng(1).normal(size=6)
    np.testing.assert_allclose(replace_time(np.zeros(6)).bends(state), replace_time(np.arange(6.0)).bends(state))


# What moves with what


def states_of(space: StateSpace, amplitude: np.ndarray) -> np.ndarray:
    """Return the state of the modes alone, no rigid motion and none of its own contraction, with axial amplitudes."""
    axial = [space.basis.names.index("translation_z") + space.rigid]
    state = np.zeros(space.shape[1])
    own = np.flatnonzero(space.group == axial[0])
    shapes = space.to_amplitude[:, own].reshape(*space.basis.shape, -1)[:, axial[0] - space.rigid]
    state[own] = np.linalg.solve(shapes, amplitude)
    return state


@pytest.mark.parametrize("tied", [0.5, 0.3, -0.2])
def test_stretching_alone_contracts_by_nu_times_the_strain(tied):
    """u_z = e z makes u_x = -nu e x: an amplitude of contraction of -nu R e."""
    one = case(1, 3, tied=tied)
    strain = 0.7
    state = states_of(one.space, strain * (HEIGHT - 0.3))
    amplitude = (one.space.to_amplitude @ state).reshape(one.basis.shape)
    found = dict(zip(one.basis.names, amplitude.T, strict=True))
    np.testing.assert_allclose(found.pop("translation_z"), strain * (HEIGHT - 0.3), atol=1e-9)
    np.testing.assert_allclose(found.pop("contraction"), -tied * RADIUS * strain, atol=1e-9)
    assert all(np.abs(rest).max() < 1e-12 for rest in found.values())
    # as a field: across and along, of a point off the axis
    ends = np.array([[0.2, -0.1, -0.2], [0.2, -0.1, 0.3]])
    low, high = one.basis.displacement(amplitude, ends)
    assert high[2] - low[2] == pytest.approx(strain * 0.5)
    np.testing.assert_allclose(high[:2], -tied * strain * ends[1, :2], atol=1e-9)


def test_a_sample_that_moves_up_as_a_whole_does_not_contract():
    one = case(1, 3)
    amplitude = (one.space.to_amplitude @ states_of(one.space, np.ones(4))).reshape(one.basis.shape)
    np.testing.assert_allclose(amplitude[:, one.basis.names.index("contraction")], 0, atol=1e-9)


@pytest.mark.parametrize(("tied", "section_motions"), [(None, ALL), (NU, TWO), (NU, (CONTRACTION, TRANSLATION_X))])
def test_nothing_is_tied_where_it_is_not_asked_for_or_cannot_be(tied, section_motions):
    space = case(1, 3, section_motions, tied=tied).space
    own = space.to_amplitude[:, space.rigid :].reshape(*space.basis.shape, len(section_motions), -1)
    for k in range(len(section_motions)):
        others = np.delete(own[:, :, k], k, axis=1)
        assert not others.any()
        assert own[:, k, k].any()


@law(20)
@given(seeds, st.sampled_from((ALL, RIGID, TWO)))
def test_any_amplitudes_can_be_followed(seed, section_motions):
    """Modes as many as sections: with them alone every section moves as it will."""
    space = case(seed, 3, section_motions).space
    assert np.linalg.matrix_rank(space.to_amplitude[:, space.rigid :]) == len(HEIGHT) * len(section_motions)
    expected = rigid_motions(space.basis.names)
    np.testing.assert_allclose(space.to_amplitude[:, : space.rigid], expected.reshape(-1, space.rigid), atol=1e-9)


# Deviations found in the data


def drawn_history(seed: int, steps: int, bend_voxel: float, noise: float = 0.02):
    """Return a case of two motions, drawn with known deviations, whose radiographs tell each amplitude alike."""
    one = case(seed, steps, TWO, trend=0, tied=None, even=True)
    guess = one.space.first_guess()
    truth = replace(
        guess,
        bend_voxel=np.full_like(one.deviations.bend_voxel, bend_voxel),
        apparent_voxel=0 * guess.apparent_voxel,
    )
    root = np.linalg.cholesky(one.prior(truth) + 1e-12 * np.eye(one.seen.data.size))
    rng = np.random.default_rng(seed)
    amplitude = (root @ rng.normal(size=len(root))).reshape(one.seen.data.shape)
    design = np.broadcast_to(np.eye(one.seen.unknowns) / noise, one.seen.design.shape)
    data = np.einsum("tnm,tm->tn", design, amplitude) + rng.normal(size=amplitude.shape)
    return replace(one, seen=Seen(design=design, data=data), deviations=truth), amplitude


@pytest.mark.parametrize("bend_voxel", [0.02, 0.2])
def test_deviations_are_found_in_a_long_history(bend_voxel):
    one, amplitude = drawn_history(11, 60, bend_voxel)
    found = one.process.fitted(one.space.first_guess())
    smoothed = one.process.smoothed(found)
    inverse = smoothed.factor.inverted()
    # with neighbours on one side only, what a radiograph tells is taken for a motion
    np.testing.assert_array_equal(found.apparent_scale[[0, -1]], 1)
    assert not np.isclose(found.apparent_scale[1:-1], 1, atol=1e-6).all()
    own = found.bend_voxel[one.space.rigid :]
    assert (np.abs(np.log(own / bend_voxel)) < np.log(2)).all()
    assert (np.abs(np.log(found.misfit)) < np.log(3)).all()
    away = one.process.amplitude(smoothed) - amplitude
    variance = np.einsum("tnn->tn", one.process.covariance(smoothed, inverse))
    # what bends ten times more than the noise may be apparent in part: intervals are then too wide, never narrow
    assert 0.6 < np.sqrt((away**2 / variance).mean()) < 1.15


def test_a_slip_is_found_where_it_is_and_the_radiographs_that_fit_badly():
    """A jump of one motion bends the history at the steps on both sides of it, and no others."""
    one, amplitude = drawn_history(12, 40, 0.02)
    data = one.seen.data.copy()
    jump = np.zeros(one.basis.shape)
    jump[:, 0] = 2.0
    data[20:] += np.einsum("tnm,m->tn", one.seen.design[20:], jump.ravel())
    data[31] += 6 * np.random.default_rng(3).normal(size=data.shape[1])
    process = Process(one.space, replace(one.seen, data=data))
    found = process.fitted(one.space.first_guess())
    smoothed = process.smoothed(found)
    largest = np.maximum(found.rigid_scale.max(axis=1), found.own_scale)
    # w(t) belongs to the step between three
    assert set(np.argsort(largest)[-2:] + 1) == {19, 20}
    assert largest[[18, 19]].min() > 25
    assert np.delete(largest, [18, 19]).max() < 10
    assert int(np.argmax(found.misfit)) == 31
    assert found.misfit[31] > 4
    # of eight data each, a step in forty may look as if it did not fit
    assert (np.delete(found.misfit, 31) > 3).sum() <= 1
    away = process.amplitude(smoothed) - amplitude
    away[20:] -= jump.ravel()
    assert np.sqrt((away[18:22] ** 2).mean()) < 0.05
