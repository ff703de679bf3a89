"""Pixels of single radiographs that show something else than the sample."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.outliers import MOST, outliers
from pdvc.protocol import measure
from validation.testing.small_cases import SmallExperiment, small_scenario

SHAPE = (30, 25, 20)
MANY = settings(max_examples=30, deadline=None)


def noise(seed):
    return np.random.default_rng(seed).standard_normal(SHAPE).astype(np.float32)


@MANY
@given(seed=st.integers(0, 1000), scale=st.floats(1e-4, 10.0))
def test_of_noise_alone_nothing_is_left_out(seed, scale):
    assert not outliers(np.float32(scale) * noise(seed), 6.0).any()


@MANY
@given(
    seed=st.integers(0, 1000),
    step=st.integers(0, SHAPE[0] - 1),
    row=st.integers(1, SHAPE[1] - 2),
    column=st.integers(1, SHAPE[2] - 2),
    height=st.sampled_from((-60.0, 15.0, 1e4)),
)
def test_a_pixel_far_off_is_left_out_with_its_neighbours_and_no_other(seed, step, row, column, height):
    residual = noise(seed)
    residual[step, row, column] += height
    expected = np.zeros(SHAPE, dtype=bool)
    expected[step, row - 1 : row + 2, column - 1 : column + 2] = True
    assert np.array_equal(outliers(residual, 6.0), expected)


def test_what_is_usual_in_a_pixel_or_in_a_step_is_no_outlier():
    """An edge errs at all steps, and a step whose motion is not found errs everywhere."""
    residual = noise(1)
    residual[:, :, 7] *= 20
    assert not outliers(residual, 6.0).any()
    residual = noise(1)
    residual[11] *= 2.2
    assert not outliers(residual, 6.0).any()


def test_a_step_with_too_many_keeps_them_all():
    residual = noise(2)
    rows = int(np.ceil(MOST * SHAPE[1])) + 2
    residual[4, :rows] += 100
    residual[9, 12, 12] += 100
    found = outliers(residual, 6.0)
    assert found[9].sum() == 9
    assert not found[4].any()


@cache
def small():
    return SmallExperiment(small_scenario())


def test_zingers_bad_lines_and_debris_do_not_move_the_sample(tmp_path):
    here, rng = small().experiment, np.random.default_rng(0)
    counts = here.test.counts.copy()
    steps, rows, columns = counts.shape
    for t in range(steps):
        counts[t, rng.integers(rows, size=2), rng.integers(columns, size=2)] = 65535
    counts[5, rows // 2, 10:30] = 100
    counts[9, 30:33, 20:23] //= 2
    spoilt = replace(here, test=replace(here.test, counts=counts))
    options = small().options.model_copy(update={"outliers_over": 8.0})
    clean, found, harmed = measure(here, options), measure(spoilt, options), measure(spoilt, small().options)

    def off(measured):
        away = measured.motion.amplitude - small().measurement.motion.amplitude
        return float(np.sqrt(np.nanmean(away**2)))

    # what is left out of clean radiographs moves it by less than two deviations
    assert off(clean) < 2 * small().measurement.motion.amplitude_std.mean()
    assert off(found) < 0.3 * off(harmed)
    assert clean.fit.outliers.mean() < 0.02
    assert found.fit.outliers[5].sum() >= 20
    assert harmed.fit.outliers is None
    write_measurement(found, tmp_path / "found.nc")
    assert np.array_equal(read_measurement(tmp_path / "found.nc").fit.outliers, found.fit.outliers)
