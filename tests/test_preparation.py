"""What solvers start from: which pixels of the coarse radiographs count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdvc.preparation import prepare, snr_reprojection, volume_choices
from pdvc.projection import project_at_rest
from pdvc.radiographs import calibrate, snr_db
from pdvc.rays import ray_vectors
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


def test_views_are_sharpened_for_the_volume_alone():
    """What is left of a view, and steps are compared with, is the view as it was."""
    plain, sharp = (
        prepare(set_up(SMALL.experiment, SMALL.options.model_copy(update={"sharpen": sharpen})), 1)
        for sharpen in (False, True)
    )
    np.testing.assert_array_equal(sharp.view(7), plain.view(7))
    np.testing.assert_array_equal(sharp.images.grey, plain.images.grey)
    # rougher from voxel to voxel
    rough = [np.diff(each.images.volume.values, axis=2).std() for each in (plain, sharp)]
    assert rough[1] > 1.1 * rough[0]
    for each in (plain, sharp):
        rays = ray_vectors(SMALL.experiment.geometry, SMALL.experiment.reference.angle_rad[7]).stacked()
        model = project_at_rest(each.images.volume, rays, each.systematic.detector)[0]
        left = each.systematic.left(7)
        reached = left.any(axis=1)
        # kept to eleven bits
        np.testing.assert_allclose(left[reached], (model - each.view(7))[reached], rtol=2**-11, atol=1e-5)
        first, rows = each.systematic.corner[0], each.systematic.shape[0]
        assert reached[first : first + rows].all()


def test_volumes_that_are_sharpened_and_others_are_not_taken_for_each_other():
    one, other = (
        volume_choices(SMALL.options.model_copy(update={"sharpen": sharpen}), SMALL.experiment.geometry)
        for sharpen in (False, True)
    )
    assert one != other


def test_the_mean_over_views_is_as_wide_as_half_a_pixel_at_the_section_s_edge():
    setup = set_up(SMALL.experiment, SMALL.options)
    for scale in (1, 2):
        width = prepare(setup, scale).systematic.width_rad
        assert width * setup.sections.radius_mm == pytest.approx(0.5 * scale * setup.geometry.voxel_mm)


def test_a_pattern_is_taken_from_all_images_alike():
    """From radiographs and views; what re-projection leaves of the views grows by it, as the volume stays."""
    prepared = prepare(set_up(SMALL.experiment, SMALL.options), 1)
    pattern = np.random.default_rng(1).normal(size=prepared.systematic.detector).astype(np.float32)
    found = prepared.without(pattern)
    taken = prepared.images.grey - found.images.grey
    window = np.broadcast_to(pattern[prepared.systematic.window], taken.shape)
    np.testing.assert_allclose(taken, window, atol=1e-5)
    np.testing.assert_allclose(prepared.view(2) - found.view(2), pattern, atol=1e-5)
    left = found.images.systematic.left(2) - prepared.systematic.left(2)
    np.testing.assert_allclose(left, pattern, atol=1e-5)
    np.testing.assert_array_equal(found.systematic.left(2), found.images.systematic.left(2))


def test_the_snr_of_re_projection_is_that_of_the_views_that_steps_look_along():
    """At rest those on both sides of each step's angle; of a sample that turned by a right angle, others."""
    setup = set_up(SMALL.experiment, SMALL.options)
    prepared, basis = prepare(setup, 1), setup.sections
    still = np.zeros((len(SMALL.experiment.test), *basis.shape))
    found = snr_reprojection(prepared, basis, still)
    view, step = SMALL.experiment.reference.angle_rad, SMALL.experiment.test.angle_rad
    away = np.abs(np.angle(np.exp(1j * np.subtract.outer(view, step))))
    # views are nine degrees apart: three deviations of half of that
    near = np.flatnonzero((away < 1.5 * 2 * np.pi / len(view)).any(axis=1))
    row, column = prepared.systematic.corner
    window = np.s_[row : row + prepared.systematic.shape[0], column : column + prepared.systematic.shape[1]]
    used = np.ones(prepared.systematic.shape, dtype=bool)
    expected = [snr_db(prepared.view(i)[window], prepared.systematic.left(i)[window], used) for i in near.tolist()]
    np.testing.assert_allclose(found, expected)
    assert (found > 10).all()
