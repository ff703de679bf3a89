"""Standard deviations on the axis against errors drawn from the covariance."""

from __future__ import annotations

import numpy as np
import pytest

from tests import synthetic_records as records
from validation.scoring.deviations import centre_line_deviation


@pytest.fixture(scope="module")
def case():
    truth, amplitude = records.stretched(*records.tensile_history())
    return records.measurement(amplitude), truth


def test_at_a_section_only_that_section_takes_part(case):
    measurement, _ = case
    centre = centre_line_deviation(measurement)
    # white covariance of the coefficients: a step's variance is that times the squares of its functions
    expected = np.sqrt(4e-4 / records.STEPS * (measurement.motion.time_functions**2).sum(axis=0))
    np.testing.assert_allclose(centre.std, np.broadcast_to(expected[:, None, None], centre.std.shape))
    length = np.diff(records.HEIGHT_MM) / records.VOXEL_MM
    np.testing.assert_allclose(centre.strain_std, np.sqrt(2) * expected[:, None] / length)
    assert centre.error is None
    assert centre.strain_error is None


def test_an_error_turns_with_the_beam(case):
    measurement, truth = case
    wrong = measurement.motion.amplitude.copy()
    wrong[..., 0] += 0.3
    centre = centre_line_deviation(records.altered(measurement, amplitude=wrong), truth)
    turn = measurement.recording.angle_rad[:, None] + np.zeros(len(centre.level_mm))
    seen = np.isfinite(centre.error[..., 0])
    np.testing.assert_allclose(centre.error[..., 0][seen], -0.3 * np.sin(turn)[seen], atol=1e-9)
    np.testing.assert_allclose(centre.error[..., 1][seen], 0, atol=1e-9)
    np.testing.assert_allclose(centre.error[..., 2][seen], 0.3 * np.cos(turn)[seen], atol=1e-9)
    np.testing.assert_allclose(centre.strain_error[np.isfinite(centre.strain_error)], 0, atol=1e-9)


def test_errors_drawn_from_the_covariance_scatter_as_predicted(case):
    measurement, truth = case
    rng = np.random.default_rng(12)
    predicted = centre_line_deviation(measurement, truth)
    draws = [centre_line_deviation(records.drawn(measurement, rng), truth) for _ in range(60)]
    for errors, std in (
        (np.stack([draw.error for draw in draws]), predicted.std),
        (np.stack([draw.strain_error for draw in draws]), predicted.strain_std),
    ):
        z = errors / std
        assert np.isnan(z).any()  # heights beyond the sections
        # late steps are stretched by 8 %: a strain referred to the current length would show
        for steps in (slice(0, 12), slice(12, None)):
            assert np.sqrt(np.nanmean(z[:, steps] ** 2)) == pytest.approx(1, abs=0.03)
