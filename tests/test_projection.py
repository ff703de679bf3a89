"""The kernels against closed forms, finite differences, and a projector written anew in numpy."""

from dataclasses import replace
from itertools import pairwise

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from pdvc import projection
from pdvc.geometry import ConeBeam
from pdvc.projection import StepEquations
from pdvc.rays import ray_vectors
from pdvc.sections import CONTRACTION, RIGID, SectionBasis, names_of
from pdvc.volume import Grid, Volume
from tests.laws import law
from tests.small_case import (
    ONE,
    SCANNER,
    SECTIONS,
    SHAPE,
    VOXEL_MM,
    blob,
    blob_integrals,
    motion,
    plane_sums,
    rays_at,
    stored,
    textured,
    volume_of,
)

BLANK = np.zeros(SHAPE, dtype=np.float32)
EVEN = np.ones(SHAPE, dtype=np.float32)


def project(volume, rays, shape, basis, amplitude, *, voxel_mm):
    """Return the radiograph (row, column) of a single step."""
    return projection.project(volume, rays[None], shape, basis, amplitude[None], voxel_mm=voxel_mm)[0]


def normal_equations(volume, rays, basis, amplitude, target, weight, *, voxel_mm):
    """Return the equations of a single step."""
    found = projection.normal_equations(
        volume, rays[None], basis, amplitude[None], target[None], weight[None], voxel_mm=voxel_mm
    )
    return StepEquations(
        matrix=found.matrix[0],
        vector=found.vector[0],
        chi2=found.chi2[0],
        residual=found.residual[0],
        blocks=found.blocks,
    )


def still(basis=ONE):
    return np.zeros(basis.shape)


@pytest.mark.parametrize("angle", [0.0, 0.8, 4.0])
def test_line_integrals_converge_to_the_closed_form_with_the_square_of_the_voxel(angle):
    rays = rays_at(angle)
    exact = blob_integrals(rays, SHAPE)
    sizes = (0.06, 0.03, 0.015)
    errors = [
        np.sqrt(np.mean((project(blob(h), rays, SHAPE, ONE, still(), voxel_mm=VOXEL_MM) - exact) ** 2)) / exact.max()
        for h in sizes
    ]
    rates = -np.diff(np.log2(errors))
    np.testing.assert_allclose(rates, 2, atol=0.15)
    assert errors[-1] < 3e-4


@pytest.mark.parametrize("angle", [0.0, np.pi / 2])
def test_rays_exactly_along_an_axis_see_what_their_neighbours_see(angle):
    """The middle row and column of a detector of odd size, without shift and roll: no component across is left."""
    scanner = ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=45, columns=37)
    shape = (scanner.rows, scanner.columns)
    rays = rays_at(angle, scanner)
    along, beside = (
        project(textured(), rays_at(each, scanner), shape, ONE, still(), voxel_mm=VOXEL_MM)
        for each in (angle, angle + 1e-7)
    )
    across = rays[1] + 22 * rays[2] + 18 * rays[3] - rays[0]
    assert (np.abs(across) < 1e-12).sum() >= 1
    assert along[22, 18] > 0.1 * along.max()
    np.testing.assert_allclose(along, beside, atol=1e-4 * along.max())


def test_a_translated_blob_is_where_the_translation_takes_it():
    rays = rays_at(1.3)
    amplitude = still()
    amplitude[0, :3] = [2.3, -1.7, 3.1]
    moved = project(blob(0.025), rays, SHAPE, ONE, amplitude, voxel_mm=VOXEL_MM)
    exact = blob_integrals(rays, SHAPE, VOXEL_MM * amplitude[0, :3])
    # the same error as that of the still blob: 0.05 voxel more would double it
    assert np.sqrt(np.mean((moved - exact) ** 2)) < 7e-4 * exact.max()


@pytest.mark.parametrize("basis", [ONE, SECTIONS], ids=["one", "sections"])
def test_the_projection_is_the_residual_against_a_blank_radiograph(basis):
    rays, amplitude = rays_at(2.0), motion(basis)
    alone = project(textured(), rays, SHAPE, basis, amplitude, voxel_mm=VOXEL_MM)
    whole = normal_equations(textured(), rays, basis, amplitude, BLANK, EVEN, voxel_mm=VOXEL_MM)
    np.testing.assert_allclose(alone, whole.residual, atol=2e-6 * alone.max())
    assert whole.chi2 == pytest.approx((alone.astype(float) ** 2).sum(), rel=1e-6)


WITH_CONTRACTION = SectionBasis(
    height_mm=SECTIONS.height_mm, radius_mm=SECTIONS.radius_mm, motions=(*RIGID, CONTRACTION)
)


COARSE = SCANNER.binned(2)
COARSE_SHAPE = (COARSE.rows, COARSE.columns)


def scaled(matrix, scale):
    return matrix / np.outer(scale, scale)


@pytest.mark.parametrize(
    ("basis", "angle"),
    [(ONE, 0.0), (ONE, 0.7), (SECTIONS, 0.0), (SECTIONS, 2.5), (WITH_CONTRACTION, 5.0)],
    ids=["one, 0", "one, 0.7", "sections, 0", "sections, 2.5", "contraction, 5"],
)
def test_normal_equations_agree_with_stored_sensitivities(basis, angle):
    rays, amplitude = rays_at(angle, COARSE), motion(basis, seed=3, size=0.5)
    rng = np.random.default_rng(4)
    target = rng.normal(size=COARSE_SHAPE).astype(np.float32)
    weight = rng.uniform(0, 2, size=COARSE_SHAPE).astype(np.float32)
    found = normal_equations(textured(), rays, basis, amplitude, target, weight, voxel_mm=VOXEL_MM)
    value, s = stored(textured(), rays, COARSE_SHAPE, basis, amplitude, VOXEL_MM)
    rho, w = value - target.ravel(), weight.ravel()
    np.testing.assert_allclose(found.residual.ravel(), rho, atol=1e-5 * value.max())
    assert found.chi2 == pytest.approx((w * rho**2).sum(), rel=1e-5)
    expected = s.T @ (w[:, None] * s)
    # motion along the beam hardly shows: it is compared on a tenth of the best seen one's scale
    scale = np.maximum(np.sqrt(np.diag(expected)), 0.1 * np.sqrt(np.diag(expected).max()))
    np.testing.assert_allclose(scaled(found.matrix, scale), scaled(expected, scale), atol=2e-2)
    np.testing.assert_allclose(found.vector / scale, s.T @ (w * rho) / scale, atol=5e-3 * np.sqrt((w * rho**2).sum()))


def test_rays_at_45_degrees_have_no_seam_between_sections_turned_against_each_other():
    """There a ray follows x and y alike, and its parts in two sections must be summed over the same planes."""
    amplitude = still(SECTIONS)
    amplitude[:, names_of(RIGID).index("rotation_z")] = [0.3, -0.3, 0.3, -0.3]
    rays = rays_at(np.pi / 4)
    found = project(textured(), rays, SHAPE, SECTIONS, amplitude, voxel_mm=VOXEL_MM)
    expected = plane_sums(textured(), rays, SHAPE, SECTIONS, amplitude, VOXEL_MM)
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-4 * expected.max())


def test_amplitudes_are_counted_in_the_voxel_that_is_named_whatever_the_volume_s():
    rays, amplitude = rays_at(1.0), motion(SECTIONS)
    fine = normal_equations(textured(), rays, SECTIONS, amplitude, BLANK, EVEN, voxel_mm=VOXEL_MM)
    half = normal_equations(textured(), rays, SECTIONS, 2 * amplitude, BLANK, EVEN, voxel_mm=VOXEL_MM / 2)
    np.testing.assert_array_equal(half.residual, fine.residual)
    np.testing.assert_allclose(half.vector, fine.vector / 2, rtol=1e-9)
    np.testing.assert_allclose(half.matrix, fine.matrix / 4, rtol=1e-9, atol=1e-12)


def smooth(seed):
    field = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=SHAPE), 3)
    return (field / field.std()).astype(np.float32)


CASES = [
    *[(ONE, 0, k) for k in range(6)],
    *[(SECTIONS, j, k) for j, k in ((0, 0), (0, 4), (1, 2), (1, 5), (2, 1), (2, 3), (3, 2), (3, 4))],
    *[(WITH_CONTRACTION, j, 6) for j in (1, 2)],
]


@pytest.mark.parametrize(("basis", "section", "kind"), CASES)
def test_sensitivities_are_the_slope_of_the_projection(basis, section, kind):
    """c = S^T rho with rho given, against central differences: S = -dP/da."""
    rays, amplitude, rho = rays_at(0.9), motion(basis, seed=5), smooth(6)

    def projected(change):
        trial = amplitude.copy()
        trial[section, kind] += change
        return project(textured(3.0), rays, SHAPE, basis, trial, voxel_mm=VOXEL_MM)

    target = projected(0) - rho
    found = normal_equations(textured(3.0), rays, basis, amplitude, target, EVEN, voxel_mm=VOXEL_MM)
    change = 0.02
    slope = (projected(-change).astype(float) - projected(change)) / (2 * change)
    expected = (slope * rho).sum()
    norm = np.sqrt((slope**2).sum() * (rho.astype(float) ** 2).sum())
    at = section * basis.shape[1] + kind
    assert found.vector[at] == pytest.approx(expected, abs=3e-3 * norm)
    assert np.sqrt(found.matrix[at, at]) == pytest.approx(np.sqrt((slope**2).sum()), rel=1e-2)


@law(15)
@given(st.tuples(*[st.integers(-3, 3)] * 3), st.floats(-3, 3))
def test_a_translation_by_whole_voxels_is_the_volume_shifted(shift, angle):
    values = np.pad(textured().values, 4)
    moved = np.roll(values, shift, axis=(2, 1, 0))
    amplitude = still(SECTIONS)
    amplitude[:, :3] = shift
    rays = rays_at(angle)
    warped = project(volume_of(values), rays, SHAPE, SECTIONS, amplitude, voxel_mm=VOXEL_MM)
    shifted = project(volume_of(moved), rays, SHAPE, SECTIONS, still(SECTIONS), voxel_mm=VOXEL_MM)
    np.testing.assert_allclose(warped, shifted, atol=2e-6 * shifted.max())


@law(15)
@given(st.integers(1, 6), st.integers(0, 1000), st.floats(-3, 3))
def test_the_number_of_sections_does_not_change_the_same_rigid_motion(sections, seed, angle):
    basis = SectionBasis(height_mm=np.linspace(-1.1, 1.2, sections), radius_mm=0.3)
    amplitude = motion(ONE, seed)
    one = project(textured(), rays_at(angle), SHAPE, ONE, amplitude, voxel_mm=VOXEL_MM)
    many = project(textured(), rays_at(angle), SHAPE, basis, basis.reproduced(amplitude, ONE), voxel_mm=VOXEL_MM)
    np.testing.assert_allclose(many, one, atol=2e-5 * one.max())


def test_a_pixel_of_no_weight_counts_for_nothing():
    rays, amplitude, target = rays_at(0.2), motion(SECTIONS), smooth(1)
    weight = (smooth(2) > 0).astype(np.float32)
    other = np.where(weight > 0, target, 1e3 * smooth(3)).astype(np.float32)
    one, two = (
        normal_equations(textured(), rays, SECTIONS, amplitude, g, weight, voxel_mm=VOXEL_MM) for g in (target, other)
    )
    np.testing.assert_array_equal(one.matrix, two.matrix)
    np.testing.assert_array_equal(one.vector, two.vector)
    assert one.chi2 == two.chi2
    assert (one.residual != two.residual).any()


def test_a_nan_in_a_pixel_of_no_weight_counts_for_nothing():
    rays, target, weight = rays_at(0.2), smooth(1), EVEN.copy()
    weight[3, 4] = 0
    whole = normal_equations(textured(), rays, SECTIONS, still(SECTIONS), target, weight, voxel_mm=VOXEL_MM)
    target[3, 4] = np.nan
    holed = normal_equations(textured(), rays, SECTIONS, still(SECTIONS), target, weight, voxel_mm=VOXEL_MM)
    np.testing.assert_array_equal(holed.matrix, whole.matrix)
    np.testing.assert_array_equal(holed.vector, whole.vector)
    assert holed.chi2 == whole.chi2


def test_a_window_without_any_weight_gives_empty_equations():
    found = normal_equations(textured(), rays_at(0.2), SECTIONS, still(SECTIONS), BLANK, BLANK, voxel_mm=VOXEL_MM)
    assert not found.matrix.any()
    assert not found.vector.any()
    assert found.chi2 == 0


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_one_and_two_threads_give_the_same_bits():
    results = []
    before = numba.get_num_threads()
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            results.append(
                normal_equations(
                    textured(), rays_at(0.7), SECTIONS, motion(SECTIONS), smooth(1), EVEN, voxel_mm=VOXEL_MM
                )
            )
    finally:
        numba.set_num_threads(before)
    one, two = results
    np.testing.assert_array_equal(one.matrix, two.matrix)
    np.testing.assert_array_equal(one.vector, two.vector)
    np.testing.assert_array_equal(one.residual, two.residual)
    assert one.chi2 == two.chi2


@pytest.mark.parametrize("one_weight_for_all", [True, False])
def test_steps_together_are_those_one_by_one_to_the_last_bit(one_weight_for_all):
    """Moved far and little, so that bands of rows touch more sections in one step than in the other."""
    rays = ray_vectors(SCANNER, np.array([0.1, 0.8, 2.9])).stacked()
    amplitude = np.stack([motion(SECTIONS, seed=step, size=6.0 * step) for step in range(3)])
    target = np.stack([smooth(step) for step in range(3)])
    weight = np.abs(np.stack([smooth(9 + step) for step in range(1 if one_weight_for_all else 3)]))
    together = projection.normal_equations(textured(), rays, SECTIONS, amplitude, target, weight, voxel_mm=VOXEL_MM)
    alone = projection.project(textured(), rays, SHAPE, SECTIONS, amplitude, voxel_mm=VOXEL_MM)
    for t in range(3):
        w = weight[t % len(weight)]
        one = normal_equations(textured(), rays[t], SECTIONS, amplitude[t], target[t], w, voxel_mm=VOXEL_MM)
        for name in ("matrix", "vector", "chi2", "residual"):
            np.testing.assert_array_equal(getattr(together, name)[t], getattr(one, name), err_msg=name)
        one = project(textured(), rays[t], SHAPE, SECTIONS, amplitude[t], voxel_mm=VOXEL_MM)
        np.testing.assert_array_equal(alone[t], one)


@pytest.mark.parametrize("kind", ["translation_x", "translation_y", "translation_z"])
def test_a_sample_moved_out_of_sight_leaves_air(kind):
    amplitude = still(SECTIONS)
    amplitude[:, names_of(RIGID).index(kind)] = 300
    # along the beam, 15 mm stay on the screen: then look across
    rays = rays_at(np.pi / 2 if kind == "translation_x" else 0.0)
    found = normal_equations(textured(), rays, SECTIONS, amplitude, BLANK, EVEN, voxel_mm=VOXEL_MM)
    assert not found.residual.any()
    assert not found.matrix.any()


def test_a_sample_of_which_half_has_left_the_window_is_still_projected_rightly():
    amplitude = motion(SECTIONS)
    amplitude[:, 2] += 25
    rays = rays_at(0.3)
    found = project(textured(), rays, SHAPE, SECTIONS, amplitude, voxel_mm=VOXEL_MM)
    expected = plane_sums(textured(), rays, SHAPE, SECTIONS, amplitude, VOXEL_MM)
    assert (expected == 0).mean() > 0.4
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-5 * expected.max())


def test_a_long_window_is_the_sum_of_its_parts():
    """Bands of rows see other sections; their equations add up wherever the cuts lie."""
    amplitude, target = motion(SECTIONS), smooth(8)
    cuts = [0, 5, 22, 39, SCANNER.rows]
    whole = normal_equations(textured(), rays_at(1.1), SECTIONS, amplitude, target, EVEN, voxel_mm=VOXEL_MM)
    parts = [
        normal_equations(
            textured(),
            rays_at(1.1, SCANNER.cropped(first, last, 0, SCANNER.columns)),
            SECTIONS,
            amplitude,
            target[first:last],
            EVEN[first:last],
            voxel_mm=VOXEL_MM,
        )
        for first, last in pairwise(cuts)
    ]
    np.testing.assert_allclose(np.concatenate([part.residual for part in parts]), whole.residual, atol=1e-5)
    np.testing.assert_allclose(sum(part.matrix for part in parts), whole.matrix, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("band", "block"), [(0, 0), (1, 1), (2, 2)])
def test_the_right_hand_side_of_a_block_is_that_of_its_pixels_alone(band, block):
    """Blocks of 16 x 16 pixels; those at the edges are smaller, and together they make the whole."""
    volume, rays, amplitude = textured(), rays_at(0.8), motion(SECTIONS, 3)
    unknowns = SECTIONS.shape[0] * SECTIONS.shape[1]
    whole = normal_equations(volume, rays, SECTIONS, amplitude, BLANK, EVEN, voxel_mm=VOXEL_MM)
    only = np.zeros_like(EVEN)
    here = (slice(16 * band, 16 * band + 16), slice(16 * block, 16 * block + 16))
    only[here] = 1
    alone = normal_equations(volume, rays, SECTIONS, amplitude, BLANK, only, voxel_mm=VOXEL_MM)
    found = np.zeros(2 * unknowns)
    each = whole.blocks[0]
    found[each.first[band] : each.first[band] + each.values.shape[2]] = each.values[band, block]
    np.testing.assert_allclose(found[:unknowns], alone.vector, atol=1e-9 * np.abs(whole.vector).max())
    assert not found[unknowns:].any()


def test_a_wide_window_is_the_sum_of_its_columns():
    """The rays of a row rise differently in a wide fan: its middle reaches sections that its ends do not."""
    scanner = ConeBeam(source_axis_mm=20.0, source_detector_mm=40.0, pixel_mm=0.8, rows=45, columns=41)
    values = np.zeros((170, 12, 14), dtype=np.float32)
    values[6:-6, 2:-2, 2:-2] = 1 + 0.2 * np.random.default_rng(0).random((158, 8, 10))
    volume = volume_of(values, 0.1)
    basis = SectionBasis(height_mm=np.linspace(-8, 8, 80), radius_mm=0.5)

    def matrix(first, last):
        rays = rays_at(0.3, scanner.cropped(0, scanner.rows, first, last))
        blank = np.zeros((scanner.rows, last - first), dtype=np.float32)
        even = np.ones_like(blank)
        return normal_equations(volume, rays, basis, still(basis), blank, even, voxel_mm=0.1).matrix

    columns = sum(matrix(column, column + 1) for column in range(scanner.columns))
    np.testing.assert_allclose(matrix(0, scanner.columns), columns, atol=1e-4 * np.diag(columns).max())


@pytest.mark.parametrize("moved_voxel", [0.0, 1.0])
@pytest.mark.parametrize("angle", [0.2, 1.9])
def test_a_uniform_bar_cut_in_height_inside_its_hull_feels_no_vertical_motion(angle, moved_voxel):
    """The step from the sample to the volume's empty outermost layer is where the scan ends, and no texture."""
    whole = textured().values.copy()
    whole[1:-1] = whole[len(whole) // 2]
    endless = volume_of(whole)
    values = whole[14:50].copy()
    values[[0, -1]] = 0
    x, y, z = endless.grid.origin_mm
    grid = Grid(shape=values.shape, voxel_mm=VOXEL_MM, origin_mm=(x, y, z + 14 * VOXEL_MM))
    cut = Volume(values=values, grid=grid, hull=endless.hull)
    basis = SectionBasis(height_mm=np.array([0.0]), radius_mm=0.5, motions=RIGID[:3])
    found = normal_equations(
        cut, rays_at(angle), basis, np.array([[0.0, 0.0, moved_voxel]]), BLANK, EVEN, voxel_mm=VOXEL_MM
    )
    sensitivity = np.sqrt(np.diag(found.matrix))
    assert sensitivity[2] < 1e-5 * sensitivity[:2].max()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_amplitudes_that_are_no_numbers_are_refused(bad):
    amplitude = still(SECTIONS)
    amplitude[1, 1] = bad
    with pytest.raises(ValueError, match=r"amplitude: expected finite \(1, 4, 6\)"):
        project(textured(), rays_at(0.0), SHAPE, SECTIONS, amplitude, voxel_mm=VOXEL_MM)


def test_amplitudes_of_another_basis_are_refused():
    with pytest.raises(ValueError, match=r"amplitude: expected finite \(1, 4, 6\), got \(1, 1, 6\)"):
        project(textured(), rays_at(0.0), SHAPE, SECTIONS, still(ONE), voxel_mm=VOXEL_MM)


def test_a_volume_of_another_type_is_refused():
    with pytest.raises(ValueError, match="volume: expected float32"):
        replace(textured(), values=textured().values.astype(float))
