"""What solvers start from: which pixels of the coarse radiographs count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdvc.preparation import prepare
from pdvc.radiographs import calibrate
from pdvc.setup import set_up
from validation.scoring.bound import noise_free
from validation.testing.small_cases import SmallExperiment, small_scenario

SMALL = SmallExperiment(small_scenario({"detector.bad_pixel_fraction": 0.0}))


def with_dead_pixels(experiment, places):
    """Return the experiment, seen by a detector some pixels of which answer nothing but the dark."""
    rows, columns = np.array(places).T

    def seen(counts):
        changed = counts.copy()
        changed[:, rows, columns] = experiment.darks[0][rows, columns]
        return changed

    return replace(
        experiment,
        flats=seen(experiment.flats),
        reference=replace(experiment.reference, counts=seen(experiment.reference.counts)),
        test=replace(experiment.test, counts=seen(experiment.test.counts)),
    )


@pytest.mark.parametrize(
    ("scale", "dead", "counts"),
    [
        (2, [(0, 0)], True),
        (2, [(0, 0), (1, 1)], False),
        (2, [(0, 0), (0, 1), (1, 0)], False),
        (3, [(0, 0), (2, 1)], True),
        (3, [(0, 0), (2, 1), (1, 2)], False),
    ],
)
def test_a_coarse_pixel_counts_where_more_than_two_thirds_of_it_were_measured(scale, dead, counts):
    """A dead pixel takes its neighbours' mean: a coarse pixel that is made of such means by a third tells nothing new.

    One dead pixel of four is let pass, or a detector with one in a hundred would lose four at the coarse scale.
    """
    row, column = 12 * scale, 6 * scale
    setup = set_up(with_dead_pixels(SMALL.experiment, [(row + i, column + j) for i, j in dead]), SMALL.options)
    assert setup.calibration.bad.sum() == len(dead)
    weight = prepare(setup, scale).images.weight[0]
    expected = np.ones_like(weight)
    expected[12 - setup.window[0] // scale, 6 - setup.window[2] // scale] = counts
    np.testing.assert_array_equal(weight, expected)


@pytest.mark.parametrize("scale", [1, 2])
def test_the_noise_told_of_the_radiographs_is_what_they_differ_by_from_those_without_noise(scale):
    """Photons, readout and the two flats, which make a third of it in air, after filter and binning."""
    clean = set_up(SmallExperiment(noise_free(SMALL.scenario)).experiment, SMALL.options)
    calibration = calibrate(SMALL.experiment).with_polynomial(clean.outline.polynomial)
    noisy = replace(clean, experiment=SMALL.experiment, calibration=calibration)
    told = prepare(noisy, scale)
    apart = told.images.grey.astype(float) - prepare(clean, scale).images.grey
    # twenty thousand pixels, of which a filter leaves every fifth by itself; at scale 2 a quarter
    assert told.noise_rms == pytest.approx(np.sqrt((apart**2).mean()), rel=0.04)
    signal = told.images.grey.std(axis=(1, 2), dtype=float)
    expected = 20 * np.log10(signal / np.sqrt((apart**2).mean(axis=(1, 2))))
    assert told.snr_noise_db.mean() == pytest.approx(expected.mean(), abs=0.5)
