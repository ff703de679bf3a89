"""A correction of a scanner: what it does to geometry and views, and to a measurement that is made with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.correction import (
    DIRECTIONS,
    Correction,
    Parameter,
    corrected,
    correction_of,
    modes_of,
    motion_after,
    moved_back,
    rays_of_moved,
    text_of,
    view_motion,
)
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.protocol import measure
from pdvc.radiographs import calibrate, grey_levels
from pdvc.rays import ray_vectors
from pdvc.setup import set_up
from tests.command_line import only_line, pdvc_bench
from tests.spheres import BEAM, experiment
from validation.testing.small_cases import SmallExperiment, small_scenario

FEW = settings(max_examples=20, deadline=None)


@FEW
@given(axis=st.floats(-5, 5), roll=st.floats(-5, 5))
def test_a_corrected_geometry_sees_a_point_where_a_moved_image_has_it(axis, roll):
    """A detector that went right sees the sample further left; one that was turned sees it turned back."""
    angle, point = np.array([0.3]), np.array([0.2, -0.4, 1.1])
    here, there = (
        place_of(point, geometry, angle) for geometry in (BEAM, corrected(BEAM, {"column_shift": axis, "roll": roll}))
    )
    turn = roll / (BEAM.rows / 2)
    middle = (np.array([BEAM.rows, BEAM.columns]) - 1) / 2
    away = here - middle - np.array([0, axis])
    turned = np.array(
        [np.cos(turn) * away[0] - np.sin(turn) * away[1], np.sin(turn) * away[0] + np.cos(turn) * away[1]]
    )
    assert there == pytest.approx(middle + turned, abs=1e-9)


def place_of(point, geometry, angle):
    """Return row and column at which a point (3,), mm, is seen."""
    return place_by(point, ray_vectors(geometry, angle).stacked())


def place_by(point, rays):
    """Return the same by rays (1, 4, 3)."""
    source, corner, down, right = rays[0]
    unknown = np.linalg.solve(np.stack([point - source, -down, -right], axis=1), corner - source)
    return unknown[1:]


@FEW
@given(motion=st.tuples(*[st.floats(-1.5, 1.5)] * 3), scale=st.sampled_from((1, 2)))
def test_a_view_that_moved_is_moved_back(motion, scale):
    """A smooth image in closed form, seen where the motion has brought it, and moved back."""
    rows, columns = 60, 44
    row, column = np.indices((rows, columns))
    right, down, turn = motion
    c, s = np.cos(turn / (rows * scale / 2)), np.sin(turn / (rows * scale / 2))
    y, x = row - (rows - 1) / 2 - down / scale, column - (columns - 1) / 2 - right / scale
    before = c * x + s * y, -s * x + c * y  # where what is seen here was
    moved = blob(*before)
    back = moved_back(moved.astype(np.float32), motion, scale)
    inner = np.s_[6:-6, 6:-6]
    assert back[inner] == pytest.approx(blob(column - (columns - 1) / 2, row - (rows - 1) / 2)[inner], abs=2e-3)


@FEW
@given(
    motion=st.tuples(*[st.floats(-3, 3)] * 3),
    scale=st.sampled_from((1, 2)),
    corner=st.tuples(st.integers(0, 9), st.integers(0, 9)),
    tilt=st.floats(-0.1, 0.1),
)
def test_rays_of_an_image_that_moved_see_a_point_where_the_motion_has_brought_it(motion, scale, corner, tilt):
    angle, point = np.array([0.3]), np.array([0.2, -0.4, 1.1])
    whole = replace(BEAM, roll_rad=tilt).binned(scale)
    row, column = corner
    window = whole.cropped(row, whole.rows, column, whole.columns)
    middle = (np.array([whole.rows, whole.columns]) - 1) / 2
    rays = ray_vectors(window, angle).stacked()
    moved = rays_of_moved(rays, np.array([motion]), scale, middle - corner, whole.rows / 2)
    right, down, turn = motion
    turn /= whole.rows / 2 * scale
    away = place_of(point, whole, angle) - middle
    due = [np.cos(turn) * away[0] + np.sin(turn) * away[1], np.cos(turn) * away[1] - np.sin(turn) * away[0]]
    due = middle + due + np.array([down, right]) / scale - corner
    assert place_by(point, moved) == pytest.approx(due, abs=1e-9)
    # without motion they are the same to the last bit but one
    assert rays_of_moved(rays, np.zeros((1, 3)), scale, middle - corner, 1.0) == pytest.approx(rays, abs=1e-13)


def test_after_the_views_what_drifted_stays_and_waves_go_with_the_angle():
    values = {"right drift": 0.6, "right bend": 0.2, "down sin": 0.4, "turn cos 2": -0.3}
    series = experiment(views=40, steps=2).reference
    views = view_motion(values, series.angle_rad, series.time_s)
    after = motion_after(values, series.angle_rad[[-1, 10, 17]] + 4 * np.pi)
    assert after[0] == pytest.approx(views[-1])
    assert after[:, 0] == pytest.approx([0.5] * 3)
    assert after[1:, 1:] == pytest.approx(views[[10, 17], 1:])


def blob(x, y):
    return np.exp(-((x - 4) ** 2) / 50 - (y + 6) ** 2 / 30)


def test_an_image_that_did_not_move_is_the_same_to_the_last_bit():
    image = np.random.default_rng(0).random((9, 7), dtype=np.float32)
    assert moved_back(image, (0.0, 0.0, 0.0)) is image


def test_modes_are_of_the_time_and_of_the_angle():
    series = experiment(views=30, steps=2).reference
    series = replace(series, time_s=np.zeros(30))
    modes = modes_of(series.angle_rad, series.time_s)
    assert modes["drift"][[0, -1]] == pytest.approx([-0.5, 0.5])
    assert modes["cos 2"] == pytest.approx(np.cos(2 * series.angle_rad))
    assert view_motion({"turn sin 2": 2.0}, series.angle_rad, series.time_s)[
        :, DIRECTIONS.index("turn")
    ] == pytest.approx(2 * modes["sin 2"])


def test_a_correction_is_kept_as_a_text():
    here = Correction(
        parameters=(
            Parameter(name="roll", value_px=0.1, std_px=0.01),
            Parameter(name="row_shift", state="not observable"),
        ),
        rounds=3,
        last_change_px=0.001,
        rms_before=0.02,
        rms_after=0.01,
    )
    assert text_of(correction_of(text_of(here))) == text_of(here)
    assert "roll: +0.100 +- 0.010 px" in here.lines


def test_what_was_found_by_other_grey_levels_is_not_taken_for_this(tmp_path, monkeypatch):
    """A folder keeps a correction for the options that it depends on: the beam of the views is one."""
    none, asked = Correction(parameters=(), rounds=1, last_change_px=0.0, rms_before=0.1, rms_after=0.1), []
    monkeypatch.setattr("pdvc.setup.self_calibrated", lambda *_, **__: asked.append(1) or none)
    small = SmallExperiment(small_scenario())
    for brightness, times in (("flats", 1), ("air", 2), ("flats", 2)):
        changes = {"self_calibration": "geometry", "brightness": brightness}
        set_up(small.experiment, small.options.model_copy(update=changes), work=tmp_path)
        assert len(asked) == times


def test_a_measurement_with_a_wrong_axis_is_that_with_the_right_one(tmp_path):
    """The reference scan, the test and the result know the corrected geometry; the file tells what it was."""
    small = SmallExperiment(small_scenario())
    told = replace(small.experiment, geometry=corrected(small.experiment.geometry, {"column_shift": -1.2}))
    options = small.options.model_copy(update={"self_calibration": "geometry"})
    right, wrong = small.measurement, measure(told, options, work=tmp_path)
    assert wrong.correction is not None
    assert wrong.correction.values_px["column_shift"] == pytest.approx(1.2, abs=0.02)
    assert "axis" not in wrong.verdict.names
    assert wrong.motion.amplitude == pytest.approx(right.motion.amplitude, abs=0.03)
    assert "axis" in measure(told, small.options).verdict.names
    write_measurement(wrong, tmp_path / "found.nc")
    assert text_of(read_measurement(tmp_path / "found.nc").correction) == text_of(wrong.correction)
    # what is kept is found again
    again = measure(told, options, work=tmp_path)
    assert np.array_equal(again.motion.amplitude, wrong.motion.amplitude)


def test_a_scanner_that_drifts_during_the_scan_is_followed_into_the_test():
    """The image moves by its angle, and by its time in the scan, and stays there in the test."""
    small = SmallExperiment(small_scenario())
    here, values = small.experiment, {"right drift": 0.8, "down cos": 0.4}
    calibration = calibrate(here)

    def moved(series, way):
        views = [
            moved_back(grey_levels(counts, calibration), -px) for counts, px in zip(series.counts, way, strict=True)
        ]
        counts = calibration.dark + calibration.open_beam * np.exp(-np.stack(views))
        return replace(series, counts=np.rint(counts).clip(0, 65535).astype(np.uint16))

    views, test = here.reference, here.test
    drifted = replace(
        here,
        reference=moved(views, view_motion(values, views.angle_rad, views.time_s)),
        test=moved(test, motion_after(values, test.angle_rad)),
    )
    options = small.options.model_copy(update={"self_calibration": "motion"})
    away = [
        np.abs(measure(drifted, each).motion.amplitude - small.measurement.motion.amplitude)[..., :3].mean()
        for each in (options, small.options)
    ]
    assert away[0] < 0.06
    assert away[1] > 4 * away[0]


def test_the_command_line_refuses_what_it_does_not_know(tmp_path):
    result = pdvc_bench("measure", tmp_path, "-o", tmp_path / "x.nc", "--self-calibrate", "axis")
    assert result.exit_code == 2
    assert only_line(result) == (
        "error: --self-calibrate: self_calibration: expected 'none', 'geometry' or 'motion', given 'axis'"
    )
