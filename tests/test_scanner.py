import errno

import numpy as np
import pytest
import tifffile

from pdvc.experiment import DESCRIPTION, FLATS, REFERENCE, TEST, interrupted_stack, read_experiment
from pdvc.settings import SettingsError
from simulator import scanner
from simulator.detector import expected
from simulator.images import prepare, transmission
from simulator.sample import moved_body
from simulator.scanner import SimulationError, simulate
from simulator.scenario import course_of
from simulator.stacks import Stack, clear_images, exposed, step_image
from simulator.truth import DISPLACEMENT, read_scenario, read_truth
from tests.tiny_scenarios import tinier


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "experiment"
    simulate(tinier(), path, workers=2)
    return path


def stacks(folder):
    return [tifffile.imread(folder / name) for name in (REFERENCE, TEST, FLATS)]


def test_the_folder_reads_as_an_experiment(folder):
    experiment = read_experiment(folder)
    assert experiment.reference.counts.shape == (20, 40, 24)
    assert experiment.test.counts.shape == (20, 40, 24)
    assert (len(experiment.flats), len(experiment.darks), experiment.frames) == (2, 1, 5)
    assert experiment.geometry == tinier().geometry.cone_beam()
    assert experiment.photons_per_count == pytest.approx(0.2)
    np.testing.assert_allclose(experiment.test.angle_rad, 2 * np.pi * np.arange(20) / 10, atol=1e-11)
    np.testing.assert_allclose(experiment.test.force_N, course_of(tinier()).history.force_N, atol=5)


def test_the_sample_is_in_the_middle_and_darker_than_the_beam(folder):
    experiment = read_experiment(folder)
    open_beam = np.median(experiment.flats, axis=0) - np.median(experiment.darks, axis=0)
    ratio = (experiment.reference.counts[0] - np.median(experiment.darks, axis=0)) / open_beam
    assert np.median(ratio[:, 12]) < 0.8
    assert np.median(ratio[:, :2]) == pytest.approx(1, abs=0.02)


def test_truth_holds_scenario_and_displacement(folder):
    assert read_scenario(folder) == tinier()
    truth = read_truth(folder)
    course = course_of(tinier())
    assert truth.point_mm.shape == (81 * 5, 3)
    assert truth.displacement_mm.shape == (20, 81 * 5, 3)
    np.testing.assert_array_equal(truth.point_mm[::5, :2], 0.0)
    np.testing.assert_array_equal(truth.point_mm[::5, 2], truth.level_mm)
    moved = truth.point_mm + truth.displacement_mm[19]
    np.testing.assert_allclose(course.motion.inverse(moved, 19), truth.point_mm, atol=1e-10)
    np.testing.assert_array_equal(truth.force_N, course.history.force_N)


def test_counts_do_not_depend_on_workers(folder, tmp_path):
    simulate(tinier(), tmp_path, workers=1)
    for one, two in zip(stacks(tmp_path), stacks(folder), strict=True):
        np.testing.assert_array_equal(one, two)
    assert (tmp_path / DESCRIPTION).read_bytes() == (folder / DESCRIPTION).read_bytes()


def test_the_seed_changes_the_counts(folder, tmp_path):
    simulate(tinier(seed=1, acquisition={"reference_views": 1, "test_steps": 1}, motion={"ingredients": []}), tmp_path)
    assert not np.array_equal(tifffile.imread(tmp_path / FLATS), tifffile.imread(folder / FLATS))


@pytest.mark.parametrize(("task", "at"), [("reference", 3), ("reference", 19), ("test", 17)])
def test_an_interrupted_run_goes_on_to_the_same_counts(folder, tmp_path, task, at):
    def interrupt(name, done, total):
        if (name, done) == (task, at):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tinier(), tmp_path, progress=interrupt, workers=2)
    assert not (tmp_path / DESCRIPTION).exists()
    assert not (tmp_path / TEST).exists()
    starts = {}
    simulate(tinier(), tmp_path, progress=lambda name, done, total: starts.setdefault(name, done), workers=2)
    assert starts[task] == at
    for one, two in zip(stacks(tmp_path), stacks(folder), strict=True):
        np.testing.assert_array_equal(one, two)
    assert not list(tmp_path.rglob("*.partial"))


def test_a_complete_folder_is_left_alone(folder):
    stamp = (folder / DESCRIPTION).stat().st_mtime_ns
    simulate(tinier(), folder, progress=lambda *_: pytest.fail("nothing is left to do"))
    assert (folder / DESCRIPTION).stat().st_mtime_ns == stamp


def test_another_scenario_is_refused_with_the_key_that_differs(folder):
    with pytest.raises(SimulationError, match=r"another scenario \(tiny; detector\.frames differs\)"):
        simulate(tinier(detector={"frames": 3}), folder)


def test_an_experiment_that_was_not_simulated_is_refused(tmp_path):
    (tmp_path / DESCRIPTION).write_text("title = 'real data'")
    with pytest.raises(SimulationError, match=r"holds experiment\.toml of an experiment that was not simulated"):
        simulate(tinier(), tmp_path)
    assert (tmp_path / DESCRIPTION).read_text() == "title = 'real data'"


def test_a_full_disk_is_told_in_one_line_and_leaves_nothing_that_looks_whole(tmp_path, monkeypatch):
    class FullDisk(scanner.StackWriter):
        def write(self, index, image):
            if self.path.name == "radiographs.tif" and index == 5:
                raise OSError(errno.ENOSPC, "No space left on device")
            super().write(index, image)

    monkeypatch.setattr(scanner, "StackWriter", FullDisk)
    with pytest.raises(OSError, match=r"disk full: tiny needs \d+ MB") as caught:
        simulate(tinier(), tmp_path)
    assert caught.value.errno == errno.ENOSPC
    assert "\n" not in str(caught.value)
    assert not (tmp_path / DESCRIPTION).exists()
    assert not (tmp_path / REFERENCE).exists()


def test_truth_that_is_missing_or_damaged_is_refused(tmp_path):
    with pytest.raises(SettingsError, match=r"displacement\.nc: expected the truth of a simulated experiment"):
        read_truth(tmp_path)
    (tmp_path / "truth").mkdir()
    (tmp_path / DISPLACEMENT).write_bytes(b"not a file of this kind")
    with pytest.raises(SettingsError, match=r"displacement\.nc: expected displacement samples"):
        read_truth(tmp_path)


def test_without_motion_the_test_repeats_the_reference(tmp_path):
    still = tinier(
        motion={"ingredients": []},
        acquisition={"steps_per_turn": 20},
        detector={"photons_per_pixel": 1e9, "readout_noise_counts": 0.0},
    )
    simulate(still, tmp_path)
    reference, test, _ = (stack.astype(float) for stack in stacks(tmp_path))
    # photon noise is 40000 / sqrt(5e9) = 0.6 counts at most, and rounding adds as much
    assert np.abs(reference - test).max() < 6


def test_with_motion_the_test_differs_by_more_than_noise(folder):
    reference, test, _ = (stack.astype(float) for stack in stacks(folder))
    assert np.abs(reference[0] - test[0]).max() > 2000


def test_images_can_be_made_one_at_a_time(folder):
    bench = prepare(tinier(), course_of(tinier()))
    np.testing.assert_array_equal(step_image(bench, 7), tifffile.imread(folder / TEST)[7])


HELD = {"steps": (0, 13), "views": 10, "view_s": 3.0}


@pytest.fixture(scope="module")
def held_folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("held") / "experiment"
    simulate(tinier(interrupted=HELD), path, workers=2)
    return path


def test_interrupted_scans_are_recorded_with_step_angle_time_and_force(held_folder):
    scans = read_experiment(held_folder).interrupted
    history = course_of(tinier()).history
    assert [scan.step for scan in scans] == [0, 13]
    for scan in scans:
        assert scan.series.counts.shape == (10, 40, 24)
        np.testing.assert_allclose(scan.series.angle_rad, 2 * np.pi * np.arange(10) / 10, atol=1e-11)
        np.testing.assert_allclose(scan.series.time_s, history.time_s[scan.step] + 3.0 * np.arange(10))
        np.testing.assert_allclose(scan.series.force_N, history.force_N[scan.step], atol=5)
        assert len(set(scan.series.force_N)) == 10


def test_interrupted_scans_change_no_other_count_and_no_recorded_force(folder, held_folder):
    for one, two in zip(stacks(held_folder), stacks(folder), strict=True):
        np.testing.assert_array_equal(one, two)
    plain, held = read_experiment(folder), read_experiment(held_folder)
    np.testing.assert_array_equal(plain.reference.force_N, held.reference.force_N)
    np.testing.assert_array_equal(plain.test.force_N, held.test.force_N)


def test_by_default_an_interrupted_scan_is_taken_like_the_reference_scan():
    course = course_of(tinier(interrupted={"steps": (4,)}))
    np.testing.assert_array_equal(course.interrupted_angle_rad, course.reference_angle_rad)
    expected_s = course.history.time_s[4] + course.reference_time_s
    np.testing.assert_allclose(course.interrupted_time_s, expected_s[None])


def held_image(bench, step, view):
    stack = Stack("interrupted", step)
    return exposed(bench.scenario, bench.maps, clear_images(bench, stack)(view), stack, view)


def test_a_view_at_the_angle_of_the_held_step_shows_what_the_step_shows():
    """Steps turn by a tenth of a turn, and so do these views: view 3 stands where step 13 stands."""
    quiet = tinier(interrupted=HELD, detector={"photons_per_pixel": 1e9, "readout_noise_counts": 0.0})
    bench = prepare(quiet, course_of(quiet))
    held = moved_body(bench.body, bench.course.motion, 13)
    scan, step = held_image(bench, 13, 3), step_image(bench, 13)
    noise_free = expected(transmission(bench, held, 2 * np.pi * 13 / 10, 0.0), quiet.detector, bench.maps, 2)
    for image in (scan, step):
        # photon noise is 40000 / sqrt(5e9) = 0.6 counts at most, and rounding adds as much
        assert np.abs(image - np.clip(noise_free, 0, 65535)).max() < 5
    assert not np.array_equal(scan, step)


def test_without_motion_an_interrupted_scan_differs_from_the_reference_scan_by_its_noise_alone(tmp_path):
    still = tinier(motion={"ingredients": []}, interrupted={"steps": (3, 19)}, detector={"bad_pixel_fraction": 0.0})
    simulate(still, tmp_path)
    experiment = read_experiment(tmp_path)
    reference = experiment.reference.counts.astype(float)
    one, two = (scan.series.counts.astype(float) for scan in experiment.interrupted)
    dark = still.detector.dark_counts
    variance = ((reference - dark) / experiment.photons_per_count + experiment.readout_noise_counts**2) / 5
    for image, other in ((one, reference), (two, reference), (one, two)):
        score = (image - other) / np.sqrt(2 * variance)
        # 19200 independent normal deviates: mean within 1 / sqrt(19200) = 0.007, deviation within half of that
        assert abs(score.mean()) < 0.03
        assert score.std() == pytest.approx(1, abs=0.03)
        assert abs((score[:, :, 1:] * score[:, :, :-1]).mean()) < 0.03


def test_an_interrupted_scan_that_was_interrupted_itself_goes_on_to_the_same_counts(held_folder, tmp_path):
    def interrupt(name, done, total):
        if (name, done) == ("scan at step 13", 4):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tinier(interrupted=HELD), tmp_path, progress=interrupt, workers=2)
    assert not (tmp_path / DESCRIPTION).exists()
    simulate(tinier(interrupted=HELD), tmp_path, workers=1)
    for n in range(2):
        np.testing.assert_array_equal(
            tifffile.imread(tmp_path / interrupted_stack(n)), tifffile.imread(held_folder / interrupted_stack(n))
        )


def test_a_folder_that_lost_an_interrupted_scan_is_completed(held_folder, tmp_path):
    simulate(tinier(interrupted=HELD), tmp_path)
    (tmp_path / interrupted_stack(1)).unlink()
    simulate(tinier(interrupted=HELD), tmp_path)
    np.testing.assert_array_equal(
        tifffile.imread(tmp_path / interrupted_stack(1)), tifffile.imread(held_folder / interrupted_stack(1))
    )


def test_the_noise_of_a_scan_depends_on_its_step_not_on_the_other_scans(held_folder):
    alone = tinier(interrupted={**HELD, "steps": (13,)})
    bench = prepare(alone, course_of(alone))
    image = held_image(bench, 13, 2)
    np.testing.assert_array_equal(image, tifffile.imread(held_folder / interrupted_stack(1))[2])
