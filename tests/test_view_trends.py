"""What reference views leave of their re-projection tells of axis, roll, drift, and fading."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from pdvc.correction import corrected, modes_of, moved_back
from pdvc.preparation import Care, scan_volume
from pdvc.progress import silent
from pdvc.projection import project_at_rest
from pdvc.radiographs import calibrate, grey_levels, smoothed
from pdvc.rays import ray_vectors
from pdvc.view_trends import FADING, GEOMETRY, LEAST_VIEWS, MOVING, ViewTrends, doubts_of_views, view_trends
from pdvc.volume import Hull
from tests.spheres import BEAM, experiment

VIEWS, SCALE = 40, 2
MANY = settings(max_examples=20, deadline=None)
FEW = settings(max_examples=3, deadline=None)
ANGLE = 2 * np.pi * np.arange(VIEWS) / VIEWS
TIME = 8.8 * np.arange(VIEWS)
PX = st.floats(-0.4, 0.4)


@cache
def texture():
    """Return a picture (row, column) without edges of its own."""
    rng = np.random.default_rng(0)
    return ndimage.gaussian_filter(rng.standard_normal((50, 30)), 2.0).astype(np.float32) + np.float32(1)


def left_of(motion_px, share):
    """Return e of each view (view, row, column), by its definition: moved by (view, 3) px as stored, brighter.

    The picture is the mean of a view and its re-projection.
    """
    picture = texture()
    down, right = np.gradient(picture)
    y, x = np.arange(50)[:, None] - 24.5, np.arange(30)[None, :] - 14.5
    roll = (y * right - x * down) / 40
    ways = np.stack([right, down, roll]) / SCALE
    return np.einsum("vk,krc->vrc", motion_px, ways) + share[:, None, None] * picture


def trends(left):
    return view_trends(
        lambda i: (texture() - left[i] / 2).astype(np.float32),
        lambda i: left[i].astype(np.float32),
        ANGLE,
        TIME,
        SCALE,
        40.0,
    )


@MANY
@given(axis=PX, roll=PX, right=PX, down=PX, wave=PX, fading=st.floats(-0.02, 0.02))
def test_what_scanners_do_is_told_apart(axis, roll, right, down, wave, fading):
    modes = modes_of(ANGLE, TIME)
    drift = modes["drift"]
    motion = np.stack(
        [
            axis + right * drift + wave * modes["sin 2"] + 0.3 * modes["cos"],
            0.7 + down * drift + wave * modes["sin"],
            roll + 0.1 * modes["cos 2"],
        ],
        axis=1,
    )
    found = trends(left_of(motion, fading * drift + 0.01 * np.cos(4 * ANGLE) + 0.02))
    for name, due in (("axis", axis), ("roll", roll), ("right", right), ("down", down)):
        value, std = getattr(found, f"{name}_px")
        assert value == pytest.approx(due, abs=2e-4)
        assert std < 1e-3
    assert found.fading[0] == pytest.approx(fading, abs=2e-5)


def test_the_deviations_are_those_that_noise_makes():
    rng, values = np.random.default_rng(5), []
    for _ in range(60):
        motion = 0.05 * rng.standard_normal((VIEWS, 3))
        values.append(trends(left_of(motion, 0.001 * rng.standard_normal(VIEWS))))
    for name in ("axis_px", "roll_px", "right_px", "down_px", "fading"):
        found = np.array([getattr(each, name) for each in values])
        assert (found[:, 0] / found[:, 1]).std() == pytest.approx(1, abs=0.35)


def test_few_views_and_half_a_turn_tell_nothing():
    left = left_of(np.zeros((VIEWS, 3)), np.zeros(VIEWS))
    few = slice(LEAST_VIEWS - 1)
    for angle, time in ((ANGLE[few], TIME[few]), (ANGLE / 2, TIME)):
        assert view_trends(lambda _: texture(), lambda i: left[i], angle, time, SCALE, 40.0) is None


@cache
def scan():
    return experiment(3, views=48, steps=2)


def of_scan(series, told=BEAM):
    """Return the trends of a scan of spheres, reconstructed with a geometry as it was told."""
    calibration, support = calibrate(scan()), np.abs(Hull.normals()) @ [1.3, 1.1]
    hull = Hull(z_mm=-2.8, slab_mm=0.4, support_mm=np.tile(support, (14, 1)))
    volume = scan_volume(series, told, calibration, hull, 1, Care(smooth_px=0.7), lambda made: made(), silent)
    views = np.stack([smoothed(grey_levels(counts, calibration), 0.7) for counts in series.counts])
    again = project_at_rest(volume, ray_vectors(told, series.angle_rad).stacked(), views[0].shape)
    rows = slice(4, -4)
    seen, left = views[:, rows], (again - views)[:, rows]
    return view_trends(seen.__getitem__, left.__getitem__, series.angle_rad, series.time_s, 1, BEAM.rows / 2)


@FEW
@given(axis=st.floats(-0.5, 0.5), roll=st.floats(-0.5, 0.5))
def test_an_axis_and_a_roll_that_are_told_wrongly_are_told_by_spheres(axis, roll):
    told = corrected(BEAM, {"column_shift": axis, "roll": -roll})
    found = of_scan(scan().reference, told)
    # what is not small is not told exactly by slopes
    assert found.axis_px[0] == pytest.approx(axis, abs=0.03 + 0.15 * abs(axis))
    assert found.roll_px[0] == pytest.approx(roll, abs=0.03 + 0.15 * abs(roll))


def test_views_that_drift_and_fade_are_told_by_spheres():
    series, calibration = scan().reference, calibrate(scan())
    drift = modes_of(series.angle_rad, series.time_s)["drift"]
    views = [
        (1 - 0.02 * t) * moved_back(grey_levels(counts, calibration), (-0.6 * t, 0.4 * t, 0.0))
        for counts, t in zip(series.counts, drift, strict=True)
    ]
    counts = calibration.dark + calibration.open_beam * np.exp(-np.stack(views))
    moved = replace(series, counts=np.rint(counts).clip(0, 65535).astype(np.uint16))
    found, still = of_scan(moved), of_scan(series)
    for name, due in (("right_px", 0.6), ("down_px", -0.4), ("fading", 0.02)):
        # the volume has taken up what opposite views agree on: up to half of a drift
        assert 0.5 < getattr(found, name)[0] / due < 1.1
        assert abs(getattr(found, name)[0]) > 5 * getattr(found, name)[1]
        assert abs(getattr(still, name)[0]) < 3 * getattr(still, name)[1]


NOTHING = dict.fromkeys(("axis_px", "roll_px", "right_px", "down_px"), (0.01, 0.005)) | {"fading": (1e-4, 1e-4)}
DOUBTED = {
    "axis": ({"axis_px": (-0.3, 0.01)}, GEOMETRY, "the axis by -0.300 +- 0.010 px"),
    "roll": ({"roll_px": (0.2, 0.01)}, GEOMETRY, "the roll by +0.200 +- 0.010 px"),
    "right": ({"right_px": (-0.06, 0.01)}, MOVING, "0.060 +- 0.010 px to the left"),
    "down": ({"down_px": (0.06, 0.01)}, MOVING, "0.060 +- 0.010 px downwards"),
    "fading": ({"fading": (3e-3, 3e-4)}, FADING, "by -0.30% +- 0.03%: half of that is worth 0.9 voxel"),
}


def doubts(found, stated=0.01, along=0.1):
    limits = {"across_voxel": stated, "vertical_voxel": stated, "along_voxel": along}
    return list(doubts_of_views(ViewTrends(**found), **limits, source_axis_voxel=600.0))


@pytest.mark.parametrize("name", DOUBTED)
def test_each_has_its_doubt_with_its_size(name):
    change, due, figure = DOUBTED[name]
    (doubt,) = doubts(NOTHING | change)
    assert doubt.name == due
    assert figure in doubt.figure
    (key, (value, _)) = next(iter(change.items()))
    # not told from nothing
    assert doubts(NOTHING | {key: (value, abs(value) / 4)}) == []


def test_what_is_smaller_than_what_is_stated_is_not_doubted():
    assert doubts(NOTHING) == []
    assert doubts(NOTHING | {"axis_px": (0.12, 0.001)}) == []
    assert doubts(NOTHING | {"right_px": (0.06, 0.001), "down_px": (-0.06, 0.001)}, stated=0.04) == []
    assert doubts(NOTHING | {"fading": (3e-3, 3e-4)}, along=1.0) == []
