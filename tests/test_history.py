"""Time functions: their shapes from their definitions, and the laws of the orthonormal basis made of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from pdvc.experiment import Series
from pdvc.history import PAPER, Angle, Force, Fourier, Polynomial, Ramp, Splines, Steps, time_basis
from tests.laws import law


def series(steps=127, *, loading_from=50):
    """Return the record of a test like the paper's: 50 radiographs a turn, loaded after the first turn."""
    t = np.arange(steps)
    return Series(
        counts=np.zeros((steps, 1, 1), dtype=np.uint16),
        angle_rad=2 * np.pi * t / 50,
        time_s=2.0 * t,
        force_N=250 + 500 * np.sqrt(np.maximum(t - loading_from, 0) / max(steps - loading_from, 1)),
    )


def table_1(record):
    """Return the seven functions (function, step) of Table 1, from the paper's text."""
    t = np.arange(len(record), dtype=float)
    late = np.maximum(t - 50, 0)
    angle = record.angle_rad
    return np.stack([record.force_N, np.sin(angle), np.cos(angle), t**0, t, late, late**2])


def left_over(functions, basis):
    """Return the largest share of any function that lies outside the span of a basis."""
    part = np.linalg.lstsq(basis.T, functions.T, rcond=None)[0]
    return max(np.linalg.norm(functions.T - basis.T @ part, axis=0) / np.linalg.norm(functions, axis=1))


PARTS = st.sampled_from(
    [
        Force(),
        Angle(),
        Angle(harmonics=3),
        Polynomial(degree=0),
        Polynomial(degree=4),
        Ramp(start=9),
        Ramp(start=500),
        Splines(intervals=4, degree=1),
        Splines(intervals=3, degree=3, start=11),
        Fourier(period=40.0, harmonics=2),
        Steps(),
    ]
)


@law()
@given(st.lists(PARTS, min_size=1, max_size=5), st.integers(30, 60))
def test_the_basis_is_orthonormal_in_the_mean_over_steps_and_spans_all_parts(parts, steps):
    record = series(steps, loading_from=20)
    functions = np.concatenate([part.functions(record) for part in parts])
    functions = functions[np.abs(functions).max(axis=1) > 0]
    if len(functions) == 0:
        with pytest.raises(ValueError, match="expected at least one that is not zero"):
            time_basis(tuple(parts), record)
        return
    basis = time_basis(tuple(parts), record)
    np.testing.assert_allclose(basis @ basis.T / steps, np.eye(len(basis)), atol=1e-10)
    assert left_over(functions, basis) < 1e-5
    assert left_over(basis, functions) < 1e-5


def test_the_paper_s_basis_spans_table_1():
    record = series()
    basis = time_basis(PAPER, record)
    assert basis.shape == (7, 127)
    assert left_over(table_1(record), basis) < 1e-9
    assert left_over(basis, table_1(record)) < 1e-9


def test_force_and_one_are_parallel_over_the_first_turn_and_one_of_them_is_dropped():
    record = series(50, loading_from=50)
    assert len(time_basis((Force(), Polynomial(degree=0)), record)) == 1
    # the ramps have not begun either
    assert len(time_basis(PAPER, record)) == 4


def test_functions_given_twice_are_dropped():
    record = series()
    assert len(time_basis(PAPER + PAPER, record)) == 7


def test_steps_alone_make_every_step_independent():
    basis = time_basis((Steps(),), series(9))
    np.testing.assert_allclose(basis, 3 * np.eye(9), atol=1e-12)


def test_force_and_angle_follow_the_record():
    record = series()
    np.testing.assert_array_equal(Force().functions(record), [record.force_N])
    theta = record.angle_rad
    np.testing.assert_allclose(
        Angle(harmonics=2).functions(record),
        [np.sin(theta), np.sin(2 * theta), np.cos(theta), np.cos(2 * theta)],
        atol=1e-12,
    )


def test_polynomials_span_the_powers_of_the_step():
    functions = Polynomial(degree=3).functions(series())
    powers = np.arange(127.0) ** np.arange(4)[:, None]
    assert functions.shape == (4, 127)
    assert left_over(powers, functions) < 1e-10


def test_ramps_leave_zero_at_their_start():
    functions = Ramp(start=50, powers=(1, 2)).functions(series())
    assert not functions[:, :51].any()
    since = np.arange(1, 77)
    np.testing.assert_allclose(functions[:, 51:] / functions[:, 51:52], [since, since**2])


def test_tents_are_piecewise_linear_with_corners_at_the_knots_only():
    functions = Splines(intervals=6, degree=1).functions(series(61))
    assert functions.shape == (7, 61)
    np.testing.assert_allclose(functions.sum(axis=0), 1)
    np.testing.assert_allclose(functions[:, ::10], np.eye(7), atol=1e-12)
    bent = np.abs(np.diff(functions, 2)) > 1e-9
    assert set(1 + np.nonzero(bent)[1]) == set(range(10, 60, 10))


def test_cubic_splines_are_smooth_and_add_up_to_one():
    functions = Splines(intervals=5, degree=3).functions(series(101))
    assert functions.shape == (8, 101)
    np.testing.assert_allclose(functions.sum(axis=0), 1)
    fourth = np.abs(np.diff(functions, 4)) > 1e-9
    # four differences reach over a knot (20, 40, ...), where the third derivative jumps, and nowhere else
    near = {knot + off for knot in range(20, 100, 20) for off in (-1, 0, 1)}
    assert set(2 + np.nonzero(fourth)[1]) <= near


@pytest.mark.parametrize("degree", [1, 3])
def test_splines_with_a_start_are_zero_before_it(degree):
    functions = Splines(intervals=4, degree=degree, start=20).functions(series(61))
    assert functions.shape == (3 + degree, 61)
    assert not functions[:, :21].any()
    assert functions[:, 21].any()


def test_fourier_functions_repeat_after_their_period():
    functions = Fourier(period=25.0, harmonics=2).functions(series(75))
    assert functions.shape == (4, 75)
    np.testing.assert_allclose(functions[:, 25:50], functions[:, :25], atol=1e-12)
    np.testing.assert_allclose(functions[:, 0], [0, 0, 1, 1], atol=1e-12)


def test_the_sine_of_half_turns_is_zero_and_is_dropped():
    record = Series(
        counts=np.zeros((12, 1, 1), dtype=np.uint16),
        angle_rad=np.deg2rad(180.0 * np.arange(12)),
        time_s=np.arange(12.0),
        force_N=np.ones(12),
    )
    basis = time_basis((Polynomial(degree=0), Angle()), record)
    assert len(basis) == 2
    assert left_over(np.stack([np.ones(12), (-1.0) ** np.arange(12)]), basis) < 1e-9


def test_nothing_but_zero_is_refused():
    with pytest.raises(ValueError, match="expected at least one that is not zero over the steps"):
        time_basis((Ramp(start=50),), series(30))


def test_no_time_function_at_all_is_refused():
    with pytest.raises(ValueError, match="expected at least one that is not zero over the steps"):
        time_basis((), series(30))


@pytest.mark.parametrize(
    ("kind", "key", "least", "most", "functions"),
    [
        (Angle, "harmonics", 1, None, 2),
        (Polynomial, "degree", 0, None, 1),
        (Fourier, "harmonics", 1, None, 2),
        (Splines, "intervals", 1, None, 4),
        (Splines, "degree", 1, 5, 7),
    ],
)
def test_the_least_and_the_most_that_can_be_asked_for_is_made_and_less_or_more_is_refused(
    kind, key, least, most, functions
):
    """A cubic spline has an interval and three more functions; degrees above five are no use to a short test."""
    assert kind(**{key: least}).functions(series(30)).shape == (functions, 30)
    with pytest.raises(ValidationError, match=key):
        kind(**{key: least - 1})
    if most is not None:
        assert kind(**{key: most}).functions(series(30)).shape == (functions + most - least, 30)
        with pytest.raises(ValidationError, match=key):
            kind(**{key: most + 1})


def test_a_power_of_zero_is_a_jump_at_the_start_and_a_negative_one_is_refused():
    (jump,) = Ramp(start=5, powers=(0,)).functions(series(9))
    np.testing.assert_array_equal(jump, np.arange(9) > 5)
    with pytest.raises(ValidationError, match="powers"):
        Ramp(start=5, powers=(-1,))


def test_by_default_the_parts_are_those_of_table_1_and_the_period_is_the_paper_s_test():
    assert (Force(), Angle(), Polynomial(), Ramp(start=50)) == PAPER
    assert Fourier().functions(series()).shape == (6, 127)
    np.testing.assert_allclose(Fourier(harmonics=1).functions(series(128))[:, 127], [0, 1], atol=1e-12)
    assert Splines().functions(series()).shape == (9, 127)
    assert Splines().functions(series())[0, 0] == 1
