"""Errors where all methods measured, and their differences: made-up errors whose rms is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests import synthetic_records as records
from validation.compare.machine_time import gains
from validation.compare.paired import QUANTITIES, FieldErrors, errors_of, summarised, where_all
from validation.scoring.scores import score

STEPS, POINTS, INTERVALS = 8, 5, 3


def constant(size, *, measured=slice(None), strain=1e-3):
    """Return errors of one size in every direction, at some steps."""
    points = np.full((STEPS, POINTS, 3), np.nan, dtype=np.float32)
    strains = np.full((STEPS, INTERVALS), np.nan, dtype=np.float32)
    points[measured], strains[measured] = size, strain
    return FieldErrors(points=points, strain=strains)


def lay_out(folder, runs):
    """Write errors as runs leave them; `runs` holds (method, repetition, errors or the reason why there are none)."""
    (folder / "errors").mkdir()
    rows = []
    for number, (method, repetition, errors) in enumerate(runs):
        row = {"scenario": "made-up", "method": method, "repetition": repetition, "key": f"k{number}"}
        if isinstance(errors, str):
            rows.append({**row, "status": "failed", "reason": errors})
            continue
        np.savez(folder / "errors" / f"k{number}.npz", points=errors.points, strain=errors.strain)
        costs = {"radiographs": 67, "scanner_minutes": 2.5, "reference_radiographs": 60, "reference_minutes": 2.0}
        measured = int(errors.steps.sum())
        row |= {"status": "done", "reason": "", "steps": STEPS, "steps_measured": measured, "seconds_method": 3.0}
        row |= {"verdict": "trusted", "doubts": ""}
        rows.append({**row, **costs})
    return rows


def test_doubted_measurements_are_counted_by_their_reasons(tmp_path):
    rows = lay_out(tmp_path, [("one", k, constant(1.0)) for k in range(3)] + [("other", 0, constant(1.0))])
    rows[0] |= {"verdict": "doubtful", "doubts": "strain, cut-ends"}
    rows[2] |= {"verdict": "failed", "doubts": "strain"}
    one, other = summarised(rows, tmp_path).methods
    assert (one.doubted, one.doubts) == (2, "strain 2, cut-ends 1")
    assert (other.doubted, other.doubts) == (0, "")


def test_a_method_with_few_steps_is_compared_where_it_measured(tmp_path):
    growing = constant(1.0)
    growing.points[4:] = 3.0
    few = constant(2.0, measured=slice(4, None), strain=4e-3)
    rows = lay_out(tmp_path, [("every", 0, growing), ("few", 0, few)])
    summary = summarised(rows, tmp_path)
    every, scans = summary.methods
    assert (every.measured, scans.measured, every.common, scans.common) == (8, 4, 4, 4)
    for name in QUANTITIES[:3]:
        assert every.error[name].value == pytest.approx(3)
        assert scans.error[name].value == pytest.approx(2)
        assert every.own_error[name].value == pytest.approx(math.sqrt(5))
        assert scans.own_error[name].value == pytest.approx(2)
    (difference,) = summary.differences
    assert (difference.method, difference.other) == ("every", "few")
    assert difference.error["vertical"].value == pytest.approx(1)
    assert difference.error["strain"].value == pytest.approx(-3e-3)
    assert every.minutes_per_step == pytest.approx(2.5 / 8)


def test_directions_are_kept_apart(tmp_path):
    errors = constant(0.0)
    errors.points[...] = [0.1, 0.2, 0.3]
    summary = summarised(lay_out(tmp_path, [("one", 0, errors)]), tmp_path)
    found = [summary.methods[0].error[name].value for name in QUANTITIES]
    np.testing.assert_allclose(found, [0.1, 0.2, 0.3, 1e-3], rtol=1e-6)
    assert summary.differences == ()


def test_a_point_that_one_method_leaves_out_counts_for_none():
    one, other = constant(1.0), constant(1.0)
    one.points[:, 0], other.points[2] = np.nan, np.nan
    one.points[:, 1, 2] = np.nan  # one direction is enough
    points, _ = where_all([one, other])
    expected = np.ones((STEPS, POINTS), dtype=bool)
    expected[:, :2], expected[2] = False, False
    np.testing.assert_array_equal(points, expected)


def test_repetitions_are_paired_and_failures_kept_apart(tmp_path):
    """The second method is worse by 0.1 in each repetition, however much these differ; one repetition is missing."""
    sizes = [0.5, 1.0, 2.0, 4.0]
    runs = [("one", r, constant(size)) for r, size in enumerate(sizes)]
    runs += [("two", r, constant(size + 0.1)) for r, size in enumerate(sizes[:3])]
    summary = summarised(lay_out(tmp_path, [*runs, ("two", 3, "ValueError: no")]), tmp_path)
    one, two = summary.methods
    assert (one.done, one.failed, two.done, two.failed, two.reason) == (4, 0, 3, 1, "ValueError: no")
    assert one.error["vertical"].value == pytest.approx(np.sqrt(np.mean(np.square(sizes))))
    assert one.error["vertical"].low < 1 < one.error["vertical"].high
    (difference,) = summary.differences
    for bound in (
        difference.error["vertical"].low,
        difference.error["vertical"].value,
        difference.error["vertical"].high,
    ):
        assert bound == pytest.approx(-0.1, abs=1e-6)


def test_a_method_that_always_fails_takes_nothing_from_the_others(tmp_path):
    rows = lay_out(tmp_path, [("one", 0, constant(1.0)), ("broken", 0, "ValueError: no")])
    summary = summarised(rows, tmp_path)
    one, broken = summary.methods
    assert one.error["along_beam"].value == pytest.approx(1)
    assert (broken.done, broken.failed, broken.measured) == (0, 1, 0)
    assert math.isnan(broken.error["along_beam"].value)
    assert math.isnan(broken.minutes_per_step)
    assert [each.method for each in summary.by_step] == ["one"]


def test_methods_that_share_no_step_have_nothing_in_common(tmp_path):
    early, late = constant(1.0, measured=slice(0, 3)), constant(1.0, measured=slice(3, 8))
    summary = summarised(lay_out(tmp_path, [("early", 0, early), ("late", 0, late)]), tmp_path)
    assert [each.common for each in summary.methods] == [0, 0]
    assert all(math.isnan(each.error["vertical"].value) for each in summary.methods)
    assert [each.own_error["vertical"].value for each in summary.methods] == [1, 1]


def test_errors_by_step_are_rms_over_repetitions(tmp_path):
    few = constant(3.0, measured=[2, 5])
    rows = lay_out(tmp_path, [("few", 0, few), ("few", 1, constant(4.0, measured=[2, 5]))])
    (found,) = summarised(rows, tmp_path).by_step
    expected = np.full(STEPS, np.nan)
    expected[[2, 5]] = np.sqrt(12.5)
    np.testing.assert_allclose(found.error[:, 1], expected, rtol=1e-6)


def test_errors_of_a_measurement_are_those_that_scores_are_made_of():
    truth, amplitude = records.stretched(*records.tensile_history())
    amplitude[..., 2] += 0.05
    amplitude[4:9] = np.nan
    measurement = records.measurement(amplitude)
    spacing = float(np.mean(np.diff(measurement.motion.basis.height_mm)))
    errors, scores = errors_of(measurement, truth, spacing_mm=spacing), score(measurement, truth)
    across, vertical, along, strain = errors.rms(errors.known)
    assert vertical == pytest.approx(scores.error_voxel.vertical, rel=1e-5)
    assert vertical == pytest.approx(0.05, rel=1e-4)
    assert across == pytest.approx(scores.error_voxel.across_beam, abs=1e-6)
    assert along == pytest.approx(scores.error_voxel.along_beam, abs=1e-6)
    assert strain == pytest.approx(scores.strain_rms, abs=1e-7)
    np.testing.assert_array_equal(np.flatnonzero(~errors.steps), range(4, 9))


def test_strain_is_taken_between_the_same_levels_whatever_the_sections():
    truth, amplitude = records.stretched(*records.tensile_history())
    whole = errors_of(records.measurement(amplitude), truth, spacing_mm=1.0)
    half = errors_of(records.measurement(amplitude[:, ::2]), truth, spacing_mm=1.0)
    assert whole.strain.shape == half.strain.shape


def test_the_paper_s_claim_by_its_own_numbers(tmp_path):
    """600 views in 22 min at rest, 127 radiographs of 2 s; six full scans on the other side."""
    rows = lay_out(tmp_path, [("radiographs", 0, constant(1.0)), ("scans", 0, constant(1.0))])
    reference = {"reference_radiographs": 600, "reference_minutes": 22.0}
    rows[0] |= {"steps_measured": 127, "radiographs": 727, "scanner_minutes": 22 + 127 * 2 / 60, **reference}
    rows[1] |= {"steps_measured": 6, "radiographs": 4200, "scanner_minutes": 7 * 22.0, **reference}
    further, carried_out, step_for_step = gains(*summarised(rows, tmp_path).methods)
    assert further.radiographs == pytest.approx(600)
    assert further.minutes == pytest.approx(22 * 60 / 2)
    assert carried_out.minutes == pytest.approx((7 * 22 / 6) / ((22 + 127 / 30) / 127))
    assert step_for_step.minutes == pytest.approx(128 * 22 / (22 + 127 / 30))
    assert step_for_step.radiographs == pytest.approx(128 * 600 / 727)
    assert [each.holds for each in (further, carried_out, step_for_step)] == [True, True, True]
    assert step_for_step.definition == "step for step, 127 steps"
