import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from pdvc.settings import SettingsError
from simulator.specimen import Specimen, area_mm2, depth_mm, dog_bone, section_mm, turn, turn_back
from tests.laws import law


def test_the_ligament_is_that_of_the_paper():
    half_x, half_y = section_mm(Specimen(), 0.0)
    assert (2 * half_x, 2 * half_y) == (1.31, 0.91)


def test_the_fillet_is_a_circle_that_touches_the_ligament():
    specimen = Specimen()
    z = np.linspace(-5, 5, 21)
    half_x, half_y = section_mm(specimen, z)
    np.testing.assert_allclose(np.hypot(half_x - (1.31 / 2 + 20.5), z), 20.5, rtol=1e-14)
    np.testing.assert_allclose(np.hypot(half_y - (0.91 / 2 + 20.5), z), 20.5, rtol=1e-14)


def test_a_side_that_is_not_thinned_is_flat():
    z = np.linspace(-5, 5, 21)
    thinned, flat = section_mm(Specimen(thinned="x"), z)
    np.testing.assert_array_equal(thinned, section_mm(Specimen(), z)[0])
    np.testing.assert_array_equal(flat, 0.455)
    flat, thinned = section_mm(Specimen(thinned="y"), z)
    np.testing.assert_array_equal(thinned, section_mm(Specimen(), z)[1])
    np.testing.assert_array_equal(flat, 0.655)


def test_the_grip_has_a_constant_section():
    half_x, _ = section_mm(Specimen(length_mm=60), np.array([6.0, 15.0, 25.0]))
    np.testing.assert_array_equal(half_x, 1.5)


@law(40)
@given(
    thinned=st.sampled_from(["x", "y", "both"]),
    radius=st.floats(2.0, 40.0),
    length=st.floats(1.0, 20.0),
    turned=st.floats(-360, 360),
)
def test_the_mesh_is_closed_and_has_the_volume_of_the_closed_form(thinned, radius, length, turned):
    specimen = Specimen(
        thinned=thinned,
        fillet_radius_mm=radius,
        length_mm=length,
        turned_deg=turned,
        facet_mm=min(0.25, np.sqrt(8e-4 * radius)),
    )
    mesh = dog_bone(specimen)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    exact, _ = quad(lambda z: float(area_mm2(specimen, z)), 0, length / 2, limit=200)
    # facets lie within 1e-4 mm of a surface that is at most 4 x 3 mm around
    assert abs(mesh.volume - 2 * exact) < 1e-4 * 12 * length


def test_mesh_vertices_lie_on_the_surface_and_facets_within_the_stated_error():
    specimen = Specimen()
    mesh = dog_bone(specimen)
    sides = np.abs(mesh.face_normals[:, 2]) < 0.9
    used = np.unique(mesh.faces[sides])
    assert np.abs(depth_mm(specimen, mesh.vertices[used])).max() < 1e-12
    middles = mesh.vertices[mesh.faces[sides]].mean(axis=1)
    assert np.abs(depth_mm(specimen, middles)).max() < specimen.facet_error_mm < 1e-4
    # a facet grows with the section, from the ligament to the grips
    growth = specimen.grip_width_mm / np.array([specimen.width_mm, specimen.thickness_mm])
    assert mesh.edges_unique_length.max() < np.linalg.norm(growth) * specimen.facet_mm


def test_depth_agrees_with_the_distance_to_the_mesh():
    specimen = Specimen(thinned="both", grip_width_mm=1.5)
    rng = np.random.default_rng(0)
    points = turn(specimen, rng.uniform(-1, 1, (4000, 3)) * [0.75, 0.75, 5.0])
    depth = depth_mm(specimen, points)
    # the nearest surface point bounds the distance from above, a dense sample of it from below
    mesh = dog_bone(specimen)
    sides = trimesh.Trimesh(mesh.vertices, mesh.faces[np.abs(mesh.face_normals[:, 2]) < 0.9], process=False)
    samples = sides.triangles_center
    deep = depth > 0.1
    for point, d in zip(points[deep][:50], depth[deep][:50], strict=True):
        nearest = np.sqrt(((samples - point) ** 2).sum(axis=1).min())
        assert d - specimen.facet_error_mm <= nearest <= d + 0.07
    half_x, half_y = section_mm(specimen, points[:, 2])
    x, y, _ = turn_back(specimen, points).T
    np.testing.assert_array_equal(depth > 0, (abs(x) < half_x) & (abs(y) < half_y))


def test_the_turn_is_counter_clockwise_from_above():
    np.testing.assert_allclose(turn(Specimen(turned_deg=90), np.array([1.0, 0.0, 2.0])), [0.0, 1.0, 2.0], atol=1e-15)


def test_the_mesh_can_be_exported_and_read_again(tmp_path):
    mesh = dog_bone(Specimen(length_mm=2.0))
    mesh.export(tmp_path / "dog_bone.stl")
    again = trimesh.load_mesh(tmp_path / "dog_bone.stl")
    assert again.is_watertight
    assert again.volume == pytest.approx(mesh.volume, rel=1e-6)


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"width_mm": -1.0}, "width_mm"),
        ({"grip_width_mm": 1.0}, "grip_width_mm"),
        ({"facet_mm": 1.0}, "facet_mm"),
        ({"fillet_radius_mm": 0.5, "facet_mm": 0.01}, "fillet_radius_mm of at least 0.845 mm"),
        ({"width": 1.0}, "width"),
    ],
)
def test_a_wrong_entry_is_named(values, key):
    with pytest.raises(SettingsError, match=key):
        Specimen.parse(values, where="here")
