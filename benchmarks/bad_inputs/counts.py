"""Bad stacks: what a detector, an export or a slip of files does to the counts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.bad_inputs.record import (
    ALL,
    BEAM,
    FULL,
    BadInput,
    Change,
    Counts,
    Floats,
    Folder,
    in_turn,
    rounded,
    shifted,
    stacks,
)
from pdvc.experiment import DARKS, FLATS, REFERENCE, TEST

STEP = 90
"""A step of the test at which the sample is loaded."""
EXPOSED = 4.0
"""How many times longer than well an exposure is that saturates the sample, too."""


def one_step(edit: Callable[[Counts], NDArray[Any]]) -> Change:
    """Return the change of the image (row, column) of one step."""

    def edited(counts: Counts) -> Counts:
        counts[STEP] = edit(counts[STEP])
        return counts

    return stacks(edited, TEST)


def from_images(make: Callable[[Floats, Floats, Floats], Floats], *names: str) -> Change:
    """Return the change that makes stacks from their counts, and the mean flat and dark (row, column)."""

    def change(folder: Folder) -> None:
        flat, dark = (folder.counts(name).mean(axis=0) for name in (FLATS, DARKS))
        flat = np.maximum(flat, dark + 1)  # in dead pixels, too, something can be divided by
        for name in names:
            folder.write(name, rounded(make(folder.counts(name).astype(float), flat, dark)))

    return change


def noise(counts: Counts) -> Counts:
    """Return counts that are drawn at random."""
    return np.random.default_rng(0).integers(0, FULL, counts.shape, dtype=np.uint16, endpoint=True)


def beam(counts: Floats, flat: Floats, dark: Floats) -> Floats:
    """Return images of the open beam, with photon noise."""
    return flat + np.sqrt(flat) * np.random.default_rng(0).standard_normal(counts.shape)


def exchanged(one: str, other: str) -> Change:
    """Return the change that gives each of two files the other's name."""

    def change(folder: Folder) -> None:
        aside = folder.path / "aside.tif"
        (folder.path / one).rename(aside)
        (folder.path / other).rename(folder.path / one)
        aside.rename(folder.path / other)

    return change


def copied(source: str, target: str) -> Change:
    """Return the change that writes a stack over another."""
    return lambda folder: folder.write(target, folder.counts(source))


def test_of(experiment: str) -> Change:
    """Return the change that takes the test stack from another experiment."""

    def change(folder: Folder) -> None:
        folder.write(TEST, tifffile.imread(folder.simulated(experiment) / TEST))

    return change


def dead_stripe(counts: Counts) -> Counts:
    """Return images with six dead columns in the shadow of the sample."""
    middle = counts.shape[2] // 2
    counts[:, :, middle : middle + 6] = 0
    return counts


def speckled(counts: Counts) -> Counts:
    """Return images in which every twentieth pixel, each time another, is saturated."""
    counts[np.random.default_rng(0).random(counts.shape) < 0.05] = FULL
    return counts


def lower_half_lost(counts: Counts) -> Counts:
    """Return images (..., row, column) without their lower half."""
    counts[..., counts.shape[-2] // 2 :, :] = 0
    return counts


def dimming(lowest: float) -> Change:
    """Return the change of a test whose beam fades steadily to a share of what it was."""
    return from_images(
        lambda counts, _, dark: dark + np.linspace(1, lowest, len(counts))[:, None, None] * (counts - dark), TEST
    )


def flicker(counts: Floats, _: Floats, dark: Floats) -> Floats:
    """Return images with a beam that changes by a fifth from one to the next."""
    return dark + (1 + 0.2 * np.random.default_rng(0).standard_normal((len(counts), 1, 1))) * (counts - dark)


EMPTY_STEP = from_images(
    lambda counts, flat, dark: np.where(np.arange(len(counts))[:, None, None] == STEP, flat, counts), TEST
)

IMAGES = (
    BadInput(
        name="test-all-zero",
        change=stacks(np.zeros_like, TEST),
        wrong="The test stack was exported empty: all counts are zero.",
    ),
    BadInput(
        name="test-all-full",
        change=stacks(lambda counts: np.full_like(counts, FULL), TEST),
        wrong="Every count of the test is 65535.",
    ),
    BadInput(
        name="reference-all-zero",
        change=stacks(np.zeros_like, REFERENCE),
        wrong="The reference stack was exported empty: all counts are zero.",
    ),
    BadInput(
        name="counts-inverted",
        change=stacks(np.bitwise_not, *ALL),
        wrong="All stacks were exported as negatives: dark is bright.",
    ),
    BadInput(
        name="test-inverted",
        change=stacks(np.bitwise_not, TEST),
        wrong="The test alone was exported as negatives.",
    ),
    BadInput(
        name="step-black",
        change=one_step(np.zeros_like),
        wrong="The radiograph of one step is black.",
    ),
    BadInput(
        name="step-saturated",
        change=one_step(lambda image: np.full_like(image, FULL)),
        wrong="The radiograph of one step is saturated everywhere.",
    ),
    BadInput(
        name="step-empty-beam",
        change=EMPTY_STEP,
        wrong="The radiograph of one step was taken without the sample.",
    ),
    BadInput(
        name="step-lower-half-lost",
        change=one_step(lower_half_lost),
        wrong="The transfer of one radiograph broke off: its lower half is zero.",
    ),
    BadInput(
        name="step-displaced",
        change=one_step(lambda image: shifted(image[None], 30, 12)[0]),
        wrong="The sample jumped at one step, by 30 rows and 12 columns: far beyond what can be followed.",
    ),
    BadInput(
        name="test-lower-half-lost",
        change=stacks(lower_half_lost, TEST),
        wrong="Half of the panel was not read out during the test.",
    ),
    BadInput(
        name="test-noise",
        change=stacks(noise, TEST),
        wrong="The test stack holds random numbers.",
    ),
    BadInput(
        name="reference-noise",
        change=stacks(noise, REFERENCE),
        wrong="The reference stack holds random numbers.",
    ),
    BadInput(
        name="test-empty-beam",
        change=from_images(beam, TEST),
        wrong="The test was taken without the sample.",
    ),
    BadInput(
        name="reference-empty-beam",
        change=from_images(beam, REFERENCE),
        wrong="The reference scan was taken without the sample.",
    ),
    BadInput(
        name="another-sample",
        change=test_of("small, another sample"),
        wrong="The test stack is that of another sample.",
    ),
    BadInput(
        name="test-blurred",
        change=stacks(lambda counts: ndimage.gaussian_filter(counts, (0, 4, 4)), TEST),
        wrong="The test was taken out of focus: blurred by 4 pixels.",
    ),
    BadInput(
        name="test-speckled",
        change=stacks(speckled, TEST),
        wrong="Scattered X-rays hit the sensor in the test: every twentieth pixel is saturated.",
    ),
    BadInput(
        name="stripe-dead",
        change=stacks(dead_stripe, *ALL),
        wrong="Six columns of the detector are dead, in the middle of the sample.",
    ),
    BadInput(
        name="stripe-dead-in-test",
        change=stacks(dead_stripe, TEST),
        wrong="Six columns of the detector died before the test: flats and reference still have them.",
    ),
)
"""What the images show is wrong."""

LEVELS = (
    BadInput(
        name="flats-halved",
        change=stacks(lambda counts: counts // 2, FLATS),
        wrong="The flats were exposed half as long as the radiographs.",
    ),
    BadInput(
        name="test-halved",
        change=stacks(lambda counts: counts // 2, TEST),
        wrong="The test was exposed half as long as reference and flats.",
    ),
    BadInput(
        name="counts-of-8-bits",
        change=stacks(lambda counts: counts >> 8, *ALL),
        wrong="All stacks were reduced to 8 bits, and stored as 16.",
    ),
    BadInput(
        name="already-normalised",
        change=from_images(lambda counts, flat, dark: 50000 * (counts - dark) / (flat - dark), REFERENCE, TEST),
        wrong="The radiographs are divided by the flats already, and stored as 50000 times their transmission.",
    ),
    BadInput(
        name="already-logarithms",
        change=from_images(
            lambda counts, flat, dark: 10000 * np.log((flat - dark) / np.maximum(counts - dark, 1)), REFERENCE, TEST
        ),
        wrong="The radiographs are logarithms already: attenuation times 10000.",
    ),
    BadInput(
        name="air-saturated",
        change=from_images(lambda counts, flat, dark: dark + 2 * (counts - dark), *BEAM),
        wrong="Everything was exposed twice as long as well: the air is saturated, the sample is not.",
    ),
    BadInput(
        name="sample-saturated",
        change=from_images(lambda counts, flat, dark: dark + EXPOSED * (counts - dark), *BEAM),
        wrong="Everything was exposed four times as long as well: much of the sample is saturated, too.",
    ),
    BadInput(
        name="test-saturated",
        change=from_images(lambda counts, flat, dark: dark + EXPOSED * (counts - dark), TEST),
        wrong="The test alone was exposed four times as long as well.",
    ),
    BadInput(
        name="beam-fades",
        change=dimming(0.7),
        wrong="The beam faded during the test, steadily, to 70 %.",
    ),
    BadInput(
        name="beam-flickers",
        change=from_images(flicker, TEST),
        wrong="The beam changed by a fifth from one radiograph of the test to the next.",
    ),
    BadInput(
        name="flats-and-darks-exchanged",
        change=exchanged(FLATS, DARKS),
        due="error",
        wrong="Flats and darks have each other's names.",
    ),
    BadInput(
        name="darks-are-flats",
        change=copied(FLATS, DARKS),
        due="error",
        wrong="The darks were taken with the beam on.",
    ),
    BadInput(
        name="flats-are-darks",
        change=copied(DARKS, FLATS),
        due="error",
        wrong="The flats were taken with the beam off.",
    ),
    BadInput(
        name="flats-show-the-sample",
        change=in_turn(copied(REFERENCE, FLATS), stacks(lambda counts: counts[:2], FLATS)),
        wrong="The sample stood in the beam while the flats were taken.",
    ),
)
"""Levels of counts, flats and darks are wrong."""

CASES = (*IMAGES, *LEVELS)
