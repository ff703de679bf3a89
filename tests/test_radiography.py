"""Path lengths against closed forms in the sample frame, with rays laid out after the words of pdvc.geometry.

The rays here stand in the *sample* frame (source and detector turn by -theta), the code under test works in
the lab frame (the object turns by +theta): a wrong sign cannot cancel.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pdvc.geometry import ConeBeam
from simulator import radiography
from simulator.microstructure import Graphite, place
from simulator.radiography import Body, path_lengths
from simulator.specimen import Specimen, dog_bone, section_mm, turn_back
from tests.laws import law
from validation.testing.strategies import angles_rad, cone_beams

SCANNER = ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=60, columns=44)
PARALLEL = ConeBeam(source_axis_mm=1e6, source_detector_mm=1.0001e6, pixel_mm=0.02, rows=170, columns=150)
NONE = {"vertices_mm": np.zeros((0, 3)), "faces": np.zeros((0, 3), dtype=np.int64)}


def body(mesh=None, centres=(), shapes=()):
    surface = (
        NONE
        if mesh is None
        else {
            "vertices_mm": np.array(mesh.vertices, dtype=np.float64),
            "faces": np.array(mesh.faces, dtype=np.int64),
        }
    )
    return Body(
        **surface,
        centres_mm=np.array(centres, dtype=np.float64).reshape(-1, 3),
        shapes_mm=np.array(shapes, dtype=np.float64).reshape(-1, 3, 3),
    )


def rays_in_sample_frame(geometry, angle_rad, subpixels):
    """Return the source (3,) and unit directions (rows, columns, 3) of all sub-pixel centres."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    along_beam, along_columns = np.array([c, -s, 0]), np.array([-s, -c, 0])
    along_rows = np.array([0, 0, -1.0])
    pitch = geometry.pixel_mm / subpixels
    a = (np.arange(geometry.columns * subpixels) - (geometry.columns * subpixels - 1) / 2) * pitch
    b = (np.arange(geometry.rows * subpixels) - (geometry.rows * subpixels - 1) / 2) * pitch
    c, s = math.cos(geometry.roll_rad), math.sin(geometry.roll_rad)
    u = geometry.column_shift_mm + c * a[None, :] - s * b[:, None]
    v = geometry.row_shift_mm + s * a[None, :] + c * b[:, None]
    source = -geometry.source_axis_mm * along_beam
    ray = geometry.source_detector_mm * along_beam + u[..., None] * along_columns + v[..., None] * along_rows
    return source, ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def chords_of_ellipsoid(centre, shape, source, directions):
    """|B (o + t d - c)| = 1 with B = A^-1: the difference of the two roots t."""
    inverse = np.linalg.inv(shape)
    m, e = inverse @ (source - centre), directions @ inverse.T
    a, b, c = (e * e).sum(-1), (e * m).sum(-1), m @ m - 1
    return 2 * np.sqrt(np.maximum(b * b - a * c, 0)) / a


def chords_of_box(half, source, directions):
    with np.errstate(divide="ignore", over="ignore"):
        near, far = ((side * half - source) / directions for side in (-1, 1))
    return np.maximum(np.maximum(near, far).min(-1) - np.minimum(near, far).max(-1), 0)


shapes = st.lists(st.floats(-0.5, 0.5), min_size=9, max_size=9).map(
    lambda x: 0.6 * np.eye(3) + np.reshape(x, (3, 3)) / 3
)
points = st.lists(st.floats(-0.8, 0.8), min_size=3, max_size=3).map(np.array)


@law()
@given(cone_beams(), angles_rad(), points, shapes, st.integers(1, 3))
def test_nodule_chords_are_those_of_the_ellipsoid(geometry, angle_rad, centre, shape, subpixels):
    matrix, graphite = path_lengths(body(None, [centre], [shape]), geometry, angle_rad, subpixels)
    expected = chords_of_ellipsoid(centre, shape, *rays_in_sample_frame(geometry, angle_rad, subpixels))
    assert expected.shape == graphite.shape
    # a chord that is cut off by an error e of the discriminant is as long as sqrt(e)
    np.testing.assert_allclose(graphite, expected, atol=2e-5)
    np.testing.assert_array_equal(matrix, -graphite)


def test_small_nodules_are_exact_far_from_the_axis():
    rng = np.random.default_rng(0)
    centres = rng.uniform(-1, 1, (40, 3)) * [1.0, 1.0, 1.4]
    radii = rng.uniform(0.01, 0.05, 40)
    _, graphite = path_lengths(body(None, centres, radii[:, None, None] * np.eye(3)), SCANNER, 0.7, 4)
    rays = rays_in_sample_frame(SCANNER, 0.7, 4)
    expected = sum(chords_of_ellipsoid(c, r * np.eye(3), *rays) for c, r in zip(centres, radii, strict=True))
    np.testing.assert_allclose(graphite, expected, atol=1e-6)


@law()
@given(cone_beams(), angles_rad(), st.integers(1, 3))
def test_surface_chords_are_those_of_the_box(geometry, angle_rad, subpixels):
    half = np.array([0.7, 0.4, 0.5])
    mesh = trimesh.creation.box(2 * half).subdivide().subdivide()
    matrix, graphite = path_lengths(body(mesh), geometry, angle_rad, subpixels)
    expected = chords_of_box(half, *rays_in_sample_frame(geometry, angle_rad, subpixels))
    # rays along a face may count to either side of it
    wrong = np.abs(matrix - expected) > 1e-5
    assert wrong.mean() < 5e-3
    assert not graphite.any()


@pytest.mark.parametrize("law", ["cylinder", "sphere"])
def test_mesh_chords_converge_with_the_square_of_the_facets(law):
    errors = []
    source, directions = rays_in_sample_frame(SCANNER, 0.3, 1)
    if law == "cylinder":
        meshes = [trimesh.creation.cylinder(radius=0.5, height=20, sections=n) for n in (32, 64, 128)]
        flat = np.array([[1.0, 0, 0], [0, 1, 0]])
        a = (directions @ flat.T) ** 2
        b, c = directions @ flat.T @ (flat @ source), source @ source - 0.25
        expected = 2 * np.sqrt(np.maximum(b**2 - a.sum(-1) * c, 0)) / a.sum(-1)
    else:
        meshes = [trimesh.creation.icosphere(subdivisions=n, radius=0.8) for n in (2, 3, 4)]
        expected = chords_of_ellipsoid(np.zeros(3), 0.8 * np.eye(3), source, directions)
    for mesh in meshes:
        matrix, _ = path_lengths(body(mesh), SCANNER, 0.3, 1)
        inner = expected > 0.4
        errors.append(np.sqrt(np.mean((matrix - expected)[inner] ** 2)))
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert rates.min() > 1.8


def test_chords_through_a_deformed_dog_bone_agree_with_quadrature():
    """March each ray in steps of 1 um through the closed form of a sheared, sectioned bar."""
    specimen = Specimen(length_mm=30.0, turned_deg=25.0)
    shear = np.array([[1.0, 0.02, 0.05], [-0.03, 1.0, 0.02], [0.0, 0.0, 1.04]])
    mesh = dog_bone(specimen)
    mesh = trimesh.Trimesh(mesh.vertices @ shear.T + [0.1, -0.2, 0.3], mesh.faces, process=False)
    matrix, _ = path_lengths(body(mesh), SCANNER, 1.1, 1)
    source, directions = rays_in_sample_frame(SCANNER, 1.1, 1)
    t = np.arange(27.5, 32.5, 1e-3) + 5e-4
    for i, j in [(3, 20), (30, 22), (30, 12), (41, 31), (58, 25), (25, 2)]:
        path = source + t[:, None] * directions[i, j] - [0.1, -0.2, 0.3]
        x, y, z = turn_back(specimen, path @ np.linalg.inv(shear).T).T
        half_x, half_y = section_mm(specimen, z)
        inside = (np.abs(x) < half_x) & (np.abs(y) < half_y)
        assert matrix[i, j] == pytest.approx(1e-3 * inside.sum(), abs=2.5e-3)


@law(30)
@given(cone_beams(), angles_rad(), st.integers(0, 2**32 - 1), st.booleans())
def test_no_ray_leaks(geometry, angle_rad, seed, aligned):
    """The signed crossings of every ray sum to exactly zero, for crumpled surfaces and for aligned edges."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    vertices = np.array(mesh.vertices) + rng.normal(0, 0.05, mesh.vertices.shape)
    screen = radiography._Screen.of(geometry, 2)
    lab = vertices + np.array([geometry.source_axis_mm, 0, 0])
    column, row = screen.image_of(lab)
    if aligned:
        # vertices exactly at ray centres, edges exactly through them, many triangles without area
        column, row = np.rint(column / 2) * 2, np.rint(row / 2) * 2
    crossings = np.zeros((screen.rows, screen.columns))
    radiography._add_surface(crossings, column, row, np.ones(len(lab)), np.array(mesh.faces, dtype=np.int64))
    assert not crossings.any()


def test_no_ray_leaks_through_the_dog_bone_at_full_size():
    geometry = ConeBeam(source_axis_mm=800 / 28, source_detector_mm=800, pixel_mm=0.2996, rows=954, columns=432)
    matrix, _ = path_lengths(body(dog_bone(Specimen())), geometry, 0.4, 2)
    assert matrix.min() >= 0
    # no chord is longer than the diagonal of the largest section in view, 6 % above the window's edge on the axis,
    # and rays rise to 11 degrees: 2 % more
    half = section_mm(Specimen(), 1.06 * geometry.voxel_mm * geometry.rows / 2)
    assert matrix.max() < 1.02 * 2 * np.hypot(*half)


@law(15)
@given(angles_rad(), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), points)
def test_rigid_motion_conserves_the_amount_of_matter(angle_rad, tilt, lean, centre):
    """A far source sees volume / pixel area as the sum of all path lengths, wherever the object is."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    mesh.apply_scale([1.0, 0.8, 1.2])
    nodules = np.array([[0.1, 0.2, 0.3], [-0.2, 0.0, -0.2]])
    turned = trimesh.transformations.euler_matrix(tilt, lean, angle_rad)[:3, :3]
    moved = trimesh.Trimesh(mesh.vertices @ turned.T + 0.5 * centre, mesh.faces, process=False)
    shapes = [turned @ np.diag([0.2, 0.1, 0.15]), turned * 0.1]
    matrix, graphite = path_lengths(body(moved, nodules @ turned.T + 0.5 * centre, shapes), PARALLEL, angle_rad, 4)
    area = (PARALLEL.voxel_mm / 4) ** 2
    expected = 4 / 3 * np.pi * (0.2 * 0.1 * 0.15 + 0.1**3)
    assert graphite.sum(dtype=float) * area == pytest.approx(expected, rel=2e-3)
    assert matrix.sum(dtype=float) * area == pytest.approx(mesh.volume - expected, rel=1e-3)


def spot(geometry, angle_rad, centre):
    """Return the centroid (row, column) of a small nodule's image, in pixels from the image centre."""
    _, graphite = path_lengths(body(None, [centre], [0.1 * np.eye(3)]), geometry, angle_rad, 4)
    i, j = np.indices(graphite.shape)
    weight = graphite / graphite.sum()
    return (
        ((i * weight).sum() - (graphite.shape[0] - 1) / 2) / 4,
        ((j * weight).sum() - (graphite.shape[1] - 1) / 2) / 4,
    )


@pytest.mark.parametrize(
    ("angle_deg", "centre", "row", "column"),
    [
        (0, (0, 0.5, 0), 0, -0.5),  # +y is on the left
        (0, (0, 0, 0.5), -0.5, 0),  # +z is in the upper rows
        (90, (0.5, 0, 0), 0, -0.5),  # the stage carries +x to where +y was
        (-90, (0.5, 0, 0), 0, 0.5),
        (90, (0, 0.5, 0.7), -0.7 * 30 / 29.5, 0),  # ... and +y to -x: nearer to the source, larger
        (0, (0.5, 0, 0.7), -0.7 * 30 / 30.5, 0),
    ],
)
def test_images_lie_where_the_frame_says(angle_deg, centre, row, column):
    found = spot(SCANNER, np.deg2rad(angle_deg), centre)
    np.testing.assert_allclose(found, np.array([row, column]) / SCANNER.voxel_mm, atol=0.02)


def test_a_shifted_detector_moves_the_image_the_other_way_and_roll_turns_it():
    row, column = spot(replace(SCANNER, column_shift_mm=1.5, row_shift_mm=-2.0), 0.0, (0, 0, 0))
    np.testing.assert_allclose((row, column), (4, -3), atol=0.02)
    row, column = spot(replace(SCANNER, roll_rad=0.3), 0.0, (0, -0.5, 0))
    np.testing.assert_allclose((row, column), (-10 * math.sin(0.3), 10 * math.cos(0.3)), atol=0.02)


@given(cone_beams(), angles_rad(), st.integers(2, 4))
@law(20)
def test_cropping_the_geometry_crops_the_image(geometry, angle_rad, factor):
    sample = body(trimesh.creation.icosphere(subdivisions=2, radius=0.8), [[0.2, 0.1, -0.3]], [0.3 * np.eye(3)])
    whole, _ = path_lengths(sample, geometry, angle_rad, 1)
    part, _ = path_lengths(sample, geometry.cropped(3, 15, 5, 20), angle_rad, 1)
    np.testing.assert_allclose(part, whole[3:15, 5:20], atol=1e-4)
    binned, _ = path_lengths(sample, geometry.binned(factor), angle_rad, factor)
    rows, columns = binned.shape
    np.testing.assert_allclose(binned, whole[:rows, :columns], atol=1e-4)


@pytest.mark.parametrize("where", [(0, 2.0, 0), (0, -2.0, 0), (0, 0, 2.5), (0, 0, -2.5), (0, 2.0, 2.5)])
def test_what_is_beside_the_image_leaves_no_trace_in_it(where):
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    mesh.apply_translation(where)
    beside = np.add(where, [[0.0, 0.1, 0.0], [0.0, 0.0, -0.1]])
    matrix, graphite = path_lengths(body(mesh, beside, [0.1 * np.eye(3)] * 2), SCANNER, 0.0, 1)
    assert not matrix.any()
    assert not graphite.any()


def test_nodules_take_their_place_from_the_matrix():
    mesh = trimesh.creation.box((1.0, 1.0, 1.0))
    nodule = {"centres": [[0.1, 0.0, -0.1]], "shapes": [0.3 * np.eye(3)]}
    full, _ = path_lengths(body(mesh), SCANNER, 0.5, 2)
    matrix, graphite = path_lengths(body(mesh, **nodule), SCANNER, 0.5, 2)
    np.testing.assert_allclose(matrix + graphite, full, atol=1e-6)
    assert graphite.dtype == matrix.dtype == np.float32


def test_threads_do_not_change_a_bit():
    specimen = Specimen(length_mm=4.0)
    nodules = place(Graphite(volume_fraction=0.02), specimen, np.random.default_rng(0), 2.0)
    sample = body(dog_bone(specimen), nodules.centre_mm, nodules.radius_mm[:, None, None] * np.eye(3))
    angles = np.linspace(0, 6, 8)
    alone = [path_lengths(sample, SCANNER, a, 2) for a in angles]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda a: path_lengths(sample, SCANNER, a, 2), angles))
    np.testing.assert_array_equal(alone, together)


def test_an_object_that_reaches_the_source_is_refused():
    with pytest.raises(ValueError, match="body: expected between source and detector"):
        path_lengths(body(trimesh.creation.box((61.0, 1.0, 1.0))), SCANNER, 0.0, 1)
    with pytest.raises(ValueError, match="body: expected between source and detector"):
        path_lengths(cracked([-31.0, 0.0, 0.0], np.eye(3)), SCANNER, 0.0, 1)


def cracked(centre, shape, mesh=None):
    return replace(
        body(mesh), crack_centres_mm=np.array([centre], dtype=float), crack_shapes_mm=np.array([shape], dtype=float)
    )


def air(geometry, angle_rad, subpixels, centre, shape):
    """Return by how much a crack shortens the path of each sub-pixel."""
    return -path_lengths(cracked(centre, shape), geometry, angle_rad, subpixels)[0]


rotations = st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3).map(
    lambda r: Rotation.from_rotvec(r).as_matrix()
)


def ball(n=24):
    """Return points of the unit ball and their weights, exact for polynomials (Gauss, Legendre and the trapezes)."""
    r, by_r = np.polynomial.legendre.leggauss(n)
    up, by_up = np.polynomial.legendre.leggauss(n)
    around = np.arange(2 * n) * np.pi / n
    r, flat = (r + 1) / 2, np.sqrt(1 - up**2)
    unit = np.stack(
        np.broadcast_arrays(flat[:, None] * np.cos(around), flat[:, None] * np.sin(around), up[:, None]), -1
    )
    weight = (by_r / 2 * r**2)[:, None, None] * by_up[:, None] * np.full(2 * n, np.pi / n)
    return (r[:, None, None, None] * unit).reshape(-1, 3), weight.ravel()


@law(60)
@given(rotations, st.floats(-8, 0).map(lambda power: 0.4 * 10**power), points, angles_rad(), st.integers(1, 3))
def test_no_air_is_lost_between_the_rays_however_flat_a_crack_is(turned, half, centre, angle_rad, subpixels):
    """Length by solid angle, over all rays, is the integral of 1 / r^2 over the volume, r from the source.

    Half openings from 0.4 mm, a ball, to 4e-9 mm; a sub-pixel is 0.017 to 0.05 mm.
    """
    # wholly in the image, which ends 1.1 mm from the axis
    shape, centre = turned @ np.diag([0.4, 0.4, half]), 0.5 * centre
    lengths = air(SCANNER, angle_rad, subpixels, centre, shape)
    pitch, distance = SCANNER.pixel_mm / subpixels, SCANNER.source_detector_mm
    v, u = (pitch * (np.arange(n) - (n - 1) / 2) for n in lengths.shape)
    solid_angle = pitch**2 * distance / (distance**2 + u**2 + v[:, None] ** 2) ** 1.5
    source, _ = rays_in_sample_frame(SCANNER, angle_rad, 1)
    inside, weight = ball()
    away = inside @ shape.T + centre - source
    expected = (weight / (away**2).sum(-1)).sum() * 0.16 * half
    # |d| and the solid angle are those of the middle of a sub-pixel, up to 0.025 mm from the crack: d varies by
    # 0.025 / 30, and |d|^2 by twice that times its slopes of up to 0.04
    assert (lengths * solid_angle).sum() == pytest.approx(expected, rel=7e-5)


def test_a_crack_between_two_rows_of_rays_is_seen_by_neither_and_shortens_both():
    """A crack of 1 um in the plane of source and detector centre; a row is 0.05 mm.

    Its closed form: the mean over the two rows beside the plane, in the column on the axis, is the area pi R h of its
    section over the height of two rows.
    """
    scanner = replace(SCANNER, columns=45)
    flat = np.diag([0.4, 0.4, 5e-4])
    _, points_miss_it = path_lengths(body(None, [np.zeros(3)], [flat]), scanner, 0.3, 1)
    assert not points_miss_it.any()
    lengths = air(scanner, 0.3, 1, np.zeros(3), flat)
    assert set(np.flatnonzero(lengths.any(axis=1))) == {29, 30}
    # over a column of 0.05 mm about the middle, the mean of 1 - (x / R)^2 is less than 1 by 0.05^2 / (12 R^2)
    expected = np.pi * 0.4 * 5e-4 / (2 * 0.05) * (1 - 0.05**2 / 12 / 0.16)
    np.testing.assert_allclose(lengths[29:31, 22], expected, rtol=1e-4)


@law(40)
@given(cone_beams(), angles_rad(), points, shapes, st.integers(1, 2))
def test_a_crack_shortens_each_path_by_the_mean_of_chords_over_the_sub_pixel(
    geometry, angle, centre, shape, subpixels
):
    finer = 8
    _, chords = path_lengths(body(None, [centre], [shape]), geometry, angle, finer * subpixels)
    rows, columns = geometry.rows * subpixels, geometry.columns * subpixels
    mean = chords.astype(float).reshape(rows, finer, columns, finer).mean(axis=(1, 3))
    found = air(geometry, angle, subpixels, centre, shape)
    # at the rim, where a chord begins as a square root, 8 x 8 points know the mean to a hundredth of the longest chord
    assert np.abs(found - mean).max() < 0.015 * max(chords.max(), 0.01)


@law(40)
@given(cone_beams(), angles_rad(), points, rotations, st.floats(1e-6, 0.3), st.integers(1, 3))
def test_a_crack_never_adds_matrix_nor_takes_more_than_its_chord(geometry, angle, centre, turned, half, subpixels):
    shape = turned @ np.diag([0.4, 0.4, half])
    mesh = trimesh.creation.box((4.0, 4.0, 4.0))
    whole, _ = path_lengths(body(mesh), geometry, angle, subpixels)
    left, graphite = path_lengths(cracked(0.5 * centre, shape, mesh), geometry, angle, subpixels)
    rounding = 1e-5
    assert (whole - left).min() >= -rounding
    # no chord of a spheroid is longer than its longest axis
    assert (whole - left).max() <= 0.8 + rounding
    assert left.min() >= -rounding
    assert not graphite.any()


def test_a_crack_partly_beside_the_image_is_cropped():
    shape = Rotation.from_rotvec([0.3, 0.9, 0.2]).as_matrix() @ np.diag([0.4, 0.4, 0.01])
    centre = np.array([0.1, 0.2, 0.1])
    whole = air(SCANNER, 0.4, 2, centre, shape)
    part = air(SCANNER.cropped(25, 31, 15, 22), 0.4, 2, centre, shape)
    assert part.any()
    np.testing.assert_allclose(part, whole[50:62, 30:44], atol=1e-6)


def test_a_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"body\.shapes_mm: expected shape \(1, 3, 3\)"):
        Body(**NONE, centres_mm=np.zeros((1, 3)), shapes_mm=np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"body\.crack_shapes_mm: expected shape \(1, 3, 3\)"):
        replace(body(), crack_centres_mm=np.zeros((1, 3)))
