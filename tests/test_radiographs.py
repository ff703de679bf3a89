"""Counts to grey levels against closed forms and Monte Carlo; coarse scales that stay in place."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from pdvc.experiment import Experiment, Series
from pdvc.geometry import ConeBeam
from pdvc.radiographs import (
    Calibration,
    DetectorNoise,
    binned,
    calibrate,
    coarsened,
    fill,
    grey_levels,
    grey_noise,
    noise_overlap,
    sharpened,
    smoothed,
    snr_db,
)
from pdvc.rays import ray_vectors
from tests.laws import law
from validation.testing.strategies import cone_beams

ROWS, COLUMNS = 31, 22
BAD = [(0, 0), (5, 7), (5, 8), (20, 21), (30, 3)]


def experiment(flats, darks):
    nothing = Series(
        counts=np.zeros((1, ROWS, COLUMNS), dtype=np.uint16),
        angle_rad=np.zeros(1),
        time_s=np.zeros(1),
        force_N=np.zeros(1),
    )
    return Experiment(
        title="",
        material="",
        geometry=ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=ROWS, columns=COLUMNS),
        frames=1,
        photons_per_count=None,
        readout_noise_counts=None,
        reference=nothing,
        test=nothing,
        flats=np.asarray(flats, dtype=np.uint16),
        darks=np.asarray(darks, dtype=np.uint16),
    )


def uneven(rng):
    """Return the open beam and the dark (row, column) of a detector whose gain is uneven, counts."""
    row = np.arange(ROWS)[:, None] / ROWS
    beam = 30000 * (1 - 0.02 * row**2) * rng.normal(1, 5e-3, (ROWS, COLUMNS))
    return np.round(beam), np.round(rng.normal(800, 5, beam.shape))


def test_known_attenuation_comes_back_from_counts():
    rng = np.random.default_rng(1)
    beam, dark = uneven(rng)
    attenuation = rng.uniform(0, 2.5, beam.shape)
    counts = np.round(dark + beam * np.exp(-attenuation)).astype(np.uint16)
    calibration = calibrate(experiment([dark + beam - 3, dark + beam + 3], [dark, dark]))
    assert not calibration.bad.any()
    # rounding to whole counts, of 2350 at the least
    np.testing.assert_allclose(grey_levels(counts, calibration), attenuation, atol=0.5 / 1900)


@law(30)
@given(st.tuples(*[st.floats(-0.5, 1.0, width=32)] * 3))
def test_the_polynomial_is_that_of_the_attenuation(coefficients):
    rng = np.random.default_rng(2)
    beam, dark = uneven(rng)
    counts = np.round(dark + beam * np.exp(-rng.uniform(0, 2.5, beam.shape))).astype(np.uint16)
    calibration = calibrate(experiment([dark + beam], [dark]))
    q = grey_levels(counts, calibration).astype(float)
    c1, c2, c3 = coefficients
    expected = c1 * q + c2 * q**2 + c3 * q**3
    np.testing.assert_allclose(grey_levels(counts, calibration.with_polynomial(coefficients)), expected, atol=2e-5)


def test_counts_at_or_below_the_dark_stay_finite():
    calibration = calibrate(experiment(np.full((1, ROWS, COLUMNS), 9000), np.full((1, ROWS, COLUMNS), 500)))
    grey = grey_levels(np.full((ROWS, COLUMNS), 400, dtype=np.uint16), calibration)
    np.testing.assert_allclose(grey, np.log(8500), rtol=1e-6)


@pytest.mark.parametrize("fault", ["dead", "hot", "stuck at the top"])
def test_bad_pixels_are_found_and_only_they(fault):
    rng = np.random.default_rng(3)
    beam, dark = uneven(rng)
    flats = rng.poisson(beam + dark, (2, ROWS, COLUMNS))
    darks = rng.normal(dark, 4, (1, ROWS, COLUMNS)).round()
    for at in BAD:
        if fault == "dead":
            flats[:, *at] = darks[:, *at] = 800
        elif fault == "hot":
            darks[:, *at] += 4000
            flats[:, *at] += 4000
        else:
            flats[:, *at] = darks[:, *at] = 65535
    found = {(int(row), int(column)) for row, column in np.argwhere(calibrate(experiment(flats, darks)).bad)}
    assert found == set(BAD)


def test_bad_pixels_take_the_mean_of_their_good_neighbours():
    image = np.arange(20, dtype=np.float32).reshape(4, 5)
    bad = np.zeros(image.shape, dtype=bool)
    bad[1, 2] = bad[1, 3] = bad[0, 0] = True
    filled = fill(np.where(bad, np.float32(1e9), image), bad)
    assert filled[1, 2] == pytest.approx(np.mean([1, 2, 3, 6, 11, 12, 13]))
    assert filled[1, 3] == pytest.approx(np.mean([2, 3, 4, 9, 12, 13, 14]))
    assert filled[0, 0] == pytest.approx(np.mean([1, 5, 6]))
    np.testing.assert_array_equal(filled[~bad], image[~bad])


def test_a_bad_block_takes_the_nearest_good_pixels():
    image = np.zeros((9, 9), dtype=np.float32)
    bad = np.zeros((9, 9), dtype=bool)
    bad[2:7, 2:7] = True
    image[bad] = 7
    image[1, 1:8] = 1
    filled = fill(image, bad)
    assert filled[4, 4] == pytest.approx(7 / 24)
    assert filled[6, 6] == 0


def test_bad_pixels_leave_no_trace_in_grey_levels():
    rng = np.random.default_rng(4)
    beam, dark = uneven(rng)
    flats, darks = [beam + dark], [dark.copy()]
    counts = dark + beam * np.exp(-1.5)
    for at in BAD:
        flats[0][at] = darks[0][at] = counts[at] = 65000
    grey = grey_levels(np.round(counts).astype(np.uint16), calibrate(experiment(flats, darks)))
    np.testing.assert_allclose(grey, 1.5, atol=2e-4)


def test_flats_as_dark_as_the_darks_are_refused():
    with pytest.raises(
        ValueError, match=r"flats.tif: expected more counts than the darks, found a median difference of -1"
    ):
        calibrate(experiment(np.full((1, ROWS, COLUMNS), 99), np.full((1, ROWS, COLUMNS), 100)))


def test_the_variance_of_grey_levels_is_that_of_many_draws():
    rng = np.random.default_rng(5)
    photons, readout, frames, flats, draws = 0.5, 30.0, 3, 2, 4000
    beam, dark, polynomial = 20000.0, 500.0, (0.6, 0.1, -0.01)
    attenuation = np.array([[0.0, 0.5, 1.0, 2.0, 3.0]])
    level = np.broadcast_to(beam * np.exp(-attenuation), (draws, 5))

    def image(level, averaged):
        summed = rng.poisson(level * photons * averaged) / photons
        return dark + (summed + rng.normal(0, readout * np.sqrt(averaged), level.shape)) / averaged

    # quantising a mean of three frames adds 1/12 count^2, against 20000 of noise
    counts = np.round(image(level, frames)).astype(np.uint16)
    opened = image(np.full((draws, 5), beam), frames * flats) - dark
    calibration = Calibration(
        dark=np.full((draws, 5), dark, dtype=np.float32),
        open_beam=opened.astype(np.float32),
        bad=np.zeros((draws, 5), dtype=bool),
        polynomial=polynomial,
    )
    scattered = grey_levels(counts, calibration).var(axis=0, dtype=float)
    ideal = replace(
        calibration,
        dark=calibration.dark[:1],
        open_beam=np.full((1, 5), beam, dtype=np.float32),
        bad=calibration.bad[:1],
    )
    noise = DetectorNoise(photons_per_count=photons, readout_noise_counts=readout, frames=frames)
    own, slope = grey_noise(np.round(dark + beam * np.exp(-attenuation)).astype(np.uint16), ideal, noise)
    predicted = (own + slope**2 * noise.relative_variance(ideal.open_beam, flats))[0]
    # a variance from 4000 draws is known to 2.2 %
    np.testing.assert_allclose(predicted, scattered, rtol=0.08)


@pytest.mark.parametrize("factor", [1, 2, 3, 5])
def test_coarse_images_keep_constants(factor):
    coarse = coarsened(np.full((ROWS, COLUMNS), 0.7, dtype=np.float32), factor)
    assert coarse.shape == (ROWS // factor, COLUMNS // factor)
    np.testing.assert_allclose(coarse, 0.7, rtol=1e-6)


@law()
@given(cone_beams(), st.integers(1, 3))
def test_a_coarse_image_of_where_pixels_are_says_where_the_binned_geometry_s_pixels_are(geometry, factor):
    """Colour each pixel by its place; filtered and binned, that is the place of the coarse pixel."""
    coarse = geometry.binned(factor)
    corner, row, column = ray_vectors(geometry, 0.0).stacked()[0, 1:]
    r, c = np.indices((geometry.rows, geometry.columns))
    corner2, row2, column2 = ray_vectors(coarse, 0.0).stacked()[0, 1:]
    r2, c2 = np.indices((coarse.rows, coarse.columns))
    for axis in (1, 2):
        place = ((corner[axis] + r * row[axis] + c * column[axis]) / geometry.pixel_mm).astype(np.float32)
        expected = (corner2[axis] + r2 * row2[axis] + c2 * column2[axis]) / geometry.pixel_mm
        edge = 0 if factor == 1 else 2  # there the filter repeats the outermost pixel
        inner = (slice(edge, coarse.rows - edge), slice(edge, coarse.columns - edge))
        np.testing.assert_allclose(coarsened(place, factor)[inner], expected[inner], atol=2e-5)
        np.testing.assert_allclose(binned(place, factor), expected, atol=2e-5)


def test_a_coarse_image_is_the_gaussian_s_block_mean():
    image = np.random.default_rng(6).normal(size=(ROWS, COLUMNS)).astype(np.float32)
    smooth = ndimage.gaussian_filter(image.astype(float), 1.5)
    expected = smooth[9:12, 6:9].mean()
    # the filter is cut at three standard deviations
    assert coarsened(image, 3)[3, 2] == pytest.approx(expected, abs=2e-3)


@law()
@given(st.floats(0.01, 100), st.floats(-5, 5), st.integers(0, 99))
def test_snr_is_20_db_for_each_factor_of_ten_whatever_the_offsets(scale, offset, seed):
    signal = np.random.default_rng(seed).normal(size=(9, 8)).astype(np.float32)
    used = np.ones((9, 8), dtype=bool)
    used[:2] = False
    residual = (signal * scale + offset).astype(np.float32)
    residual[:2] = 1e6
    assert snr_db(signal, residual, used) == pytest.approx(-20 * np.log10(scale), abs=2e-2)


@pytest.mark.parametrize("smooth_px", [0.0, 0.5, 0.7, 1.5])
def test_filtered_noise_overlaps_with_its_neighbours_as_told(smooth_px):
    rng = np.random.default_rng(4)
    noise = smoothed(rng.normal(size=(400, 500)).astype(np.float32), smooth_px)[8:-8, 8:-8].astype(float)
    c0, c1, c2 = noise_overlap(smooth_px)[:3]
    seen = [(noise * noise).mean(), (noise[:, 1:] * noise[:, :-1]).mean(), (noise[2:] * noise[:-2]).mean()]
    # 200 000 pixels, of which some ten are alike: known to half a per cent
    np.testing.assert_allclose(seen, [c0 * c0, c0 * c1, c0 * c2], atol=0.02 * c0 * c0)


@law(40)
@given(st.floats(0.0, 0.5), st.floats(0.0, 0.5), st.floats(0.0, 6.0))
def test_sharpening_multiplies_a_wave_by_what_two_interpolations_take_from_it(down, across, phase):
    """By 6 / (4 + 2 cos(2 pi k)) along each axis, k in cycles per pixel: 1.5 for k = 1/4, three at most."""
    row, column = np.indices((50, 60))
    wave = np.cos(2 * np.pi * down * row + phase) * np.cos(2 * np.pi * across * column)
    gain = [6 / (4 + 2 * np.cos(2 * np.pi * k)) for k in (down, across)]
    inner = (slice(15, -15), slice(15, -15))
    found = sharpened(wave.astype(np.float32))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found[inner], (gain[0] * gain[1] * wave)[inner], atol=2e-5)


@pytest.mark.parametrize("k", [0.05, 0.15, 0.25])
def test_sharpening_gives_back_what_interpolating_twice_takes(k):
    """Linear interpolation at random places, twice, leaves sinc(k)^4 of a wave on average; sharpened, nearly all."""
    rng, x = np.random.default_rng(1), np.arange(400.0)
    wave = np.exp(2j * np.pi * k * x)
    images = np.stack([wave.real, wave.imag]).astype(np.float32)
    for image, whole in ((images, False), (np.stack([sharpened(np.tile(i, (9, 1)))[4] for i in images]), True)):
        left = []
        for _ in range(400):
            first, second = rng.uniform(size=2)
            # two grids at any places against the pixels, one after the other
            once = [np.interp(x + first, x, part) for part in image]
            twice = np.interp(x + second, x, once[0]) + 1j * np.interp(x + second, x, once[1])
            left.append((twice * np.exp(-2j * np.pi * k * (x + first + second)))[50:-50].mean().real)
        assert np.mean(left) == pytest.approx(1 if whole else np.sinc(k) ** 4, abs=0.02)


@law(20)
@given(st.floats(-9.0, 9.0), st.integers(6, 40), st.integers(6, 40))
def test_sharpening_leaves_an_even_image_even_to_its_edges(level, rows, columns):
    image = np.full((rows, columns), level, dtype=np.float32)
    np.testing.assert_allclose(sharpened(image), image, atol=1e-4 * (1 + abs(level)))


def test_images_without_contrast_have_an_snr_too():
    used, flat = np.ones((3, 4), dtype=bool), np.full((3, 4), 0.3, dtype=np.float32)
    ramp = np.arange(12, dtype=np.float32).reshape(3, 4)
    assert snr_db(flat, flat, used) == 0
    assert snr_db(ramp, flat, used) == pytest.approx(20 * np.log10(ramp.std() / 1e-7))
    assert snr_db(flat, ramp, used) == pytest.approx(20 * np.log10(1e-7 / ramp.std()))
