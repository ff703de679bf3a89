"""Linear operators and their adjoints: sensitivities, registration of the systematic residual, filters."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from pdvc.geometry import ConeBeam
from pdvc.projection import Sensitivities, normal_equations, project, sensitivities
from pdvc.radiographs import binned, coarsened, smoothed
from pdvc.rays import ray_vectors
from pdvc.reconstruction import _filtered, _ramp
from pdvc.sections import CONTRACTION, RIGID, SectionBasis, names_of
from pdvc.sensitivity_sums import overlaid, spread
from pdvc.systematic import Systematic
from tests.laws import law
from tests.operators import dottest
from tests.small_case import (
    SCANNER,
    VOXEL_MM,
    blob,
    blob_gradients,
    motion,
    pixel_directions,
    rays_at,
    textured,
)
from validation.testing.strategies import cone_beams, section_bases

STEEP = ConeBeam(
    source_axis_mm=3.0,
    source_detector_mm=9.0,
    pixel_mm=0.15,
    rows=46,
    columns=38,
    column_shift_mm=0.1,
    row_shift_mm=-0.06,
    roll_rad=0.05,
)
"""Rays climb by up to 40 % of their way: they cross several sections."""
STEEP_SHAPE = (STEEP.rows, STEEP.columns)
CLOSE = SectionBasis(height_mm=np.array([-0.8, -0.3, 0.1, 0.5, 0.9]), radius_mm=0.5, motions=(*RIGID, CONTRACTION))
"""Sections as near to each other as the sample is thick."""
TURNED = motion(CLOSE, seed=1, size=0.5)
TURNED[:, names_of(RIGID).index("rotation_z")] = [3.0, -3.0, 2.0, -3.0, 3.0]
"""Neighbouring sections turned by 0.5 to 0.6 rad against each other."""
TURNED_AS_ONE = np.tile([1.0, -0.4, 0.6, 0.5, -0.3, 3.0, 0.0], (len(CLOSE.height_mm), 1))


def dense(field: Sensitivities, unknowns: int) -> np.ndarray:
    """Return S (row, column, unknown) in full."""
    rows, columns, width = field.values.shape
    whole = np.zeros((rows, columns, unknowns + width))
    for row, first in enumerate(field.first):
        at = first * field.motions
        whole[row, :, at : at + width] = field.values[row]
    return whole[..., :unknowns]


# The projection and its sensitivities


@pytest.mark.parametrize("angle", [0.3, 1.2])
def test_sensitivities_of_a_blob_converge_to_the_integrals_of_its_gradient_at_steep_rays(angle):
    """Eq. 10 by quadrature of the closed form.

    Where a ray crosses a section, the weight of what is integrated by parts jumps: the order is less than two there.
    """
    rays = rays_at(angle, STEEP)
    along = np.linspace(-1.6, 1.6, 201)
    middle = rays[0] + STEEP.source_axis_mm * pixel_directions(rays, STEEP_SHAPE)[::3, ::3, None]
    points = middle + along[:, None] * pixel_directions(rays, STEEP_SHAPE)[::3, ::3, None]
    shapes = CLOSE.shapes(points.reshape(-1, 3)).reshape(*points.shape, -1)
    slopes = np.einsum("rcla,rclan->rcln", blob_gradients(points), shapes)
    exact = np.trapezoid(slopes, along, axis=2) * VOXEL_MM
    size = np.sqrt((exact**2).sum(axis=(0, 1)))
    errors = []
    for voxel_mm in (0.03, 0.015):
        field = sensitivities(
            blob(voxel_mm), rays[None], STEEP_SHAPE, CLOSE, np.zeros((1, *CLOSE.shape)), voxel_mm=VOXEL_MM
        )[0]
        found = dense(field, size.size)[::3, ::3]
        errors.append(np.sqrt(((found - exact) ** 2).sum(axis=(0, 1))) / size)
    # of each motion of each section by itself: contraction shows least, and most of a wrong term by parts
    assert errors[0].max() < 0.1
    assert errors[1].max() < 0.04
    assert errors[1].mean() < 0.5 * errors[0].mean()


@pytest.mark.parametrize("name", names_of((*RIGID, CONTRACTION)))
@pytest.mark.parametrize(
    ("scanner", "angle", "now", "rtol"),
    [
        (STEEP, 2.1, 0 * TURNED, 8e-3),
        (STEEP, 0.3, TURNED_AS_ONE, 8e-3),
        (SCANNER, 0.3, TURNED, 8e-3),
        # one derivative is taken by parts along a ray that the motion bends as if it were straight
        (STEEP, 0.3, 0.25 * TURNED, 3e-2),
    ],
    ids=["steep", "steep, turned as one", "turned against each other", "steep and turned"],
)
def test_c_is_the_adjoint_of_the_projection_s_slope(name, scanner, angle, now, rtol):
    """dP = -S da by central differences, and c = S^T rho, one kind of motion at a time.

    The slope of a sum over planes is known to some parts in a thousand, as edges pass from plane to plane.
    """
    rays, k, volume = rays_at(angle, scanner)[None], CLOSE.names.index(name), textured(3.0)
    shape = (scanner.rows, scanner.columns)

    def moved(change: np.ndarray) -> np.ndarray:
        amplitude = now[None].copy()
        amplitude[0, :, k] += change
        return project(volume, rays, shape, CLOSE, amplitude, voxel_mm=VOXEL_MM)[0].astype(float)

    def forward(change: np.ndarray) -> np.ndarray:
        small = 0.02 / np.abs(change).max()
        return (moved(-small * change) - moved(small * change)) / (2 * small)

    def adjoint(residual: np.ndarray) -> np.ndarray:
        target = (moved(np.zeros(CLOSE.shape[0])) - residual)[None].astype(np.float32)
        even = np.ones_like(target)
        vector = normal_equations(volume, rays, CLOSE, now[None], target, even, voxel_mm=VOXEL_MM).vector
        return vector.reshape(CLOSE.shape)[:, k]

    dottest(forward, adjoint, (CLOSE.shape[0],), shape, rtol=rtol)


@law(8)
@given(cone_beams(), st.floats(-3.0, 3.0), st.integers(0, 99), st.floats(0.0, 3.0))
def test_s_and_its_transpose_in_c_and_b_are_one_operator(scanner, angle, seed, turned):
    """On whatever scanner: `sensitivities` gives S, `normal_equations` S^T W rho and S^T W S."""
    shape, volume = (scanner.rows, scanner.columns), textured()
    radius = scanner.columns / 4 * scanner.voxel_mm
    heights = np.linspace(-0.45, 0.45, 4) * scanner.rows * scanner.voxel_mm
    basis = SectionBasis(height_mm=heights, radius_mm=radius, motions=(*RIGID, CONTRACTION))
    rays, amplitude = ray_vectors(scanner, angle).stacked(), motion(basis, seed)[None]
    amplitude[0, :, names_of(RIGID).index("rotation_z")] += turned * np.array([1, -1, 1, -1])
    weight = np.random.default_rng(seed).uniform(0.0, 2.0, (1, *shape)).astype(np.float32)
    unknowns = basis.shape[0] * basis.shape[1]
    s = dense(sensitivities(volume, rays, shape, basis, amplitude, voxel_mm=VOXEL_MM)[0], unknowns)
    model = project(volume, rays, shape, basis, amplitude, voxel_mm=VOXEL_MM)

    def equations(residual: np.ndarray) -> Any:
        target = (model - residual).astype(np.float32)
        return normal_equations(volume, rays, basis, amplitude, target, weight, voxel_mm=VOXEL_MM)

    def forward(change: np.ndarray) -> np.ndarray:
        return weight[0] * (s @ change)

    dottest(forward, lambda residual: equations(residual).vector[0], (unknowns,), shape, rtol=1e-4)
    matrix = equations(np.zeros(shape)).matrix[0]
    expected = np.einsum("rcm,rc,rcn->mn", s, weight[0], s)
    np.testing.assert_allclose(matrix, expected, atol=1e-5 * np.abs(expected).max())


# Displacements


@law(20)
@given(section_bases(motions=(*RIGID, CONTRACTION)), st.integers(0, 99))
def test_shapes_are_the_adjoint_of_the_displacement(basis, seed):
    low, high = basis.height_mm[[0, -1]]
    points = np.random.default_rng(seed).uniform(-1, 1, (40, 3)) * [2, 3, high - low + 1] + [0, 0, (low + high) / 2]
    dottest(
        lambda amplitude: basis.displacement(amplitude, points),
        lambda moved: np.einsum("pajk,pa->jk", basis.shapes(points), moved),
        basis.shape,
        (40, 3),
        seed=seed,
        rtol=1e-12,
    )


# Registration of the systematic residual


@law(25)
@given(
    st.sampled_from((SCANNER, STEEP)),
    st.floats(-3.0, 3.0),
    st.integers(0, 99),
    st.floats(0.0, 9.0),
    st.floats(-3.0, 3.0),
)
def test_spreading_is_the_adjoint_of_registration(scanner, angle, seed, size, beside):
    """Between two views, sections turned strongly, and, with large motions, from off the detector."""
    whole, corner = (scanner.rows, scanner.columns), (3, 5)
    used = scanner.cropped(3, scanner.rows - 4, 5, scanner.columns - 2)
    window = (used.rows, used.columns)
    rays, amplitude = ray_vectors(used, angle).stacked(), (TURNED + motion(CLOSE, seed, size))[None]

    def systematic(fields: np.ndarray) -> Systematic:
        return Systematic(
            left=lambda view: fields[view].astype(np.float32),
            view_rad=np.array([0.0, 2.0]),
            step_rad=np.array([beside]),
            corner=corner,
            shape=window,
            detector=whole,
            width_rad=0.7,
        )

    def forward(fields: np.ndarray) -> np.ndarray:
        return systematic(fields).registered(slice(0, 1), rays, CLOSE, amplitude, VOXEL_MM)[0]

    def adjoint(image: np.ndarray) -> np.ndarray:
        still = systematic(np.zeros((2, *whole)))
        places = still.places(0, rays[0], CLOSE, amplitude[0], VOXEL_MM)
        share = still.looked_along(slice(0, 1), rays, CLOSE, amplitude, VOXEL_MM).of_step(0)
        field = Sensitivities(
            values=image[..., None].astype(np.float32), first=np.zeros(window[0], dtype=np.int64), motions=1
        )
        moved = dense(spread(field, places, whole), 1)[..., 0]
        return np.stack([share.get(view, 0.0) * moved for view in (0, 1)])

    dottest(forward, adjoint, (2, *whole), window, seed=seed)


@law(25)
@given(st.integers(0, 10**6), st.floats(0.0, 3.0))
def test_fields_whose_rows_meet_different_sections_are_spread_section_by_section(seed, size):
    """Each section's part of a field goes where a field of that section alone goes."""
    rng, window, whole = np.random.default_rng(seed), (9, 7), (14, 12)
    places = np.ones((*window, 3))
    places[..., :2] = np.stack(np.indices(window) + 2.0, axis=-1) + size * rng.normal(size=(*window, 2))
    field = Sensitivities(
        values=rng.normal(size=(*window, 4)).astype(np.float32), first=rng.integers(0, 4, window[0]), motions=2
    )
    together = spread(field, places, whole)
    assert (together.first >= 0).all()
    parts = dense(field, 10)
    for k in range(10):
        one = replace(field, values=parts[..., k : k + 1].astype(np.float32), first=0 * field.first, motions=1)
        expected = dense(spread(one, places, whole), 1)[..., 0]
        np.testing.assert_allclose(dense(together, 10)[..., k], expected, atol=1e-5)
    with ThreadPoolExecutor(2) as pool:
        halves = spread(field, places, whole, pool)
    np.testing.assert_allclose(halves.values, together.values, atol=1e-5)


@law(25)
@given(st.integers(1, 12), st.integers(-6, 6), st.integers(0, 10**6))
def test_fields_laid_over_each_other_take_room_for_the_sections_that_rows_meet_and_no_more(rise, moved, seed):
    """A field spread some rows away leaves rows to the other one alone, far up the sample."""
    rng, window, whole, corner = np.random.default_rng(seed), (24, 3), (60, 6), (18, 1)
    field = Sensitivities(
        values=rng.normal(size=(*window, 6)).astype(np.float32), first=100 + np.arange(24) // rise, motions=2
    )
    places = np.ones((*window, 3))
    places[..., :2] = np.stack(np.indices(window), axis=-1) + np.array(corner) + [moved + 0.3, 0.5]
    elsewhere = spread(field, places, whole)
    even = np.ones(whole, dtype=np.float32)
    fields = [(elsewhere, even, (0, 0)), (field, even[:24, :3], corner)]
    together = overlaid(fields, whole)
    with ThreadPoolExecutor(2) as pool:
        np.testing.assert_array_equal(overlaid(fields, whole, pool).values, together.values)
    # three sections a row, those of rows taken from, and of rows as far as the field was moved
    assert together.values.shape[2] // 2 <= 3 + 2 + (4 + abs(moved)) // rise
    expected = dense(elsewhere, 300)
    expected[18:42, 1:4] += dense(field, 300)
    np.testing.assert_allclose(dense(together, 300), expected, atol=1e-6)


# Filters


def in_air(image: np.ndarray, margin: int) -> np.ndarray:
    """Return the image with a border of zeros: at the edge of the detector filters repeat the outermost pixel."""
    return np.pad(image, margin)


@law(20)
@given(st.floats(0.1, 3.0), st.integers(5, 12), st.integers(5, 12), st.integers(0, 99))
def test_the_filter_of_radiographs_is_its_own_adjoint(smooth_px, rows, columns, seed):
    margin = int(4 * smooth_px) + 1
    shape = (rows + 2 * margin, columns + 2 * margin)

    def forward(image: np.ndarray) -> np.ndarray:
        return smoothed(in_air(image, margin), smooth_px)

    def adjoint(image: np.ndarray) -> np.ndarray:
        return smoothed(in_air(image, margin), smooth_px)[2 * margin : -2 * margin, 2 * margin : -2 * margin]

    dottest(forward, adjoint, (rows, columns), shape, seed=seed, rtol=1e-12)


@law(20)
@given(st.integers(1, 4), st.integers(2, 6), st.integers(2, 6), st.integers(0, 99))
def test_the_adjoint_of_binning_shares_a_coarse_pixel_out_and_that_of_coarsening_filters_it_then(
    factor, rows, columns, seed
):
    shape = (rows * factor, columns * factor)

    def shared(image: np.ndarray) -> np.ndarray:
        return np.kron(image, np.ones((factor, factor))) / factor**2

    dottest(lambda image: binned(image, factor), shared, shape, (rows, columns), seed=seed)
    blocks = 1 + int(np.ceil(1.5 * factor / factor))  # of air, as wide as the filter reaches
    whole = (rows + 2 * blocks, columns + 2 * blocks)

    def forward(image: np.ndarray) -> np.ndarray:
        return coarsened(in_air(image, blocks * factor), factor)

    def adjoint(image: np.ndarray) -> np.ndarray:
        fine = shared(image)
        if factor > 1:
            fine = ndimage.gaussian_filter(np.pad(fine, 2 * factor), factor / 2, truncate=3)
            fine = fine[2 * factor : -2 * factor, 2 * factor : -2 * factor]
        return fine[blocks * factor : -blocks * factor, blocks * factor : -blocks * factor]

    dottest(forward, adjoint, shape, whole, seed=seed)


@law(10)
@given(cone_beams(), st.integers(0, 99))
def test_the_ramp_filter_is_its_own_adjoint_and_takes_nothing_away_but_the_mean(scanner, seed):
    """The band-limited ramp is even, and positive but at frequency zero: <p, h * p> > 0."""
    ramp, shape = _ramp(scanner), (3, scanner.columns)

    def filtered(rows: np.ndarray) -> np.ndarray:
        return _filtered(rows.astype(np.float32), ramp)

    dottest(filtered, filtered, shape, shape, seed=seed)
    rows = np.random.default_rng(seed).normal(size=shape)
    assert (rows * filtered(rows)).sum() > 0
