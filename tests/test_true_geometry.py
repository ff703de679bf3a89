"""What experiment.toml tells stays the plan, and the truth tells where the scanner stood."""

import numpy as np
import pytest

from pdvc.experiment import read_experiment
from pdvc.rays import ray_vectors
from pdvc.settings import SettingsError
from simulator.scanner import simulate
from simulator.scenario import course_of
from simulator.stacks import Stack, clock_s, moment_of
from simulator.true_geometry import GEOMETRY, read_geometry, true_geometry
from tests.tiny_scenarios import tinier

HELD = {"steps": [3, 13], "views": 6, "view_s": 3.0}
WRONG = {
    "misalignment": {"tilt_deg": 1.0, "slant_deg": -0.5, "roll_deg": 0.4, "axis_across_mm": 0.05, "lean_deg": 0.1},
    "scanner": {
        "stage": {"angle_jitter_deg": 0.05, "backlash_deg": 0.2, "wobble_deg": 0.02, "shake_mm": 0.001},
        "focal_spot": {"drift_mm": [0.01, 0.005, 0.02], "drift_time_s": 60.0},
    },
}


def test_without_errors_the_truth_is_the_recorded_geometry():
    scenario = tinier(interrupted=HELD)
    course = course_of(scenario)
    found = true_geometry(scenario, course)
    assert set(found) == {"reference", "test", "interrupted_3", "interrupted_13"}
    recorded = scenario.geometry.cone_beam()
    for group, angles in (
        ("reference", course.reference_angle_rad),
        ("test", course.test_angle_rad),
        ("interrupted_13", course.interrupted_angle_rad),
    ):
        rays, views = ray_vectors(recorded, angles), found[group]
        np.testing.assert_allclose(views.source_mm, rays.source_mm, atol=1e-9)
        np.testing.assert_allclose(views.column * recorded.pixel_mm, rays.column_mm, atol=1e-9)
        np.testing.assert_allclose(views.row * recorded.pixel_mm, rays.row_mm, atol=1e-9)
        corner = views.detector_mm - recorded.pixel_mm * (39 / 2 * views.row + 23 / 2 * views.column)
        np.testing.assert_allclose(corner, rays.corner_mm, atol=1e-9)


def test_the_experiment_tells_the_plan_and_the_truth_what_was(tmp_path):
    scenario = tinier(interrupted=HELD, **WRONG)
    simulate(scenario, tmp_path, workers=1)
    told = read_experiment(tmp_path)
    assert told.geometry == tinier().geometry.cone_beam()
    np.testing.assert_allclose(told.test.angle_rad, course_of(tinier()).test_angle_rad, atol=1e-11)
    written, due = read_geometry(tmp_path), true_geometry(scenario, course_of(scenario))
    assert set(written) == set(due)
    for group, views in due.items():
        for name, values in vars(views).items():
            np.testing.assert_array_equal(getattr(written[group], name), values)
    # each of all errors moves something, also between one turn of the test and the next
    test = written["test"].source_mm
    assert np.abs(test[0] - test[10]).max() > 1e-3


def test_a_folder_without_the_true_geometry_says_so(tmp_path):
    with pytest.raises(SettingsError, match=r"geometry\.nc: expected the true geometry of a simulated experiment"):
        read_geometry(tmp_path)
    (tmp_path / "truth").mkdir()
    (tmp_path / GEOMETRY).write_bytes(b"not a file of this kind")
    with pytest.raises(SettingsError, match=r"geometry\.nc: expected the geometry of each radiograph"):
        read_geometry(tmp_path)


def test_a_folder_that_lost_the_true_geometry_is_completed(tmp_path):
    simulate(tinier(), tmp_path, workers=1)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.tif")}
    (tmp_path / GEOMETRY).unlink()
    simulate(tinier(), tmp_path, workers=1)
    assert set(read_geometry(tmp_path)) == {"reference", "test"}
    assert {path: path.read_bytes() for path in before} == before


def test_the_clock_goes_on_through_scans_on_the_way():
    scenario = tinier(interrupted=HELD)
    clock = [clock_s(scenario, Stack("test"), step) for step in range(20)]
    assert clock_s(scenario, Stack("reference"), 5) == pytest.approx(5 * 2.2)
    assert clock[0] == pytest.approx(20 * 2.2)
    steps = np.full(19, 2.0)
    # after the steps 3 and 13 six views of 3 s are taken
    steps[[3, 13]] += 18.0
    np.testing.assert_allclose(np.diff(clock), steps)
    for held in (3, 13):
        views = [clock_s(scenario, Stack("interrupted", held), view) for view in range(6)]
        np.testing.assert_allclose(views, clock[held] + 3.0 * np.arange(6))


def test_backlash_is_in_the_test_and_in_the_scans_on_the_way_alone():
    scenario = tinier(interrupted=HELD, scanner={"stage": {"backlash_deg": 0.3}})
    for stack, due in ((Stack("reference"), 0.0), (Stack("test"), 0.3), (Stack("interrupted", 3), 0.3)):
        assert moment_of(scenario, stack, 2).angle_error_rad == pytest.approx(np.deg2rad(due))


def test_a_repetition_and_the_other_images_leave_what_the_stage_does():
    one, again = (moment_of(tinier(repetition=n, **WRONG), Stack("test"), 4) for n in (0, 1))
    assert one == again
    stacks = (Stack("reference"), Stack("test"), Stack("interrupted", 4), Stack("interrupted", 5))
    drawn = {moment_of(tinier(**WRONG), stack, index).shift_mm for stack in stacks for index in range(4)}
    assert len(drawn) == 16
