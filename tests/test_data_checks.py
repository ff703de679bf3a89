"""Data that cannot be used are refused, doubtful ones are named with figure and remedy, good ones pass."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pdvc.data_checks import doubts_of_data, doubts_of_time, usable
from pdvc.experiment import ExperimentError
from pdvc.history import Polynomial, Ramp
from tests.spheres import DARK, OPEN, experiment, with_reference, with_test


@cache
def good():
    return experiment(5, views=72, steps=30)


def doubts(here):
    return {each.name: each for each in doubts_of_data(usable(here), here)}


def with_counts(here, change, steps=slice(None)):
    """Return an experiment in which some radiographs of the test are others."""
    counts = here.test.counts.copy()
    counts[steps] = change(counts[steps].astype(float)).clip(0, 65535).astype(np.uint16)
    return with_test(here, counts=counts)


def test_nothing_speaks_against_good_data():
    assert doubts(good()) == {}


BLACK = with_counts(good(), lambda counts: 0 * counts + DARK, 7)
REFUSED = {
    "all the same": (with_counts(good(), lambda counts: 0 * counts + 77), "found 77 counts in every pixel"),
    "one black step": (BLACK, r"found 100% of the pixels black in image 7"),
    "one step saturated": (
        with_counts(good(), lambda counts: 0 * counts + 65535, 7),
        r"found 100% of the pixels (saturated|brighter than the open beam) in image 7",
    ),
    "a step without the sample": (
        with_counts(good(), lambda counts: good().flats[0], 7),
        "expected a sample, found only air in image 7",
    ),
    "inverted": (with_counts(good(), lambda counts: OPEN - counts), "expected air at the counts of the flats"),
    "logarithms": (
        with_counts(good(), lambda counts: -1e4 * np.log((counts - DARK) / OPEN)),
        "expected",
    ),
    "flats halved": (replace(good(), flats=good().flats // 2), "brighter than the open beam"),
    "saturated flats": (
        replace(good(), flats=np.full_like(good().flats, 65535)),
        r"flats.tif: expected counts below saturation, found 100%",
    ),
    "radians": (
        with_reference(good(), angle_rad=np.deg2rad(good().reference.angle_rad)),
        r"reference.angle_deg: expected a full turn, found 6\.\d+ degrees: .* are these radians\?",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_in_one_line(case):
    here, message = REFUSED[case]
    with pytest.raises(ExperimentError, match=message) as caught:
        doubts(here)
    assert "\n" not in str(caught.value)


def test_a_beam_without_noise_or_pattern_is_no_saturation():
    """Another simulator may well give the same count in all of the air."""
    here = good()
    level = int(np.median(here.flats))
    even = [np.where(counts >= level - 1500, level, counts) for counts in (here.test.counts, here.reference.counts)]
    plain = replace(here, flats=np.full_like(here.flats, level))
    assert "saturation" not in doubts(with_reference(with_test(plain, counts=even[0]), counts=even[1]))


def swapped(counts, one, other):
    counts = counts.copy()
    counts[[one, other]] = counts[[other, one]]
    return counts


def repeated(counts, one, other):
    counts = counts.copy()
    counts[other] = counts[one]
    return counts


TEST = good().test
NOISY_FLATS = np.stack([good().flats[0], good().flats[0] + 1])
DEAD = np.arange(TEST.counts[0].size).reshape(TEST.counts[0].shape) % 25 == 0
DOUBTED = {
    "air-level": (with_counts(good(), lambda counts: 1.08 * counts, [3, 4]), (3, 4)),
    "saturation": (with_counts(good(), lambda counts: counts.clip(0, np.quantile(counts, 0.9)), [5]), (5,)),
    "starvation": (with_counts(good(), lambda c: DARK + OPEN * ((c - DARK) / OPEN) ** 9, [6]), (6,)),
    "out-of-view": (with_test(good(), counts=np.roll(TEST.counts, 11, axis=2)), None),
    "repeated-step": (
        # without noise the last are so anyway, a turn later
        replace(with_test(good(), counts=repeated(TEST.counts, 10, 11)), flats=NOISY_FLATS),
        (11, 24, 25, 26, 27, 28, 29),
    ),
    "times": (with_test(good(), time_s=TEST.time_s[::-1]), tuple(range(1, 30))),
    "one-direction": (with_test(good(), angle_rad=0.05 * TEST.angle_rad), ()),
    "step-angle": (with_test(good(), counts=swapped(TEST.counts, 9, 20)), (9, 20)),
    "test-angles": (with_test(good(), angle_rad=-TEST.angle_rad), ()),
    "upside-down": (with_test(good(), counts=TEST.counts[:, ::-1]), ()),
    "another-sample": (with_test(good(), counts=experiment(6, views=2, steps=30).test.counts), ()),
    "rotation-sign": (
        with_reference(with_test(good(), angle_rad=-TEST.angle_rad), angle_rad=-good().reference.angle_rad),
        (),
    ),
    "fan-angle": (replace(good(), geometry=replace(good().geometry, pixel_mm=2.7)), ()),
    "axis": (replace(good(), geometry=replace(good().geometry, column_shift_mm=3.6)), ()),
    "source-plane": (replace(good(), geometry=replace(good().geometry, row_shift_mm=18.0)), ()),
    "coverage": (
        with_reference(good(), counts=good().reference.counts[:66], angle_rad=good().reference.angle_rad[:66]),
        (),
    ),
    "noise-level": (replace(good(), photons_per_count=1e-3, readout_noise_counts=0.0), ()),
    "bad-pixels": (
        replace(
            good(), flats=np.where(np.arange(2400).reshape(60, 40) % 25 == 0, 450, good().flats).astype(np.uint16)
        ),
        (),
    ),
}


@pytest.mark.parametrize("name", DOUBTED)
def test_what_is_doubtful_is_named_with_its_steps(name):
    here, steps = DOUBTED[name]
    found = doubts(here)
    assert name in found, found.keys()
    assert steps is None or found[name].steps == steps
    assert found[name].figure
    assert found[name].advice


@pytest.mark.parametrize("name", ["rotation-sign", "upside-down"])
def test_what_leaves_nothing_to_believe_is_fatal(name):
    assert doubts(DOUBTED[name][0])[name].fatal


def test_a_figure_tells_the_number_that_tripped_it():
    assert "1.08" in doubts(DOUBTED["air-level"][0])["air-level"].figure
    assert "+4.0 px" in doubts(DOUBTED["axis"][0])["axis"].figure
    assert "-3.6" in doubts(DOUBTED["axis"][0])["axis"].advice


def test_a_ramp_after_the_last_step_is_named():
    (found,) = doubts_of_time((Polynomial(), Ramp(start=500), Ramp(start=10), Ramp()), good().test)
    assert found.name == "ramp-start"
    assert "step 500" in found.figure


def test_a_force_without_an_onset_is_named_where_a_ramp_waits_for_one():
    steps = np.arange(30.0)
    for force in (0 * steps, steps):
        (found,) = doubts_of_time((Ramp(),), with_test(good(), force_N=force).test)
        assert found.name == "onset"
        assert not list(doubts_of_time((Ramp(start=10), Polynomial()), with_test(good(), force_N=force).test))
    quiet = 250 + np.random.default_rng(0).normal(size=30)  # recorded, and nothing happened
    assert not list(doubts_of_time((Ramp(),), with_test(good(), force_N=quiet).test))


def test_a_ramp_that_starts_elsewhere_than_the_loading_is_named():
    """The force of the spheres leaves its plateau after step 10."""
    for start in (3, 20):
        (found,) = doubts_of_time((Ramp(start=start),), good().test)
        assert found.name == "ramp-start"
        assert "after step 10" in found.figure
    assert not list(doubts_of_time((Ramp(start=9), Ramp(start=25)), good().test))  # one more event may follow
