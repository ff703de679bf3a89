"""Uncertainties against errors drawn from them, and the Cramer-Rao bound."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
import pytest
from scipy import stats

from pdvc.experiment import read_experiment
from pdvc.measurement import Measurement
from pdvc.options import MeasureOptions
from pdvc.protocol import measure
from simulator.scanner import simulate
from tests import synthetic_records as records
from tests.tiny_scenarios import trial
from validation.scoring.bound import bound_of
from validation.scoring.interval_calibration import (
    ONSET_STEPS,
    _covered,
    crps,
    interval_calibration,
    phase_steps,
    true_coefficients,
)
from validation.scoring.scores import point_errors

SECTIONS, MOTIONS, FUNCTIONS = 4, 6, 3


@dataclass(frozen=True)
class Moved:
    point_mm: np.ndarray
    displacement_mm: np.ndarray


def known_motion(rng: np.random.Generator) -> Measurement:
    """Return a measurement that is exactly right, with a covariance that joins everything."""
    record = records.measurement(np.zeros((records.STEPS, SECTIONS, MOTIONS)))
    functions = record.motion.time_functions[:FUNCTIONS]
    coefficients = rng.normal(size=(FUNCTIONS, SECTIONS, MOTIONS))
    size = FUNCTIONS * SECTIONS * MOTIONS
    root = 0.02 * rng.normal(size=(size, size)) / np.sqrt(size) + 0.01 * np.eye(size)
    return records.altered(
        record,
        time_functions=functions,
        amplitude=np.einsum("ft,fjk->tjk", functions, coefficients),
        covariance=root @ root.T,
        observed=np.ones(SECTIONS, dtype=bool),
    )


def truth_of(measurement: Measurement) -> Moved:
    """Return material points that move as measured: U(X) = u(X + U), by iteration."""
    low, high = measurement.motion.basis.height_mm[[0, -1]]
    level = np.linspace(low + 0.1, high - 0.1, 12)
    place = np.array([[0, 0], [-0.3, -0.2], [0.3, -0.2], [0.3, 0.2], [-0.3, 0.2]])
    points = np.array([[x, y, z] for z in level for x, y in place])
    moved = np.zeros((len(measurement.recording.angle_rad), *points.shape))
    for step in range(len(moved)):
        for _ in range(40):
            moved[step] = measurement.motion.displacement(step, points + moved[step]) * measurement.recording.voxel_mm
    return Moved(points, moved)


def test_coefficients_of_a_motion_inside_the_span_are_found_exactly():
    exact = known_motion(np.random.default_rng(1))
    found, missed = true_coefficients(
        exact.motion.basis, exact.motion.time_functions, exact.recording.voxel_mm, truth_of(exact)
    )
    norm = (exact.motion.time_functions**2).sum(axis=1)[:, None, None]
    np.testing.assert_allclose(
        found, np.einsum("ft,tjk->fjk", exact.motion.time_functions, exact.motion.amplitude) / norm, atol=1e-6
    )
    assert missed.max() < 1e-6


def test_a_motion_outside_the_span_is_told_by_how_much_it_is_missed():
    exact = known_motion(np.random.default_rng(1))
    truth = truth_of(exact)
    # a wave in time that three smooth functions do not hold
    wave = 0.3 * (-1.0) ** np.arange(len(truth.displacement_mm))
    truth.displacement_mm[..., 2] += wave[:, None] * exact.recording.voxel_mm
    _, missed = true_coefficients(exact.motion.basis, exact.motion.time_functions, exact.recording.voxel_mm, truth)
    held = np.linalg.norm(exact.motion.time_functions @ wave) / np.sqrt(len(wave)) / np.linalg.norm(wave)
    assert 0.3 * np.sqrt(1 - held**2) * 0.95 < missed[2] < 0.3


def test_errors_drawn_from_the_covariance_are_covered_as_they_should_be():
    rng = np.random.default_rng(7)
    exact = known_motion(rng)
    truth = truth_of(exact)
    found = []
    for _ in range(60):
        one = records.drawn(exact, rng)
        found.append(interval_calibration(one, truth, point_errors(one, truth).components))
    for level, part in ((0.5, "coverage_50"), (0.9, "coverage_90"), (0.95, "coverage_95")):
        for name in ("across_beam", "vertical", "along_beam", "strain"):
            each = np.array([getattr(getattr(one, part), name) for one in found])
            # means over draws, which are independent; errors within a draw are not
            assert abs(each.mean() - level) < 4 * each.std() / np.sqrt(len(each)) + 0.005, (part, name)
    unknowns = FUNCTIONS * SECTIONS * MOTIONS
    assert {one.nees_unknowns for one in found} == {unknowns}
    # chi-square with so many degrees of freedom has variance twice their number
    assert np.mean([one.nees for one in found]) == pytest.approx(unknowns, abs=4 * np.sqrt(2 * unknowns / 60))


@pytest.mark.parametrize(("level", "half"), [(0.5, 0.6745), (0.9, 1.6449), (0.95, 1.9600)])
def test_intervals_are_as_wide_as_the_table_of_the_normal_distribution_says(level, half):
    """An error just inside is covered, one just outside is not: draws know the share to some hundredths alone."""
    found = _covered([half + np.array([-1e-3, 1e-3])] * 4, level)
    assert {*astuple(found)} == {0.5}


def test_an_interval_half_as_wide_as_due_shows():
    rng = np.random.default_rng(8)
    exact = known_motion(rng)
    truth = truth_of(exact)
    bold = [records.altered(records.drawn(exact, rng), covariance=exact.motion.covariance / 4) for _ in range(20)]
    found = [interval_calibration(one, truth, point_errors(one, truth).components) for one in bold]
    assert np.sqrt(np.mean([one.z_rms.vertical**2 for one in found])) == pytest.approx(2, rel=0.2)
    assert np.mean([one.coverage_95.vertical for one in found]) < 0.8
    assert np.mean([one.nees for one in found]) > 3 * FUNCTIONS * SECTIONS * MOTIONS


def test_no_standard_deviation_that_is_predicted_is_below_the_bound(tmp_path):
    """Cramer and Rao: reference views add noise, filters and weights lose information; nothing gains any."""
    one = trial({"sections": 4})
    clean = tmp_path / "clean"
    bound, truth = bound_of(one.scenario, one.options, clean)
    simulate(one.scenario, tmp_path / "experiment", clean=clean)
    measured = measure(read_experiment(tmp_path / "experiment"), one.options)
    np.testing.assert_allclose(measured.motion.basis.height_mm, bound.basis.height_mm, rtol=1e-6)
    predicted = interval_calibration(measured, truth, point_errors(measured, truth).components).predicted
    least = bound.quantities(truth.point_mm, truth.displacement_mm)
    for name in ("across_beam", "vertical", "strain"):
        assert getattr(predicted, name) > getattr(least, name), name


def test_the_bound_falls_with_the_root_of_frames(tmp_path):
    one = trial({"sections": 4})
    more = one.scenario.model_copy(
        update={"detector": one.scenario.detector.model_copy(update={"frames": 4 * one.scenario.detector.frames})}
    )
    loose = MeasureOptions(**{**dict(one.options), "prior_voxel": 1e4})
    once, truth = bound_of(one.scenario, loose, tmp_path)
    fourfold, _ = bound_of(more, loose, tmp_path)
    less, usual = (each.quantities(truth.point_mm, truth.displacement_mm) for each in (fourfold, once))
    np.testing.assert_allclose(less.across_beam, usual.across_beam / 2, rtol=1e-3)
    np.testing.assert_allclose(less.vertical, usual.vertical / 2, rtol=1e-3)


def test_the_score_of_a_normal_distribution_is_its_integral():
    """CRPS is the integral of (Phi((x - m) / s) - [x >= y])^2 over x, by quadrature."""
    error, deviation = np.array([0.0, 0.3, -1.2, 4.0]), np.array([1.0, 0.2, 0.5, 1.5])
    x = np.linspace(-40, 40, 400_001)
    expected = [
        np.trapezoid((stats.norm.cdf(x / s) - (x >= e)) ** 2, x) for e, s in zip(error, deviation, strict=True)
    ]
    np.testing.assert_allclose(crps(error, deviation), expected, rtol=1e-3)
    assert len(crps(np.array([np.nan, 1.0, 1.0]), np.array([1.0, 0.0, 1.0]))) == 1


def test_neither_wide_nor_narrow_intervals_win():
    error = np.random.default_rng(4).normal(size=20_000)
    scores = [crps(error, np.full_like(error, factor)).mean() for factor in (0.5, 0.9, 1.0, 1.1, 2.0)]
    assert np.argmin(scores) == 2


def test_phases_follow_the_force():
    """A plateau of 20 steps, and then the load: ten steps of onset, and the rest."""
    step = np.arange(60)
    found = phase_steps(250.0 + 12.0 * np.clip(step - 20, 0, None))
    assert {name: (here.nonzero()[0][0], here.sum()) for name, here in found.items()} == {
        "plateau": (0, 21),
        "onset": (21, ONSET_STEPS),
        "loading": (31, 29),
    }
    still = phase_steps(np.full(30, 250.0))
    assert still["plateau"].all()
    assert not (still["onset"] | still["loading"]).any()


def test_an_error_that_comes_with_the_load_shows_in_its_phase_alone():
    exact = known_motion(np.random.default_rng(3))
    truth, (low, high) = truth_of(exact), np.array([12, 23])
    exact = records.altered(exact, force_N=250.0 + 50.0 * np.clip(np.arange(records.STEPS) - low, 0, None))
    amplitude = exact.motion.amplitude.copy()
    amplitude[high:] += 1.0
    wrong = records.altered(exact, amplitude=amplitude)
    phases = interval_calibration(wrong, truth, point_errors(wrong, truth).components).phases
    assert phases.plateau.coverage_95.vertical == 1.0
    assert phases.loading.coverage_95.vertical == 0.0
    assert phases.loading.z_rms.vertical > 10 * phases.onset.z_rms.vertical
