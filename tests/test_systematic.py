"""What re-projection leaves: which views are next to a step's angle, and how their fields move with the sample."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc.geometry import ConeBeam
from pdvc.rays import ray_vectors
from pdvc.sections import SectionBasis
from pdvc.systematic import Systematic, neighbouring_views
from tests.laws import law

SCANNER = ConeBeam(source_axis_mm=200.0, source_detector_mm=2000.0, pixel_mm=0.5, rows=40, columns=30, roll_rad=0.0)
VOXEL_MM = 0.05
WINDOW = (5, 33, 4, 27)
SHAPE = (28, 23)
BASIS = SectionBasis(height_mm=np.array([-0.6, 0.0, 0.5]), radius_mm=0.5)
TENTH = np.deg2rad(36.0)


def fields(count=2):
    return np.random.default_rng(1).normal(size=(count, SCANNER.rows, SCANNER.columns)).astype(np.float32)


def systematic(share=0.0, values=None):
    return Systematic(
        fields=fields() if values is None else values,
        first=np.array([0]),
        second=np.array([1]),
        share=np.array([share]),
        corner=(WINDOW[0], WINDOW[2]),
        shape=SHAPE,
    )


def registered(of, amplitude, angle=0.7):
    rays = ray_vectors(SCANNER.cropped(*WINDOW), angle).stacked()
    return of.registered(slice(0, 1), rays, BASIS, amplitude[None], VOXEL_MM)[0]


def window(image, down=0, right=0):
    return image[WINDOW[0] + down : WINDOW[1] + down, WINDOW[2] + right : WINDOW[3] + right]


@law()
@given(st.integers(3, 40), st.data())
def test_a_step_at_a_reference_angle_takes_that_view_alone(count, data):
    reference = np.linspace(0, 2 * np.pi, count, endpoint=False)
    view = data.draw(st.integers(0, count - 1))
    turns = data.draw(st.integers(-2, 2))
    near = neighbouring_views(reference, reference[[view]] + 2 * np.pi * turns)
    assert (near.first[0], near.second[0], near.share[0]) == (view, view, 0)


def test_a_step_in_between_takes_both_by_its_distance():
    near = neighbouring_views(TENTH * np.arange(10), TENTH * np.array([2.25, 8.5]))
    np.testing.assert_array_equal(near.first, [2, 8])
    np.testing.assert_array_equal(near.second, [3, 9])
    np.testing.assert_allclose(near.share, [0.25, 0.5])


@pytest.mark.parametrize("angle", [9.75, -0.25, 19.75])
def test_a_step_after_the_last_view_wraps_around_to_the_first(angle):
    near = neighbouring_views(TENTH * np.arange(10), np.array([TENTH * angle]))
    assert (near.first[0], near.second[0]) == (9, 0)
    assert near.share[0] == pytest.approx(0.75)


@law()
@given(st.permutations(range(7)), st.floats(-9.0, 9.0))
def test_views_in_any_order_and_any_step_give_its_angle_back(order, angle):
    ring = np.array([0.1, 0.9, 1.7, 3.0, 4.2, 5.0, 6.1])
    reference = ring[list(order)]
    near = neighbouring_views(reference, np.array([angle]))
    first, second, share = reference[near.first[0]], reference[near.second[0]], near.share[0]
    assert 0 <= share <= 1
    between = first + share * ((second - first) % (2 * np.pi))
    assert abs((between - angle + np.pi) % (2 * np.pi) - np.pi) < 1e-5
    # no other view lies between the two
    if share > 0:
        assert not (
            ((ring - first) % (2 * np.pi) > 1e-9)
            & ((second - ring) % (2 * np.pi) > 1e-9)
            & ((ring - first) % (2 * np.pi) < (second - first) % (2 * np.pi))
        ).any()


@pytest.mark.parametrize("angle", [0.0, 0.7, 4.4])
def test_without_motion_the_field_is_itself(angle):
    np.testing.assert_allclose(registered(systematic(), np.zeros(BASIS.shape), angle), window(fields()[0]), atol=1e-5)


def test_without_motion_the_field_is_itself_to_the_detector_s_edge():
    whole = Systematic(
        fields=fields(),
        first=np.array([0]),
        second=np.array([1]),
        share=np.zeros(1),
        corner=(0, 0),
        shape=(SCANNER.rows, SCANNER.columns),
    )
    rays = ray_vectors(SCANNER, 0.7).stacked()
    found = whole.registered(slice(0, 1), rays, BASIS, np.zeros((1, *BASIS.shape)), VOXEL_MM)[0]
    np.testing.assert_allclose(found, fields()[0], atol=1e-4)


def test_half_a_share_is_the_mean_of_both():
    both = registered(systematic(share=0.5), np.zeros(BASIS.shape))
    np.testing.assert_allclose(both, window(fields().mean(axis=0)), atol=1e-5)


@pytest.mark.parametrize("rows", [-3, 1, 4])
def test_motion_upwards_by_voxels_moves_the_field_up_by_as_many_rows(rows):
    amplitude = np.zeros(BASIS.shape)
    amplitude[:, 2] = rows
    smooth = np.add.outer(np.arange(40.0) ** 2, 9 * np.arange(30.0)).astype(np.float32)
    found = registered(systematic(values=np.stack([smooth, smooth])), amplitude)
    # on the axis the magnification is exact: a pixel shows what was `rows` below it
    np.testing.assert_allclose(found, window(smooth, down=rows), atol=1e-3 * np.abs(smooth).max())


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, 2.5])
def test_motion_across_the_beam_moves_the_field_along_its_rows(angle):
    amplitude = np.zeros(BASIS.shape)
    amplitude[:, :2] = 2 * np.array([-np.sin(angle), -np.cos(angle)])  # two voxels to the right of the image
    found = registered(systematic(), amplitude, angle)
    # rays fan out: at the image's edge a shift of 2 px is a little more or less
    np.testing.assert_allclose(found, window(fields()[0], right=-2), atol=0.02)


def test_a_range_of_steps_takes_each_step_s_own_views_and_motion():
    values = fields(4)
    of = Systematic(
        fields=values,
        first=np.array([3, 0, 1, 2]),
        second=np.array([0, 1, 2, 3]),
        share=np.array([0.1, 0.0, 0.3, 0.6]),
        corner=(WINDOW[0], WINDOW[2]),
        shape=SHAPE,
    )
    rays = ray_vectors(SCANNER.cropped(*WINDOW), np.array([0.2, 0.9, 1.6, 2.3])).stacked()
    amplitude = np.random.default_rng(2).normal(size=(4, *BASIS.shape))
    found = of.registered(slice(1, 4), rays[1:], BASIS, amplitude[1:], VOXEL_MM)
    assert found.shape == (3, *SHAPE)
    for t in (1, 2, 3):
        alone = of.registered(slice(t, t + 1), rays[t : t + 1], BASIS, amplitude[t : t + 1], VOXEL_MM)[0]
        np.testing.assert_array_equal(found[t - 1], alone)
    still = of.registered(slice(2, 3), rays[2:3], BASIS, np.zeros((1, *BASIS.shape)), VOXEL_MM)[0]
    np.testing.assert_allclose(still, window(0.7 * values[1] + 0.3 * values[2]), atol=1e-5)


def test_what_comes_from_off_the_detector_is_zero():
    amplitude = np.zeros(BASIS.shape)
    amplitude[:, 2] = 100
    assert not registered(systematic(), amplitude).any()
