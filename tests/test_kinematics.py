from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from simulator.ingredients import (
    Bending,
    Compliance,
    Creep,
    Drive,
    MotionOptions,
    Moving,
    Ripple,
    Slip,
    Torsion,
    Wander,
    Wobble,
)
from simulator.kinematics import BeamMotion, Composition, MotionError, RigidMotion, SectionMotion, rotation_matrix
from simulator.loading import Loading, load_history
from simulator.solver_space import into_sections, time_functions
from simulator.specimen import Specimen, area_mm2
from tests.laws import law
from validation.testing.strategies import beam_motions, motions, rigid_motions, section_motions

FEW = law(40)
ANGLE = 2 * np.pi * np.arange(127) / 50
HEIGHT = np.linspace(-6.5, 6.5, 261)
AREA = area_mm2(Specimen(thinned="both"), HEIGHT)
HISTORY = load_history(Loading(), 2.0 * np.arange(127), HEIGHT, AREA)
DRIVE = Drive(history=HISTORY, area_mm2=AREA, angle_rad=ANGLE, start_step=50, view_mm=4.03)


def material_points(seed: int = 0, count: int = 200):
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [1.5, 1.2, 6.4]


def paper_motion(**changes):
    return MotionOptions(**changes).motion(DRIVE)


@FEW
@given(motions(), st.integers(0, 100))
def test_inverse_undoes_forward(motion, seed):
    points = material_points(seed)
    np.testing.assert_allclose(motion.inverse(motion.forward(points, 0), 0), points, atol=1e-10)


@FEW
@given(st.lists(beam_motions() | section_motions(), max_size=1), st.lists(rigid_motions(), max_size=2))
def test_inverse_undoes_a_composition(deformation, turns):
    # a deformation comes first, as in a scenario: of points turned far from the axis its sections would cross
    points = material_points()
    motion = Composition((*deformation, *turns))
    np.testing.assert_allclose(motion.inverse(motion.forward(points, 0), 0), points, atol=1e-9)


@FEW
@given(st.lists(motions(), max_size=3), st.integers(0, 100))
def test_positions_and_gradient_at_once_are_those_one_by_one(parts, seed):
    # of three motions in any order sections may cross, where there is no position to compare
    motion, points = Composition(tuple(parts)), material_points(seed)
    try:
        motion.forward(points, 0)
    except MotionError:
        assume(False)
    for each in (motion, *parts[:1]):
        position, gradient = each.carry(points, 0)
        np.testing.assert_array_equal(position, each.forward(points, 0))
        np.testing.assert_array_equal(gradient, each.gradient(points, 0))


@FEW
@given(beam_motions())
def test_a_beam_follows_natural_cubic_splines_and_goes_on_by_their_tangents(beam):
    """On the centre line there is no arm to turn: x = Z e_z + d(Z), and dx/dZ = e_z + d'(Z)."""
    height = np.concatenate([beam.knot_mm, np.linspace(-9, 9, 91)])
    spline = CubicSpline(beam.knot_mm, beam.displacement_mm[0], bc_type="natural")
    inside = np.clip(height, -6, 6)
    shift = spline(inside) + (height - inside)[:, None] * spline(inside, 1)
    line = height[:, None] * [0.0, 0.0, 1.0]
    moved, gradient = beam.carry(line, 0)
    np.testing.assert_allclose(moved - line, shift, atol=1e-14)
    np.testing.assert_allclose(gradient[:, :, 2] - [0.0, 0.0, 1.0], spline(inside, 1), atol=1e-14)


@FEW
@given(rigid_motions() | beam_motions())
def test_gradient_is_that_of_finite_differences(motion):
    check_gradient(motion, material_points(), 0)


@FEW
@given(section_motions())
def test_gradient_of_sections_is_that_of_finite_differences(motion):
    points = material_points()
    # hat functions have kinks at the sections, where no difference quotient is a gradient
    height = motion.forward(points, 0)[:, 2]
    smooth = np.min(np.abs(height[:, None] - motion.height_mm), axis=1) > 1e-3
    check_gradient(motion, points[smooth], 0)


def test_gradient_of_a_composition_follows_the_chain_rule():
    check_gradient(paper_motion(), material_points(), 126)


def check_gradient(motion, points, step):
    size = 1e-5
    columns = [
        (motion.forward(points + size * e, step) - motion.forward(points - size * e, step)) / (2 * size)
        for e in np.eye(3)
    ]
    np.testing.assert_allclose(motion.gradient(points, step), np.stack(columns, axis=-1), atol=1e-8)


@FEW
@given(rigid_motions())
def test_rigid_motion_keeps_distances_and_its_rotation_is_the_known_one(motion):
    points = material_points()
    moved = motion.forward(points, 0)
    np.testing.assert_allclose(
        np.linalg.norm(moved[1:] - moved[:-1], axis=1), np.linalg.norm(points[1:] - points[:-1], axis=1), rtol=1e-12
    )
    expected = Rotation.from_rotvec(motion.rotation_rad[0]).as_matrix()
    np.testing.assert_allclose(motion.gradient(points, 0)[0], expected, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0199, 0.0201, 3.0])
def test_rotation_matrix_at_all_sizes(angle):
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3
    np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)


@FEW
@given(section_motions())
def test_section_motion_lies_in_the_solvers_space(motion):
    # Eq. 18, written out: hat functions times rigid motions at the current position
    x = motion.forward(material_points(), 0)
    hats = np.stack([np.interp(x[:, 2], motion.height_mm, row) for row in np.eye(5)], axis=1)
    arms = x[:, None] - motion.height_mm[:, None] * np.array([0.0, 0.0, 1.0])
    rigid = motion.translation_mm[0] + np.cross(motion.rotation_rad[0], arms)
    np.testing.assert_allclose(x - material_points(), np.einsum("pj,pja->pa", hats, rigid), atol=1e-10)


def test_crossing_sections_are_refused():
    shift = np.zeros((1, 5, 3))
    shift[0, 2, 2] = -9.0
    knots = np.linspace(-6, 6, 5)
    beam = BeamMotion(knot_mm=knots, displacement_mm=shift, rotation_rad=np.zeros((1, 5, 3)), stretch=np.ones((1, 5)))
    with pytest.raises(MotionError, match="step 0: the sections cross"):
        beam.inverse(material_points(), 0)


def test_no_ingredient_is_rest():
    motion = paper_motion(ingredients=())
    points = material_points()
    np.testing.assert_array_equal(motion.forward(points, 126), points)
    np.testing.assert_array_equal(motion.gradient(points, 126)[7], np.eye(3))


def test_tension_has_the_strain_and_contraction_of_the_loading():
    motion = paper_motion(ingredients=("tension",))
    points = np.column_stack([np.zeros((len(HEIGHT), 2)), HEIGHT])
    gradient = motion.gradient(points, 126)
    inside = np.abs(HEIGHT) < 6
    np.testing.assert_allclose(gradient[inside, 2, 2] - 1, HISTORY.strain[126, inside], atol=3e-5)
    elastic = HISTORY.strain[126] - HISTORY.plastic[126]
    expected = 1 - 0.28 * elastic - 0.5 * HISTORY.plastic[126]
    np.testing.assert_allclose(gradient[:, 0, 0], expected, atol=1e-12)
    np.testing.assert_allclose(motion.forward(np.zeros((1, 3)), 126), 0.0, atol=1e-12)


def test_contraction_can_be_left_out():
    motion = paper_motion(ingredients=("tension",), tension={"contraction": False})
    np.testing.assert_array_equal(motion.gradient(material_points(), 126)[:, 0, 0], 1.0)


def test_bending_and_torsion_turn_the_ends_by_their_angle():
    bending = paper_motion(ingredients=("bending",), bending=Bending(angle_deg=2.0, direction_deg=0.0))
    torsion = paper_motion(ingredients=("torsion",), torsion=Torsion(angle_deg=3.0))
    ends = np.array([[0, 0, 4.03], [0, 0, -4.03]])
    top, bottom = (Rotation.from_matrix(m) for m in bending.gradient(ends, 126))
    np.testing.assert_allclose((top * bottom.inv()).as_rotvec(degrees=True), [0, 2, 0], atol=1e-3)
    top, bottom = (Rotation.from_matrix(m) for m in torsion.gradient(ends, 126))
    np.testing.assert_allclose((top * bottom.inv()).as_rotvec(degrees=True), [0, 0, 3], atol=1e-3)
    # an unstretched centre line keeps its length
    line = np.column_stack([np.zeros((1001, 2)), np.linspace(-6, 6, 1001)])
    length = np.linalg.norm(np.diff(bending.forward(line, 126), axis=0), axis=1).sum()
    assert length == pytest.approx(12, abs=1e-6)


@pytest.mark.parametrize("ingredient", ["bending", "torsion"])
def test_similar_sections_give_way_to_a_moment_by_their_second_moment_of_area(ingredient):
    """Euler and Bernoulli: curvature = M / (E I), with I = integral of y^2 over the section, by quadrature here.

    A shaft of similar sections twists by the same law. Ligament and ends differ by a factor 57 in I.
    """
    half = np.sqrt(AREA) / 2  # of a square section
    y, weight = np.polynomial.legendre.leggauss(4)
    moment = 2 * half * half * ((half[:, None] * y) ** 2 @ weight)
    (motion,) = paper_motion(ingredients=(ingredient,)).motions
    curvature = np.gradient(np.linalg.norm(motion.rotation_rad[-1], axis=1) * np.sign(HEIGHT), HEIGHT)
    inner = slice(5, -5)
    assert moment.max() > 50 * moment.min()
    np.testing.assert_allclose((curvature * moment)[inner], (curvature * moment)[len(HEIGHT) // 2], rtol=0.02)


def test_compliance_is_in_proportion_to_the_force():
    options = Compliance(shift_mm=(0.1, 0.0, -0.2), tilt_deg=(0.0, 0.0, 0.0))
    motion = paper_motion(ingredients=("compliance",), compliance=options)
    shift = np.array([motion.forward(np.zeros((1, 3)), step)[0] for step in (0, 90, 126)])
    load = (HISTORY.force_N[90] - 250) / (HISTORY.force_N[126] - 250)
    np.testing.assert_allclose(shift, np.outer([0, load, 1], [0.1, 0, -0.2]), atol=1e-15)


def test_backlash_comes_before_the_test_and_with_the_stroke():
    motion = paper_motion(ingredients=("backlash",))
    path = np.array([motion.forward(np.zeros((1, 3)), step)[0] for step in range(127)])
    moved = np.linalg.norm(np.diff(path, axis=0), axis=1)
    np.testing.assert_array_equal(np.flatnonzero(moved > 1e-12), [50, 51, 52])
    np.testing.assert_allclose(path[0], [0.18, 0.03, 0.03])


@FEW
@given(
    st.integers(0, 140),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    st.tuples(*[st.floats(-20.0, 20.0)] * 3),
    st.integers(0, 126),
)
def test_a_slip_is_nothing_before_its_step_and_one_rigid_motion_of_the_deformed_sample_from_it_on(
    at, shift, turn, step
):
    points = material_points()
    others = ("tension", "bending", "torsion", "compliance", "backlash", "wobble")
    slip = Slip(step=at, shift_mm=shift, turn_deg=turn)
    moved = paper_motion(ingredients=(*others, "slip"), slip=slip).forward(points, step)
    due = paper_motion(ingredients=others[:3]).forward(points, step)
    if step >= at:
        # written as a rotation of scipy: another one than that of the code
        due = Rotation.from_rotvec(turn, degrees=True).apply(due) + shift
    due = paper_motion(ingredients=others[3:]).forward(due, step)
    np.testing.assert_allclose(moved, due, atol=1e-12)


def test_wobble_stands_still_in_the_lab():
    # a point of the axis, turned into the lab by the stage, is always shifted by the same vector
    motion = Wobble(across_mm=0.05, along_mm=0.02, roll_deg=0.0, lean_deg=0.0).motion(DRIVE)
    for step in (0, 13, 77):
        lab = Rotation.from_rotvec([0, 0, ANGLE[step]]).apply(motion.forward(np.zeros((1, 3)), step)[0])
        np.testing.assert_allclose(lab, [0.02, -0.05, 0.0], atol=1e-15)  # along +x, and to the right: -y


def test_creep_is_a_logarithm_of_time_and_keeps_the_volume():
    (motion,) = paper_motion(ingredients=("creep",), creep=Creep(strain=3e-3, time_s=10.0)).motions
    waist = np.argmin(AREA)
    axis = np.zeros((2, 3))
    axis[:, 2] = HEIGHT[waist] + np.array([-1e-3, 1e-3])

    def strain(step):
        return (np.diff(motion.forward(axis, step)[:, 2]) / np.diff(axis[:, 2]) - 1)[0]

    assert strain(50) == pytest.approx(0, abs=1e-12)
    assert strain(126) == pytest.approx(3e-3, rel=1e-4)
    since = HISTORY.time_s - HISTORY.time_s[50]
    assert strain(80) / strain(126) == pytest.approx(np.log1p(since[80] / 10) / np.log1p(since[126] / 10), rel=1e-4)
    np.testing.assert_allclose(motion.stretch[126, waist] ** 2 * (1 + 3e-3), 1, rtol=1e-9)


@FEW
@given(st.floats(0.4, 9.0), st.floats(-360.0, 360.0), st.floats(0.0, 0.1), st.integers(0, 126))
def test_a_ripple_is_a_sine_of_the_height_follows_the_force_and_keeps_the_volume(wavelength, phase, strain, step):
    ripple = Ripple(strain=strain, wavelength_mm=wavelength, phase_deg=phase)
    motion = paper_motion(ingredients=("ripple",), ripple=ripple)
    points = material_points()
    points = points[np.abs(points[:, 2]) < 6]
    share = (HISTORY.force_N[step] - 250) / (HISTORY.force_N[126] - 250)
    due = strain * share * np.sin(2 * np.pi * points[:, 2] / wavelength + np.deg2rad(phase))
    # cubic splines between n heights a wavelength: an error as n^-3, 0.5 % of the amplitude at n = 8
    near = 0.006 * strain * min(1.0, (0.4 / wavelength) ** 3) + 1e-9
    gradient = motion.gradient(points, step)
    np.testing.assert_allclose(gradient[:, 2, 2] - 1, due, atol=near, rtol=0)
    np.testing.assert_allclose(gradient[:, 0, 0], 1 / np.sqrt(1 + due), atol=near, rtol=0)
    np.testing.assert_allclose(gradient[:, 1, 1], gradient[:, 0, 0], rtol=0)
    np.testing.assert_allclose(np.linalg.det(gradient), 1, atol=2 * near, rtol=0)
    check_gradient(motion, points, step)
    # u_z is the integral of the strain from the middle of the ligament
    moved = motion.forward(np.column_stack([0 * due, 0 * due, points[:, 2]]), step)
    k, phi = 2 * np.pi / wavelength, np.deg2rad(phase)
    shift = strain * share * (np.cos(phi) - np.cos(k * points[:, 2] + phi)) / k
    np.testing.assert_allclose(moved - points * [0, 0, 1], np.outer(shift, [0, 0, 1]), atol=near, rtol=0)


@law(30)
@given(st.floats(0.01, 1.0))
def test_a_ripple_finer_than_the_heights_is_refused(wavelength):
    ripple = Ripple(wavelength_mm=wavelength)
    if wavelength >= 0.4:  # eight heights, 0.05 mm apart
        ripple.deformation(DRIVE)
    else:
        with pytest.raises(ValueError, match=r"motion\.ripple\.wavelength_mm: expected at least 0\.4 mm"):
            ripple.deformation(DRIVE)


def test_wandering_has_the_size_and_the_slowness_that_are_asked_for():
    """Over many draws: the slow part's variance of a difference is 2 s^2 (1 - exp(-d^2 / 2 l^2))."""
    still = {"drift_mm": 0.0, "slips": 0, "tilt_deg": 0.0}
    draws = np.stack(
        [Wander(draw=n, shift_mm=0.5, slow_steps=10.0, **still).motion(DRIVE).translation_mm for n in range(300)]
    )
    for lag in (1, 5, 60):
        found = ((draws[:, lag:] - draws[:, :-lag]) ** 2).mean()
        assert found == pytest.approx(2 * 0.25 * (1 - np.exp(-((lag / 10) ** 2) / 2)), rel=0.1)
    np.testing.assert_array_equal(draws[:, 0], 0)
    assert np.array_equal(Wander(draw=7).motion(DRIVE).translation_mm, Wander(draw=7).motion(DRIVE).translation_mm)
    assert not np.array_equal(Wander(draw=7).motion(DRIVE).translation_mm, Wander(draw=8).motion(DRIVE).translation_mm)


def test_one_more_slip_leaves_the_others_where_they_were():
    still = {"drift_mm": 0.0, "shift_mm": 0.0, "tilt_deg": 0.0, "draw": 3}
    paths = [Wander(slips=n, **still).motion(DRIVE).translation_mm for n in range(4)]
    for n, path in enumerate(paths):
        assert len(np.unique(path, axis=0)) == n + 1
    for fewer, more in pairwise(paths):
        jump = np.unique(np.round(more - fewer, 12), axis=0)
        assert len(jump) == 2


def test_one_more_ingredient_is_a_record_and_a_field():
    class Drift(Moving):
        def motion(self, drive):
            steps = len(drive.angle_rad)
            return RigidMotion(rotation_rad=np.zeros((steps, 3)), translation_mm=np.ones((steps, 1)) * [0.0, 0.0, 2.0])

    class More(MotionOptions):
        drift: Drift = Drift()

    assert More.names() == (*MotionOptions.names(), "drift")
    motion = More().model_copy(update={"ingredients": ("drift", "torsion")}).motion(DRIVE)
    np.testing.assert_allclose(motion.forward(np.zeros((1, 3)), 126), [[0, 0, 2]], atol=1e-15)
    assert [type(part) for part in motion.motions] == [BeamMotion, RigidMotion]


def test_into_sections_is_exact_for_what_is_in_the_space():
    time = time_functions(HISTORY.force_N, ANGLE, 50)
    rng = np.random.default_rng(1)
    heights = np.linspace(-4.03, 4.03, 15)
    known = SectionMotion(
        height_mm=heights,
        translation_mm=np.einsum("ti,ija->tja", time, rng.normal(0, 0.01, (7, 15, 3))),
        rotation_rad=np.einsum("ti,ija->tja", time, rng.normal(0, 1e-4, (7, 15, 3))),
    )
    found = into_sections(known, heights, time)
    np.testing.assert_allclose(found.translation_mm, known.translation_mm, atol=1e-10)
    np.testing.assert_allclose(found.rotation_rad, known.rotation_rad, atol=1e-10)


def test_into_sections_resembles_the_motion_it_replaces():
    motion = paper_motion()
    heights = np.linspace(-4.03, 4.03, 15)
    found = into_sections(motion, heights, time_functions(HISTORY.force_N, ANGLE, 50))
    axis = np.column_stack([np.zeros((41, 2)), np.linspace(-4, 4, 41)])
    for step in (20, 80, 126):
        difference = found.forward(axis, step) - motion.forward(axis, step)
        assert np.sqrt(np.mean(difference**2)) < 0.01  # mm, of 0.3 mm of motion


def test_motions_are_values():
    motion = RigidMotion(rotation_rad=np.zeros((1, 3)), translation_mm=np.ones((1, 3)))
    assert replace(motion, translation_mm=np.zeros((1, 3))).forward(np.ones((1, 3)), 0).tolist() == [[1, 1, 1]]
