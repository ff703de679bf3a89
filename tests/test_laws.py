"""Laws of the measurement, on whatever `validation.strategies` draws.

Through the whole pipeline, from counts to motion:

- the same counts, described or stored in another way, give the same motion. Where the reference volume keeps its
  grid, only the end of the passes can differ: by less than the noise, which is the same. Where the grid lies otherwise
  in the sample, both are interpolated otherwise. Interpolating linearly between voxels of features some three voxels
  wide (nodules, edges) shifts an image by up to a few hundredths of a voxel, the known bias of image correlation; a
  tenth is allowed, rms over points and steps, across the beam and vertically. Along the beam the same shift of an
  edge counts R / r = 40 times, which says nothing;
- more noise is answered by larger standard deviations.

On radiographs made by pdvc's own projector, laws are exact, and only rounding is allowed for.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy import linalg

from pdvc import gauss_newton, pgd
from pdvc.equations import Equations, linearise
from pdvc.history import Angle, Force, Polynomial
from pdvc.measure import measure
from pdvc.prior import Prior
from pdvc.uncertainty import posterior
from simulator.kinematics import Composition, RigidMotion, rotation_matrix
from simulator.scenario import course_of
from simulator.truth import sample_truth
from simulator.views import prepare, step_image, view_image
from validation.bound import bound_of
from validation.scores import point_errors
from validation.small_cases import SmallExperiment
from validation.strategies import projected_cases, small_experiments

THROUGH = settings(
    max_examples=int(os.environ.get("PDVC_LAW_EXAMPLES", "1")),
    deadline=None,
    derandomize=True,
    phases=[Phase.generate],
)
"""A law through the whole pipeline costs some two seconds an example: one here, and as many as asked for by hand."""
QUICK = settings(max_examples=6, deadline=None, derandomize=True)

moving_experiments = small_experiments(least_ingredients=5)
moving_cases = projected_cases().filter(lambda case: np.count_nonzero(case.coefficients) >= 5)
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
    share = (other.amplitude - one.amplitude) / one.amplitude_std
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
    back = found.amplitude.copy()
    for k in (0, 3):  # translations, and rotations, which are vectors about the axis too
        back[..., k : k + 3] = seen_from(found.amplitude[..., k : k + 3], -offset)
    np.testing.assert_allclose(found.basis.radius_mm, small.measurement.basis.radius_mm, rtol=1e-6)
    assert in_deviations(small.measurement, replace(found, amplitude=back)) < 1


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
        np.testing.assert_allclose(found.basis.height_mm[[0, -1]], heights, atol=2e-4)
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
    noise = np.sqrt((small.measurement.amplitude_std[..., :3] ** 2).mean())
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
    options = small.options.model_copy(update={"weighting": "noise"})
    here = small.experiment
    louder = replace(
        with_counts(here, lambda counts: np.minimum(gain * counts.astype(int) + dark, 65535).astype(np.uint16)),
        photons_per_count=here.photons_per_count / gain,
        readout_noise_counts=here.readout_noise_counts * gain,
    )
    found, expected = measure(louder, options), measure(here, options)
    assert in_deviations(expected, found) < 0.01
    np.testing.assert_allclose(found.amplitude_std, expected.amplitude_std, rtol=1e-2)
    np.testing.assert_allclose(found.snr_noise_db, expected.snr_noise_db, atol=1e-3)


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
    for name in ("amplitude", "snr_initial_db", "snr_final_db"):
        np.testing.assert_allclose(getattr(two, name), getattr(one, name)[order], atol=1e-6, err_msg=name)
    # the noise that all images share is summed over them in single precision
    for name in ("amplitude_std", "data_share"):
        np.testing.assert_allclose(getattr(two, name), getattr(one, name)[order], rtol=1e-4, err_msg=name)
    np.testing.assert_array_equal(two.residual_initial, one.residual_initial[order])


@THROUGH
@given(moving_experiments)
def test_with_a_quarter_of_the_photons_every_amplitude_is_less_well_known(small):
    """Noise doubles; a tenth is allowed for the volume, whose noise doubles too and shows in the sensitivities."""
    scenario = small.scenario
    detector = scenario.detector.model_copy(update={"photons_per_pixel": scenario.detector.photons_per_pixel / 4})
    dim = SmallExperiment(scenario.model_copy(update={"detector": detector}))
    ratio = dim.measurement.amplitude_std / small.measurement.amplitude_std
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


# With pdvc's own projector: exact laws


def weak_prior(case):
    return Prior(deviation_voxel=np.full(case.sections.shape, 1e3))


def solved(case, images, functions, *, sections=None, passes=3):
    """Return the coefficients (function, section, motion) that direct solves find from rest."""
    sections = sections or case.sections
    return gauss_newton.solve(
        lambda amplitude: linearise(images, sections, amplitude),
        functions,
        np.zeros_like(case.coefficients),
        weak_prior(case),
        most_passes=passes,
        least_change_voxel=1e-9,
    ).coefficients


@QUICK
@given(moving_cases, st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_a_shift_of_the_frame_shifts_where_the_motion_is_and_nothing_else(case, shift):
    """The volume, the rays and the sections described from another origin.

    Single precision resolves 1e-5 voxel at the hundred voxels of the largest shift.
    """
    shift = np.array(shift)
    images, volume = case.images, case.images.volume
    rays = images.rays.copy()
    rays[:, :2] += shift  # source and corner; the vectors from pixel to pixel stay
    hull = replace(
        volume.hull,
        z_mm=volume.hull.z_mm + shift[2],
        support_mm=volume.hull.support_mm + volume.hull.normals() @ shift[:2],
    )
    grid = replace(volume.grid, origin_mm=tuple(np.array(volume.grid.origin_mm) + shift))
    there = replace(images, rays=rays, volume=replace(volume, grid=grid, hull=hull))
    sections = replace(case.sections, height_mm=case.sections.height_mm + shift[2])
    one = np.einsum("ft,fjk->tjk", case.time_functions, solved(case, images, case.time_functions))
    two = np.einsum("ft,fjk->tjk", case.time_functions, solved(case, there, case.time_functions, sections=sections))
    low, high = volume.hull.box_mm()
    points = np.random.default_rng(0).uniform(low, high, size=(50, 3))
    for a, b in zip(one, two, strict=True):
        expected = case.sections.displacement(a, points)
        np.testing.assert_allclose(sections.displacement(b, points + shift), expected, atol=1e-4)


@QUICK
@given(moving_cases, st.floats(0.01, 100.0))
def test_volume_and_radiographs_on_another_grey_scale_give_the_same_motion(case, scale):
    images = case.images
    volume = replace(images.volume, values=(scale * images.volume.values).astype(np.float32))
    brighter = replace(images, volume=volume, grey=(scale * images.grey).astype(np.float32))
    one, two = (solved(case, each, case.time_functions) for each in (images, brighter))
    np.testing.assert_allclose(two, one, atol=1e-4)


def reordered(case, order):
    """Return the radiographs of a case, each with weights of its own, and the same in another order."""
    weight = np.random.default_rng(1).uniform(0.5, 1.5, case.images.grey.shape).astype(np.float32)
    images = replace(case.images, weight=weight)
    return images, replace(images, rays=images.rays[order], grey=images.grey[order], weight=weight[order])


@QUICK
@given(moving_cases, st.data())
def test_steps_in_another_order_have_the_same_equations_to_the_last_bit(case, data):
    order = np.array(data.draw(st.permutations(range(len(case.angle_rad)))))
    images, shuffled = reordered(case, order)
    amplitude = 0.7 * case.amplitude
    one, two = linearise(images, case.sections, amplitude), linearise(shuffled, case.sections, amplitude[order])
    for name in ("matrix", "vector", "chi2", "residual"):
        np.testing.assert_array_equal(getattr(two, name), getattr(one, name)[order], err_msg=name)


@pytest.mark.parametrize("solver", ["gauss-newton", "pgd"])
@QUICK
@given(case=moving_cases, data=st.data())
def test_steps_in_another_order_give_the_same_motion(solver, case, data):
    """Solved to the end: where passes stop, rounding decides, hence the tolerance of a change that counts as none."""
    order = np.array(data.draw(st.permutations(range(len(case.angle_rad)))))
    found = []
    for images, functions in zip(
        reordered(case, order), (case.time_functions, case.time_functions[:, order]), strict=True
    ):
        start, believed = np.zeros_like(case.coefficients), weak_prior(case)

        def equations(amplitude, images=images):
            return linearise(images, case.sections, amplitude)

        if solver == "pgd":
            found.append(
                pgd.solve(
                    equations,
                    functions,
                    start,
                    believed,
                    most_modes=2,
                    passes_per_mode=3,
                    least_gain=0.0,
                    noise_rms=None,
                )
            )
        else:
            found.append(
                gauss_newton.solve(equations, functions, start, believed, most_passes=20, least_change_voxel=1e-4)
            )
    one, two = found
    np.testing.assert_allclose(two.coefficients, one.coefficients, atol=1e-4)
    np.testing.assert_allclose(two.temporal, one.temporal[:, order], atol=1e-4)


# What is known of the amplitudes


def deviations(equations, functions, prior, *, noise):
    """Return the posterior standard deviations (step, section, motion), voxels, under white noise, grey levels."""
    pixels = equations.pixels / len(equations.chi2)
    noisy = replace(equations, chi2=np.full(len(equations.chi2), pixels * noise**2))
    return posterior(noisy, functions, prior).deviation


def part_of(equations: Equations, steps) -> Equations:
    return replace(
        equations,
        matrix=equations.matrix[steps],
        vector=equations.vector[steps],
        chi2=equations.chi2[steps],
        residual=equations.residual[steps],
        pixels=equations.pixels * len(steps) // len(equations.chi2),
    )


priors = st.floats(0.1, 30.0)
noises = st.floats(0.001, 0.1)


@QUICK
@given(projected_cases(), priors, noises, st.data())
def test_more_steps_never_lower_the_information(case, believed, noise, data):
    steps = range(len(case.angle_rad))
    few = sorted(data.draw(st.sets(st.sampled_from(steps), min_size=1, max_size=len(steps) - 1)))
    whole, functions = case.equations(0 * case.amplitude), case.time_functions
    part = part_of(whole, few)
    more, less = gauss_newton.hessian(whole.matrix, functions), gauss_newton.hessian(part.matrix, functions[:, few])
    eigenvalues = np.linalg.eigvalsh(more - less)
    assert eigenvalues.min() > -1e-9 * eigenvalues.max()
    assert eigenvalues.max() > 0
    prior = Prior(deviation_voxel=np.full(case.sections.shape, believed))
    known = deviations(whole, functions, prior, noise=noise)[few]
    before = deviations(part, functions[:, few], prior, noise=noise)
    assert (known <= before * (1 + 1e-6)).all()
    assert known.sum() < before.sum()


@QUICK
@given(projected_cases(), priors, noises, st.floats(1.1, 10.0))
def test_more_noise_never_makes_an_amplitude_better_known_and_the_prior_holds_it(case, believed, noise, louder):
    equations, functions = case.equations(0 * case.amplitude), case.time_functions
    prior = Prior(deviation_voxel=np.full(case.sections.shape, believed))
    quiet = deviations(equations, functions, prior, noise=noise)
    loud = deviations(equations, functions, prior, noise=louder * noise)
    assert (loud > quiet).all()
    assert (loud <= louder * quiet * (1 + 1e-9)).all()
    assert (loud <= believed * np.sqrt((functions**2).sum(axis=0))[:, None, None] * (1 + 1e-9)).all()
