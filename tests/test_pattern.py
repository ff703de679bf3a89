"""The detector's fixed pattern: found in the residual of a sample that moves, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdvc.equations import residuals
from pdvc.noise import ImageNoise, Noise
from pdvc.pattern import MOST, GrowingPattern, fixed_pattern
from pdvc.radiographs import noise_overlap, smoothed
from pdvc.systematic import Systematic
from tests.small_case import ANGLES, SECTIONS, SHAPE, STEPS, motion, radiographs

RELATIVE = 4e-3
"""Of the flats' noise."""
SLOPE = 0.6
OWN = 5e-3
"""Standard deviation of a radiograph's own noise, grey levels."""
AMPLITUDE = np.stack([motion(SECTIONS, seed, 2.0) for seed in range(STEPS)])


def drawn(seed: int = 0, size: float = RELATIVE) -> np.ndarray:
    """Return a pattern psi (row, column), grey levels."""
    return (SLOPE * size * np.random.default_rng(seed).normal(size=SHAPE)).astype(np.float32)


def noise(smooth_px: float = 0.0) -> Noise:
    image = ImageNoise(variance=np.full(SHAPE, OWN**2, np.float32), slope=np.full(SHAPE, SLOPE, np.float32))
    flat = np.full(SHAPE, RELATIVE**2, np.float32)
    return Noise(step=lambda t: image, view=lambda v: image, flat=flat, smooth_px=smooth_px)


def seen(psi: np.ndarray, own: float = 0.0):
    """Return images and systematic residual of a detector with a pattern, and noise of its own in the radiographs."""
    images = radiographs(SECTIONS, AMPLITUDE)
    systematic = Systematic(
        left=lambda view: -psi,
        view_rad=ANGLES,
        step_rad=ANGLES,
        corner=(0, 0),
        shape=SHAPE,
        detector=SHAPE,
        width_rad=0.1,
    )
    rng = np.random.default_rng(7)
    grey = (images.grey + psi + own * rng.normal(size=images.grey.shape)).astype(np.float32)
    return replace(images, grey=grey, systematic=systematic), systematic


def found(images, systematic, of=None):
    rho = residuals(images, SECTIONS, AMPLITUDE)
    return fixed_pattern(images, systematic, SECTIONS, AMPLITUDE, of or noise(), rho), rho


def cleaned(images, systematic, pattern):
    """Return the images without it, as pdvc.preparation takes it away."""
    left = replace(systematic, left=lambda view: systematic.left(view) + pattern)
    return replace(images, grey=images.grey - pattern, systematic=left)


def test_a_pattern_under_a_sample_that_moves_is_found():
    psi = drawn()
    images, systematic = seen(psi)
    pattern, before = found(images, systematic)
    after = residuals(cleaned(images, systematic, pattern.grey), SECTIONS, AMPLITUDE)
    assert before.std() > 0.5 * psi.std()
    assert after.std() < 0.2 * before.std()
    assert np.corrcoef(pattern.grey.ravel(), psi.ravel())[0, 1] > 0.97


@pytest.mark.parametrize("smooth_px", [0.0, 0.7])
def test_what_is_left_of_its_variance_is_as_stated(smooth_px):
    """Of a pattern drawn as the flats' noise says, with radiographs as noisy as they say."""
    psi = smoothed(drawn(1), smooth_px)
    images, systematic = seen(psi, OWN * noise_overlap(smooth_px)[0])
    pattern, _ = found(images, systematic, noise(smooth_px))
    own = 2 * OWN**2 / STEPS
    found_of_it = (SLOPE * RELATIVE) ** 2 / ((SLOPE * RELATIVE) ** 2 + own)
    # but for what a Gaussian of 3 px keeps of white noise
    expected = 1 - found_of_it * (1 - 1 / (4 * np.pi * 9))
    np.testing.assert_allclose(pattern.left, expected, rtol=1e-5)
    before, after = (
        residuals(each, SECTIONS, AMPLITUDE) for each in (images, cleaned(images, systematic, pattern.grey))
    )
    # of the mean over the steps, where radiographs' own noise is small: nothing else is
    assert after.mean(axis=0).std() < 0.35 * before.mean(axis=0).std()


def test_noise_that_differs_from_step_to_step_is_no_pattern():
    images, systematic = seen(np.zeros(SHAPE, np.float32), OWN)
    pattern, _ = found(images, systematic)
    assert pattern.grey.std() < 1.5 * OWN / np.sqrt(STEPS)


def test_a_smooth_misfit_is_left_to_the_motion():
    """What an error of the motion leaves in the mean over all steps is smooth over pixels: no noise of flats."""
    row, column = np.indices(SHAPE) - np.array(SHAPE)[:, None, None] / 2
    misfit = 2 * SLOPE * RELATIVE * np.exp(-(row**2 + column**2) / (2 * 8.0**2))
    images, systematic = seen(np.zeros(SHAPE, np.float32))
    images = replace(images, grey=(images.grey + misfit).astype(np.float32))
    pattern, _ = found(images, systematic)
    assert np.abs(pattern.grey).max() < 0.15 * misfit.max()


def test_what_is_far_more_than_the_flats_noise_is_left():
    """A thing that stands in the beam is no noise of the flats."""
    psi = drawn()
    psi[10:14, 10:14] = 0.5
    images, systematic = seen(psi)
    pattern, _ = found(images, systematic)
    assert np.abs(pattern.grey).max() <= MOST * SLOPE * RELATIVE * (1 + 1e-6)


def test_without_the_flats_noise_nothing_is_taken():
    images, systematic = seen(drawn())
    pattern, _ = found(images, systematic, replace(noise(), flat=np.zeros(SHAPE, np.float32)))
    assert not pattern.grey.any()


def test_radiographs_in_turn_tell_it_nearly_as_well_as_all_together():
    psi = drawn()
    images, systematic = seen(psi, OWN)
    growing, errors = GrowingPattern(systematic, noise()), []
    for t in range(STEPS):
        taken = growing.found().grey
        one = slice(t, t + 1)
        alike = replace(images, grey=images.grey[one] - taken, rays=images.rays[one])
        known = replace(systematic, left=lambda _, taken=taken: taken - psi, step_rad=ANGLES[one])
        rho = residuals(replace(alike, systematic=known), SECTIONS, AMPLITUDE[one])[0]
        growing.add(rho, taken, noise().step(t))
        errors.append(float(np.std(growing.found().grey - psi)))
    together, _ = found(images, systematic)
    assert errors[-1] < 0.8 * errors[0] < 0.8 * psi.std()
    assert errors[-1] < 1.15 * np.std(together.grey - psi)
    np.testing.assert_allclose(growing.found().left, together.left, rtol=1e-6)


def test_before_the_first_radiograph_nothing_is_known_of_it():
    _, systematic = seen(drawn())
    nothing = GrowingPattern(systematic, noise()).found()
    assert not nothing.grey.any()
    assert (nothing.left == 1).all()
