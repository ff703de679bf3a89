"""What a reference scan tells of its scanner, on spheres whose radiographs have a closed form."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from pdvc.correction import (
    MOTION,
    UNSEEN,
    corrected,
    modes_of,
    view_motion,
)
from pdvc.radiographs import calibrate
from pdvc.rays import directions
from pdvc.self_calibration import LEAST_SEEN, _change, self_calibrated
from pdvc.volume import Hull
from tests.spheres import BEAM, DARK, attenuation, experiment, sample

FEW = settings(max_examples=3, deadline=None)
VIEWS = 48
EXACT_PX = 0.02
"""What is observable is found to within this, px."""


@cache
def prepared(seed):
    """Return what a calibration starts from: the scan, its calibration and a hull of the sample."""
    here = experiment(seed, views=VIEWS, steps=2)
    support = np.abs(Hull.normals()) @ [1.3, 1.1]
    hull = Hull(z_mm=-2.8, slab_mm=0.4, support_mm=np.tile(support, (14, 1)))
    return here.reference, calibrate(here), hull


@cache
def as_told(seed):
    """Return what is found, motion of the views and all, where nothing is wrong."""
    return found(seed, sought="motion")


def found(seed, told=BEAM, sought="geometry", *, shift_voxel=None, axis_px=0.0):
    """Return the correction of a scan; `shift_voxel` (view, 3) moves the sample in the frame of the laboratory:
    across the beam to the right, down, and along the beam."""
    series, calibration, hull = prepared(seed)
    if shift_voxel is not None:
        beam, right = directions(series.angle_rad)
        down = np.broadcast_to([0.0, 0.0, -1.0], beam.shape)
        way = np.einsum("vd,dvi->vi", shift_voxel, np.stack([right, down, beam])) * BEAM.voxel_mm
        centre, radius = sample(seed)
        moved = [
            attenuation(BEAM, series.angle_rad[k : k + 1], (centre + way[k], radius))[0] for k in range(len(series))
        ]
        gain = calibration.open_beam
        series = replace(series, counts=np.round(DARK + gain * np.exp(-np.stack(moved))).astype(np.uint16))
    return self_calibrated(series, told, calibration, hull, sought, axis_px=axis_px)


def by_name(correction):
    return {each.name: each for each in correction.parameters}


@FEW
@given(seed=st.integers(0, 20), axis=st.floats(-2.5, 2.5), roll=st.floats(-0.8, 0.8))
def test_an_axis_and_a_roll_that_are_told_wrongly_are_found(seed, axis, roll):
    told = corrected(BEAM, {"column_shift": -axis, "roll": -roll})
    parameters = by_name(found(seed, told, axis_px=-round(axis)))
    assert parameters["column_shift"].value_px == pytest.approx(axis, abs=EXACT_PX)
    assert parameters["roll"].value_px == pytest.approx(roll, abs=EXACT_PX)


def test_a_scanner_that_is_as_told_is_left_so():
    correction = as_told(0)
    assert max(abs(value) for value in correction.values_px.values()) < EXACT_PX
    assert {each.state for each in correction.parameters if each.name in MOTION} == {"none"}
    assert correction.rms_after < 1.02 * correction.rms_before


@settings(max_examples=1, deadline=None, phases=[Phase.generate])
@given(right=st.floats(0.3, 0.9), down=st.floats(0.3, 0.9), sign=st.sampled_from((-1, 1)))
def test_a_sample_that_drifts_during_the_scan_is_followed(right, down, sign):
    """The sample is a rigid body that really moves; the correction only knows motion in the plane of the image."""
    series = prepared(3)[0]
    modes = modes_of(series.angle_rad, series.time_s)
    t, wave = modes["drift"], modes["cos"]
    way = np.stack([sign * right * t, down * wave, np.zeros(VIEWS)], axis=1)
    correction = found(3, sought="motion", shift_voxel=way)
    parameters = by_name(correction)
    assert parameters["right drift"].value_px == pytest.approx(sign * right, abs=EXACT_PX)
    assert parameters["down cos"].value_px == pytest.approx(down, abs=2 * EXACT_PX)
    # what is left of it, view by view, but for a sample that stands elsewhere
    left = view_motion(correction.values_px, series.angle_rad, series.time_s)[:, 0] - way[:, 0]
    waves = np.stack([np.ones(VIEWS), np.cos(series.angle_rad), np.sin(series.angle_rad)])
    left -= np.linalg.lstsq(waves.T, left, rcond=None)[0] @ waves
    assert np.sqrt(np.mean(left**2)) < EXACT_PX
    assert correction.rms_after < 0.6 * correction.rms_before


def test_what_the_material_does_alike_in_opposite_views_is_no_doubt_about_a_drift():
    """As scatter or beam hardening do: large, with the angle, and alike in a view and in its mirrored opposite one."""
    rng, views = np.random.default_rng(4), 32

    def unlike(images):
        return (images - np.roll(images, views // 2, axis=0)[:, :, ::-1]) / 2

    t = np.linspace(-0.5, 0.5, views, endpoint=False)[:, None, None]
    slope = np.abs(rng.standard_normal((1, 40, 12)))
    drift = unlike(t * (slope + slope[:, :, ::-1])).astype(np.float32)
    found, stated = [], []
    for _ in range(40):
        noise = 0.1 * rng.standard_normal(drift.shape)
        alike = 3.0 * np.cos(2 * np.pi * t + rng.uniform(0, 2 * np.pi)) ** 2 * slope
        e = noise + alike + np.roll(alike, views // 2, axis=0)[:, :, ::-1]
        change, matrix, covariance = _change(drift[None], e.astype(np.float32), unlike, np.zeros(1), np.full(1, 1e3))
        found.append(float(change[0]))
        moved, *_ = _change(drift[None], (e - 0.3 * drift).astype(np.float32), unlike, np.zeros(1), np.full(1, 1e3))
        assert moved[0] - change[0] == pytest.approx(0.3, abs=0.003)
        stated.append(float(np.sqrt(covariance[0, 0]) / matrix[0, 0]))
    assert np.std(found) == pytest.approx(np.mean(stated), rel=0.3)


def test_a_sample_that_stands_elsewhere_is_no_fault_of_the_scanner():
    """In the frame of the laboratory it goes round, a wave in a turn across the beam and along it."""
    angle = prepared(0)[0].angle_rad
    elsewhere = 1.5 * np.stack([np.cos(angle), np.zeros(VIEWS), np.sin(angle)], axis=1)
    elsewhere[:, 1] = 0.7
    correction = found(0, sought="motion", shift_voxel=elsewhere)
    assert max(abs(value) for value in correction.values_px.values()) < EXACT_PX


def test_the_share_that_is_seen_is_that_of_the_closed_form():
    seen = {name: each.seen for name, each in by_name(as_told(0)).items()}
    for direction in ("right", "turn"):
        assert seen[f"{direction} drift"] == pytest.approx(np.sqrt(1 - 6 / np.pi**2), abs=0.08)
        assert seen[f"{direction} bend"] == pytest.approx(np.sqrt(1 - 90 / np.pi**4), abs=0.08)
        assert seen[f"{direction} cos 2"] == pytest.approx(1, abs=0.06)
    assert seen["column_shift"] == pytest.approx(1, abs=0.1)
    assert seen["roll"] == pytest.approx(1, abs=0.1)
    assert min(seen[f"down {mode}"] for mode in ("drift", "bend", "cos", "sin")) > 0.8
    # opposite views agree on these: only how narrow the sample is shows them
    assert 0.4 < min(seen[f"down {mode}"] for mode in ("cos 2", "sin 2")) < 0.8
    assert max(seen[name] for name in UNSEEN) < LEAST_SEEN


@pytest.mark.parametrize("name", UNSEEN)
def test_what_is_not_observable_is_said_to_be_left_as_told(name):
    parameter = by_name(as_told(0))[name]
    assert (parameter.value_px, parameter.state) == (0.0, "not observable")
    assert np.isnan(parameter.std_px)
    assert "not observable, left as told" in str(parameter)
