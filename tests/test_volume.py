"""Filtering and refining a volume, against scipy's own splines and closed forms."""

import numpy as np
from scipy import ndimage

from pdvc.volume import Grid, Volume, framed, halved, hull_of, smoothed
from tests.small_case import textured


def random_volume(shape=(9, 8, 7)):
    """Return a random volume that goes on beyond its lowest and highest layer, with air around it otherwise."""
    values = np.random.default_rng(2).normal(size=shape).astype(np.float32)
    values[:, [0, 1, -2, -1]] = 0
    values[:, :, [0, 1, -2, -1]] = 0
    grid = Grid(shape=shape, voxel_mm=0.3, origin_mm=(1.0, 2.0, 3.0))
    return Volume(values=framed(values), grid=grid, hull=hull_of(values != 0, grid, 2))


def continued(values):
    return np.concatenate([values[1:2], values[1:-1], values[-2:-1]])


def test_a_halved_volume_is_the_cubic_spline_through_the_voxels():
    volume = random_volume()
    fine = halved(volume)
    assert fine.grid.voxel_mm == 0.15
    assert fine.grid.origin_mm == volume.grid.origin_mm
    assert fine.values.shape == (17, 15, 13)
    places = np.stack(np.meshgrid(*(np.arange(n) / 2 for n in fine.values.shape), indexing="ij"))
    oracle = ndimage.map_coordinates(continued(volume.values).astype(float), places, order=3, mode="mirror")
    np.testing.assert_allclose(fine.values[1:-1], oracle[1:-1], atol=2e-6)
    np.testing.assert_allclose(fine.values[2:-2:2, ::2, ::2], volume.values[1:-1], atol=1e-6)


def test_halving_gives_a_smooth_field_back_between_the_voxels_to_fourth_order():
    def error(voxel_mm):
        n = round(6 / voxel_mm) + 1
        grid = Grid(shape=(n, n, n), voxel_mm=voxel_mm, origin_mm=(-3.0, -3.0, -3.0))

        def field(grid):
            z, y, x = (np.arange(m) * grid.voxel_mm - 3 for m in grid.shape)
            return np.exp(-2 * (z[:, None, None] ** 2 + y[:, None] ** 2 + x**2)).astype(np.float32)

        values = framed(field(grid))
        fine = halved(Volume(values=values, grid=grid, hull=hull_of(values > 0, grid, 2)))
        return np.abs(fine.values - field(fine.grid)).max()

    # a fourth-order method gains 16 from half the voxel
    assert error(0.2) < error(0.4) / 11


def test_smoothing_keeps_constants_along_the_sample_and_adds_nothing():
    volume = random_volume((12, 16, 15))
    column = np.zeros_like(volume.values)
    column[:, 5:11, 5:10] = 1
    bar = Volume(values=framed(column), grid=volume.grid, hull=volume.hull)
    result = smoothed(bar, 0.7).values
    # a sample that goes on beyond the volume is not dimmed at its ends
    np.testing.assert_allclose(result[1:-1], np.broadcast_to(result[5], (10, 16, 15)), atol=1e-6)
    np.testing.assert_allclose(result[5].sum(), 30, rtol=1e-6)
    assert (result[[0, -1]] == 0).all()


def test_smoothing_is_the_gaussian_of_the_stated_width():
    values = np.zeros((21, 21, 21), dtype=np.float32)
    values[10, 10, 10] = 1
    grid = Grid(shape=values.shape, voxel_mm=0.1, origin_mm=(0.0, 0.0, 0.0))
    result = smoothed(Volume(values=values, grid=grid, hull=hull_of(values > 0, grid, 4)), 1.5).values
    z = np.arange(21) - 10
    np.testing.assert_allclose((result.sum(axis=(1, 2)) * z**2).sum(), 1.5**2, rtol=0.01)


def test_neither_changes_what_it_was_given():
    volume = textured()
    before = volume.values.copy()
    smoothed(volume, 1.0), halved(volume)
    np.testing.assert_array_equal(volume.values, before)
