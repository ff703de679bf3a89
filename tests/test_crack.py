"""A crack that opens: its law, what keeps clear of it, and what it changes of an experiment."""

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from pdvc.experiment import DESCRIPTION, REFERENCE, TEST, read_experiment
from pdvc.settings import SettingsError
from simulator.clean import clean_file
from simulator.crack import Crack, keep_clear, outline_mm, spheroids
from simulator.images import prepare
from simulator.microstructure import Nodules
from simulator.sample import leaning_body, moved_body, rest_body
from simulator.scanner import simulate
from simulator.scenario import course_of, load_scenario
from simulator.stacks import Stack, clear_images
from simulator.truth import read_scenario, read_truth
from tests.laws import law
from tests.tiny_scenarios import tinier

OPEN = {"opening_mm": 0.2, "radius_mm": 0.35, "centre_mm": [0.1, 0.03, 0.2], "first_step": 12, "opening_steps": 4}

cracks = st.builds(
    Crack,
    opening_mm=st.floats(1e-6, 0.3),
    radius_mm=st.floats(0.05, 0.5),
    centre_mm=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    tilt_deg=st.floats(-180.0, 180.0),
    direction_deg=st.floats(-180.0, 180.0),
    first_step=st.integers(0, 130),
    opening_steps=st.integers(1, 40),
)


@law(50)
@given(cracks, st.integers(0, 200))
def test_it_is_closed_before_its_first_step_opens_evenly_and_stays_open(crack, step):
    opened = crack.opened_mm(step)
    since = step - crack.first_step
    if since < 0:
        assert opened == 0
    elif since < crack.opening_steps:
        assert opened == pytest.approx(crack.opening_mm * (since + 1) / crack.opening_steps)
    else:
        assert opened == crack.opening_mm


def test_it_is_closed_where_nothing_is_said():
    centres, shapes = spheroids(Crack(), Crack().opened_mm(100))
    assert (len(centres), len(shapes)) == (0, 0)


@pytest.mark.parametrize(
    ("tilt", "direction", "normal"),
    [(0, 50, (0, 0, 1)), (90, 0, (1, 0, 0)), (90, 90, (0, 1, 0)), (45, 180, (-np.sqrt(0.5), 0, np.sqrt(0.5)))],
)
def test_its_normal_leans_from_z_in_the_direction_told(tilt, direction, normal):
    crack = Crack(opening_mm=0.02, radius_mm=0.3, tilt_deg=tilt, direction_deg=direction, centre_mm=(1.0, 2.0, 3.0))
    (centre,), (shape,) = spheroids(crack, 0.02)
    np.testing.assert_array_equal(centre, [1, 2, 3])
    # the ellipsoid {A s} has the quadratic form (A A')^-1: half the opening along its normal, the radius across
    normal = np.array(normal)
    expected = 0.3**2 * (np.eye(3) - np.outer(normal, normal)) + 0.01**2 * np.outer(normal, normal)
    np.testing.assert_allclose(shape @ shape.T, expected, atol=1e-15)


@law(50)
@given(cracks)
def test_its_outline_lies_on_the_spheroid_and_reaches_all_round(crack):
    (centre,), (shape,) = spheroids(crack, crack.opening_mm)
    points = np.linalg.solve(shape, (outline_mm(crack) - centre).T).T
    np.testing.assert_allclose((points**2).sum(axis=1), 1, rtol=1e-6)
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        assert (points @ axis).max() > 1 - 1e-4


@law(30)
@given(cracks, st.integers(0, 999), st.floats(0, 0.02))
def test_nodules_that_are_kept_do_not_meet_the_open_crack(crack, seed, gap):
    rng = np.random.default_rng(seed)
    nodules = Nodules(
        centre_mm=np.array(crack.centre_mm) + rng.uniform(-0.7, 0.7, (60, 3)), radius_mm=rng.uniform(0.01, 0.1, 60)
    )
    kept = keep_clear(nodules, crack, gap)
    # points of the outline and inside it stand for the crack
    outline = outline_mm(crack)[::7] - crack.centre_mm
    inside = np.concatenate([share * outline for share in (1.0, 0.8, 0.5, 0.2, 0.0)]) + crack.centre_mm
    for centre, radius in zip(kept.centre_mm, kept.radius_mm, strict=True):
        assert np.linalg.norm(inside - centre, axis=1).min() >= radius + gap - 1e-12


@law(50)
@given(cracks, st.floats(0.01, 0.1), st.floats(0, 0.02), st.floats(0, 2 * np.pi), st.sampled_from([-1e-6, 1e-6]))
def test_nodules_above_the_middle_and_beside_the_rim_are_kept_from_the_gap_on(crack, radius, gap, angle, more):
    """There the distance is known: how far the centre is above the middle, or beside the rim, less the radius."""
    (centre,), (shape,) = spheroids(crack, crack.opening_mm)
    first, second, normal = (shape / np.linalg.norm(shape, axis=0)).T
    outward = np.cos(angle) * first + np.sin(angle) * second
    places = [
        centre + direction * (size + radius + gap + more)
        for direction, size in ((normal, crack.opening_mm / 2), (-normal, crack.opening_mm / 2))
    ] + [centre + outward * (crack.radius_mm + radius + gap + more)]
    nodules = Nodules(centre_mm=np.array(places), radius_mm=np.full(3, radius))
    np.testing.assert_array_equal(keep_clear(nodules, crack, gap).centre_mm, places if more > 0 else np.zeros((0, 3)))


def test_it_leaves_out_nodules_in_every_image_and_no_other_nodule_moves():
    scenario, sound = tinier(crack=OPEN), tinier()
    cracked, whole = rest_body(scenario), rest_body(sound)
    assert 0 < len(cracked.centres_mm) < len(whole.centres_mm)
    among = (whole.centres_mm[:, None] == cracked.centres_mm).all(axis=2)
    np.testing.assert_array_equal(among.sum(axis=0), 1)
    assert len(cracked.crack_centres_mm) == 0


def test_it_is_carried_and_deformed_with_the_matrix():
    scenario = tinier(crack=OPEN)
    motion, body = course_of(scenario).motion, rest_body(scenario)
    for step in (11, 12, 19):
        moved = moved_body(body, motion, step, scenario.crack)
        sound = moved_body(body, motion, step)
        np.testing.assert_array_equal(moved.vertices_mm, sound.vertices_mm)
        np.testing.assert_array_equal(moved.centres_mm, sound.centres_mm)
        if step < 12:
            assert len(moved.crack_centres_mm) == 0
            continue
        # the images of points of the spheroid, to the second order of its size, and its volume
        centre, (shape,) = (
            np.array([scenario.crack.centre_mm]),
            spheroids(scenario.crack, scenario.crack.opened_mm(step))[1],
        )
        small = 1e-4
        for s in np.eye(3):
            at = motion.forward(centre + small * shape @ s, step) - motion.forward(centre, step)
            np.testing.assert_allclose(at[0] / small, moved.crack_shapes_mm[0] @ s, atol=1e-4)
        np.testing.assert_allclose(moved.crack_centres_mm, motion.forward(centre, step), atol=1e-15)
        leaning = leaning_body(moved, 0.2, 0.7)
        turn = np.linalg.lstsq(moved.vertices_mm, leaning.vertices_mm)[0]
        np.testing.assert_allclose(leaning.crack_centres_mm, moved.crack_centres_mm @ turn, atol=1e-12)
        np.testing.assert_allclose(leaning.crack_shapes_mm[0], turn.T @ moved.crack_shapes_mm[0], atol=1e-12)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("crack") / "experiment"
    simulate(tinier(crack=OPEN), path, workers=2)
    return path


def test_a_crack_that_does_not_open_changes_no_count(tmp_path):
    closed = {**OPEN, "opening_mm": 0.0}
    simulate(tinier(crack=closed), tmp_path / "closed", workers=2)
    simulate(tinier(), tmp_path / "sound", workers=2)
    for name in (REFERENCE, TEST, DESCRIPTION):
        assert (tmp_path / "closed" / name).read_bytes() == (tmp_path / "sound" / name).read_bytes()


def test_it_is_seen_from_its_first_step_on_brighter_and_where_it_is():
    scenario = tinier(crack=OPEN)
    never = tinier(crack={**OPEN, "first_step": 19, "opening_steps": 1000, "opening_mm": 0.2})
    images = [clear_images(prepare(each, course_of(each)), Stack("test")) for each in (scenario, never)]
    scanner = scenario.geometry.cone_beam()
    for step in range(19):
        brighter = images[0](step).astype(float) - images[1](step)
        assert brighter.min() >= 0
        assert brighter.any() == (step >= 12)
        if step < 12:
            continue
        row = (brighter.sum(axis=1) @ np.arange(40) / brighter.sum() - 19.5) * scanner.voxel_mm
        centre = course_of(scenario).motion.forward(np.array([scenario.crack.centre_mm]), step)[0]
        assert row == pytest.approx(-centre[2], abs=0.1 * scanner.voxel_mm + 0.05)
    # a held sample is as far open as its step
    held = tinier(crack=OPEN, interrupted={"steps": [13], "views": 10})
    bench = prepare(held, course_of(held))
    np.testing.assert_array_equal(clear_images(bench, Stack("interrupted", 13))(3), images[0](13))


def test_the_measurement_is_told_nothing_of_it(folder, tmp_path):
    """What lies outside `truth` is what it is without a crack, but for the counts."""
    simulate(tinier(), tmp_path, workers=2)
    assert (folder / DESCRIPTION).read_bytes() == (tmp_path / DESCRIPTION).read_bytes()
    outside = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    assert outside == {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    for path in folder.rglob("*.tif"):
        with tifffile.TiffFile(path) as file, tifffile.TiffFile(tmp_path / path.relative_to(folder)) as other:
            assert file.pages[0].tags.keys() == other.pages[0].tags.keys()
            assert file.pages[0].description == other.pages[0].description
    assert read_experiment(folder).title == "In situ tension of cast iron, after Jailin et al. 2018"


def test_the_truth_holds_the_crack_and_the_motion_of_a_sound_sample(folder):
    assert read_scenario(folder).crack == Crack(**{**OPEN, "centre_mm": tuple(OPEN["centre_mm"])})
    truth, course = read_truth(folder), course_of(tinier())
    np.testing.assert_array_equal(truth.force_N, course.history.force_N)
    for step in (0, 19):
        moved = course.motion.forward(truth.point_mm, step) - truth.point_mm
        np.testing.assert_array_equal(truth.displacement_mm[step], moved)


def test_the_reference_scan_depends_on_where_it_is_and_not_on_when_it_opens():
    rest, test = Stack("reference"), Stack("test")
    first = tinier(crack=OPEN)
    for change, shared in (
        ({"first_step": 11}, True),
        ({"opening_steps": 3}, True),
        ({"radius_mm": 0.3}, False),
        ({"tilt_deg": 1.0}, False),
        ({"opening_mm": 0.19}, False),
        ({"centre_mm": [0.1, 0.03, 0.21]}, False),
    ):
        other = tinier(crack={**OPEN, **change})
        assert (clean_file(first, rest) == clean_file(other, rest)) == shared
        assert clean_file(first, test) != clean_file(other, test)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"opening_mm": -0.1}, r"crack\.opening_mm: expected greater than or equal to 0, given -0\.1"),
        ({"radius_mm": 0.0}, r"crack\.radius_mm: expected greater than 0, given 0\.0"),
        ({"opening_steps": 0}, r"crack\.opening_steps: expected greater than or equal to 1, given 0"),
        ({"first_step": 20}, r"expected crack\.first_step below 20, the number of steps of the test, got 20"),
        ({"centre_mm": [0.4, 0.4, 0.2]}, r"expected crack\.centre_mm and crack\.radius_mm .*: 0\.\d+ mm outside"),
        ({"centre_mm": [0.0, 0.0, 6.45]}, r"expected crack\.centre_mm and crack\.radius_mm .*: 0\.05 mm outside"),
        ({"radius_mm": 0.454, "centre_mm": [0.0, 0.0, 0.0]}, r"crack\.radius_mm .*: 0\.00\d+ mm below it"),
        ({"width": 1.0}, r"crack\.width: unknown key"),
    ],
)
def test_a_crack_that_cannot_be_is_answered_with_its_key_in_one_line(change, message):
    with pytest.raises(SettingsError, match=message) as caught:
        tinier(crack={**OPEN, **change})
    assert "\n" not in str(caught.value)


def test_the_one_that_comes_with_the_package_differs_from_quick_in_nothing_else():
    cracked, quick = load_scenario("crack"), load_scenario("quick")
    assert cracked.model_copy(update={"name": quick.name, "title": quick.title, "crack": Crack()}) == quick
    assert cracked.crack.opened_mm(89) == 0 < cracked.crack.opened_mm(90) < cracked.crack.opened_mm(99) == 0.04
