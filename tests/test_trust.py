"""The sentences of the report follow from the numbers, whichever way these turn out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdvc.measurement import ResidualTests
from tests import synthetic_records as records
from validation.report.page import write_report
from validation.report.sentences import (
    calibration_sentences,
    nees_sentence,
    noise_known,
    phase_table,
    residual_sentences,
    trust_table,
)
from validation.scoring.interval_calibration import Quantities
from validation.scoring.scores import score

AS_NOISE = ResidualTests(
    chi2_reduced=1.01, lag1_row=0.21, lag1_column=0.30, lag1_row_expected=0.2, lag1_column_expected=0.29
)


@pytest.fixture(scope="module")
def case():
    """Return a measurement whose errors are known: 0.03 voxel up and down, and its scores."""
    truth, amplitude = records.stretched(*records.tensile_history())
    amplitude[..., 2] += 0.03 * (-1.0) ** np.arange(records.STEPS)[:, None]
    measurement = records.measurement(amplitude)
    return measurement, truth, score(measurement, truth)


def with_z(scores, *values):
    return replace(
        scores, calibration=replace(scores.calibration, z_rms=Quantities(**dict(zip(QUANTITIES, values, strict=True))))
    )


QUANTITIES = ("across_beam", "vertical", "along_beam", "strain")


def test_the_table_tells_what_the_scores_tell(case):
    _, _, scores = case
    table = trust_table(scores)
    assert [line[0].partition(",")[0] for line in table] == ["across the beam", "vertical", "along the beam", "strain"]
    assert float(table[1][2]) == pytest.approx(0.03, abs=1e-4)
    assert float(table[1][1]) == pytest.approx(scores.calibration.predicted.vertical, abs=1e-4)
    assert float(table[3][1]) == pytest.approx(100 * scores.calibration.predicted.strain, abs=1e-4)
    assert table[0][4:7] == ["100", "100", "100"]  # no error at all
    assert float(table[1][7]) == pytest.approx(scores.calibration.crps.vertical, abs=1e-4)
    rows = phase_table(scores)
    assert [row[0] for row in rows] == ["across the beam", "vertically", "along the beam", "in strain"]
    assert rows[0][1:] == ["0.00, 100"] * 3


def test_an_interval_too_small_is_told_with_its_factor_and_why(case):
    measurement, truth, scores = case
    small, fair = calibration_sentences(measurement, with_z(scores, 1.1, 2.13, 3.3, 1.4), truth)
    assert small.startswith(
        "The interval is too small vertically by a factor of 2.1 and along the beam by a factor of 3.3:"
    )
    assert "contraction and motion along the beam" in small
    assert fair == "The interval agrees with the errors, to a factor of 1.5, across the beam and in strain."


def test_the_distance_of_the_true_motion_from_the_space_is_told(case):
    measurement, truth, scores = case
    found, _ = calibration_sentences(measurement, with_z(scores, 2, 1, 1, 1), truth)
    tail = found.partition("nearest motion in that space is ")[2]
    told = np.array([float(part) for part in tail.partition(" voxel")[0].replace(" and", ",").split(", ")])
    assert told.shape == (3,)
    # seven random functions do not hold this motion; more of them hold all of it
    assert told.max() > 0.5
    whole = records.altered(
        measurement,
        time_functions=np.sqrt(records.STEPS) * np.eye(records.STEPS),
        covariance=np.eye(records.STEPS * 54),
    )
    inside, _ = calibration_sentences(whole, with_z(scores, 2, 1, 1, 1), truth)
    assert "0.000, 0.000 and 0.000 voxel rms" in inside


def test_contraction_is_no_cause_where_only_other_directions_are_wrong_or_volumes_were_compared(case):
    measurement, truth, scores = case
    assert "contraction" not in calibration_sentences(measurement, with_z(scores, 2, 2, 1, 1), truth)[0]
    volumes = records.altered(measurement, residual_final=np.zeros((records.STEPS, 0, 0), np.float32))
    assert "contraction" not in calibration_sentences(volumes, with_z(scores, 2, 2, 2, 1), truth)[0]


def test_intervals_that_are_right_or_too_large_are_told(case):
    measurement, truth, scores = case
    assert calibration_sentences(measurement, with_z(scores, 1.4, 0.7, 1, 1), truth) == [
        "The interval agrees with the errors, to a factor of 1.5, across the beam, vertically, along the beam and in "
        "strain."
    ]
    large, fair = calibration_sentences(measurement, with_z(scores, 0.5, 1, 1, np.nan), truth)
    assert large == "The interval is too large across the beam by a factor of 2.0."
    assert "strain" not in fair


def test_nees_is_told_with_its_bounds(case):
    _, _, scores = case
    # the chi-square tables give 74.22 and 129.56 at 100 degrees of freedom
    for nees, side in ((60.0, "below"), (75.0, "inside"), (129.0, "inside"), (130.0, "above")):
        text = nees_sentence(replace(scores.calibration, nees=nees, nees_unknowns=100))
        assert f"NEES = {nees:.0f}, {side} the 74 to 130" in text
    assert nees_sentence(replace(scores.calibration, nees=np.nan, nees_unknowns=0)) == ""


@pytest.mark.parametrize(
    ("changed", "first", "last"),
    [
        ({}, "is as large as noise: chi²/(N - p) = 1.01", "nothing in the radiographs speaks against"),
        ({"chi2_reduced": 1.5}, "holds more than noise: chi²/(N - p) = 1.50", "errors may be larger than predicted"),
        ({"chi2_reduced": 0.7}, "is smaller than the noise expected", "not to be relied on"),
        ({"lag1_row": 0.6}, "is as large as noise", "errors may be larger than predicted"),
    ],
)
def test_residuals_that_pass_and_that_do_not(changed, first, last):
    tests = replace(AS_NOISE, **changed)
    size, lags, conclusion = residual_sentences(tests, noise_known=True, truth_known=False)
    assert first in size
    assert lags.endswith("not as expected." if "lag1_row" in changed else "0.20 and 0.29: as expected.")
    assert last in conclusion
    # errors themselves are known beside a truth, so that nothing is concluded from the residual
    assert residual_sentences(tests, noise_known=True, truth_known=True) == [size, lags]


def test_a_noise_taken_from_the_residual_is_not_tested_by_it(case):
    measurement, _, _ = case
    assert noise_known(measurement)
    assert not noise_known(records.altered(measurement, snr_noise_db=np.full(records.STEPS, np.nan)))
    wrong = replace(AS_NOISE, chi2_reduced=0.7)
    size, _, conclusion = residual_sentences(wrong, noise_known=False, truth_known=False)
    assert "tells nothing" in size
    assert "nothing in the radiographs speaks against" in conclusion


def test_volumes_were_not_tested():
    assert residual_sentences(None, noise_known=False, truth_known=False) == [
        "The residual was not tested against noise."
    ]


def test_a_page_without_truth_has_no_table_but_the_sentences(tmp_path, case):
    measurement, _, _ = case
    text = write_report(tmp_path, records.altered(measurement, residual_tests=AS_NOISE)).read_text()
    assert 'id="trust"' not in text
    verdict = text.partition('<ul id="deviations">')[2].partition("</ul>")[0]
    assert verdict.count("<li>") == 3
    assert 'id="uncertainty_histories"' in text
    assert 'id="uncertainty_maps"' in text
