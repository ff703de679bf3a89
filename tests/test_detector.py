import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import gaussian_filter

from pdvc.geometry import ConeBeam
from simulator.detector import (
    Detector,
    detector_maps,
    expected,
    expose,
    expose_dark,
    expose_flat,
    focal_blur_px,
    pixel_means,
)
from tests.laws import law

PLAIN = Detector(bad_pixel_fraction=0.0, gain_spread=0.0, beam_falloff=0.0, blur_px=0.0)


def maps_of(detector, rows=200, columns=160, seed=0):
    return detector_maps(detector, rows, columns, np.random.default_rng(seed))


def even(value, rows=200, columns=160):
    return np.full((rows, columns), value, dtype=np.float32)


@given(
    arrays(np.float32, (12, 20), elements=st.floats(0, 1, width=32)),
    st.sampled_from([1, 2, 4]),
    st.floats(0, 1.5),
)
@law(50)
def test_pixel_means_are_a_gaussian_filter_and_then_the_mean_of_each_pixel(image, subpixels, blur_px):
    blurred = gaussian_filter(image.astype(float), blur_px * subpixels, mode="nearest", truncate=8)
    whole = blurred.reshape(12 // subpixels, subpixels, 20 // subpixels, subpixels).mean(axis=(1, 3))
    np.testing.assert_allclose(pixel_means(image, subpixels, blur_px), whole, atol=2e-6)


def test_without_blur_a_pixel_is_the_mean_of_its_subpixels():
    image = np.arange(24, dtype=np.float32).reshape(4, 6)
    np.testing.assert_allclose(pixel_means(image, 2, 0.0), [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5]])


@pytest.mark.parametrize("transmission", [0.0005, 0.02, 0.3, 1.0])
def test_variance_follows_photons_and_readout(transmission):
    detector = PLAIN.model_copy(update={"frames": 3})
    maps = maps_of(detector)
    counts = expose(even(transmission), detector, maps, 1, np.random.default_rng(1)).astype(float)
    per_count = detector.photons_per_count
    mean = detector.dark_counts + transmission * detector.counts_full
    # Poisson: variance = mean; then the mean of 3 frames, the readout, and rounding to integers
    variance = transmission * detector.photons_per_pixel / per_count**2 / 3 + 30**2 / 3 + 1 / 12
    assert counts.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance / counts.size))
    assert counts.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / counts.size))


def test_few_photons_are_counted_one_by_one():
    """The counts of a single quiet frame are multiples of one photon, with the Poisson law's frequencies."""
    detector = PLAIN.model_copy(update={"frames": 1, "readout_noise_counts": 0.0, "photons_per_pixel": 4000.0})
    counts = expose(even(2 / 4000), detector, maps_of(detector), 1, np.random.default_rng(0))
    photons = (counts.astype(int) - 800) / 10
    assert np.all(photons == np.rint(photons))
    frequency = [np.mean(photons == k) for k in range(4)]
    np.testing.assert_allclose(frequency, np.exp(-2) * np.array([1, 2, 2, 4 / 3]), atol=0.01)


def test_the_default_noise_is_half_a_percent_of_the_open_beam():
    detector = Detector()
    flat = expose_flat(detector, maps := maps_of(detector), np.random.default_rng(0))
    good = ~(maps.dead | maps.hot)
    noise = (flat - expected(even(1.0), detector, maps, 1))[good].std() / detector.counts_full
    assert noise == pytest.approx(0.005, rel=0.05)


def test_noise_is_independent_from_pixel_to_pixel_and_image_to_image():
    maps = maps_of(PLAIN)
    rng = np.random.default_rng(0)
    first, second = (expose(even(0.5), PLAIN, maps, 1, rng).astype(float) for _ in range(2))
    first, second = first - first.mean(), second - second.mean()
    for other in (second, np.roll(first, 1, axis=0), np.roll(first, 1, axis=1)):
        assert abs((first * other).mean() / first.var()) < 4 / np.sqrt(first.size)


def test_flats_and_darks_correct_the_gain_and_the_beam():
    detector = Detector(photons_per_pixel=1e7, readout_noise_counts=0.0, bad_pixel_fraction=0.0)
    maps, rng = maps_of(detector), np.random.default_rng(0)
    flat, dark = expose_flat(detector, maps, rng), expose_dark(detector, maps, rng)
    image = expose(np.full((400, 320), 0.4, dtype=np.float32), detector, maps, 2, rng)
    assert np.all(dark == 800)
    assert flat.std() > 500
    np.testing.assert_allclose((image - 800.0) / (flat - 800.0), 0.4, atol=2e-3)


def test_gains_and_beam_are_as_stated():
    maps = maps_of(Detector(gain_spread=0.03, beam_falloff=0.1))
    assert maps.gain.mean() == pytest.approx(1, abs=1e-3)
    assert maps.gain.std() == pytest.approx(0.03, rel=0.03)
    assert maps.beam.max() == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(maps.beam[[0, 0, -1, -1], [0, -1, 0, -1]], 0.9, rtol=1e-6)


def test_bad_pixels_are_dead_or_saturated_in_every_image():
    detector = Detector(bad_pixel_fraction=0.02)
    maps, rng = maps_of(detector), np.random.default_rng(0)
    assert maps.dead.mean() + maps.hot.mean() == pytest.approx(0.02, rel=0.2)
    assert not (maps.dead & maps.hot).any()
    for image in (expose_flat(detector, maps, rng), expose_dark(detector, maps, rng)):
        assert np.all(image[maps.hot] == 65535)
        assert np.all(np.abs(image[maps.dead] - 800.0) < 100)


def test_counts_are_rounded_and_clipped():
    detector = PLAIN.model_copy(update={"dark_counts": 0.0, "readout_noise_counts": 200.0})
    counts = expose_dark(detector, maps_of(detector), np.random.default_rng(0))
    assert counts.dtype == np.uint16
    assert np.mean(counts == 0) == pytest.approx(0.5, abs=0.02)
    assert counts.max() < 1000


def test_the_seed_decides_everything():
    detector = Detector()
    maps = maps_of(detector)
    images = [expose(even(0.5), detector, maps, 1, np.random.default_rng(s)) for s in (0, 0, 1)]
    np.testing.assert_array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])
    np.testing.assert_array_equal(maps_of(detector).gain, maps.gain)


def test_the_focal_spot_blurs_by_the_magnification_less_one():
    geometry = ConeBeam(source_axis_mm=20, source_detector_mm=200, pixel_mm=0.3, rows=3, columns=4)
    assert focal_blur_px(0.01, geometry) == pytest.approx(0.01 * 9 / 0.3)


def test_wrong_shapes_are_refused():
    maps = maps_of(PLAIN)
    with pytest.raises(ValueError, match=r"transmission: expected shape \(400, 320\), got \(200, 160\)"):
        expose(even(1.0), PLAIN, maps, 2, np.random.default_rng(0))
    with pytest.raises(ValueError, match="whole pixels of 3 x 3"):
        pixel_means(even(1.0), 3, 0.5)


def test_an_open_beam_beyond_full_scale_is_refused():
    with pytest.raises(ValueError, match="of at most 65535"):
        Detector(counts_full=62000)
