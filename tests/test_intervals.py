"""Bootstrap intervals: what is exact, and how often they cover."""

from __future__ import annotations

import numpy as np
import pytest

from validation.scoring.bootstrap import Estimate, bootstrapped, mean, rms


def test_equal_repetitions_leave_no_doubt():
    assert bootstrapped([0.3, 0.3, 0.3]) == Estimate(
        value=pytest.approx(0.3), low=pytest.approx(0.3), high=pytest.approx(0.3)
    )


@pytest.mark.parametrize("values", [[], [np.nan], [2.0], [2.0, 4.0], [2.0, np.nan, 4.0]])
def test_fewer_than_three_give_a_value_without_interval(values):
    found = bootstrapped(values)
    known = [value for value in values if np.isfinite(value)]
    assert found.value == pytest.approx(np.mean(known)) if known else np.isnan(found.value)
    assert np.isnan([found.low, found.high, found.half_width]).all()


def test_same_values_same_interval_within_their_range():
    values = np.random.default_rng(4).normal(size=8)
    once, again = bootstrapped(values), bootstrapped(values)
    assert once == again
    assert values.min() < once.low < once.value < once.high < values.max()
    assert once.half_width == pytest.approx((once.high - once.low) / 2)


def test_the_interval_of_an_rms_is_that_of_the_mean_square():
    """A monotonous function commutes with quantiles."""
    values = np.random.default_rng(5).uniform(1, 2, size=7)
    squares, root = bootstrapped(values**2, mean), bootstrapped(values, rms)
    np.testing.assert_allclose(
        [root.value, root.low, root.high], np.sqrt([squares.value, squares.low, squares.high]), rtol=1e-6
    )


@pytest.mark.parametrize(("repetitions", "covered"), [(3, 0.75), (10, 0.91)])
def test_how_often_the_interval_covers_the_truth(repetitions, covered):
    """Of normal values: of three, some three times in four, as the docstring says; of ten, nine times in ten."""
    rng = np.random.default_rng(6)
    found = [bootstrapped(rng.normal(size=repetitions)) for _ in range(1000)]
    assert np.mean([each.low <= 0 <= each.high for each in found]) == pytest.approx(covered, abs=0.03)
