"""Faults of the flat panel, each against its closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from simulator.detector import Conditions, Detector, detector_maps, faulty, record
from simulator.images import prepare
from simulator.panel import Panel, correlated, covariance, noise_filter, panel_maps, zingers
from simulator.scenario import course_of
from tests.laws import law
from tests.tiny_scenarios import tinier

QUIET = Detector(
    bad_pixel_fraction=0.0, gain_spread=0.0, beam_falloff=0.0, readout_noise_counts=0.0, photons_per_pixel=1e9
)
NOISY = Detector(bad_pixel_fraction=0.0, gain_spread=0.0, beam_falloff=0.0, readout_noise_counts=0.0, frames=1)


def taken(panel, value=1.0, detector=QUIET, shape=(200, 160), seed=0, **when):
    maps = faulty(detector_maps(detector, *shape, np.random.default_rng(0)), panel, np.random.default_rng(1))
    image = np.full(shape, value, dtype=np.float32)
    return record(image, detector, maps, np.random.default_rng(seed), Conditions(panel=panel, **when)).astype(float)


def signal(*args, **kwargs):
    return taken(*args, **kwargs) - QUIET.dark_counts


@law(12)
@given(st.floats(0.02, 2.0))
def test_what_two_pixels_see_in_common_is_the_integral_of_their_light(blur_px):
    """Light of photons at x, Gaussian, in pixels at 0 and at m: over all x the integral of their shares' product."""
    c = covariance(blur_px, 3)

    def share(x, m):
        return norm.cdf((m + 0.5 - x) / blur_px) - norm.cdf((m - 0.5 - x) / blur_px)

    for m in range(3):
        edges = np.sort([-0.5, 0.5, m - 0.5, m + 0.5])
        expected = quad(lambda x, m=m: share(x, 0) * share(x, m), -12, 12, points=edges, epsabs=1e-9, limit=400)[0]
        assert c[3 + m] == pytest.approx(expected, abs=1e-6)
        assert c[3 - m] == pytest.approx(expected, abs=1e-6)


@law(30)
@given(st.floats(0.02, 3.0))
def test_the_filter_with_itself_is_the_covariance(blur_px):
    h = noise_filter(blur_px)
    reach = len(h) // 2
    twice = np.convolve(h, h)[reach : 3 * reach + 1]
    np.testing.assert_allclose(twice, covariance(blur_px, reach), atol=2e-6)
    assert h.sum() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("blur_px", [0.4, 1.0])
def test_noise_before_the_blur_is_correlated_after_it(blur_px):
    counts = taken(Panel(scintillator_blur_px=blur_px), 0.5, NOISY, (400, 300))
    noise, c = counts - counts.mean(), covariance(blur_px, 3)[3:]
    variance = 0.5 * NOISY.photons_per_pixel / NOISY.photons_per_count**2
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2)):
        found = np.mean(noise[: 400 - down, : 300 - right] * noise[down:, right:])
        # 120000 products; rounding adds 1 / 12 to the variance alone
        assert found == pytest.approx(variance * c[down] * c[right], abs=4 * variance * c[0] ** 2 / np.sqrt(3e4))


def test_photons_one_by_one_leave_the_same_noise():
    """Each photon at a place of its own, its light put into the pixels by hand: no filter, no covariance."""
    rng, blur_px, side, reach = np.random.default_rng(0), 0.5, 120, 3
    at = rng.uniform(0, side, (2, 30 * side * side))
    pixel = np.floor(at).astype(int) + np.arange(-reach, reach + 1)[:, None, None]
    share = norm.cdf((pixel + 1 - at) / blur_px) - norm.cdf((pixel - at) / blur_px)
    counts = np.zeros(side * side)
    for row, of_row in zip(pixel[:, 0], share[:, 0], strict=True):
        for column, of_column in zip(pixel[:, 1], share[:, 1], strict=True):
            # those that leave the image come in on the other side
            place = row % side * side + column % side
            counts += np.bincount(place, of_row * of_column, side * side)
    counts = counts.reshape(side, side)
    noise, c = counts - 30.0, covariance(blur_px, 3)[3:]
    for down, right in ((0, 0), (0, 1), (1, 1)):
        found = np.mean(noise * np.roll(noise, (down, right), (0, 1))) / 30
        assert found == pytest.approx(c[down] * c[right], abs=4 * c[0] ** 2 / np.sqrt(side * side / 4))


def test_the_image_is_blurred_as_its_noise_is():
    plain, spreading = (
        prepare(scenario, course_of(scenario))
        for scenario in (
            tinier(detector={"blur_px": 0.3}),
            tinier(detector={"blur_px": 0.3}, scanner={"panel": {"scintillator_blur_px": 0.4}}),
        )
    )
    assert plain.optics.blur_px == 0.3
    assert spreading.optics.blur_px == pytest.approx(0.5)
    still = np.ones((3, 4), dtype=np.float32)
    assert correlated(still, 0.0) is still


def test_the_filter_of_the_noise_leaves_the_image_alone():
    """Its blur is in the image already, where rays end and not only pixels."""
    image = np.ones((20, 30), dtype=np.float32)
    image[:, 15:] = 0.2
    maps = detector_maps(QUIET, 20, 30, np.random.default_rng(0))
    conditions = Conditions(panel=Panel(scintillator_blur_px=0.8))
    counts = record(image, QUIET, maps, np.random.default_rng(1), conditions)
    np.testing.assert_allclose((counts - QUIET.dark_counts) / QUIET.counts_full, image, atol=1e-4)


def test_gains_that_drift_leave_a_pattern_that_grows_with_time():
    panel = Panel(gain_drift_per_hour=0.004)
    at_once, later, again = (signal(panel, 0.8, time_s=time_s, seed=n) for n, time_s in enumerate((0, 1800, 3600)))
    np.testing.assert_allclose(at_once / (0.8 * QUIET.counts_full), 1, atol=1e-4)
    assert np.std(later / at_once) == pytest.approx(0.002, rel=4 / np.sqrt(2 * 200 * 160))
    # the same pixels drift on
    np.testing.assert_allclose(again / at_once - 1, 2 * (later / at_once - 1), atol=2e-4)


def test_a_signal_that_bends_leaves_a_flat_field_correction_wrong():
    panel = Panel(nonlinearity=0.03)
    flat = signal(panel)
    np.testing.assert_allclose(flat / QUIET.counts_full, 1 - 0.03, atol=1e-4)
    for transmission in (0.1, 0.5, 0.9):
        corrected = (signal(panel, transmission) / flat).mean()
        assert corrected == pytest.approx(transmission * (1 - 0.03 * transmission) / (1 - 0.03), abs=2e-5)


def test_pixels_bend_by_different_shares():
    panel = Panel(nonlinearity=0.03, nonlinearity_spread=0.2)
    missing = 1 - signal(panel) / QUIET.counts_full
    assert missing.mean() == pytest.approx(0.03, rel=0.01)
    assert missing.std() == pytest.approx(0.03 * 0.2, rel=0.03)
    # half of the light: half of the share
    np.testing.assert_allclose(1 - signal(panel, 0.5) / QUIET.counts_full / 0.5, missing / 2, atol=2e-4)


def test_no_pixel_tells_more_than_saturation():
    panel = Panel(saturation_counts=30000.4)
    assert np.all(taken(panel, 1.0) == 30000)
    assert taken(panel, 0.1, Detector(bad_pixel_fraction=0.1)).max() == 30000
    np.testing.assert_allclose(signal(panel, 0.5) / QUIET.counts_full, 0.5, atol=1e-4)


def test_hits_of_the_panel_come_at_their_rate_and_add_their_charge():
    panel = Panel(zingers_per_cm2_min=2.0, zinger_counts=3000.0)
    # 200 x 160 pixels of 0.2 mm: 12.8 cm2; 90 s: 38.4 hits
    draws = [zingers(panel, (200, 160), 0.2, 90.0, np.random.default_rng(n)) for n in range(100)]
    hits = np.array([np.count_nonzero(each) for each in draws])
    assert hits.mean() == pytest.approx(38.4, abs=4 * np.sqrt(38.4 / 100))
    assert hits.var() == pytest.approx(38.4, rel=4 * np.sqrt(2 / 100))
    charge = np.concatenate([each[each > 0] for each in draws])
    assert charge.mean() == pytest.approx(3000, rel=4 / np.sqrt(len(charge)))
    assert charge.std() == pytest.approx(3000, rel=0.1)
    assert zingers(Panel(), (3, 4), 0.2, 90.0, np.random.default_rng(0)) is None
    # in an image they are seen in one of its frames, and change nothing else
    when = {"pixel_mm": 0.2, "exposure_s": 90.0}
    added = taken(panel, 0.5, **when) - taken(Panel(), 0.5, **when)
    struck = added[added != 0]
    assert 10 < len(struck) < 80
    assert struck.mean() == pytest.approx(3000 / QUIET.frames, rel=0.5)
    assert struck.min() >= 0


@pytest.mark.parametrize("radius", [1.5, 4.0])
def test_clusters_are_discs_and_lines_are_lines(radius):
    panel = Panel(bad_clusters=5, bad_cluster_px=radius)
    area = np.mean([panel_maps(panel, 300, 250, np.random.default_rng(n)).dead.sum() for n in range(60)])
    assert area / 5 == pytest.approx(np.pi * radius**2, rel=0.1)
    dead = panel_maps(Panel(bad_rows=3, bad_columns=2), 300, 250, np.random.default_rng(0)).dead
    assert dead.all(axis=1).sum() == 3
    assert dead.all(axis=0).sum() == 2
    assert dead.sum() == 3 * 250 + 2 * 300 - 6


def test_dead_lines_see_no_light():
    counts = taken(Panel(bad_columns=1))
    assert (np.abs(counts.mean(axis=0) - QUIET.dark_counts) < 1).sum() == 1


def test_a_panel_without_faults_is_left_as_it_is():
    maps = detector_maps(QUIET, 20, 30, np.random.default_rng(0))
    assert faulty(maps, Panel(), np.random.default_rng(0)) is maps


def test_a_fault_changes_neither_photons_nor_readout():
    """Zingers and saturation that never happen leave every count as it was, though the panel has faults."""
    rare = Panel(zingers_per_cm2_min=1e-12, zinger_counts=1.0, saturation_counts=65534.0)
    np.testing.assert_array_equal(taken(rare, 0.5, Detector()), taken(Panel(), 0.5, Detector()).clip(max=65534))
