"""The brightness of each radiograph, by the air beside the sample."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.alarms import Watch
from pdvc.brightness import air_pixels, brightness
from pdvc.incoming import Arrival
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.options import MeasureOptions
from pdvc.protocol import measure
from pdvc.radiographs import Calibration, DetectorNoise, calibrate, grey_levels, grey_noise
from pdvc.setup import set_up, with_air
from tests.spheres import BEAM, experiment
from validation.testing.small_cases import SmallExperiment, small_scenario

ROWS, COLUMNS = 40, 30
AIR = np.zeros((ROWS, COLUMNS), dtype=bool)
AIR[:, :6] = AIR[:, -5:] = True
MANY = settings(max_examples=50, deadline=None)


def bar(off: int = 0, depth: float = 1.0, rows: int = ROWS, columns: int = COLUMNS) -> np.ndarray:
    """Return attenuations of a bar ten columns wide, so far to the right of the middle."""
    place = np.abs(np.arange(columns) - (columns - 1) / 2 - off)
    return np.tile(np.where(place < 5, depth, 0.0), (rows, 1)).astype(np.float32)


def calibration(air=AIR) -> Calibration:
    gain = np.random.default_rng(0).uniform(0.9, 1.1, size=(ROWS, COLUMNS)).astype(np.float32)
    dark = np.full((ROWS, COLUMNS), 300, dtype=np.float32)
    return Calibration(
        dark=dark,
        open_beam=30_000 * gain,
        bad=np.zeros((ROWS, COLUMNS), dtype=bool),
        polynomial=(0.9, 0.1, 0.0),
        air=air,
    )


@MANY
@given(b=st.floats(0.3, 1.4), seed=st.integers(0, 1000))
def test_the_brightness_is_told_within_its_deviation(b, seed):
    rng = np.random.default_rng(seed)
    signal = 20_000 * b * np.exp(-bar()) * (1 + 0.01 * rng.standard_normal((ROWS, COLUMNS)))
    found, std = brightness(signal, np.full((ROWS, COLUMNS), 20_000.0), AIR)
    assert abs(found - b) < 6 * std
    # medians of some 440 pixels of one per cent
    assert 0.2 * b * 0.01 / np.sqrt(440) < std < 3 * b * 0.01 / np.sqrt(440)


@MANY
@given(b=st.floats(0.5, 1.5), depth=st.floats(0.1, 3.0))
def test_grey_levels_and_their_noise_do_not_know_the_brightness(b, depth):
    """Where air tells it; else they do."""
    known, noise = calibration(), DetectorNoise(photons_per_count=1.0, readout_noise_counts=0.0, frames=1)
    signal = known.open_beam * np.exp(-bar(depth=depth))
    full, dim = (np.asarray(known.dark + share * signal, dtype=np.float32) for share in (1.0, b))
    assert grey_levels(dim, known) == pytest.approx(grey_levels(full, known), abs=2e-5)
    (variance, slope), (of_dim, slope_of_dim) = grey_noise(full, known, noise), grey_noise(dim, known, noise)
    assert slope_of_dim == pytest.approx(slope, rel=1e-4)
    assert of_dim == pytest.approx(variance / b, rel=1e-3)
    if abs(b - 1) > 0.01:
        assert np.abs(grey_levels(dim, replace(known, air=None)) - grey_levels(full, known)).max() > 0.005


def test_a_side_that_the_sample_covers_does_not_count():
    signal = 1000 * np.exp(-bar(off=12))
    assert signal[:, -5:].max() < 500
    assert brightness(0.8 * signal, np.full((ROWS, COLUMNS), 1000.0), AIR)[0] == pytest.approx(0.8)


@pytest.mark.parametrize("off", [-5, 0, 5])
def test_air_is_where_no_view_shows_the_sample_whatever_the_beam_did(off):
    views = [bar(off=off) - np.log(share) for share in (0.9, 1.0, 1.1)] + [bar(off=off - 2)]
    bad = np.zeros((ROWS, COLUMNS), dtype=bool)
    bad[3, 1] = True
    air = air_pixels(views, bad)
    covered = np.any([view - view.min() > 0.1 for view in views], axis=0)
    assert not (air & (covered | bad)).any()
    # a margin of two columns is left on either side, and a single column is no side
    seen = np.flatnonzero(covered.any(axis=0))
    sides = [width - 2 for width in (seen[0], COLUMNS - 1 - seen[-1])]
    assert air[20].sum() == sum(width for width in sides if width >= 2)


def test_no_air_is_said_to_be_none():
    assert (
        air_pixels([np.ones((ROWS, 10), dtype=np.float32) * np.linspace(1, 2, 10)], np.zeros((ROWS, 10), bool)) is None
    )


@cache
def small():
    return SmallExperiment(small_scenario())


def options(**changes) -> MeasureOptions:
    return small().options.model_copy(update=changes)


def dimmed(series, share):
    """Return a series in a beam of which shares (image,) are left; the dark is some 100 counts."""
    dark = np.mean(small().experiment.darks, axis=0)
    counts = np.rint(dark + share[:, None, None] * (series.counts - dark)).clip(0, 65535).astype(np.uint16)
    return replace(series, counts=counts)


def test_a_beam_that_drifts_does_not_move_the_sample(tmp_path):
    here, rng = small().experiment, np.random.default_rng(4)
    beam = {name: 1 + 0.02 * rng.standard_normal(len(getattr(here, name))) for name in ("reference", "test")}
    drifted = replace(here, **{name: dimmed(getattr(here, name), share) for name, share in beam.items()})
    air = options(brightness="air")
    still, found = measure(here, air), measure(drifted, air)
    assert found.motion.amplitude == pytest.approx(still.motion.amplitude, abs=0.02)
    assert still.motion.amplitude == pytest.approx(small().measurement.motion.amplitude, abs=0.02)
    told = found.recording.brightness
    assert told[:, 0] / still.recording.brightness[:, 0] == pytest.approx(beam["test"], abs=5e-4)
    assert 0 < told[:, 1].max() < 1e-3
    write_measurement(found, tmp_path / "found.nc")
    assert read_measurement(tmp_path / "found.nc").recording.brightness == pytest.approx(told)
    # without air, it is moved by several voxels, along the beam above all
    blind = measure(drifted, options())
    assert blind.recording.brightness is None
    assert np.abs(blind.motion.amplitude - still.motion.amplitude).max() > 1


def test_a_dim_radiograph_is_told_and_not_lost_where_air_tells_its_brightness():
    here = small().experiment
    for share, spoils in ((0.96, False), (0.85, False), (0.5, True)):
        series = dimmed(here.test, np.full(len(here.test), share))
        watch = Watch(set_up(here, options(brightness="air")))
        (alarm,) = [each for each in watch.seen(Arrival.of(series, 0)) if each.name == "beam"]
        assert alarm.spoils is spoils


def test_a_sample_as_wide_as_the_detector_leaves_brightness_to_the_flats():
    here = experiment(0, views=24, steps=2, beam=replace(BEAM, columns=24))
    assert with_air(here, calibrate(here)).air is None
