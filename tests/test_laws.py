"""Laws of the measurement, on whatever `validation.testing.strategies` draws.

Through the whole pipeline, from counts to motion:

- the same counts, described or stored in another way, give the same motion. Where the reference volume keeps its
  grid, only the end of the passes can differ: by less than the noise, which is the same. Where the grid lies otherwise
  in the sample, both are interpolated otherwise. Interpolating linearly between voxels of features some three voxels
  wide (nodules, edges) shifts an image by up to a few hundredths of a voxel, the known bias of image correlation; a
  tenth is allowed, rms over points and steps, across the beam and vertically. Along the beam the same shift of an
  edge counts R / r = 40 times, which says nothing;
- more noise is answered by larger standard deviations.
"""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import linalg

from pdvc.gauss_newton import GaussNewton
from pdvc.history import Angle, Force, Polynomial
from pdvc.options import StageOptions
from pdvc.protocol import measure
from simulator.images import prepare
from simulator.kinematics import Composition, RigidMotion, rotation_matrix
from simulator.scenario import course_of
from simulator.stacks import step_image, view_image
from simulator.truth import sample_truth
from tests.laws import law
from tests.synthetic_records import altered
from validation.scoring.bound import bound_of
from validation.scoring.scores import point_errors
from validation.testing.small_cases import SmallExperiment
from validation.testing.strategies import small_experiments

THROUGH = law(2, cost=10)
"""A law through the whole pipeline costs some two seconds an example; the first is the plainest that there is."""

moving_experiments = small_experiments(least_ingredients=5)
"""A sample at rest looks alike in too many ways."""


# What is compared


def with_counts(experiment, change):
    """Return an experiment whose stacks (image, row, column) went through `change`."""

    def changed(series):
        return replace(series, counts=change(series.counts))

    return replace(
        experiment,
        reference=changed(experiment.reference),
        test=changed(experiment.test),
        flats=change(experiment.flats),
        darks=change(experiment.darks),
    )


def with_offset(experiment, offset_rad):
    """Return the same counts, recorded from another zero of the stage angle."""

    def turned(series):
        return replace(series, angle_rad=series.angle_rad + offset_rad)

    return replace(experiment, reference=turned(experiment.reference), test=turned(experiment.test))


def seen_from(vectors, offset_rad):
    """Return vectors (..., 3) in the frame that an offset of the stage angle makes: it lies +offset further round."""
    return vectors @ rotation_matrix([0.0, 0.0, -offset_rad]).T


def turned_truth(truth, offset_rad):
    return replace(
        truth,
        point_mm=seen_from(truth.point_mm, offset_rad),
        displacement_mm=seen_from(truth.displacement_mm, offset_rad),
    )


def difference(one, its_truth, other, other_truth):
    """Return the rms over points and steps of how two measurements differ at the same material points, voxels.

    (direction,): across the beam, vertical, along the beam. Each is compared with its own truth, as the points may
    be described differently; the truths themselves cancel.
    """
    both = point_errors(one, its_truth).components - point_errors(other, other_truth).components
    assert np.isfinite(both).all(axis=2).mean() > 0.3
    return np.sqrt(np.nanmean(both**2, axis=(0, 1)))


def in_deviations(one, other):
    """Return the rms of a difference of amplitudes over their standard deviation."""
    share = (other.motion.amplitude - one.motion.amplitude) / one.motion.amplitude_std
    return np.sqrt(np.nanmean(share**2))


INTERPOLATION_VOXEL = 0.1
"""See the head of this file."""


# Through the whole pipeline


@THROUGH
@given(moving_experiments, st.floats(0.2, 2.9), st.sampled_from((1, -1)))
def test_an_offset_of_all_angles_turns_the_motion_with_it(small, offset, sign):
    offset *= sign
    found = measure(with_offset(small.experiment, offset), small.options)
    across, vertical, _ = difference(found, turned_truth(small.truth, offset), small.measurement, small.truth)
    assert max(across, vertical) < INTERPOLATION_VOXEL


@THROUGH
@given(moving_experiments, st.sampled_from((1, 2, 3)))
def test_an_offset_by_quarter_turns_changes_nothing_else(small, quarters):
    """The grid of voxels is turned into itself: nothing is interpolated otherwise."""
    offset = quarters * np.pi / 2
    found = measure(with_offset(small.experiment, offset), small.options)
    back = found.motion.amplitude.copy()
    for k in (0, 3):  # translations, and rotations, which are vectors about the axis too
        back[..., k : k + 3] = seen_from(found.motion.amplitude[..., k : k + 3], -offset)
    np.testing.assert_allclose(found.motion.basis.radius_mm, small.measurement.motion.basis.radius_mm, rtol=1e-6)
    assert in_deviations(small.measurement, altered(found, amplitude=back)) < 1


@THROUGH
@given(moving_experiments, st.integers(0, 2), st.integers(3, 5), st.integers(1, 4))
def test_rows_stored_beyond_the_used_window_do_not_matter(small, top, bottom, more):
    """The frame does not move, the detector's middle does: `row_shift_mm` tells.

    Twelve rows are left at least: rays of the window leave it by two rows through the cone, the sample by some three,
    the hull keeps three, and the outermost two layers of a volume do not count.
    """
    rows = small.scenario.geometry.rows

    def stored(top, bottom, discarded):
        cut = with_counts(small.experiment, lambda counts: counts[:, top : rows - bottom])
        geometry = cut.geometry.cropped(top, rows - bottom, 0, cut.geometry.columns)
        options = small.options.model_copy(update={"discard_rows": discarded})
        return measure(replace(cut, geometry=geometry), options)

    whole, cut = stored(top, bottom, 12 + more), stored(top + more, bottom + more, 12)
    recorded = small.experiment.geometry
    edges = np.array([rows - bottom - more - 12, top + more + 12])  # of the used rows, from the bottom up
    heights = -((edges - rows / 2) * recorded.pixel_mm + recorded.row_shift_mm) / recorded.magnification
    for found in (whole, cut):
        # a roll of one degree shortens heights by 1.5e-4 of them
        np.testing.assert_allclose(found.motion.basis.height_mm[[0, -1]], heights, atol=2e-4)
    # where rays leave the volume, which is as high as what is stored, more of it tells more
    assume(not {"cut-ends"} & {*whole.verdict.names, *cut.verdict.names})
    assert in_deviations(whole, cut) < 1


@THROUGH
@given(moving_experiments, st.tuples(*[st.floats(0.05, 0.3)] * 3))
def test_a_sample_mounted_elsewhere_moves_alike(small, shift):
    """Other rays, other noise: to interpolation, the noise of two measurements adds."""
    shift = np.array(shift)
    course = course_of(small.scenario)
    steps = len(course.test_angle_rad)

    def by(vector):
        return RigidMotion(rotation_rad=np.zeros((steps, 3)), translation_mm=np.tile(vector, (steps, 1)))

    truth = sample_truth(small.scenario, course)
    course = replace(course, motion=Composition((by(-shift), course.motion, by(shift))))
    scanner = prepare(small.scenario, course)
    body = replace(
        scanner.body, vertices_mm=scanner.body.vertices_mm + shift, centres_mm=scanner.body.centres_mm + shift
    )
    scanner, here = replace(scanner, body=body), small.experiment
    views = np.stack([view_image(scanner, k) for k in range(len(here.reference))])
    images = np.stack([step_image(scanner, k) for k in range(steps)])
    elsewhere = replace(here, reference=replace(here.reference, counts=views), test=replace(here.test, counts=images))
    found = measure(elsewhere, small.options)
    moved = replace(truth, point_mm=truth.point_mm + shift)
    across, vertical, _ = difference(found, moved, small.measurement, small.truth)
    noise = np.sqrt((small.measurement.motion.amplitude_std[..., :3] ** 2).mean())
    assert max(across, vertical) < np.hypot(INTERPOLATION_VOXEL, np.sqrt(2) * noise)


@THROUGH
@given(moving_experiments, st.sampled_from((3, 2)), st.integers(0, 5000))
def test_another_gain_and_another_dark_level_change_nothing(small, gain, dark):
    """The same photons in more counts: a logarithm of ratios is left as it was, to single precision.

    Bad pixels too are to be as bad as before: some five of them.
    """
    scenario = small.scenario
    detector = scenario.detector.model_copy(update={"counts_full": 16000.0, "bad_pixel_fraction": 2e-3})
    small = SmallExperiment(scenario.model_copy(update={"detector": detector}))
    # as many passes for both: where one would stop by itself, a thousandth of a voxel from the end, rounding decides
    passes = StageOptions(scale=1, solver=GaussNewton(most_passes=3))
    options = small.options.model_copy(update={"weighting": "noise", "deformation": (passes,)})
    here = small.experiment
    louder = replace(
        with_counts(here, lambda counts: np.minimum(gain * counts.astype(int) + dark, 65535).astype(np.uint16)),
        photons_per_count=here.photons_per_count / gain,
        readout_noise_counts=here.readout_noise_counts * gain,
    )
    found, expected = measure(louder, options), measure(here, options)
    assert in_deviations(expected, found) < 0.01
    np.testing.assert_allclose(found.motion.amplitude_std, expected.motion.amplitude_std, rtol=1e-2)
    np.testing.assert_allclose(found.fit.snr_noise_db, expected.fit.snr_noise_db, atol=1e-3)


@THROUGH
@given(moving_experiments, st.integers(0, 2**32 - 1))
def test_steps_in_another_order_are_measured_alike(small, seed):
    """With time functions of what was recorded at each step; sums in another order differ by rounding alone."""
    order = np.random.default_rng(seed).permutation(len(small.experiment.test))
    options = small.options.model_copy(update={"time": (Force(), Angle(harmonics=2), Polynomial(degree=0))})
    test = small.experiment.test
    shuffled = replace(
        small.experiment,
        test=replace(
            test,
            counts=test.counts[order],
            angle_rad=test.angle_rad[order],
            time_s=test.time_s[order],
            force_N=test.force_N[order],
        ),
    )
    one, two = measure(small.experiment, options), measure(shuffled, options)
    for name in ("motion.amplitude", "fit.snr_initial_db", "fit.snr_final_db"):
        found, expected = attrgetter(name)(two), attrgetter(name)(one)[order]
        np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=name)
    # the noise that all images share is summed over them in single precision
    for name in ("amplitude_std", "data_share"):
        found, expected = getattr(two.motion, name), getattr(one.motion, name)[order]
        np.testing.assert_allclose(found, expected, rtol=1e-4, err_msg=name)
    np.testing.assert_array_equal(two.fit.residual_initial, one.fit.residual_initial[order])


@THROUGH
@given(moving_experiments)
def test_with_a_quarter_of_the_photons_every_amplitude_is_less_well_known(small):
    """Noise doubles; a tenth is allowed for the volume, whose noise doubles too and shows in the sensitivities."""
    scenario = small.scenario
    detector = scenario.detector.model_copy(update={"photons_per_pixel": scenario.detector.photons_per_pixel / 4})
    dim = SmallExperiment(scenario.model_copy(update={"detector": detector}))
    ratio = dim.measurement.motion.amplitude_std / small.measurement.motion.amplitude_std
    assert ratio.min() > 1
    assert ratio.mean() < 2.2


@THROUGH
@given(moving_experiments, st.floats(1.1, 20.0))
def test_with_fewer_photons_the_bound_grows_in_every_direction_and_no_more_than_their_noise(small, fewer):
    """The variance of photons is inversely as their number; that of readout, and the prior, stay."""
    scenario = small.scenario
    detector = scenario.detector.model_copy(update={"photons_per_pixel": scenario.detector.photons_per_pixel / fewer})
    bright, _ = bound_of(scenario, small.options)
    dim, _ = bound_of(scenario.model_copy(update={"detector": detector}), small.options)
    # whatever is asked of the unknowns, not only each of them by itself: generalised eigenvalues
    growth = linalg.eigh(dim.covariance, bright.covariance, eigvals_only=True)
    assert growth.min() > 1
    assert growth.max() < fewer
