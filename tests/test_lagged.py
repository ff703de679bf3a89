"""A filter over steps that go on: against the smoother of the same steps, in any order, killed and gone on with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from threadpoolctl import threadpool_limits

from pdvc import lagged
from pdvc.lagged import LaggedFilter, Late, Told
from pdvc.process import Process, Seen
from pdvc.sections import CONTRACTION, TRANSLATION_X, TRANSLATION_Z, SectionBasis
from pdvc.state_space import StateSpace
from tests.laws import law

BASIS = SectionBasis(
    height_mm=np.array([-1.1, -0.4, 0.5, 1.2]),
    radius_mm=0.6,
    motions=(TRANSLATION_X, TRANSLATION_Z, CONTRACTION),
)
UNKNOWNS = 12
BEND = 0.05
ERRORS = 2

seeds = st.integers(0, 10**6)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Two threads would wait for each other over matrices as small as these."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


def space(steps: int, modes: int | None = None) -> StateSpace:
    angle = np.linspace(0, 4 * np.pi, steps, endpoint=False)
    trend = np.stack([np.sin(angle), np.cos(angle)])
    return StateSpace(
        BASIS, np.arange(steps) * 2.0, trend, contraction_of_strain=0.5, prior_voxel=30.0, most_modes=modes
    )


def tracker(steps: int, bend: float | str = BEND) -> LaggedFilter:
    return LaggedFilter(space(steps), space(steps, 2), bend, ERRORS)


def motion(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Return amplitudes (step, unknown) that bend a little from step to step."""
    rate = np.cumsum(rng.normal(scale=0.01, size=(steps, UNKNOWNS)), axis=0)
    return np.cumsum(rate, axis=0)


def told(rng: np.random.Generator, amplitude: np.ndarray, deviation: float = 0.02) -> list[Told]:
    """Return what radiographs tell of amplitudes (step, unknown)."""
    found = []
    for each in amplitude:
        design = (np.eye(UNKNOWNS) + 0.3 * rng.normal(size=(UNKNOWNS, UNKNOWNS))) / deviation
        data = design @ each + rng.normal(size=UNKNOWNS)
        found.append(Told(design=design, data=data, errors=rng.normal(size=(UNKNOWNS, ERRORS))))
    return found


def smoothed(data: dict[int, Told], planned: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of the last of some steps, under the data of all; missing ones have none."""
    steps = max(data) + 1
    design, right = np.zeros((steps, UNKNOWNS, UNKNOWNS)), np.zeros((steps, UNKNOWNS))
    for step, each in data.items():
        design[step], right[step] = each.design, each.data
    states = space(planned).within(slice(0, steps))
    process, deviations = Process(states, Seen(design=design, data=right)), states.fixed(BEND)
    found = process.smoothed(deviations)
    return process.amplitude(found)[-1], process.covariance(found, found.factor.inverted())[-1]


@law(20)
@given(seeds, st.integers(2, 7), st.data())
def test_each_step_is_that_of_a_smoother_of_the_steps_so_far_in_any_order_and_with_gaps(seed, steps, data):
    rng = np.random.default_rng(seed)
    arriving = data.draw(st.permutations(range(steps)))[: data.draw(st.integers(1, steps))]
    known, given_so_far = tracker(steps), {}
    for step, each in zip(arriving, told(rng, motion(rng, len(arriving))), strict=True):
        known.add(step, each, known.expected(step))
        given_so_far[step] = each
    newest = max(given_so_far)
    mean, covariance = known.at(newest)
    expected, spread = smoothed(given_so_far, steps)
    np.testing.assert_allclose(mean[:, 0], expected, atol=1e-6 * max(np.abs(expected).max(), 1))
    np.testing.assert_allclose(covariance, spread, atol=1e-6 * np.abs(spread).max())


@law(20)
@given(seeds, st.integers(1, 6))
def test_errors_in_common_do_to_the_motion_what_they_do_as_data(seed, steps):
    rng = np.random.default_rng(seed)
    data = told(rng, motion(rng, steps))
    known, wrong = tracker(steps), tracker(steps)
    for step, each in enumerate(data):
        known.add(step, each, known.expected(step))
        wrong.add(step, replace(each, data=each.data + each.errors[:, 1]), wrong.expected(step))
    mean, change = known.at(steps - 1)[0], wrong.at(steps - 1)[0][:, 0]
    np.testing.assert_allclose(mean[:, 2], change - mean[:, 0], atol=1e-7 * max(np.abs(mean).max(), 1))


@law(20)
@given(seeds, st.integers(0, 5))
def test_a_pass_is_weighed_against_what_is_expected_as_two_gaussians_are(seed, step):
    rng = np.random.default_rng(seed)
    data, known = told(rng, motion(rng, step + 1)), tracker(6)
    for t in range(step):
        known.add(t, data[t], known.expected(t))
    expected = known.expected(step)
    matrix, vector = data[step].design.T @ data[step].design, data[step].design.T @ data[step].data
    mean, covariance = known.weighed(expected, matrix, vector)
    to, states = known.space.to_amplitude, known.space
    spread = expected.covariance.copy()
    if step >= 2:
        spread += np.diag(states.bend_variance(states.fixed(BEND))[step - 2])
    prior = to @ spread @ to.T
    together = np.linalg.inv(np.linalg.inv(prior) + matrix)
    wanted = together @ (np.linalg.solve(prior, to @ expected.mean) + vector)
    np.testing.assert_allclose(mean, wanted, atol=1e-5 * max(np.abs(mean).max(), 1))
    np.testing.assert_allclose(covariance, together, atol=1e-5 * np.abs(covariance).max())


@pytest.mark.parametrize("killed", [1, 6, 7, 8, 12, 17, 24])
def test_gone_on_with_it_finds_the_same_to_the_last_digit(killed, monkeypatch):
    for name, value in (("LAG", 4), ("WINDOW", 8), ("FITTED", 12), ("FIRST", 6), ("EVERY", 6)):
        monkeypatch.setattr(lagged, name, value)
    steps = 30
    rng = np.random.default_rng(3)
    data = told(rng, motion(rng, steps))
    whole, kept = tracker(steps, "fit"), {}
    for step, each in enumerate(data):
        whole.add(step, each, whole.expected(step))
        if step + 1 == killed:
            kept = {name: np.array(values) for name, values in whole.kept().items()}
        whole.fit()
    again = tracker(steps, "fit")
    # that of the step in hand was kept, too, but does not count yet
    again.restore(kept, dict(enumerate(data[: killed + 1])))
    again.fit()
    for step in range(killed, steps):
        again.add(step, data[step], again.expected(step))
        again.fit()
    for one, other in zip(whole.at(steps - 1), again.at(steps - 1), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_fit_that_is_begun_again_rests_on_what_was_told_when_it_began(monkeypatch):
    for name, value in (("FIRST", 6), ("EVERY", 6), ("MEANWHILE", 4)):
        monkeypatch.setattr(lagged, name, value)
    rng = np.random.default_rng(3)
    data, order = told(rng, motion(rng, 12)), (0, 1, 2, 3, 5, 4, 6, 7, 8, 9, 10, 11)
    whole, again = tracker(12, "fit"), tracker(12, "fit")
    # it is begun after step 5, before step 4 has come
    for step in order[:7]:
        whole.add(step, data[step], whole.expected(step))
        whole.fit()
    again.restore({name: np.array(values) for name, values in whole.kept().items()}, dict(enumerate(data)))
    for step in order[7:]:
        for each in (whole, again):
            each.add(step, data[step], each.expected(step))
            each.fit()
    for one, other in zip(whole.at(11), again.at(11), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_slip_is_followed_in_the_radiograph_that_shows_it():
    steps, slipped = 24, 15
    rng = np.random.default_rng(5)
    truth = motion(rng, steps)
    # the whole sample moves down by five voxels, a hundred times as far as from step to step before
    truth[slipped:] += np.tile([0.0, -5.0, 0.0], 4)
    data, known = told(rng, truth), tracker(steps, "fit")
    for step, each in enumerate(data):
        if step == slipped:
            expected = known.expected(step)
            mean, _ = known.weighed(expected, each.design.T @ each.design, each.design.T @ each.data)
            np.testing.assert_allclose(mean, truth[step], atol=0.15)
        known.add(step, each, known.expected(step))
        mean, covariance = known.at(step)
        assert np.abs((mean[:, 0] - truth[step]) / np.sqrt(np.diag(covariance))).max() < 5
    assert steps == known.steps


def test_a_step_far_behind_comes_too_late(monkeypatch):
    monkeypatch.setattr(lagged, "LAG", 3)
    rng = np.random.default_rng(0)
    data, known = told(rng, motion(rng, 8)), tracker(8)
    for step in (0, 1, 3, 4, 5, 6):
        known.add(step, data[step], known.expected(step))
    known.add(4, data[4])
    known.add(3, data[3])
    for asked in (lambda: known.add(2, data[2]), lambda: known.expected(2)):
        with pytest.raises(Late, match="step 2: expected one that is at most 3 steps behind the newest"):
            asked()
