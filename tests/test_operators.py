"""Linear operators and their adjoints: sensitivities, registration of the systematic residual, filters."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
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
from pdvc.sensitivity_sums import BAND_ROWS, Rows, Spread, summed
from pdvc.systematic import Systematic, taps
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
    rows, width, columns = field.values.shape
    whole = np.zeros((rows, columns, unknowns + width))
    for row, first in enumerate(field.first):
        at = first * field.motions
        whole[row, :, at : at + width] = field.values[row].T
    return whole[..., :unknowns]


def joined(parts: list[Rows], unknowns: int) -> np.ndarray:
    """Return a field that is given band by band, (row, column, unknown) in full."""
    found = []
    for part in parts:
        rows, width, columns = part.values.shape
        whole = np.zeros((rows, columns, unknowns + width))
        whole[..., part.first : part.first + width] = part.values.transpose(0, 2, 1)
        found.append(whole[..., :unknowns])
    return np.concatenate(found)


def moved(spread: Spread, unknowns: int) -> np.ndarray:
    """Return Y (row, column, unknown) in full: one band is looked at before the next one takes its room."""
    return np.concatenate([joined([spread.moved(band)], unknowns) for band in spread.bands])


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
            values=image[:, None].astype(np.float32), first=np.zeros(window[0], dtype=np.int64), motions=1
        )
        found = moved(Spread(weighted=field, places=places, corner=(0, 0), shape=whole), 1)[..., 0]
        return np.stack([share.get(view, 0.0) * found for view in (0, 1)])

    dottest(forward, adjoint, (2, *whole), window, seed=seed)


@law(25)
@given(st.integers(0, 10**6), st.floats(0.0, 3.0))
def test_fields_whose_rows_meet_different_sections_are_spread_section_by_section(seed, size):
    """Each section's part of a field goes where a field of that section alone goes, by the taps told one by one."""
    rng, window, whole = np.random.default_rng(seed), (40, 7), (50, 12)
    places = np.ones((*window, 3))
    # mostly neighbours from neighbours, in part from anywhere, off the detector too
    places[..., :2] = np.stack(np.indices(window) + rng.uniform(-2, 6, 2)[:, None, None], axis=-1)
    places[..., :2] += size * rng.normal(size=(*window, 2)) * (rng.random(window) < 0.3)[..., None]
    places[..., 2] = rng.uniform(0.9, 1.1, window)
    field = Sensitivities(
        values=(rng.normal(size=(window[0], 4, window[1])) * (rng.random((window[0], 1, window[1])) < 0.9)).astype(
            "f4"
        ),
        first=rng.integers(0, 4, window[0]),
        motions=2,
    )
    parts, expected = dense(field, 10), np.zeros((*whole, 10))
    for row, column in np.ndindex(window):
        (r, c), longer = places[row, column, :2], places[row, column, 2]
        if not (-0.01 <= r <= whole[0] - 0.99 and -0.01 <= c <= whole[1] - 0.99):
            continue
        i, j = np.clip([int(r), int(c)], 0, [whole[0] - 2, whole[1] - 2])
        down, right = taps(np.array([r, c]), np.array([i, j])).T
        for m, n in np.ndindex(4, 4):
            to = np.clip(i - 1 + m, 0, whole[0] - 1), np.clip(j - 1 + n, 0, whole[1] - 1)
            expected[to] += longer * down[m] * right[n] * parts[row, column]
    together = Spread(weighted=field, places=places, corner=(5, 3), shape=whole)
    np.testing.assert_allclose(moved(together, 10), expected, atol=1e-5)
    view, image = rng.random(whole).astype("f4"), rng.random(window).astype("f4")
    expected *= view[..., None]
    expected[5:45, 3:10] -= image[..., None] * parts
    found = [joined([together.shared(b, together.moved(b), view, image)], 10) for b in together.bands]
    np.testing.assert_allclose(np.concatenate(found), expected, atol=1e-5)


@law(25)
@given(st.integers(1, 12), st.integers(-6, 6), st.integers(0, 10**6))
def test_a_band_takes_room_for_the_sections_that_its_rows_meet_and_no_more(rise, away, seed):
    """A field far up the sample, moved by some rows: bands beside it are empty, others hold a few sections."""
    rng, window, whole, corner = np.random.default_rng(seed), (24, 3), (90, 6), (18, 1)
    values = rng.normal(size=(window[0], 6, window[1])).astype(np.float32)
    field = Sensitivities(values=values, first=100 + np.arange(24) // rise, motions=2)
    places = np.ones((*window, 3))
    places[..., :2] = np.stack(np.indices(window), axis=-1) + np.array(corner) + [away + 0.3, 0.5]
    spread = Spread(weighted=field, places=places, corner=corner, shape=whole)
    even = np.ones(whole, dtype=np.float32)
    for band in spread.bands:
        part = spread.shared(band, spread.moved(band), even, even[:24, :3])
        # three sections a row, those of sixteen rows and of as many as the field was moved and is spread over
        assert part.values.shape[1] // 2 <= 3 + (BAND_ROWS + 4 + abs(away)) // rise + 1
    assert spread.moved(len(spread.bands) - 1).values.size == 0


@law(25)
@given(st.integers(0, 10**6), st.booleans())
def test_products_are_those_of_the_whole_detector(seed, in_halves):
    rng, window, whole = np.random.default_rng(seed), (30, 6), (40, 9)
    values = rng.normal(size=(window[0], 6, window[1])).astype(np.float32)
    field = Sensitivities(values=values, first=np.arange(30) // 8, motions=2)
    places = np.ones((*window, 3))
    places[..., :2] = np.stack(np.indices(window), axis=-1) + rng.uniform(0, 4, 2)
    spread = Spread(weighted=field, places=places, corner=(4, 2), shape=whole)
    variance, full = rng.random(whole).astype("f4"), moved(spread, 12)

    def add(band, found):
        part = spread.moved(band)
        part.add_product(part, variance[spread.rows(band)], found[0])

    with ThreadPoolExecutor(2) as pool:
        (found,) = summed(spread.bands, 12, add, pool=pool if in_halves else None)
    np.testing.assert_allclose(found, np.einsum("rcn,rc,rcm->nm", full, variance, full), rtol=1e-4, atol=1e-3)
    joint = np.zeros((12, 12))
    for band in spread.bands:
        spread.moved(band).add_product(spread.moved(band, "other"), variance[spread.rows(band)], joint)
    np.testing.assert_allclose(joint, found, rtol=1e-4, atol=1e-3)


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
