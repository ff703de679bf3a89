"""The noise floor sees what a laboratory can see, and nothing else: measurements in closed form, with known noise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulator.scenario import course_of
from tests import synthetic_records as records
from tests.laws import law
from validation.scoring.noise_floor import constant_load_steps, noise_floor, without_rigid_motion
from validation.testing.small_cases import SmallExperiment, small_scenario

TURN = 10
STEPS = records.STEPS


def tensile_test(amplitude, *, constant=TURN, **changes):
    """Return a measurement whose force stays at 250 N for some steps and then rises by 12 N a step, noise of 1 N."""
    force = 250.0 + 12 * np.clip(np.arange(STEPS) - constant + 1, 0, None)
    force += np.random.default_rng(5).normal(size=STEPS)
    return records.altered(records.measurement(amplitude, **changes), force_N=force)


def still():
    return np.zeros((STEPS, 9, 6))


def rigid_amplitude(translation, rotation):
    """Return sections' amplitudes of a rigid motion of each step: (step, 3) voxels, (step, 3) voxels at the radius."""
    amplitude = still()
    amplitude[..., :3] = translation[:, None]
    amplitude[..., 3:6] = rotation[:, None]
    # u = w x (x - z_j e_z) / radius for each section: its own axis point has to move as the body does
    height = records.HEIGHT_MM / 0.6
    amplitude[..., 0] += rotation[:, 1, None] * height
    amplitude[..., 1] -= rotation[:, 0, None] * height
    return amplitude


# Which steps are at constant load


def loaded(constant, rising, rate, level=250.0):
    """Return a force that stays for some steps, then rises by `rate` a step."""
    return level + rate * np.clip(np.arange(constant + rising) - constant + 1, 0, None)


@law(100)
@given(st.integers(5, 60), st.integers(0, 60), st.floats(0.01, 1e3), st.floats(1.0, 1e4), st.booleans())
def test_without_noise_the_constant_load_ends_at_the_last_step_before_the_force_rises(
    constant, rising, rate, level, pulled
):
    force = loaded(constant, rising, rate, level) * (1 if pulled else -1)
    assert constant_load_steps(force) == constant


@pytest.mark.parametrize(("constant", "rising"), [(10, 15), (50, 77)])
def test_in_noise_of_a_twelfth_of_a_step_s_rise_the_end_is_found(constant, rising):
    """Five deviations are passed by chance once in 2e6 steps; in 25 steps the deviation is known to a quarter only."""
    rng = np.random.default_rng(10)
    rise = loaded(constant, rising, 12.0)
    found = np.array([constant_load_steps(rise + rng.normal(size=len(rise))) for _ in range(300)])
    assert (found == constant).mean() > 0.98
    assert found.max() <= constant + 1


def test_a_test_wholly_at_constant_load_is_found_whole():
    force = 250 + np.random.default_rng(2).normal(size=50)
    assert constant_load_steps(force) == 50
    assert constant_load_steps(np.full(50, 250.0)) == 50


def test_a_force_that_nobody_recorded_says_nothing():
    assert constant_load_steps(np.zeros(50)) == 0
    measurement = records.altered(records.measurement(still()), force_N=np.zeros(STEPS))
    assert noise_floor(measurement) is None


def test_a_load_that_rises_at_once_leaves_no_noise_floor():
    assert noise_floor(tensile_test(still(), constant=2)) is None


# What is seen


def test_a_rigid_motion_however_it_changes_is_no_noise():
    rng = np.random.default_rng(1)
    amplitude = rigid_amplitude(rng.normal(scale=3, size=(STEPS, 3)), rng.normal(scale=0.3, size=(STEPS, 3)))
    floor = noise_floor(tensile_test(amplitude))
    for part in (floor.temporal_voxel, floor.spatial_voxel):
        assert max(vars(part).values()) < 1e-9


@law(50)
@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_less_its_rigid_motion_nothing_rigid_is_left_and_nothing_else_is_lost(seed, levels):
    rng = np.random.default_rng(seed)
    z, u = np.sort(rng.normal(size=levels)), rng.normal(size=(4, levels, 3))
    points = np.stack([0 * z, 0 * z, z], axis=1)
    rigid = rng.normal(size=(4, 1, 3)) + np.cross(rng.normal(size=(4, 1, 3)), points)
    rest = without_rigid_motion(u, z)
    np.testing.assert_allclose(without_rigid_motion(u + rigid, z), rest, atol=1e-9)
    np.testing.assert_allclose(rest.mean(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(np.cross(points, rest).mean(axis=1), 0, atol=1e-12)


def test_noise_of_each_section_and_step_is_found_in_both_ways():
    """Independent translations of 0.05 voxel of nine sections: hats smooth them, a rigid motion takes its share.

    What is left of white noise is the Frobenius norm of what it goes through.
    """
    fraction = np.arange(33) / 4
    hats = np.maximum(1 - np.abs(fraction[:, None] - np.arange(9)), 0)
    one, slope = np.ones((33, 1)), fraction[:, None]
    left = []
    for rigid in (np.hstack([one, slope]), one):
        q = np.linalg.qr(rigid)[0]
        left.append(0.05 * np.sqrt(((hats - q @ (q.T @ hats)) ** 2).sum() / 33))
    rng = np.random.default_rng(3)
    draws = []
    for _ in range(60):
        amplitude = still()
        amplitude[..., :3] = rng.normal(scale=0.05, size=(STEPS, 9, 3))
        floor = noise_floor(tensile_test(amplitude))
        draws.append([list(vars(floor.temporal_voxel).values()), list(vars(floor.spatial_voxel).values())])
    # 60 draws of ten steps and some eight sections: known to one percent
    for across, vertical, along in np.sqrt(np.mean(np.square(draws), axis=0)):
        assert [across, vertical, along] == pytest.approx([left[0], left[1], left[0]], rel=0.04)


def test_after_the_load_rises_nothing_counts():
    amplitude = still()
    amplitude[TURN:, 4, 2] = 5.0
    floor = noise_floor(tensile_test(amplitude))
    assert floor.steps == TURN
    assert max(vars(floor.temporal_voxel).values()) == 0


def test_one_noisy_section_is_told_by_its_height():
    rng = np.random.default_rng(4)
    amplitude = still()
    amplitude[:, 6, 2] = rng.normal(scale=0.1, size=STEPS)
    floor = noise_floor(tensile_test(amplitude))
    assert floor.level_mm[np.argmax(floor.temporal_by_level[:, 1])] == pytest.approx(records.HEIGHT_MM[6])


def test_a_constant_error_is_seen_over_points_but_not_over_steps_unless_it_turns():
    amplitude = still()
    amplitude[:, 4, 2] = 0.1
    floor = noise_floor(tensile_test(amplitude))
    assert floor.temporal_voxel.vertical < 1e-12
    # a hat in the middle of 33 levels: 1, twice 0.75, 0.5 and 0.25
    hat = np.array([0.25, 0.5, 0.75, 1, 0.75, 0.5, 0.25, *np.zeros(26)])
    assert floor.spatial_voxel.vertical == pytest.approx(0.1 * hat.std(), rel=0.01)
    # fixed in the sample, it swings between across and along the beam: sine and cosine, of mean square one half
    amplitude = still()
    amplitude[:, 4, 0] = 0.1
    floor = noise_floor(tensile_test(amplitude))
    # the hat stands in the middle, so that no slope follows it
    assert floor.temporal_voxel.across_beam == pytest.approx(0.1 * hat.std() * np.sqrt(0.5 * 10 / 9), rel=0.01)
    assert floor.temporal_voxel.across_beam == pytest.approx(floor.temporal_voxel.along_beam, rel=1e-6)


def test_unobserved_sections_take_no_part():
    rng = np.random.default_rng(6)
    amplitude = still()
    amplitude[..., 2] = rng.normal(scale=0.05, size=(STEPS, 9))
    floor = noise_floor(tensile_test(amplitude, unobserved=(0, 8)))
    assert floor.level_mm[[0, -1]] == pytest.approx(records.HEIGHT_MM[[1, 7]])
    assert np.isfinite(floor.temporal_by_level).all()
    assert np.isfinite(list(vars(floor.spatial_voxel).values())).all()


def test_a_section_in_the_middle_that_nobody_saw_leaves_a_gap():
    amplitude = np.random.default_rng(8).normal(scale=0.05, size=(STEPS, 9, 6))
    floor = noise_floor(tensile_test(amplitude, unobserved=(4,)))
    gap = np.abs(floor.level_mm - records.HEIGHT_MM[4]) < 0.9
    assert np.isnan(floor.temporal_by_level[gap]).all()
    assert np.isfinite(list(vars(floor.temporal_voxel).values())).all()


def test_steps_that_were_not_measured_do_not_count():
    amplitude = np.random.default_rng(9).normal(scale=0.05, size=(STEPS, 9, 6))
    amplitude[[1, 4]] = np.nan
    assert noise_floor(tensile_test(amplitude)).steps == TURN - 2
    amplitude[[0, 2, 3, 5]] = np.nan
    assert noise_floor(tensile_test(amplitude)) is None


def test_histories_are_those_that_differ_over_the_constant_load():
    steps = np.arange(STEPS)
    ramp = np.clip(steps - TURN + 1, 0, None)
    functions = np.stack([np.ones(STEPS), steps - STEPS / 2, ramp, ramp**2]).astype(float)
    measurement = records.altered(tensile_test(still()), time_functions=functions)
    assert noise_floor(measurement).histories == 2
    each = records.altered(measurement, time_functions=np.eye(STEPS))
    assert noise_floor(each).histories == TURN


# Beside the truth


def test_the_true_error_holds_what_the_floor_cannot_see():
    """All sections off by 0.3 voxel upwards, and one of them noisy by 0.1 besides."""
    rng = np.random.default_rng(7)
    truth, amplitude = records.stretched(np.zeros(STEPS), np.zeros((STEPS, 3)))
    amplitude[..., 2] += 0.3
    amplitude[:, 4, 2] += rng.normal(scale=0.1, size=STEPS)
    floor = noise_floor(tensile_test(amplitude), truth)
    assert floor.temporal_voxel.vertical < 0.06
    assert floor.true.rms_voxel.vertical == pytest.approx(0.3, abs=0.02)
    assert floor.true.rms_voxel.across_beam < 1e-12
    at = np.argmin(np.abs(floor.true.level_mm - records.HEIGHT_MM[4]))
    assert np.argmax(floor.true.scatter_by_level[:, 1]) == at
    noise = amplitude[:TURN, 4, 2].std(ddof=1)
    assert floor.true.scatter_by_level[at, 1] == pytest.approx(noise, rel=0.05)


def test_the_floor_of_a_simulated_experiment_is_the_scatter_of_its_error_but_not_all_of_its_error():
    """Over its first turn nothing deforms: what is not rigid is error, on the same axis at nearly the same heights."""
    small = SmallExperiment(small_scenario({"seed": 2}))
    floor = noise_floor(small.measurement, small.truth)
    true_force = course_of(small.scenario).history.force_N
    assert floor.steps == np.count_nonzero(true_force == true_force[0])
    # 1, t, sine and cosine; the force's own noise and the ramps hardly show
    assert floor.histories in (4, 5)
    for name in ("across_beam", "vertical"):
        seen, true = getattr(floor.temporal_voxel, name), getattr(floor.true.scatter_voxel, name)
        assert 0.5 * true < seen < 1.5 * true
        assert getattr(floor.spatial_voxel, name) < 1.5 * getattr(floor.true.rms_voxel, name)
    # the sample as a whole stands off along the beam: nothing here tells
    assert floor.temporal_voxel.along_beam < 0.5 * floor.true.rms_voxel.along_beam
