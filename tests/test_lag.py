"""Light that comes late: geometric decay, its sum, and the same images whoever asks for them."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulator.images import prepare
from simulator.lag import Lag, Late
from simulator.scenario import course_of
from simulator.stacks import Stack, clear_images, late_images
from tests.laws import law
from tests.tiny_scenarios import tinier


def even(value):
    return np.full((3, 4), value, dtype=np.float32)


def late(clear, lag, image_s, before=1.0):
    return Late(clear, lambda: even(before), lag.parts(image_s))


@law(60)
@given(st.floats(0, 0.3), st.floats(0.1, 10), st.floats(0, 0.3), st.floats(1, 1000), st.floats(0.1, 10))
def test_what_is_left_after_the_light_decays_by_one_share_and_sums_to_what_was_kept(share, time, glow, long, image_s):
    lag = Lag(share=share, time_s=time, afterglow_share=glow, afterglow_time_s=long)
    images = late(lambda _: even(0.0), lag, image_s)
    found = np.array([images(n)[0, 0] for n in range(8)])
    # what is kept of even light at the end of an image, and the part of it that comes during the next
    expected = sum(
        p * (1 - np.exp(-image_s / tau)) * tau / image_s * np.exp(-np.arange(8) * image_s / tau)
        for p, tau in ((share, time), (glow, long))
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)
    for (first, left), p, tau in zip(lag.parts(image_s), (share, glow), (time, long), strict=True):
        assert first / (1 - left) == pytest.approx(p * tau / image_s, abs=1e-12)


def test_light_that_is_kept_is_the_integral_over_the_image():
    """Of light that falls evenly for T, share p of each moment is left of exp(-s / tau) at s before the end."""
    s = (np.arange(20000) + 0.5) / 20000 * 2.0
    kept = 0.05 * np.mean(np.exp(-s / 0.7))
    ((first, _), _) = Lag(share=0.05, time_s=0.7).parts(2.0)
    assert first == pytest.approx(kept, rel=1e-6)


def test_light_that_does_not_change_is_shown_as_it_is():
    images = late(lambda _: even(0.37), Lag(share=0.2, afterglow_share=0.1), 2.0, before=0.37)
    for n in range(5):
        np.testing.assert_allclose(images(n), 0.37, rtol=1e-6)


def test_a_change_that_lasts_is_shown_in_the_end():
    images = late(lambda _: even(0.2), Lag(share=0.2, time_s=1.0), 2.0)
    errors = np.array([images(n)[0, 0] for n in range(4)]) - 0.2
    np.testing.assert_allclose(errors[1:] / errors[:-1], np.exp(-2.0), rtol=1e-3)
    assert errors[0] > 0.05


def course(asked):
    def clear(n):
        asked.append(n)
        return np.random.default_rng(n).random((3, 4)).astype(np.float32)

    return clear


def in_turn(count, lag=Lag(share=0.1, time_s=3.0, afterglow_share=0.05)):  # noqa: B008 - frozen
    images = late(course([]), lag, 2.0)
    return [images(n) for n in range(count)]


def test_asked_in_order_each_image_is_made_once():
    asked = []
    images = late(course(asked), Lag(share=0.1), 2.0)
    for n in range(50):
        images(n)
    assert asked == list(range(50))


def test_images_are_the_same_whoever_asks_and_when():
    expected, lag = in_turn(80), Lag(share=0.1, time_s=3.0, afterglow_share=0.05)
    for order in ([79], [40, 3, 79, 0], list(range(79, -1, -1)), [5, 5, 4]):
        images = late(course([]), lag, 2.0)
        for n in order:
            np.testing.assert_array_equal(images(n), expected[n])


def test_threads_side_by_side_get_the_same_images():
    expected, lag, barrier = in_turn(60), Lag(share=0.1, time_s=3.0, afterglow_share=0.05), threading.Barrier(4)
    images = late(course([]), lag, 2.0)

    def ask(first):
        barrier.wait()
        return [images(n) for n in range(first, 60, 4)]

    with ThreadPoolExecutor(4) as pool:
        for first, found in zip(range(4), pool.map(ask, range(4)), strict=True):
            for image, wanted in zip(found, expected[first::4], strict=True):
                np.testing.assert_array_equal(image, wanted)


def test_an_image_that_fails_fails_for_all_who_need_it():
    def clear(n):
        if n == 2:
            raise ValueError("no such image")
        return even(1.0)

    images = late(clear, Lag(share=0.1), 2.0)
    images(1)
    for n in (2, 3):
        with pytest.raises(ValueError, match="no such image"):
            images(n)


def test_without_lag_the_images_are_handed_on_as_they_are():
    bench = prepare(tinier(), course_of(tinier()))
    clear = clear_images(bench, Stack("test"))
    assert late_images(tinier(), Stack("test"), lambda _: clear) is clear


def test_what_the_panel_saw_before_each_stack():
    scenario = tinier(scanner={"lag": {"share": 0.5, "time_s": 1e5}}, interrupted={"steps": [7], "views": 4})
    shown = {"reference": 0.25, "test": 0.5}

    def clear_of(stack):
        return lambda n: np.full((40, 24), shown.get(stack.kind, 0.75) + n / 1000, dtype=np.float32)

    for stack, before, first in (
        (Stack("reference"), 1.0, 0.25),
        (Stack("test"), 0.25 + 0.019, 0.5),
        (Stack("interrupted", 7), 0.5 + 0.007, 0.75),
    ):
        image = late_images(scenario, stack, clear_of)(0)
        np.testing.assert_allclose(image, (before + first) / 2, rtol=1e-4)


def test_more_light_than_there_is_cannot_be_kept():
    with pytest.raises(ValueError, match=r"sum to less than 1, got 0\.6 and 0\.5"):
        Lag(share=0.6, afterglow_share=0.5)
