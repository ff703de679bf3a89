"""Scores obey their laws, and see what they should: expected values are closed forms."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pdvc.measurement import MeasurementError
from tests import synthetic_records as records
from tests.laws import law
from validation.scoring.centre_line import centre_line, measured_at
from validation.scoring.scores import Errors, point_errors, score

VOXEL = records.VOXEL_MM


def tensile():
    truth, amplitude = records.stretched(*records.tensile_history())
    return truth, records.measurement(amplitude)


def test_a_perfect_measurement_has_no_error_at_8_percent_strain_and_15_voxels():
    truth, measurement = tensile()
    result = score(measurement, truth)
    for error in (result.error_voxel, result.bias_voxel, result.random_voxel):
        assert max(error.across_beam, error.vertical, error.along_beam) < 1e-9
    assert result.strain_rms < 1e-12
    assert result.max_strain_true == pytest.approx(0.08)
    assert result.max_strain_measured == pytest.approx(0.08)


def test_reading_the_field_at_the_reference_position_would_cost_over_a_voxel():
    truth, measurement = tensile()
    step = len(measurement.recording.angle_rad) - 1
    at_reference = measurement.motion.displacement(step, truth.point_mm) - truth.displacement_mm[step] / VOXEL
    used = np.isfinite(point_errors(measurement, truth).components[step]).all(axis=1)
    # u(X) - U(X) = -(e / (1 + e)) U_z: 8 % of up to 15 + 0.08 * 336 voxels
    expected = -0.08 / 1.08 * truth.displacement_mm[step, used, 2] / VOXEL
    np.testing.assert_allclose(at_reference[used, 2], expected, atol=0.6)
    assert np.abs(at_reference[used, 2]).max() > 1


@pytest.mark.parametrize("direction", ["across_beam", "vertical", "along_beam"])
def test_an_offset_appears_in_its_direction_only_even_when_that_turns(direction):
    truth, amplitude = records.stretched(*records.tensile_history())
    angle = records.angles()
    c, s = np.cos(angle), np.sin(angle)
    zero = np.zeros_like(c)
    unit = {"across_beam": (-s, -c, zero), "vertical": (zero, zero, zero + 1), "along_beam": (c, -s, zero)}
    amplitude[..., :3] += 0.25 * np.stack(unit[direction], axis=1)[:, None]
    result = score(records.measurement(amplitude), truth)
    for name in ("across_beam", "vertical", "along_beam"):
        expected = 0.25 if name == direction else 0.0
        assert getattr(result.error_voxel, name) == pytest.approx(expected, abs=1e-9)
        assert getattr(result.bias_voxel, name) == pytest.approx(expected, abs=1e-9)
        assert getattr(result.random_voxel, name) == pytest.approx(0, abs=1e-9)


def test_an_offset_fixed_in_the_sample_is_random_across_the_turning_beam():
    steps = 20  # two whole turns
    truth, amplitude = records.stretched(np.zeros(steps), np.zeros((steps, 3)))
    amplitude[..., 0] += 0.2
    result = score(records.measurement(amplitude), truth)
    assert result.error_voxel.across_beam == pytest.approx(0.2 / np.sqrt(2))
    assert result.random_voxel.across_beam == pytest.approx(0.2 / np.sqrt(2))
    assert result.bias_voxel.across_beam == pytest.approx(0, abs=1e-12)


components = arrays(
    float,
    st.tuples(st.integers(1, 6), st.integers(1, 5), st.just(3)),
    elements=st.one_of(st.floats(-20, 20), st.just(np.nan)),
)


@given(components)
@law(100)
def test_squared_error_is_squared_bias_plus_squared_random(values):
    values = np.where(np.isfinite(values).all(axis=2, keepdims=True), values, np.nan)
    errors = Errors(components=values)
    for name in ("across_beam", "vertical", "along_beam"):
        error, bias, random = (getattr(part(), name) for part in (errors.rms, errors.bias, errors.random))
        if errors.scored.any():
            assert error**2 == pytest.approx(bias**2 + random**2, rel=1e-9, abs=1e-12)
        else:
            assert np.isnan([error, bias, random]).all()


@given(st.floats(-0.1, 0.1), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
@law(25)
def test_any_uniform_strain_and_translation_is_scored_exactly(strain, dx, dz):
    truth, amplitude = records.stretched([0.0, strain], [[0, 0, 0], [dx, -dx, dz]])
    result = score(records.measurement(amplitude), truth)
    assert max(vars(result.error_voxel).values()) < 1e-9
    assert result.max_strain_true == pytest.approx(max(strain, 0), abs=1e-12)


def test_only_points_between_observed_sections_count():
    truth, amplitude = records.stretched(np.zeros(4), np.zeros((4, 3)))
    whole = point_errors(records.measurement(amplitude), truth).scored
    height = truth.point_mm[:, 2]
    inside = (height >= records.HEIGHT_MM[0]) & (height <= records.HEIGHT_MM[-1])
    assert (whole == inside).all()
    # the top section unobserved: its hat reaches down to the section below
    part = point_errors(records.measurement(amplitude, unobserved=(8,)), truth).scored
    assert (part == (inside & (height <= records.HEIGHT_MM[-2]))).all()
    # one in the middle: both of its neighbouring intervals are lost, the sections beside it are not
    part = point_errors(records.measurement(amplitude, unobserved=(4,)), truth).scored
    assert (part == (inside & (np.abs(height - records.HEIGHT_MM[4]) >= 0.95 - 1e-9))).all()
    result = score(records.measurement(amplitude, unobserved=(4,)), truth)
    assert result.points_scored + result.points_left_out == len(height)
    assert result.points_scored == part[0].sum()


def test_a_point_that_moves_out_of_the_observed_heights_is_not_scored_there():
    truth, amplitude = records.stretched([0.0, 0.0], [[0, 0, 0], [0, 0, 1.0]])
    scored = point_errors(records.measurement(amplitude), truth).scored
    height = truth.point_mm[:, 2]
    assert (scored[1] == ((height + 1 >= -4.0) & (height + 1 <= 3.6 + 1e-12))).all()


def test_strain_error_of_a_known_strain_offset():
    truth, amplitude = records.stretched(np.zeros(5), np.zeros((5, 3)))
    amplitude[..., 2] += 0.004 * records.HEIGHT_MM / VOXEL
    result = score(records.measurement(amplitude), truth)
    assert result.strain_rms == pytest.approx(0.004)
    assert result.max_strain_measured == pytest.approx(0.004)
    assert result.max_strain_true == 0


@pytest.mark.parametrize("share", [1.0, 0.25, 0.0, -0.5])
def test_the_share_of_the_stretch_is_what_the_last_step_has_of_it_whatever_moves_as_a_whole(share):
    strain = np.linspace(0, 0.06, records.STEPS)
    truth, amplitude = records.stretched(strain, np.zeros((records.STEPS, 3)))
    amplitude[:-1] = 0.0
    amplitude[-1] *= share
    amplitude[..., 2] += 7.0
    assert score(records.measurement(amplitude), truth).stretch_share == pytest.approx(share)


def test_one_section_in_a_wrong_place_is_a_wrong_strain_but_hardly_a_wrong_share():
    truth, amplitude = records.stretched(*records.tensile_history())
    amplitude[-1, 4, 2] += 3.0
    result = score(records.measurement(amplitude), truth)
    assert result.max_strain_measured - result.max_strain_true > 0.02
    assert result.stretch_share == pytest.approx(1, abs=0.02)


def test_the_share_is_that_of_the_last_step_measured_and_unknown_without_a_stretch():
    truth, amplitude = records.stretched(*records.tensile_history())
    amplitude[12] *= 0.5
    amplitude[13:] = np.nan
    assert score(records.measurement(amplitude), truth).stretch_share == pytest.approx(0.5)
    truth, amplitude = records.stretched(np.zeros(records.STEPS), np.full((records.STEPS, 3), 0.1))
    assert np.isnan(score(records.measurement(amplitude), truth).stretch_share)


def test_levels_are_a_section_apart_on_the_axis():
    truth, amplitude = records.stretched(np.zeros(3), np.zeros((3, 3)))
    centre = centre_line(records.measurement(amplitude), truth)
    assert np.diff(centre.level_mm) == pytest.approx(np.diff(records.HEIGHT_MM).mean(), rel=0.2)


def test_without_truth_the_sections_themselves_are_followed():
    _, measurement = tensile()
    centre = centre_line(measurement)
    assert centre.true is None
    np.testing.assert_allclose(centre.measured[..., 2], measurement.motion.amplitude[..., 2])
    assert centre.stretch(centre.measured).mean(axis=1) == pytest.approx(0, abs=1e-9)


def test_json_has_the_promised_keys_and_null_for_what_is_unknown():
    truth, measurement = tensile()
    measurement = records.altered(measurement, snr_noise_db=np.full(records.STEPS, np.nan))
    values = json.loads(score(measurement, truth, scenario="quick", simulate_s=3.0).to_json())
    assert values["scenario"] == "quick"
    assert values["steps"] == records.STEPS
    assert values["unknowns"] == 7 * 9 * 6
    assert values["modes"] == {"rigid": 5, "deformation": 3}
    assert set(values["snr_db"]) == {"reprojection", "initial", "rigid", "final", "noise_limit"}
    assert values["snr_db"]["noise_limit"] is None
    assert values["snr_db"]["rigid"] == pytest.approx(23.5)
    for key in ("error_voxel", "bias_voxel", "random_voxel"):
        assert set(values[key]) == {"across_beam", "vertical", "along_beam"}
    assert values["seconds"] == {"simulate": 3.0, "reconstruct": 12.5, "measure": 60.25}
    assert values["peak_memory_gib"] is None
    assert {"strain_rms", "max_strain_true", "max_strain_measured", "stretch_share"} <= set(values)


def test_truth_of_another_experiment_is_refused():
    _, measurement = tensile()
    other, _ = records.stretched([0.0], [[0, 0, 0]])
    with pytest.raises(MeasurementError, match="expected the 24 steps"):
        score(measurement, other)


def test_nothing_observed_is_said():
    truth, amplitude = records.stretched(np.zeros(3), np.zeros((3, 3)))
    with pytest.raises(MeasurementError, match="observed section"):
        score(records.measurement(amplitude, unobserved=tuple(range(9))), truth)


def test_unobserved_amplitudes_do_not_leak_into_observed_points():
    _, amplitude = records.stretched(*records.tensile_history())
    points = np.zeros((records.STEPS, 1, 3))
    whole = measured_at(records.measurement(amplitude), points)
    part = measured_at(records.measurement(amplitude, unobserved=(0, 8)), points)
    np.testing.assert_array_equal(whole, part)


def test_a_level_that_leaves_the_field_does_not_make_the_mean_translation_jump():
    # a rigid shift, and a stretch that makes the levels differ
    offset = np.zeros((6, 3))
    offset[:, 2] = np.linspace(0, 1, 6)
    truth, amplitude = records.stretched(np.full(6, 0.05), offset)
    centre = centre_line(records.measurement(amplitude), truth)
    assert np.isnan(centre.measured[..., 2]).any(axis=1).sum() > 1
    np.testing.assert_allclose(np.diff(centre.translation(centre.measured)[:, 2]), 0.2 / VOXEL)
