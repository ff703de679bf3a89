"""Volume correlation of a small simulated experiment: what it finds, records, keeps, draws and refuses."""

from dataclasses import fields, replace
from operator import attrgetter

import numpy as np
import pytest

from pdvc.experiment import InterruptedScan
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.volume_correlation import correlate
from validation.report.page import write_report
from validation.scoring.scores import point_errors, score
from validation.testing.small_cases import SmallExperiment, small_options, small_scenario

HELD = (0, 12, 17)
CASE = SmallExperiment(small_scenario({"interrupted.steps": HELD}))
OPTIONS = small_options(CASE.scenario)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def measured(work):
    return correlate(CASE.experiment, OPTIONS, work=work)


def with_scans(*scans):
    return replace(CASE.experiment, interrupted=tuple(scans))


def test_the_motion_at_the_held_steps_is_found_in_all_directions(measured):
    by_step = point_errors(measured, CASE.truth).by_step()
    assert np.flatnonzero(np.isfinite(by_step).all(axis=1)).tolist() == list(HELD)
    # nodules and walls are a few voxels here; what is found is some hundredths of a voxel, along the beam too
    assert by_step[list(HELD)].max() < 0.1
    moved = np.abs(CASE.truth.displacement_mm[list(HELD)]).max(axis=(1, 2)) / measured.recording.voxel_mm
    assert moved.min() > 1


def test_errors_are_of_the_size_of_the_standard_deviations(measured):
    """The truth in the basis of the measurement, by least squares, against what was found."""
    z = []
    for step in HELD:
        points = CASE.truth.point_mm + CASE.truth.displacement_mm[step]
        inside = (points[:, 2] >= measured.motion.basis.height_mm[0]) & (
            points[:, 2] <= measured.motion.basis.height_mm[-1]
        )
        points, true = points[inside], CASE.truth.displacement_mm[step][inside] / measured.recording.voxel_mm
        unit = np.eye(np.prod(measured.motion.basis.shape)).reshape(-1, *measured.motion.basis.shape)
        moves = np.stack([measured.motion.basis.displacement(each, points).ravel() for each in unit], axis=1)
        best = np.linalg.lstsq(moves, true.ravel(), rcond=None)[0].reshape(measured.motion.basis.shape)
        z.append((measured.motion.amplitude[step] - best) / measured.motion.amplitude_std[step])
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 3


def test_the_record_tells_which_steps_were_scanned(measured):
    held = np.zeros(18, dtype=bool)
    held[list(HELD)] = True
    names = ("motion.amplitude", "motion.amplitude_std", "fit.snr_initial_db", "fit.snr_rigid_db", "fit.snr_final_db")
    for name in names:
        known = np.isfinite(attrgetter(name)(measured)).reshape(18, -1)
        np.testing.assert_array_equal(known, np.broadcast_to(held[:, None], known.shape), err_msg=name)
    points = np.zeros((4, 3))
    points[:, 2] = measured.motion.basis.height_mm
    for step in range(18):
        told = np.concatenate([measured.turned_std(step, points).ravel(), measured.strain_std(step, points[:, 2])])
        assert np.isfinite(told).all() if held[step] else np.isnan(told).all()
        assert not (told <= 0).any()
    # at the height of a section its translations alone move the axis
    np.testing.assert_allclose(measured.turned_std(12, points)[:, 1], measured.motion.amplitude_std[12, :, 2])
    np.testing.assert_allclose(
        measured.motion.time_functions @ measured.motion.time_functions.T / 18, np.eye(3), atol=1e-12
    )
    np.testing.assert_array_equal(measured.motion.time_functions.argmax(axis=1), HELD)
    assert measured.motion.observed.all()
    assert measured.motion.data_share[list(HELD)].min() > 0.9
    assert (measured.fit.snr_final_db > measured.fit.snr_rigid_db)[list(HELD)].all()
    assert [(stage.name, stage.scale, stage.unknowns) for stage in measured.fit.stages] == [
        ("rigid", 1, 18),
        ("deformation", 1, 72),
    ]
    for stage in measured.fit.stages:
        assert stage.rms[1] < stage.rms[0]
        assert all(f"step {step}: converged" in stage.stop_reason for step in HELD)


def test_what_was_kept_is_found_again_to_the_bit(measured, work):
    tasks = []
    again = correlate(CASE.experiment, OPTIONS, work=work, progress=lambda task, *_: tasks.append(task))
    assert not [task for task in tasks if "pass" in task or "reconstruct" in task]
    assert again.provenance.seconds["measure"] == measured.provenance.seconds["measure"]
    np.testing.assert_array_equal(again.motion.amplitude, measured.motion.amplitude)
    np.testing.assert_array_equal(again.motion.amplitude_std, measured.motion.amplitude_std)


def test_a_scan_is_measured_alike_whatever_else_was_scanned(measured):
    alone = correlate(with_scans(CASE.experiment.interrupted[1]), OPTIONS)
    np.testing.assert_array_equal(alone.motion.amplitude[12], measured.motion.amplitude[12])
    assert np.isnan(alone.motion.amplitude[[0, 17]]).all()


def test_the_reference_scan_repeated_has_not_moved():
    """Other noise than that of the reference scan, and no motion."""
    still = SmallExperiment(small_scenario({"interrupted.steps": (4,), "motion.ingredients": ()}))
    found = correlate(still.experiment, OPTIONS)
    z = found.motion.amplitude[4] / found.motion.amplitude_std[4]
    assert 0.3 < np.sqrt(np.mean(z**2)) < 2
    assert np.abs(found.motion.amplitude[4, :, :3]).max() < 0.1


def test_a_measurement_with_unscanned_steps_is_written_read_scored_and_reported(measured, tmp_path):
    write_measurement(measured, tmp_path / "a.nc")
    again = read_measurement(tmp_path / "a.nc")
    for field in fields(measured):
        if isinstance(getattr(measured, field.name), np.ndarray):
            one, two = getattr(measured, field.name), getattr(again, field.name)
            np.testing.assert_array_equal(one, two, err_msg=field.name)
    scores = score(again, CASE.truth)
    assert scores.error_voxel.along_beam < 0.1
    assert np.isnan(scores.snr_db.noise_limit)
    page = write_report(tmp_path, again, experiment=CASE.experiment, truth=CASE.truth, scores=scores)
    text = page.read_text()
    assert "from full scans at 3 of its load steps" in " ".join(text.split())
    assert "nan" not in text.split("<h2>Figures</h2>")[0].lower()
    names = {path.name for path in (tmp_path / "figures").glob("*.png")}
    assert {"errors.png", "fig07_translations.png", "fig10b_strain.png"} < names
    assert {"uncertainty_bands.png", "uncertainty_maps.png"} < names
    assert "The residual was not tested against noise." in text
    assert "NEES" not in text
    assert not any("residual" in name for name in names)
    write_report(tmp_path / "without", again)


def test_an_experiment_without_interrupted_scans_is_refused():
    with pytest.raises(ValueError, match=r"interrupted scans: expected at least one \[\[interrupted\]\] entry"):
        correlate(with_scans(), OPTIONS)


def test_a_scan_that_does_not_go_all_around_is_refused_by_its_step():
    scan = CASE.experiment.interrupted[1]
    half = replace(scan.series, angle_rad=scan.series.angle_rad / 2)
    with pytest.raises(ValueError, match=r"scan at step 12: angles of a full scan: expected a full turn") as caught:
        correlate(with_scans(InterruptedScan(step=12, series=half)), OPTIONS)
    assert "\n" not in str(caught.value)


def test_a_scan_of_air_is_refused_by_its_step():
    scan = CASE.experiment.interrupted[2]
    air = replace(scan.series, counts=np.broadcast_to(CASE.experiment.flats[0], scan.series.counts.shape))
    with pytest.raises(ValueError, match=r"scan at step 17: radiographs of a full scan: expected a sample, found"):
        correlate(with_scans(InterruptedScan(step=17, series=air)), OPTIONS)
