"""What re-projection leaves: the views that a step looks along, and how their fields move with the sample."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pdvc.geometry import ConeBeam
from pdvc.likeness import neighbouring_views
from pdvc.rays import ray_vectors
from pdvc.sections import CONTRACTION, RIGID, SectionBasis
from pdvc.systematic import KNOT, Systematic, _cubic, taps, turned_rad, views_around
from tests.laws import law

SCANNER = ConeBeam(source_axis_mm=200.0, source_detector_mm=2000.0, pixel_mm=0.5, rows=40, columns=30, roll_rad=0.0)
VOXEL_MM = 0.05
WINDOW = (5, 33, 4, 27)
SHAPE = (28, 23)
BASIS = SectionBasis(height_mm=np.array([-0.6, 0.0, 0.5]), radius_mm=0.5)
GROWING = SectionBasis(height_mm=np.array([-0.6, 0.1, 0.5]), radius_mm=0.5, motions=(*RIGID, CONTRACTION))
TENTH = np.deg2rad(36.0)


def fields(count=1):
    return np.random.default_rng(1).normal(size=(count, SCANNER.rows, SCANNER.columns)).astype(np.float32)


def systematic(step_rad=0.7, values=None, view_rad=(0.7,)):
    """Return fields of one view, or of several, and steps; a single view is looked along from everywhere."""
    values = fields(len(view_rad)) if values is None else values
    return Systematic(
        left=lambda view: values[view],
        view_rad=np.array(view_rad),
        step_rad=np.atleast_1d(step_rad),
        corner=(WINDOW[0], WINDOW[2]),
        shape=SHAPE,
        detector=(SCANNER.rows, SCANNER.columns),
        width_rad=0.01,
    )


def registered(of, amplitude, angle=0.7, basis=BASIS):
    rays = ray_vectors(SCANNER.cropped(*WINDOW), angle).stacked()
    return of.registered(slice(0, 1), rays, basis, amplitude[None], VOXEL_MM)[0]


def window(image, down=0, right=0):
    return image[WINDOW[0] + down : WINDOW[1] + down, WINDOW[2] + right : WINDOW[3] + right]


# The two views next to an angle


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


# The views around a direction


def shares_of(view_rad, direction, width):
    """Return the share of every view (view,) in the mean around a direction."""
    views, share = views_around(np.asarray(view_rad), np.array([direction]), width)
    assert len(np.unique(views[0])) == len(views[0])
    found = np.zeros(len(view_rad))
    found[views[0]] = share[0]
    return found


def drawn_views(seed, count):
    """Return views of one turn (view,), unevenly apart, in any order and a turn or two away."""
    rng = np.random.default_rng(seed)
    even = np.linspace(0, 2 * np.pi, count, endpoint=False)
    turns = rng.integers(-2, 3, size=count)
    return rng.permutation(even + rng.uniform(-0.2, 0.2, count) * 2 * np.pi / count) + 2 * np.pi * turns


seeds = st.integers(0, 10**6)


@law(50)
@given(seeds, st.integers(1, 60), st.floats(0.0, 0.3), st.floats(-9.0, 9.0))
def test_shares_are_none_below_zero_and_add_up_to_one(seed, count, width, direction):
    share = shares_of(drawn_views(seed, count), direction, width)
    assert (share >= 0).all()
    assert share.sum() == pytest.approx(1, abs=1e-12)


@law(50)
@given(seeds, st.integers(20, 90), st.floats(0.5, 3.0), st.floats(-9.0, 9.0))
def test_shares_of_evenly_spaced_views_are_a_gaussian_of_the_angle_between(seed, count, widths, direction):
    """The angle is taken over the turn's end too; beyond three deviations nothing counts."""
    gap = 2 * np.pi / count
    view = np.random.default_rng(seed).permutation(gap * np.arange(count)) + 0.1
    away = np.abs(np.angle(np.exp(1j * (view - direction)))) / (widths * gap)
    assume(np.abs(away - 3).min() > 1e-6)
    expected = np.exp(-(away**2) / 2) * (away <= 3)
    np.testing.assert_allclose(shares_of(view, direction, widths * gap), expected / expected.sum(), atol=1e-6)


@law(30)
@given(seeds, st.integers(8, 60), st.floats(0.0, 0.3), st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
def test_shares_follow_a_turn_of_everything_and_a_mirror(seed, count, width, direction, turn):
    view = drawn_views(seed, count)
    share = shares_of(view, direction, width)
    np.testing.assert_allclose(shares_of(view + turn, direction + turn, width), share, atol=1e-6)
    np.testing.assert_allclose(shares_of(-view, -direction, width), share, atol=1e-6)


def test_views_that_are_not_closer_than_the_width_count_by_half_their_spacing():
    """On a view its neighbours are two deviations away, half-way between two these alone are within three."""
    view = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    beside = np.exp(-2)
    on = shares_of(view, view[7], 0.0)
    np.testing.assert_allclose(on[6:9], np.array([beside, 1, beside]) / (1 + 2 * beside), rtol=1e-6)
    np.testing.assert_allclose(on.sum(), on[6:9].sum())
    np.testing.assert_array_equal(shares_of(view, view[7], 0.01), on)
    between = shares_of(view, view[[7, 8]].mean(), 0.0)
    np.testing.assert_allclose(between[7:9], 0.5, atol=0.01)


@pytest.mark.parametrize("direction", [2.0, 2.3, 3.0 - 1e-6, 2.0 + 4 * np.pi])
def test_a_view_far_from_all_others_is_taken_alone(direction):
    """However far it is: of a scan with gaps the nearest view shows best what a step sees."""
    view = np.concatenate([np.linspace(3.0, 6.0, 100), [2.0]])
    nearest = 100 if direction % (2 * np.pi) < 2.5 else 0
    found = shares_of(view, direction, 0.02)
    if nearest == 100:
        np.testing.assert_array_equal(found, np.arange(101) == 100)
    else:
        assert found[100] == 0
        assert found[0] > 0.01


def test_a_view_counts_by_the_part_of_the_turn_that_it_stands_for():
    """Two views taken almost at one angle count as that one alone did."""
    view = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    once = shares_of(view, view[20] + 0.07, 0.2)
    twice = shares_of(np.append(view, view[20] + 1e-7), view[20] + 0.07, 0.2)
    np.testing.assert_allclose(twice[20] + twice[60], once[20], rtol=1e-5)
    np.testing.assert_allclose(np.delete(twice[:60], 20), np.delete(once, 20), rtol=1e-5, atol=1e-12)


# The direction in which a step looks through the sample as it was


def turned(angle, basis, amplitude):
    return float(turned_rad(ray_vectors(SCANNER, angle).stacked(), basis, amplitude[None], VOXEL_MM)[0])


def turn_about_z(psi, basis=GROWING):
    """Return amplitudes (section, motion) of x = R(psi) X, X being where a point was: x - u(x) = R(-psi) x."""
    amplitude = np.zeros(basis.shape)
    amplitude[:, basis.names.index("rotation_z")] = np.sin(psi) * basis.radius_mm / VOXEL_MM
    amplitude[:, basis.names.index("contraction")] = (1 - np.cos(psi)) * basis.radius_mm / VOXEL_MM
    return amplitude


@pytest.mark.parametrize("psi", [0.3, -0.02, 1e-4])
@pytest.mark.parametrize("angle", [0.0, 0.7, 4.4])
def test_a_sample_that_turned_is_seen_as_at_rest_from_a_stage_angle_turned_as_much(angle, psi):
    """By the rays themselves: turned back with the sample they are those of the stage angle theta + psi."""
    assert turned(angle, GROWING, turn_about_z(psi)) == pytest.approx(psi, abs=1e-9)
    back = np.array([[np.cos(psi), np.sin(psi), 0], [-np.sin(psi), np.cos(psi), 0], [0, 0, 1]])
    rays, there = (ray_vectors(SCANNER, each).stacked()[0] for each in (angle, angle + psi))
    np.testing.assert_allclose(rays @ back.T, there, atol=1e-9)
    used = ray_vectors(SCANNER.cropped(*WINDOW), angle).stacked()[0]
    places = systematic(angle).places(0, used, GROWING, turn_about_z(psi), VOXEL_MM)
    own = np.stack(np.indices(SHAPE), axis=-1) + np.array([WINDOW[0], WINDOW[2]])
    np.testing.assert_allclose(places[..., :2], own, atol=1e-6)
    # no path grew
    np.testing.assert_allclose(places[..., 2], 1, atol=1e-9)


def test_e_grows_as_the_path_through_the_material_does():
    """By contraction and by nothing else here; its place is that of the material."""
    amplitude = np.zeros(GROWING.shape)
    amplitude[:, -1] = 1.2
    grown = 1.2 * VOXEL_MM / GROWING.radius_mm
    rays = ray_vectors(SCANNER.cropped(*WINDOW), 0.7).stacked()[0]
    places = systematic(0.7).places(0, rays, GROWING, amplitude, VOXEL_MM)
    # x = X (1 + grown) from X = x (1 - grown): the path is longer by 1 / (1 - grown), but along z
    np.testing.assert_allclose(places[..., 2], 1 / (1 - grown), rtol=1e-4)


@pytest.mark.parametrize("angle", [0.0, 1.1, 4.4])
@pytest.mark.parametrize("shift", [12.0, -5.0])
def test_a_sample_that_moved_across_the_beam_is_seen_from_its_side(angle, shift):
    """To the right of the image by u: as at rest from theta + u / |S|."""
    amplitude = np.zeros(BASIS.shape)
    amplitude[:, :2] = shift * np.array([-np.sin(angle), -np.cos(angle)])
    expected = shift * VOXEL_MM / SCANNER.source_axis_mm
    assert turned(angle, BASIS, amplitude) == pytest.approx(expected, rel=1e-4)
    along = np.zeros(BASIS.shape)
    along[:, :2] = shift * np.array([np.cos(angle), -np.sin(angle)])
    along[:, 2] = shift
    assert turned(angle, BASIS, along) == pytest.approx(0, abs=1e-12)


@law(30)
@given(st.floats(-9.0, 9.0), seeds, st.floats(0.0, 3.0))
def test_a_pixel_shows_what_the_stage_turned_by_delta_shows_at_its_place(angle, seed, size):
    """Of any motion: its ray through the place meets where the pixel's material was, the source behind it."""
    amplitude = size * np.random.default_rng(seed).normal(size=GROWING.shape)
    rays = ray_vectors(SCANNER.cropped(*WINDOW), angle).stacked()
    delta = turned(angle, GROWING, amplitude)
    before = rays[0, 0] - VOXEL_MM * GROWING.displacement(amplitude, rays[0, :1])[0]
    there = ray_vectors(SCANNER, angle + delta).stacked()[0]
    cross = there[0, 0] * before[1] - there[0, 1] * before[0]
    assert abs(cross) < 1e-8 * np.linalg.norm(before) * SCANNER.source_axis_mm
    assert there[0, :2] @ before[:2] > 0
    places = systematic(angle).places(0, rays[0], GROWING, amplitude, VOXEL_MM)
    for row, column in ((0, 0), (13, 11), (20, 3), (27, 22)):
        source, corner, down, right = rays[0]
        along = corner + row * down + column * right - source
        # its distance from the axis, squared, is a parabola along the ray
        tried = np.array([0.09, 0.1, 0.11])
        bend, slope, _ = np.polyfit(tried, ((source + tried[:, None] * along)[:, :2] ** 2).sum(axis=1), 2)
        point = source - slope / (2 * bend) * along
        was = point - VOXEL_MM * GROWING.displacement(amplitude, point[None])[0]
        at = there[1] + places[row, column, :2] @ there[2:]
        miss = np.cross(was - there[0], at - there[0]) / np.linalg.norm(at - there[0])
        # between pixels whose place is worked out it is linear
        assert np.linalg.norm(miss) < (1e-6 if column % KNOT == 0 else 1e-3) * VOXEL_MM


# Interpolation


def kernel(s):
    """Return Keys' kernel for a = -1/2, his equation 15."""
    s = np.abs(s)
    near = 1.5 * s**3 - 2.5 * s**2 + 1
    far = -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2
    return np.where(s < 1, near, np.where(s < 2, far, 0.0))


@law(50)
@given(st.floats(0.0, 1.0), st.integers(0, 9))
def test_weights_of_the_pixels_about_a_place_are_keys_kernel(part, first):
    found = taps(np.array([first + part]), np.array([first]))[:, 0]
    np.testing.assert_allclose(found, kernel(part - np.arange(-1, 3)), atol=1e-12)


@law(50)
@given(seeds, st.floats(1.0, 7.0), st.floats(1.0, 9.0))
def test_what_is_quadratic_in_row_and_column_is_interpolated_exactly_away_from_the_edges(seed, row, column):
    factor = np.random.default_rng(seed).normal(size=(3, 3))

    def polynomial(r, c):
        return sum(factor[i, j] * r**i * c**j for i in range(3) for j in range(3))

    field = polynomial(*np.indices((9, 11)).astype(float))
    assert _cubic(field, row, column) == pytest.approx(polynomial(row, column), abs=1e-9 * np.abs(field).max())


@law(50)
@given(seeds, st.integers(0, 8), st.integers(0, 10))
def test_a_pixel_s_own_value_is_kept_to_the_edge(seed, row, column):
    field = np.random.default_rng(seed).normal(size=(9, 11))
    assert _cubic(field, float(row), float(column)) == pytest.approx(field[row, column], abs=1e-12)


@pytest.mark.parametrize("place", [(-0.02, 3.0), (8.02, 3.0), (3.0, -0.02), (3.0, 10.02), (-5.0, 40.0)])
def test_a_place_off_the_detector_has_nothing_and_one_inside_the_constant(place):
    assert _cubic(np.ones((9, 11)), *place) == 0
    inside = np.clip(place, 0.0, [8.0, 10.0])
    assert _cubic(np.ones((9, 11)), *inside) == pytest.approx(1)


# Registration


@pytest.mark.parametrize("angle", [0.0, 0.7, 4.4])
def test_without_motion_the_field_is_itself(angle):
    found = registered(systematic(angle), np.zeros(BASIS.shape), angle)
    np.testing.assert_allclose(found, window(fields()[0]), atol=1e-5)


def test_without_motion_the_field_is_itself_to_the_detector_s_edge():
    whole = replace(systematic(), corner=(0, 0), shape=(SCANNER.rows, SCANNER.columns))
    rays = ray_vectors(SCANNER, 0.7).stacked()
    found = whole.registered(slice(0, 1), rays, BASIS, np.zeros((1, *BASIS.shape)), VOXEL_MM)[0]
    np.testing.assert_allclose(found, fields()[0], atol=1e-4)


def test_half_way_between_two_views_is_the_mean_of_both():
    both = registered(systematic(0.7, view_rad=(0.5, 0.9)), np.zeros(BASIS.shape))
    np.testing.assert_allclose(both, window(fields(2).mean(axis=0)), atol=1e-5)


@pytest.mark.parametrize("rows", [-3, 1, 4])
def test_motion_upwards_by_voxels_moves_the_field_up_by_as_many_rows(rows):
    amplitude = np.zeros(BASIS.shape)
    amplitude[:, 2] = rows
    smooth = np.add.outer(np.arange(40.0) ** 2, 9 * np.arange(30.0)).astype(np.float32)
    found = registered(systematic(values=smooth[None]), amplitude)
    # on the axis the magnification is exact: a pixel shows what was `rows` below it
    np.testing.assert_allclose(found, window(smooth, down=rows), atol=1e-3 * np.abs(smooth).max())


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, 2.5])
def test_motion_across_the_beam_moves_the_field_along_its_rows(angle):
    amplitude = np.zeros(BASIS.shape)
    amplitude[:, :2] = 2 * np.array([-np.sin(angle), -np.cos(angle)])  # two voxels to the right of the image
    found = registered(systematic(angle), amplitude, angle)
    # rays fan out: at the image's edge a shift of 2 px is a little more or less
    np.testing.assert_allclose(found, window(fields()[0], right=-2), atol=0.02)


def test_a_range_of_steps_takes_each_step_s_own_views_and_motion():
    values, view, step = fields(40), np.linspace(0, 2 * np.pi, 40, endpoint=False), np.array([0.2, 0.9, 1.6, 2.3])
    of = systematic(step, values, view)
    rays = ray_vectors(SCANNER.cropped(*WINDOW), step).stacked()
    amplitude = np.random.default_rng(2).normal(size=(4, *BASIS.shape))
    found = of.registered(slice(1, 4), rays[1:], BASIS, amplitude[1:], VOXEL_MM)
    assert found.shape == (3, *SHAPE)
    for t in (1, 2, 3):
        alone = of.registered(slice(t, t + 1), rays[t : t + 1], BASIS, amplitude[t : t + 1], VOXEL_MM)[0]
        np.testing.assert_array_equal(found[t - 1], alone)
    still = of.registered(slice(2, 3), rays[2:3], BASIS, np.zeros((1, *BASIS.shape)), VOXEL_MM)[0]
    share = shares_of(view, step[2], of.width_rad)
    assert np.count_nonzero(share) > 1
    np.testing.assert_allclose(still, window(np.einsum("v,vrc->rc", share, values)), atol=1e-5)


def test_a_step_that_turned_takes_the_views_that_it_looks_along_now():
    view = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    values = fields(40)
    turn = view[3]
    found = registered(systematic(view[5], values, view), turn_about_z(turn), view[5], GROWING)
    share = shares_of(view, view[8], 0.0)
    np.testing.assert_allclose(found, window(np.einsum("v,vrc->rc", share, values)), atol=1e-5)


def test_what_comes_from_off_the_detector_is_zero():
    amplitude = np.zeros(BASIS.shape)
    amplitude[:, 2] = 100
    assert not registered(systematic(), amplitude).any()
