"""FDK of spheres, whose projections are known chords, and the laws of the views' shares."""

from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pdvc.geometry import ConeBeam
from pdvc.projection import project_at_rest
from pdvc.radiographs import sharpened
from pdvc.rays import ray_vectors
from pdvc.reconstruction import (
    LARGEST_GAP_RAD,
    _add_beside,
    _add_piece,
    angular_share,
    fdk,
    one_of,
    seen_half_height_mm,
)
from pdvc.volume import Grid, Volume, hull_of
from tests.laws import law

SCANNER = ConeBeam(source_axis_mm=40.0, source_detector_mm=400.0, pixel_mm=0.5, rows=44, columns=56)
ANGLES = np.linspace(0, 2 * np.pi, 180, endpoint=False)
RADIUS = 0.55
SUB = (np.arange(4) - 1.5) / 4


def sphere_views(geometry, centre_mm, angles=ANGLES, radius=RADIUS):
    """Return views (view, row, column) of a sphere of density 1 / mm: exact chords, averaged over each pixel."""
    vectors = ray_vectors(geometry, angles).stacked()[:, :, None, None, :]
    row, column = np.indices((geometry.rows, geometry.columns))[..., None]
    result = np.zeros((len(angles), geometry.rows, geometry.columns))
    for dr in SUB:
        for dc in SUB:
            d = vectors[:, 1] + (row + dr) * vectors[:, 2] + (column + dc) * vectors[:, 3] - vectors[:, 0]
            to = np.asarray(centre_mm) - vectors[:, 0]
            away2 = (np.cross(to, d) ** 2).sum(axis=-1) / (d**2).sum(axis=-1)
            result += 2 * np.sqrt(np.maximum(radius**2 - away2, 0)) / 16
    return result.astype(np.float32)


def grid_of(geometry, half_mm=(0.9, 0.75, 0.8)):
    return Grid.around(-np.array(half_mm), np.array(half_mm), geometry.voxel_mm)


def everywhere(grid):
    return hull_of(np.ones(grid.shape, dtype=bool), grid, 4)


def places(grid):
    """Return x, y, z of every voxel (z, y, x), mm."""
    axes = [o + grid.voxel_mm * np.arange(n) for o, n in zip(grid.origin_mm, grid.shape[::-1], strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack([x, y, z], axis=-1)


def reconstructed(geometry, centre_mm, angles=ANGLES, radius=RADIUS, grid=None):
    views = sphere_views(geometry, centre_mm, angles, radius)
    grid = grid or grid_of(geometry)
    return fdk(lambda i: views[i], geometry, angles, grid, everywhere(grid)), grid


CASES = {
    "centred": (SCANNER, (0.0, 0.0, 0.0)),
    "off the axis": (SCANNER, (0.25, -0.13, 0.1)),
    "shifted detector": (replace(SCANNER, column_shift_mm=1.3, row_shift_mm=-0.8), (0.05, 0.1, -0.05)),
    "rolled detector": (replace(SCANNER, roll_rad=0.06), (0.2, 0.1, 0.15)),
    "shifted and rolled": (replace(SCANNER, column_shift_mm=-0.9, row_shift_mm=0.6, roll_rad=-0.05), (0.1, -0.1, 0.0)),
    "strong cone": (replace(SCANNER, source_axis_mm=15.0, source_detector_mm=150.0), (0.1, 0.05, 0.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_a_sphere_comes_back_with_its_density_and_its_place(case):
    geometry, centre = CASES[case]
    values, grid = reconstructed(geometry, centre)
    away = np.linalg.norm(places(grid) - centre, axis=-1)
    assert values[away < 0.8 * RADIUS].mean() == pytest.approx(1, rel=0.01)
    near = away < RADIUS + 2 * grid.voxel_mm
    centroid = (values[near][:, None] * places(grid)[near]).sum(axis=0) / values[near].sum()
    np.testing.assert_allclose(centroid, centre, atol=0.05 * grid.voxel_mm)
    outside = (away > RADIUS + 3 * grid.voxel_mm) & (np.abs(places(grid)[..., 2]) < 0.6)
    assert abs(values[outside].mean()) < 0.01


def test_the_error_falls_with_finer_pixels():
    """Compare where the sphere is smooth: away from its edge, which every size blurs."""
    errors = []
    for factor in (1, 2, 4):
        geometry = replace(SCANNER, pixel_mm=2.0 / factor, rows=11 * factor, columns=14 * factor)
        values, grid = reconstructed(geometry, (0.1, 0.0, 0.0), radius=0.4)
        away = np.linalg.norm(places(grid) - [0.1, 0, 0], axis=-1)
        # each size must reach the density across a band of fixed width in mm
        errors.append(np.sqrt(np.mean((values - (away < 0.4))[away < 0.7] ** 2)))
    assert errors[0] > 1.3 * errors[1] > 1.69 * errors[2]


@pytest.mark.parametrize("between", [0.25, 0.5])
def test_sharpened_views_leave_less_when_the_volume_is_projected_again(between):
    """Grains of a few voxels: interpolation, on the way to the voxels and back, blurs them less then.

    The layers of voxels lie between rows, by a part of a pixel. In so flat a fan they do so for all the sample.
    """
    geometry, angles = replace(SCANNER, row_shift_mm=between * SCANNER.pixel_mm), ANGLES[::2]
    rng = np.random.default_rng(3)
    centres = rng.uniform([-0.45, -0.45, -0.4], [0.45, 0.45, 0.4], (25, 3))
    views = np.sum([sphere_views(geometry, centre, angles, radius=0.11) for centre in centres], axis=0)
    grid, some = grid_of(geometry), [3, 17, 40, 61]
    rays, shape = ray_vectors(geometry, angles[some]).stacked(), (geometry.rows, geometry.columns)

    def left(seen):
        values = fdk(seen, geometry, angles, grid, everywhere(grid))
        model = project_at_rest(Volume(values=values, grid=grid, hull=everywhere(grid)), rays, shape)
        return np.sqrt(((model - views[some])[:, 6:-6, 6:-6] ** 2).mean())

    plain, sharp = left(lambda i: views[i]), left(lambda i: sharpened(views[i]))
    assert sharp < 0.6 * plain


def test_nothing_is_reconstructed_outside_the_hull_nor_in_the_outermost_layer():
    grid = grid_of(SCANNER)
    views = sphere_views(SCANNER, (0, 0, 0))
    x, y, z = np.moveaxis(places(grid), -1, 0)
    inside = (x**2 / 0.5**2 + y**2 / 0.3**2 < 1) & (np.abs(z) < 0.4)
    values = fdk(lambda i: views[i], SCANNER, ANGLES, grid, hull_of(inside, grid, 4))
    half = grid.voxel_mm / 2
    beyond = (np.abs(x) > 0.5 + 2 * half) | (np.abs(y) > 0.3 + 2 * half) | (np.abs(z) > 0.4 + 4 * grid.voxel_mm)
    assert not values[beyond].any()
    whole = fdk(lambda i: views[i], SCANNER, ANGLES, grid, everywhere(grid))
    np.testing.assert_allclose(values[inside], whole[inside], atol=1e-4)
    for axis in range(3):
        assert not np.moveaxis(whole, axis, 0)[[0, -1]].any()


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="needs two threads")
def test_one_and_two_threads_give_the_same_bits():
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            results.append(reconstructed(SCANNER, (0.1, 0, 0), ANGLES[::6])[0])
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(*results)


def test_views_in_another_order_make_the_same_volume():
    order = np.random.default_rng(1).permutation(60)
    one, _ = reconstructed(SCANNER, (0.1, 0, 0), ANGLES[::3])
    two, _ = reconstructed(SCANNER, (0.1, 0, 0), ANGLES[::3][order])
    np.testing.assert_allclose(one, two, atol=1e-4)


FULL_TURN = st.integers(19, 60).flatmap(
    # every tenth of a turn's part is moved by less than a gap may allow
    lambda n: arrays(float, n, elements=st.floats(-0.02, 0.02)).map(
        lambda moved: np.linspace(0, 2 * np.pi, n, endpoint=False) + moved * 6 / n
    )
)


@law()
@given(FULL_TURN, st.floats(-10, 10))
def test_shares_add_up_to_half_a_turn_and_do_not_depend_on_the_start(angles, start):
    share = angular_share(angles)
    assert share.sum() == pytest.approx(np.pi)
    np.testing.assert_allclose(angular_share(angles + start), share, atol=1e-7)


def test_views_at_the_same_angle_share_its_part():
    once = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    share = angular_share(np.append(once, 2 * np.pi))  # a scan that ends where it began
    np.testing.assert_allclose(share[1:24], np.pi / 24)
    np.testing.assert_allclose(share[[0, 24]], np.pi / 48)


@pytest.mark.parametrize(
    ("angles", "gap"),
    [
        (np.linspace(0, np.pi, 100), "180.0"),
        (np.linspace(0, 2 * np.pi, 17, endpoint=False), "21.2"),
        (np.zeros(5), "360.0"),
    ],
)
def test_a_turn_with_gaps_is_refused_with_the_largest(angles, gap):
    with pytest.raises(ValueError, match=f"expected a full turn without gaps above 20 degrees, found one of {gap}"):
        angular_share(angles)


def test_every_view_sees_all_of_a_cylinder_of_the_seen_half_height():
    geometry = replace(SCANNER, row_shift_mm=0.7)
    half = seen_half_height_mm(geometry, 0.8)
    # the nearest point of the cylinder is magnified most; it must stay within the outermost row's centre
    down = half * geometry.source_detector_mm / (geometry.source_axis_mm - 0.8)
    assert down == pytest.approx(21.5 * 0.5 - 0.7)


@law()
@given(st.integers(3, 700), st.integers(0, 8), st.randoms(use_true_random=False))
def test_one_of_so_many_views_goes_all_around_in_whatever_order_they_were_taken(count, most, random):
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    random.shuffle(angles)
    chosen = one_of(angles, most)
    gaps = np.diff(np.sort(angles[chosen]), append=np.min(angles[chosen]) + 2 * np.pi)
    assert (np.diff(chosen) > 0).all()
    # as few as asked for where that leaves no gap, and all where any choice would
    if count >= most * 40 and most > 0:
        assert len(chosen) == -(-count // most)
    if len(chosen) < count:
        assert gaps.max() < LARGEST_GAP_RAD
    assert len(chosen) >= count / max(most, 1)


@law()
@given(st.floats(0.0, 9.0), st.floats(0.3, 1.9) | st.floats(0.99, 1.01) | st.just(1.0), st.integers(0, 10**6))
def test_a_column_read_in_runs_sees_what_it_sees_voxel_by_voxel(place, step, seed):
    """However long voxels and rows keep step; the line has a place more than the detector has rows."""
    rng, rows, first = np.random.default_rng(seed), 120, 3
    last = min(int((rows - 1 - place) / step), 90)
    line = np.append(rng.normal(size=rows), 0).astype(np.float32)
    runs, one_by_one = np.zeros((2, 100), dtype=np.float32)
    _add_piece(runs, line, first, last, place, step, np.float32(0.7))
    _add_beside(one_by_one, line, first, last, place, step, np.float32(0.7))
    np.testing.assert_allclose(runs, one_by_one, atol=1e-4)
    assert runs[first:last].all()
    assert not runs[:first].any()
    assert not runs[last:].any()
