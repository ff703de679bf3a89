"""Where the scanner truly stands, against places and chords worked out by hand in the lab, with scipy's rotations."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pdvc.geometry import ConeBeam
from simulator.alignment import Aligner, Moment
from simulator.focal_spot import FocalSpot
from simulator.misalignment import Misalignment
from simulator.radiography import Body, path_lengths
from simulator.stage import RotationStage
from tests.laws import law

SCANNER = ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=60, columns=44)
PARALLEL = ConeBeam(source_axis_mm=1e6, source_detector_mm=1.0001e6, pixel_mm=0.02, rows=170, columns=150)
STILL = Moment()


def spheres(centres, radius=0.3):
    """Return a body of spheres of graphite alone, whose chords `path_lengths` gives as the second image."""
    centres = np.array(centres, dtype=float).reshape(-1, 3)
    return Body(
        vertices_mm=np.zeros((0, 3)),
        faces=np.zeros((0, 3), dtype=np.int64),
        centres_mm=centres,
        shapes_mm=np.tile(radius * np.eye(3), (len(centres), 1, 1)),
    )


def chords(aligner, body, angle_rad, moment=STILL, subpixels=1):
    moved, scanner = aligner.at(angle_rad, moment).seen(body, aligner.recorded)
    return path_lengths(moved, scanner, 0.0, subpixels)[1]


def spot(aligner, point, angle_rad=0.0, moment=STILL):
    """Return column and row, from the middle of the detector, where a point is seen: a line meets a plane."""
    source, middle, column, row = aligner.at(angle_rad, moment).in_sample_frame()
    normal = np.cross(column, row)
    ray = np.asarray(point, dtype=float) - source
    on_detector = source + ray * (normal @ (middle - source)) / (normal @ ray) - middle
    return np.array([column @ on_detector, row @ on_detector]) / aligner.recorded.pixel_mm


def centroid(image):
    """Return column and row of the centre of mass, from the middle of the image."""
    rows, columns = image.shape
    across, down = image.sum(axis=0), image.sum(axis=1)
    place = across @ np.arange(columns) / across.sum(), down @ np.arange(rows) / down.sum()
    return np.array(place) - [(columns - 1) / 2, (rows - 1) / 2]


small = st.floats(-4, 4)
places = st.tuples(*[st.floats(-0.6, 0.6)] * 3)


@st.composite
def aligners(draw):
    degrees = {name: draw(small) for name in ("roll_deg", "tilt_deg", "slant_deg", "lean_deg")}
    wrong = Misalignment(
        source_axis_mm=draw(small) / 2,
        source_detector_mm=draw(small),
        column_shift_mm=draw(small) / 4,
        row_shift_mm=draw(small) / 4,
        axis_across_mm=draw(small) / 20,
        **degrees,
    )
    stage = RotationStage(
        angle_error_deg=draw(small), wobble_deg=abs(draw(small)), runout_mm=abs(draw(small)) / 50, lift_mm=0.05
    )
    drift = tuple(draw(small) / 20 for _ in range(3))
    return Aligner(recorded=SCANNER, misalignment=wrong, stage=stage, spot=FocalSpot(drift_mm=drift))


def by_hand(aligner, angle_rad, moment):
    """Return source, middle, column, row, Q and p in the lab, after the words of the docstrings."""
    wrong, stage, recorded = aligner.misalignment, aligner.stage, aligner.recorded
    source_axis = recorded.source_axis_mm + wrong.source_axis_mm
    detector = recorded.source_detector_mm + wrong.source_detector_mm - source_axis
    across, up, along = (1 - np.exp(-moment.time_s / aligner.spot.drift_time_s)) * np.array(aligner.spot.drift_mm)
    # in the plane of the detector: clockwise for an eye at the source, which looks along +x
    plane = Rotation.from_euler("XYZ", [wrong.roll_deg, 0, 0], degrees=True)
    leaning = Rotation.from_euler("y", wrong.tilt_deg, degrees=True)
    slanted = Rotation.from_euler("z", wrong.slant_deg, degrees=True)
    turned = slanted * leaning * plane
    k = stage.wobbles_per_turn
    wobble = np.deg2rad(stage.wobble_deg) * np.array([np.cos(k * angle_rad), np.sin(k * angle_rad), 0])
    angle = angle_rad + np.deg2rad(stage.angle_error_deg) * np.sin(angle_rad) + moment.angle_error_rad
    sample = Rotation.from_euler("y", -wrong.lean_deg, degrees=True) * Rotation.from_rotvec(wobble)
    sample *= Rotation.from_euler("z", angle)
    place = np.array([0, -wrong.axis_across_mm, 0]) + moment.shift_mm
    place += [
        stage.runout_mm * np.cos(k * angle_rad),
        stage.runout_mm * np.sin(k * angle_rad),
        stage.lift_mm * np.cos(k * angle_rad),
    ]
    return (
        np.array([-source_axis + along, -across, up]),
        np.array([detector, -wrong.column_shift_mm, -wrong.row_shift_mm]),
        turned.apply([0, -1, 0]),
        turned.apply([0, 0, -1]),
        sample.as_matrix(),
        place,
    )


@law(60)
@given(aligners(), places, st.floats(-4, 4), st.tuples(*[st.floats(-0.02, 0.02)] * 4), st.floats(0, 1e4))
def test_chords_are_those_of_rays_laid_out_by_hand(aligner, centre, angle_rad, own, time_s):
    moment = Moment(time_s=time_s, angle_error_rad=own[0], shift_mm=own[1:])
    source, middle, column, row, turn, place = by_hand(aligner, angle_rad, moment)
    shape = 0.3 * np.array([[1.2, 0.2, 0.0], [0.0, 0.8, 0.1], [0.0, 0.1, 1.0]])
    body = replace(spheres([centre]), shapes_mm=shape[None])
    found = chords(aligner, body, angle_rad, moment)
    i, j = np.meshgrid(np.arange(60) - 29.5, np.arange(44) - 21.5, indexing="ij")
    rays = middle + 0.5 * (j[..., None] * column + i[..., None] * row) - source
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    inverse = np.linalg.inv(turn @ shape)
    m, e = inverse @ (source - turn @ centre - place), rays @ inverse.T
    a, b, c = (e * e).sum(-1), (e * m).sum(-1), m @ m - 1
    np.testing.assert_allclose(found, 2 * np.sqrt(np.maximum(b * b - a * c, 0)) / a, atol=3e-5)


@law(60)
@given(aligners(), places, st.floats(-4, 4), st.floats(0, 1e4))
def test_the_vectors_of_the_truth_tell_where_a_point_is_seen(aligner, point, angle_rad, time_s):
    moment = Moment(time_s=time_s)
    source, middle, column, row, turn, place = by_hand(aligner, angle_rad, moment)
    a, b = spot(aligner, point, angle_rad, moment) * 0.5
    seen = middle + a * column + b * row
    np.testing.assert_allclose(np.cross(seen - source, turn @ point + place - source) / 300, 0, atol=1e-9)


def test_a_scanner_that_is_not_misaligned_sees_what_a_cone_beam_tells():
    body = spheres([[0.3, -0.2, 0.5], [-0.4, 0.1, -0.6]])
    aligner = Aligner(recorded=SCANNER)
    assert aligner.plain
    np.testing.assert_allclose(chords(aligner, body, 0.7), path_lengths(body, SCANNER, 0.7, 1)[1], atol=1e-5)


@pytest.mark.parametrize(
    "part",
    [
        {"misalignment": Misalignment(tilt_deg=0.1)},
        {"misalignment": Misalignment(slant_deg=0.1)},
        {"misalignment": Misalignment(axis_across_mm=0.1)},
        *({"stage": RotationStage(**{key: 0.1})} for key in RotationStage.model_fields if key != "wobbles_per_turn"),
        *({"spot": FocalSpot(drift_mm=tuple(0.1 * np.eye(3)[n]))} for n in range(3)),
    ],
)
def test_whatever_a_cone_beam_cannot_tell_is_not_plain(part):
    assert not Aligner(recorded=SCANNER, **part).plain


def test_opposite_views_are_mirrored_about_the_column_of_the_shifted_axis():
    aligner = Aligner(recorded=PARALLEL, misalignment=Misalignment(axis_across_mm=0.06))
    body = spheres([[0.3, -0.2, 0.5], [-0.4, 0.1, -0.6], [0.5, 0.4, 0.1]], 0.2)
    one, other = (chords(aligner, body, angle) for angle in (0.4, 0.4 + np.pi))
    # the axis is 0.06 mm / 0.02 mm = 3 columns right of the middle; a mirror doubles it
    mirrored = np.roll(other[:, ::-1], 2 * 3, axis=1)
    # chords end like square roots, and the beam is not quite parallel
    np.testing.assert_allclose(one, mirrored, atol=3e-3)
    assert np.abs(one - other[:, ::-1]).max() > 0.1


def test_the_image_of_the_axis_slopes_as_the_detector_is_rolled():
    aligner = Aligner(recorded=SCANNER, misalignment=Misalignment(roll_deg=2.0))
    top, bottom = (centroid(chords(aligner, spheres([[0, 0, z]]), 1.0, subpixels=3)) / 3 for z in (1.0, -1.0))
    # the image turns against the detector
    assert (top - bottom)[0] / (top - bottom)[1] == pytest.approx(np.tan(np.deg2rad(2)), rel=5e-3)
    top, bottom = (spot(aligner, [0, 0, z], 1.0) for z in (1.0, -1.0))
    assert (top - bottom)[0] / (top - bottom)[1] == pytest.approx(np.tan(np.deg2rad(2)))


def test_a_shifted_detector_sees_the_image_shifted_the_other_way():
    wrong = Misalignment(column_shift_mm=1.5, row_shift_mm=-2.0)
    plain, shifted = (
        centroid(chords(Aligner(recorded=SCANNER, misalignment=m), spheres([[0.1, 0.2, 0.3]]), 0.3))
        for m in (Misalignment(), wrong)
    )
    np.testing.assert_allclose(shifted - plain, [-3.0, 4.0], atol=1e-3)


@pytest.mark.parametrize("height", [-1.2, 0.7])
@pytest.mark.parametrize("degrees", [-5.0, 3.0])
def test_a_tilted_or_slanted_detector_stretches_the_side_that_leans_away(height, degrees):
    """A ray of slope m meets a line that leaves the axis at L under the angle t at b = m L / (cos t - m sin t)."""
    t, m = np.deg2rad(degrees), height / 30.0
    b = m * 300.0 / (np.cos(t) - m * np.sin(t)) / 0.5
    tilted = Aligner(recorded=SCANNER, misalignment=Misalignment(tilt_deg=degrees))
    np.testing.assert_allclose(spot(tilted, [0, 0, height]), [0, -b], atol=1e-9)
    slanted = Aligner(recorded=SCANNER, misalignment=Misalignment(slant_deg=degrees))
    np.testing.assert_allclose(spot(slanted, [0, -height, 0]), [b, 0], atol=1e-9)


def test_wrong_distances_are_a_wrong_magnification():
    for wrong, magnification in (
        (Misalignment(source_axis_mm=3.0), 300 / 33),
        (Misalignment(source_detector_mm=-30.0), 270 / 30),
        (Misalignment(source_axis_mm=-2.0, source_detector_mm=8.0), 308 / 28),
    ):
        seen = spot(Aligner(recorded=SCANNER, misalignment=wrong), [0, 0.4, 0.6])
        np.testing.assert_allclose(seen * 0.5, [-0.4 * magnification, -0.6 * magnification])


def test_jitter_displaces_by_the_radius_and_backlash_turns_the_test_alone():
    stage = RotationStage(angle_jitter_deg=0.05, backlash_deg=0.3, shake_mm=0.002)
    rng = np.random.default_rng(0)
    drawn = [stage.drawn(rng, in_test=False) for _ in range(4000)]
    aligner = Aligner(recorded=SCANNER, stage=stage)
    radius, at_rest = 0.6, aligner.at(0.4, STILL).turn @ [0.6, 0, 0.2]
    moved = [aligner.at(0.4, Moment(angle_error_rad=angle)).turn @ [0.6, 0, 0.2] - at_rest for angle, _ in drawn]
    rms = np.sqrt(np.square(moved).sum(axis=1).mean())
    # the relative error of a deviation found from n draws is 1 / sqrt(2 n)
    assert rms == pytest.approx(radius * np.deg2rad(0.05), rel=4 / np.sqrt(8000))
    shakes = np.array([shift for _, shift in drawn])
    np.testing.assert_allclose(shakes.std(axis=0), 0.002, rtol=4 / np.sqrt(8000))
    assert abs(np.mean([angle for angle, _ in drawn])) < 4 * np.deg2rad(0.05) / np.sqrt(4000)
    one, other = (stage.drawn(np.random.default_rng(3), in_test=test)[0] for test in (False, True))
    assert other - one == pytest.approx(np.deg2rad(0.3))


def test_an_encoder_off_its_centre_errs_by_a_sine_of_the_angle():
    aligner = Aligner(recorded=SCANNER, stage=RotationStage(angle_error_deg=0.2))
    for angle in np.linspace(0, 7, 15):
        x, y, _ = aligner.at(angle, STILL).turn @ [1, 0, 0]
        assert np.arctan2(y, x) == pytest.approx(
            np.arctan2(np.sin(angle), np.cos(angle)) + np.deg2rad(0.2) * np.sin(angle)
        )


def test_a_wobble_displaces_by_the_height_and_goes_round_twice_a_turn():
    aligner = Aligner(recorded=SCANNER, stage=RotationStage(wobble_deg=0.1, runout_mm=0.003, lift_mm=0.001))
    angles = np.linspace(0, 2 * np.pi, 9)
    top = np.array([aligner.at(a, STILL).turn @ [0, 0, 5.0] - [0, 0, 5.0] for a in angles])
    np.testing.assert_allclose(np.hypot(*top.T[:2]), 5 * np.deg2rad(0.1), rtol=1e-5)
    np.testing.assert_allclose(top[:4], top[4:8], atol=1e-12)
    # w = (cos 2 theta, sin 2 theta, 0) tilts z towards (sin 2 theta, -cos 2 theta)
    np.testing.assert_allclose(top[1, :2], [5 * np.deg2rad(0.1), 0], atol=1e-7)
    axis = np.array([aligner.at(a, STILL).shift_mm for a in angles])
    np.testing.assert_allclose(np.hypot(*axis.T[:2]), 0.003)
    np.testing.assert_allclose(axis[:, 2], 0.001 * np.cos(2 * angles), atol=1e-12)


def test_a_wobble_once_a_turn_is_another_way_to_mount_the_sample():
    aligner = Aligner(recorded=SCANNER, stage=RotationStage(wobble_deg=1.0, wobbles_per_turn=1))
    mounted = aligner.at(0.0, STILL).turn
    for angle in (0.5, 2.0, 4.0):
        plain = Rotation.from_euler("z", angle).as_matrix()
        np.testing.assert_allclose(aligner.at(angle, STILL).turn, plain @ mounted, atol=1e-12)


def test_the_spot_drifts_as_a_body_warms_and_the_image_goes_the_other_way():
    aligner = Aligner(recorded=SCANNER, spot=FocalSpot(drift_mm=(0.02, -0.01, 0.0), drift_time_s=600.0))
    for time_s, share in ((0.0, 0.0), (600.0, 1 - np.exp(-1)), (1e9, 1.0)):
        seen = spot(aligner, [0, 0, 0], moment=Moment(time_s=time_s))
        # M - 1 = 9; a spot that moves to the right and down moves the image to the left and up
        np.testing.assert_allclose(seen, np.array([-0.02, -0.01]) * 9 * share / 0.5, atol=1e-9)
    nearer = Aligner(recorded=SCANNER, spot=FocalSpot(drift_mm=(0.0, 0.0, 1.0)))
    assert spot(nearer, [0, -1, 0], moment=Moment(time_s=1e9))[0] * 0.5 == pytest.approx(299 / 29)


def test_a_surface_is_seen_as_its_spheres_are():
    """The other kernel: a sphere of triangles at the place of one of graphite."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.4)
    mesh.apply_translation([0.2, 0.1, -0.3])
    body = Body(
        vertices_mm=np.array(mesh.vertices),
        faces=np.array(mesh.faces, dtype=np.int64),
        centres_mm=np.zeros((0, 3)),
        shapes_mm=np.zeros((0, 3, 3)),
    )
    wrong = Misalignment(tilt_deg=4.0, slant_deg=-3.0, roll_deg=2.0, axis_across_mm=0.2)
    aligner = Aligner(recorded=SCANNER, misalignment=wrong)
    moved, scanner = aligner.at(0.9, STILL).seen(body, SCANNER)
    expected = chords(aligner, spheres([[0.2, 0.1, -0.3]], 0.4), 0.9)
    inner = expected > 0.3
    np.testing.assert_allclose(path_lengths(moved, scanner, 0.0, 1)[0][inner], expected[inner], atol=6e-3)
