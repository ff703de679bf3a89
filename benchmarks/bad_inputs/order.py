"""Stacks in disorder: flipped, shifted, swapped, a step late; each image by itself is fine."""

from __future__ import annotations

import numpy as np

from benchmarks.bad_inputs.counts import STEP, copied, exchanged
from benchmarks.bad_inputs.record import ALL, BadInput, Change, Counts, described, in_turn, picked, shifted, stacks
from pdvc.experiment import REFERENCE, TEST


def repeated(counts: Counts) -> Counts:
    """Return a test whose detector went on sending the same image for ten steps."""
    counts[STEP : STEP + 10] = counts[STEP]
    return counts


def two_swapped(counts: Counts) -> Counts:
    """Return a test in which two images, 40 steps apart, have changed places."""
    counts[[STEP - 30, STEP + 10]] = counts[[STEP + 10, STEP - 30]]
    return counts


def drifting(rows: float, columns: float, since: int = 50) -> Change:
    """Return the change of a test whose images move away steadily, from step `since` on, by so many pixels in all."""

    def moved(counts: Counts) -> Counts:
        for t, share in enumerate(np.clip((np.arange(len(counts)) - since) / (len(counts) - 1 - since), 0, 1)):
            counts[t] = shifted(counts[t : t + 1], round(rows * share), round(columns * share))[0]
        return counts

    return stacks(moved, TEST)


CASES = (
    BadInput(
        name="test-upside-down",
        change=stacks(lambda counts: counts[:, ::-1], TEST),
        wrong="The test stack was flipped vertically.",
    ),
    BadInput(
        name="test-mirrored",
        change=stacks(lambda counts: counts[:, :, ::-1], TEST),
        wrong="The test stack was flipped horizontally.",
    ),
    BadInput(
        name="reference-upside-down",
        change=stacks(lambda counts: counts[:, ::-1], REFERENCE),
        wrong="The reference stack was flipped vertically.",
    ),
    BadInput(
        name="reference-mirrored",
        change=stacks(lambda counts: counts[:, :, ::-1], REFERENCE),
        wrong="The reference stack was flipped horizontally.",
    ),
    BadInput(
        name="all-mirrored",
        change=stacks(lambda counts: counts[:, :, ::-1], *ALL),
        wrong="All stacks were flipped horizontally: seen from behind the detector.",
    ),
    BadInput(
        name="all-upside-down",
        change=stacks(lambda counts: counts[:, ::-1], *ALL),
        due="unknowable",
        wrong="All stacks were flipped vertically: that is what the mirrored sample would show.",
    ),
    BadInput(
        name="test-turned-half",
        change=stacks(lambda counts: counts[:, ::-1, ::-1], TEST),
        wrong="The camera was turned by half a turn before the test.",
    ),
    BadInput(
        name="test-shifted-across",
        change=stacks(lambda counts: shifted(counts, 0, 5), TEST),
        wrong="The test was cropped 5 columns beside the reference.",
    ),
    BadInput(
        name="test-shifted-down",
        change=stacks(lambda counts: shifted(counts, 20, 0), TEST),
        wrong="The test was cropped 20 rows above the reference.",
    ),
    BadInput(
        name="all-shifted-across",
        change=stacks(lambda counts: shifted(counts, 0, 5), *ALL),
        wrong="All stacks were cropped 5 columns beside what the geometry says.",
    ),
    BadInput(
        name="all-shifted-down",
        change=stacks(lambda counts: shifted(counts, 20, 0), *ALL),
        wrong="All stacks were cropped 20 rows above what the geometry says.",
    ),
    BadInput(
        name="sample-half-outside",
        change=stacks(lambda counts: shifted(counts, 0, 22), REFERENCE, TEST),
        wrong="Half of the sample is outside the field of view.",
    ),
    BadInput(
        name="test-sample-outside",
        change=stacks(lambda counts: shifted(counts, 0, 45), TEST),
        wrong="The sample is outside the field of view during the test.",
    ),
    BadInput(
        name="motion-beyond-capture-in-test",
        change=drifting(40, 0),
        wrong="The sample moved down by 40 rows during the test, some ten times the size of its grains.",
    ),
    BadInput(
        name="sample-leaves",
        change=drifting(0, 45),
        wrong="The sample slipped out of the field of view during the test.",
    ),
    BadInput(
        name="images-reversed",
        change=stacks(lambda counts: counts[::-1], TEST),
        wrong="The images of the test are stacked in the opposite order.",
    ),
    BadInput(
        name="views-reversed",
        change=stacks(lambda counts: counts[::-1], REFERENCE),
        wrong="The images of the reference scan are stacked in the opposite order.",
    ),
    BadInput(
        name="steps-duplicated",
        change=stacks(repeated, TEST),
        wrong="The detector sent the same radiograph for ten steps.",
    ),
    BadInput(
        name="step-recorded-twice",
        change=picked("test", TEST, lambda n: np.insert(np.arange(n), STEP, STEP)),
        wrong="One step is in the stack twice, and in all lists.",
    ),
    BadInput(
        name="steps-swapped",
        change=stacks(two_swapped, TEST),
        wrong="Two radiographs of the test have changed places.",
    ),
    BadInput(
        name="steps-off-by-one",
        change=stacks(lambda counts: np.concatenate([counts[:1], counts[:-1]]), TEST),
        wrong="The first radiograph of the test is stored twice, so that all others are a step late.",
    ),
    BadInput(
        name="views-off-by-one",
        change=stacks(lambda counts: np.roll(counts, 1, axis=0), REFERENCE),
        due="unknowable",
        wrong="The reference scan is a view late: that is a sample which turned by 4.8 degrees before the test.",
    ),
    BadInput(
        name="views-shuffled",
        change=stacks(lambda counts: np.random.default_rng(0).permutation(counts), REFERENCE),
        wrong="The files of the reference scan were sorted by name, not by number.",
    ),
    BadInput(
        name="steps-shuffled",
        change=stacks(lambda counts: np.random.default_rng(0).permutation(counts), TEST),
        wrong="The files of the test were sorted by name, not by number.",
    ),
    BadInput(
        name="reference-and-test-exchanged",
        change=in_turn(
            exchanged(REFERENCE, TEST),
            described(lambda values: values.update(reference=values["test"], test=values["reference"])),
        ),
        wrong="The test was given as reference scan, and the reference scan as test.",
    ),
    BadInput(
        name="test-is-the-reference",
        change=in_turn(copied(REFERENCE, TEST), described(lambda values: values.update(test=values["reference"]))),
        wrong="The reference scan was given as test, too.",
    ),
)
"""Images that are not in their place."""
