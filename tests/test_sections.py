"""The spatial basis against formulas written with cross products, and the laws of hat functions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pdvc.sections import CONTRACTION, RIGID, SectionBasis, SectionPattern, motions_named, names_of, offer_motion
from tests.laws import law
from validation.testing.strategies import section_bases

NUMBERS = st.floats(-10.0, 10.0)
POINTS = arrays(float, (7, 3), elements=NUMBERS)


def hat(heights, j, z):
    """Return p_j(z) of Eq. 18 from its definition, for one z; constant beyond the ends."""
    z = min(max(z, heights[0]), heights[-1])
    if j > 0 and heights[j - 1] <= z <= heights[j]:
        return (z - heights[j - 1]) / (heights[j] - heights[j - 1])
    if j + 1 < len(heights) and heights[j] <= z <= heights[j + 1]:
        return (heights[j + 1] - z) / (heights[j + 1] - heights[j])
    return 1.0 if z == heights[j] else 0.0


def displacement(basis, amplitude, point):
    """Return u (3,) from translations and rotation vectors: u = sum_j p_j (t_j + r_j x (x - z_j e_z) / radius)."""
    u = np.zeros(3)
    for j, z in enumerate(basis.height_mm):
        turned = np.cross(amplitude[j, 3:6], point - [0, 0, z]) / basis.radius_mm
        u += hat(basis.height_mm, j, point[2]) * (amplitude[j, :3] + turned)
    return u


@law()
@given(section_bases(), arrays(float, 9, elements=NUMBERS))
def test_hats_add_up_to_one(basis, z):
    np.testing.assert_allclose(basis.weights(z).sum(axis=-1), 1, atol=1e-12)


@law()
@given(section_bases(), st.floats(0, 1), NUMBERS, NUMBERS)
def test_hats_reproduce_linear_functions_between_the_ends(basis, share, slope, level):
    z = basis.height_mm[0] + share * (basis.height_mm[-1] - basis.height_mm[0])
    np.testing.assert_allclose(basis.weights(z) @ (slope * basis.height_mm + level), slope * z + level, atol=1e-9)


@law()
@given(section_bases(), st.data())
def test_displacement_follows_the_formula_with_cross_products(basis, data):
    amplitude = data.draw(arrays(float, basis.shape, elements=NUMBERS))
    points = data.draw(POINTS)
    expected = [displacement(basis, amplitude, point) for point in points]
    np.testing.assert_allclose(basis.displacement(amplitude, points), expected, rtol=1e-9, atol=1e-7)


@law()
@given(section_bases(), section_bases(), POINTS, arrays(float, (1, 6), elements=NUMBERS))
def test_sections_reproduce_the_motion_of_a_single_one_everywhere(basis, other, points, amplitude):
    single = SectionBasis(height_mm=other.height_mm[:1], radius_mm=other.radius_mm)
    same = basis.reproduced(amplitude, single)
    np.testing.assert_allclose(
        basis.displacement(same, points), single.displacement(amplitude, points), rtol=1e-9, atol=1e-7
    )


def test_rigid_motions_of_many_steps_are_carried_over_step_by_step():
    single = SectionBasis(height_mm=np.array([0.5]), radius_mm=0.7)
    basis = SectionBasis(height_mm=np.array([-1.0, 0.0, 2.0]), radius_mm=0.4)
    amplitude = np.random.default_rng(1).normal(size=(4, 1, 6))
    together = basis.reproduced(amplitude, single)
    assert together.shape == (4, 3, 6)
    np.testing.assert_array_equal(together[2], basis.reproduced(amplitude[2], single))


def test_sections_reproduce_the_contraction_of_a_single_one():
    single = SectionBasis(height_mm=np.array([0.0]), radius_mm=0.5, motions=(CONTRACTION,))
    basis = SectionBasis(height_mm=np.array([-1.0, 1.0]), radius_mm=0.25, motions=(*RIGID, CONTRACTION))
    points = [[0.3, 0.2, 0.4], [-0.1, 0.6, -3.0]]
    same = basis.reproduced([[3.0]], single)
    np.testing.assert_allclose(basis.displacement(same, points), single.displacement([[3.0]], points), atol=1e-12)


def test_a_unit_rotation_moves_a_point_at_the_radius_by_one_voxel():
    basis = SectionBasis(height_mm=np.array([0.0]), radius_mm=0.6)
    amplitude = np.zeros((1, 6))
    amplitude[0, names_of(RIGID).index("rotation_z")] = 1
    np.testing.assert_allclose(basis.displacement(amplitude, [[0.6, 0, 0.3]]), [[0, 1, 0]], atol=1e-12)


def test_contraction_moves_points_away_from_the_axis_and_not_along_it():
    basis = SectionBasis(height_mm=np.array([-1.0, 1.0]), radius_mm=0.5, motions=(CONTRACTION,))
    u = basis.displacement([[2.0], [4.0]], [[0.3, -0.2, 0.0], [0.3, -0.2, 9.0]])
    np.testing.assert_allclose(u, [[1.8, -1.2, 0], [2.4, -1.6, 0]], atol=1e-12)


ROUND = SectionPattern(name="round", gradient=((0, -2, 0), (2, 0, 0), (0, 0, 0)), shift=(1, 0, 0))
"""A turn about an axis beside that of the stage: a sum of rigid motions."""


def test_a_motion_is_found_by_its_name_and_a_name_is_given_once():
    assert motions_named(("rotation_z", "translation_x")) == (RIGID[5], RIGID[0])
    with pytest.raises(ValueError, match=r"section motions: expected some of .*contraction.*got .*rotation_w"):
        motions_named(("rotation_w",))
    with pytest.raises(ValueError, match="'rotation_z': expected a name that is free"):
        offer_motion(replace(ROUND, name="rotation_z"))
    offer_motion(CONTRACTION)  # the same again changes nothing
    assert SectionPattern(name="x", shift=np.array([1, 0, 0])) == SectionPattern(name="x", shift=(1.0, 0.0, 0.0))
    for wrong in ({"gradient": np.full((3, 3), np.nan)}, {"shift": (1.0, 2.0)}, {"name": ""}):
        with pytest.raises(ValueError, match=r"section motion '.*': expected a name, 3 x 3 numbers"):
            SectionPattern(**{"name": "mine", **wrong})
    assert SectionPattern.of("round", ROUND.pattern()) == ROUND


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height_mm": [1.0, 0.0]}, "section heights: expected increasing numbers in mm"),
        ({"height_mm": []}, "section heights: expected increasing numbers in mm"),
        ({"motions": ()}, "section motions: expected some, none a sum of others"),
        ({"motions": (*RIGID, ROUND)}, "section motions: expected some, none a sum of others"),
        ({"radius_mm": 0.0}, "section radius: expected a positive length in mm, got 0.0"),
    ],
)
def test_an_impossible_basis_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        SectionBasis(**{"height_mm": [0.0, 1.0], "radius_mm": 1.0, **change})
