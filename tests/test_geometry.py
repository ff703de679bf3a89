"""The frame in explicit numbers, and windows and bins that look along the rays of the whole detector."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc.geometry import ConeBeam, gaps_rad
from pdvc.rays import directions, ray_vectors
from tests.laws import law
from validation.testing.strategies import angles_rad, cone_beams

SCANNER = ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=60, columns=44)


def centres(geometry, angle_rad):
    """Return the centres of all pixels (row, column, 3) of a geometry, mm."""
    corner, row, column = ray_vectors(geometry, angle_rad).stacked()[0, 1:]
    r, c = np.arange(geometry.rows)[:, None, None], np.arange(geometry.columns)[None, :, None]
    return corner + r * row + c * column


def block_means(points, factor):
    rows, columns = points.shape[0] // factor, points.shape[1] // factor
    whole = points[: rows * factor, : columns * factor]
    return whole.reshape(rows, factor, columns, factor, 3).mean(axis=(1, 3))


def test_at_angle_0_the_beam_runs_along_x_and_columns_along_minus_y():
    rays = ray_vectors(SCANNER, 0.0)
    np.testing.assert_allclose(rays.source_mm[0], [-30, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rays.column_mm[0], [0, -0.5, 0], atol=1e-12)
    np.testing.assert_allclose(rays.row_mm[0], [0, 0, -0.5], atol=1e-12)
    # 22 columns of 0.5 mm to the left of the middle, less half a pixel; top row 30 rows up, less half a pixel
    np.testing.assert_allclose(rays.corner_mm[0], [270, 10.75, 14.75], atol=1e-12)


def test_at_angle_90_a_sample_turned_counter_clockwise_is_seen_along_minus_y():
    rays = ray_vectors(SCANNER, np.pi / 2)
    np.testing.assert_allclose(rays.source_mm[0], [0, 30, 0], atol=1e-12)
    np.testing.assert_allclose(rays.column_mm[0], [-0.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rays.row_mm[0], [0, 0, -0.5], atol=1e-12)
    np.testing.assert_allclose(rays.corner_mm[0], [10.75, -270, 14.75], atol=1e-12)


def test_shifts_move_the_detector_right_and_down_and_roll_turns_columns_towards_rows():
    moved = replace(SCANNER, column_shift_mm=2.0, row_shift_mm=3.0, roll_rad=np.pi / 6)
    rays = ray_vectors(moved, 0.0)
    middle = rays.corner_mm[0] + 29.5 * rays.row_mm[0] + 21.5 * rays.column_mm[0]
    np.testing.assert_allclose(middle, [270, -2, -3], atol=1e-12)
    np.testing.assert_allclose(rays.column_mm[0], [0, -0.5 * np.sqrt(0.75), -0.25], atol=1e-12)
    np.testing.assert_allclose(rays.row_mm[0], [0, 0.25, -0.5 * np.sqrt(0.75)], atol=1e-12)


@given(angles_rad())
def test_beam_column_and_row_are_right_handed_unit_vectors(angle):
    beam, column = (vector[0] for vector in directions(angle))
    np.testing.assert_allclose(np.cross(beam, column), [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose([beam @ beam, column @ column, beam @ column], [1, 1, 0], atol=1e-12)


@law()
@given(cone_beams(), angles_rad(), st.data())
def test_a_cropped_window_looks_along_the_same_rays(geometry, angle, data):
    row_from = data.draw(st.integers(0, geometry.rows - 1))
    row_to = data.draw(st.integers(row_from + 1, geometry.rows))
    column_from = data.draw(st.integers(0, geometry.columns - 1))
    column_to = data.draw(st.integers(column_from + 1, geometry.columns))
    window = geometry.cropped(row_from, row_to, column_from, column_to)
    whole = centres(geometry, angle)
    np.testing.assert_allclose(
        centres(window, angle),
        whole[row_from:row_to, column_from:column_to],
        atol=1e-12 * geometry.source_detector_mm,
    )


@law()
@given(cone_beams(), angles_rad(), st.integers(1, 7))
def test_a_binned_pixel_stands_at_the_mean_of_its_block_whatever_is_left_over(geometry, angle, factor):
    coarse = geometry.binned(factor)
    expected = block_means(centres(geometry, angle), factor)
    assert (coarse.rows, coarse.columns) == expected.shape[:2]
    np.testing.assert_allclose(centres(coarse, angle), expected, atol=1e-12 * geometry.source_detector_mm)


def test_binning_odd_sizes_drops_the_last_row_and_column():
    coarse = replace(SCANNER, rows=7, columns=5).binned(2)
    assert (coarse.rows, coarse.columns, coarse.pixel_mm) == (3, 2, 1.0)
    assert (coarse.row_shift_mm, coarse.column_shift_mm) == (-0.25, -0.25)
    assert coarse.voxel_mm == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pixel_mm": -0.5}, "geometry.pixel_mm: expected a positive length in mm, got -0.5"),
        ({"source_axis_mm": float("nan")}, "geometry.source_axis_mm: expected a positive length in mm, got nan"),
        ({"source_detector_mm": 30.0}, "geometry.source_detector_mm: expected more than source_axis_mm = 30.0 mm"),
        ({"rows": 0}, "geometry.rows: expected at least 1 pixel, got 0"),
        ({"roll_rad": float("inf")}, "geometry.roll_rad: expected a finite number, got inf"),
    ],
)
def test_an_impossible_scanner_is_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        replace(SCANNER, **change)


@pytest.mark.parametrize("factor", [0, 45])
def test_a_bin_larger_than_the_detector_is_refused(factor):
    with pytest.raises(ValueError, match=f"expected 1 to 44 for a detector of 60 x 44 px, got {factor}"):
        SCANNER.binned(factor)


@pytest.mark.parametrize("window", [(-1, 9, 0, 9), (0, 61, 0, 9), (5, 5, 0, 9), (0, 9, 9, 4)])
def test_a_window_off_the_detector_is_refused(window):
    with pytest.raises(ValueError, match="window: expected a part of 60 x 44 px"):
        SCANNER.cropped(*window)


def test_gaps_between_angles_go_on_over_the_turn_s_end():
    np.testing.assert_allclose(gaps_rad(np.array([0.1, 0.5, 6.0])), [0.4, 5.5, 0.1 + 2 * np.pi - 6.0])
    np.testing.assert_allclose(gaps_rad(np.array([1.0])), [2 * np.pi])
