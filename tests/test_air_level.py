"""Whether the beam of the test was that of the reference scan, by the air beside the sample."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.air_level import BEAM_DRIFT, JOINED, AirLevel, air_level, doubts_of_air, worth_voxel
from pdvc.protocol import measure
from pdvc.radiographs import calibrate
from tests.spheres import BEAM, experiment
from validation.testing.small_cases import SmallExperiment, small_scenario

MANY = settings(max_examples=30, deadline=None)
VIEWS, STEPS, NOISE = 80, 60, 1e-4


@cache
def small():
    return SmallExperiment(small_scenario())


def dimmed(series, share):
    """Return a series in a beam of which shares (image,) are left."""
    dark = np.mean(small().experiment.darks, axis=0)
    counts = np.rint(dark + share[:, None, None] * (series.counts - dark)).clip(0, 65535).astype(np.uint16)
    return replace(series, counts=counts)


@pytest.mark.parametrize(("stated", "least"), [(True, 0.6), (False, 0.2)])
def test_the_beam_of_each_image_is_told_within_its_deviation(stated, least):
    """Where the noise is not stated, blocks of pixels hold that of the flats, too."""
    here, rng = small().experiment, np.random.default_rng(2)
    if not stated:
        here = replace(here, photons_per_count=None, readout_noise_counts=None)
    share = {name: 1 + 0.01 * rng.standard_normal(len(getattr(here, name))) for name in ("reference", "test")}
    drifted = replace(here, **{name: dimmed(getattr(here, name), each) for name, each in share.items()})
    before, found = air_level(here, calibrate(here)), air_level(drifted, calibrate(drifted))
    for name, each in share.items():
        was, now = getattr(before, name), getattr(found, name)
        assert now[:, 0] == pytest.approx(was[:, 0] * each, abs=2e-5)
        # steps differ by their own noise alone
        over = (was[:, 0] - was[:, 0].mean()) / was[:, 1]
        assert least < over.std() < 1.5


def test_zingers_in_the_air_do_not_count():
    here = small().experiment
    counts = here.test.counts.copy()
    counts[:, 5, 2] = counts[:, 20, -3] = 65535
    found = air_level(replace(here, test=replace(here.test, counts=counts)), calibrate(here))
    assert found.test[:, 0] == pytest.approx(air_level(here, calibrate(here)).test[:, 0], abs=3e-5)


def test_where_no_air_is_seen_nothing_is_told():
    here = experiment(0, views=24, steps=2, beam=replace(BEAM, columns=24))
    assert air_level(here, calibrate(here)) is None


@MANY
@given(depth=st.floats(0.2, 3.0), distance=st.floats(10, 1000))
def test_of_an_even_sample_the_worth_is_the_distance_over_its_attenuation(depth, distance):
    """A bar of attenuation q, larger by epsilon, attenuates by (1 + epsilon) q."""
    calibration = replace(calibrate(small().experiment), dark=np.zeros((40, 30), np.float32))
    flat = replace(calibration, open_beam=np.full((40, 30), 3e4, np.float32), bad=np.zeros((40, 30), bool))
    q = np.zeros((40, 30), dtype=np.float32)
    q[:, 10:20] = depth
    assert worth_voxel(3e4 * np.exp(-q), flat, distance) == pytest.approx(distance / depth, rel=1e-3)
    # grey levels that are all twice the attenuation change nothing
    twice = flat.with_polynomial((2.0, 0.0, 0.0))
    assert worth_voxel(3e4 * np.exp(-q), twice, distance) == pytest.approx(distance / depth, rel=1e-3)


def levels(seed, test=0.0, reference=0.0):
    """Return levels of beams that are off by shares (image,) or one for all, with noise."""
    rng = np.random.default_rng(seed)

    def level(count, off):
        values = 1 + off + NOISE * rng.standard_normal(count)
        return np.stack([values, np.full(count, NOISE)], axis=1)

    return AirLevel(reference=level(VIEWS, reference), test=level(STEPS, test))


def doubts(found, stated=0.1, worth=1000.0):
    turn = 2 * np.pi
    view, step = turn * np.arange(VIEWS) / VIEWS, turn * np.arange(STEPS) / 25
    return list(doubts_of_air(found, view, step, worth_voxel=worth, stated_voxel=stated))


@MANY
@given(seed=st.integers(0, 10_000))
def test_noise_alone_is_never_doubted(seed):
    assert doubts(levels(seed), stated=0.0) == []


@MANY
@given(seed=st.integers(0, 10_000), off=st.floats(2e-4, 1e-2), sign=st.sampled_from((-1, 1)))
def test_a_beam_that_drifts_is_doubted_where_it_is_worth_more_than_the_stated_deviation(seed, off, sign):
    found = levels(seed, test=sign * off)
    (doubt,) = doubts(found, stated=0.25 * off * 1000)
    assert doubt.name == BEAM_DRIFT
    whole = float(doubt.figure.split("reference scan by ")[1].split("%")[0]) / 100
    assert whole == pytest.approx(sign * off, abs=5 * NOISE / np.sqrt(STEPS) * 1.5)
    assert doubts(found, stated=off * 1000 + 0.2) == []


def test_a_drift_names_its_steps():
    off = np.where(np.arange(STEPS) < 40, 0.0, 2e-3)
    (doubt,) = doubts(levels(1, test=off))
    assert set(range(40 + JOINED // 2, STEPS)) <= set(doubt.steps) <= set(range(40 - JOINED // 2, STEPS))


def test_the_view_that_a_step_looks_along_is_what_it_is_compared_with():
    """A beam that only depends on the angle, in both alike, is in what that view leaves of its re-projection."""
    turn = 2 * np.pi
    view, step = (5e-3 * np.sin(turn * np.arange(n) / each) for n, each in ((VIEWS, VIEWS), (STEPS, 25)))
    assert doubts(levels(3, test=step, reference=view)) == []
    assert doubts(levels(3, test=step)) != []


def test_a_measurement_in_a_beam_that_drifts_is_doubted_and_by_air_is_not():
    here = small().experiment
    drifted = replace(here, test=dimmed(here.test, np.full(len(here.test), 0.985)))
    assert BEAM_DRIFT not in small().measurement.verdict.names
    assert BEAM_DRIFT in measure(drifted, small().options).verdict.names
    air = small().options.model_copy(update={"brightness": "air"})
    assert BEAM_DRIFT not in measure(drifted, air).verdict.names
