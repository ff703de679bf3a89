"""Laws on radiographs made by pdvc's own projector: they are exact, and only rounding is allowed for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc import gauss_newton, pgd
from pdvc.equations import Equations, joined, linearise
from pdvc.prior import Prior
from pdvc.uncertainty import posterior
from tests.laws import law
from validation.testing.strategies import projected_cases

QUICK = law(6)

moving_cases = projected_cases().filter(lambda case: np.count_nonzero(case.coefficients) >= 5)
"""A sample at rest looks alike in too many ways."""


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


def visible(case, difference):
    """Return the size of a difference of coefficients by what it changes in radiographs, voxels of a usual motion.

    Along the beam rounding in single precision makes differences some R / r = 400 times as large, which no radiograph
    shows.
    """
    matrix = joined(case.equations(case.amplitude).matrix, case.time_functions)
    change = difference.ravel()
    return np.sqrt(change @ matrix @ change * len(change) / np.trace(matrix))


@QUICK
@given(moving_cases, st.floats(0.01, 100.0))
def test_volume_and_radiographs_on_another_grey_scale_give_the_same_motion(case, scale):
    images = case.images
    volume = replace(images.volume, values=(scale * images.volume.values).astype(np.float32))
    brighter = replace(images, volume=volume, grey=(scale * images.grey).astype(np.float32))
    # to the end: on the way there rounding changes the steps too, by a part of what is still missing
    one, two = (solved(case, each, case.time_functions, passes=10) for each in (images, brighter))
    assert visible(case, two - one) < 5e-6


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
    more, less = joined(whole.matrix, functions), joined(part.matrix, functions[:, few])
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
