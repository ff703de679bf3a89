"""Coverage, NEES and their intervals, from tables of runs made up with a known answer."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from scipy import stats

from validation.console import honesty_table
from validation.study.coverage import DIRECTIONS, coverage_table, honesty, verdict
from validation.study.description import Study

UNKNOWNS, DRAWS, POINTS = 200, 80, 40
STUDY = Study(name="made-up", repetitions=DRAWS)


def table_of(scale: float = 1.0) -> pd.DataFrame:
    """Return runs whose errors are `scale` times what they state."""
    rng = np.random.default_rng(5)
    rows = []
    for repetition in range(DRAWS):
        row = {"status": "done", "repetition": repetition, "key": str(repetition), "chi2_reduced": 1.01}
        for direction in DIRECTIONS:
            z = scale * rng.normal(size=POINTS)
            for level in (50, 90, 95):
                half = stats.norm.ppf((1 + level / 100) / 2)
                row[f"calibration_coverage_{level}_{direction}"] = (np.abs(z) < half).mean()
            row[f"calibration_predicted_{direction}"] = 0.01
            row[f"calibration_z_rms_{direction}"] = np.sqrt((z**2).mean())
        row["calibration_nees"] = float(((scale * rng.normal(size=UNKNOWNS)) ** 2).sum())
        row["calibration_nees_unknowns"] = UNKNOWNS
        rows.append(row)
    return pd.DataFrame(rows)


def test_right_uncertainties_are_found_right():
    (found,) = honesty(STUDY, table_of())
    assert found.draws == DRAWS
    for one in found.covered:
        due = one.level / 100
        assert one.binomial[0] < due < one.binomial[1]
        # 3200 independent errors
        assert one.found.value == pytest.approx(due, abs=4 * np.sqrt(due * (1 - due) / POINTS / DRAWS))
        assert one.binomial[0] < one.found.low <= one.found.high < one.binomial[1]
    assert found.nees_bounds[0] < found.nees < found.nees_bounds[1]
    assert found.nees_bounds[1] - found.nees_bounds[0] == pytest.approx(
        2 * 1.96 * np.sqrt(2 / UNKNOWNS / DRAWS), rel=0.01
    )
    assert "as wide as" in verdict(found)
    assert "within" in verdict(found)


def test_intervals_that_are_too_small_are_called_so_with_their_factor():
    (found,) = honesty(STUDY, table_of(2.0))
    assert found.z_rms["vertical"] == pytest.approx(2, rel=0.05)
    assert found.nees == pytest.approx(4, rel=0.05)
    said = verdict(found)
    assert "too small: across beam by a factor of 2" in said
    assert "outside" in said


def test_draws_that_differ_in_all_they_may_are_pooled():
    """Each combination is one draw, of another motion: coverage is asked of all of them together."""
    table = table_of().assign(angle=np.arange(DRAWS))
    factor = {"key": "scenario.motion.bending.angle_deg", "name": "angle", "low": 0.0, "high": 1.0}
    study = Study.parse(
        {
            "name": "made-up",
            "repetitions": 1,
            "design": "latin-hypercube",
            "samples": DRAWS,
            "pooled": True,
            "factor": [factor],
        },
        where="here",
    )
    (found,) = honesty(study, table)
    (noise,) = honesty(STUDY, table)
    assert (found.draws, found.covered, found.z_rms) == (DRAWS, noise.covered, noise.z_rms)
    assert len(honesty(study.model_copy(update={"pooled": False}), table)) == DRAWS
    console = Console(width=80, record=True)
    console.print(honesty_table(study, found))
    told = console.export_text()
    assert f"{DRAWS} draws" in told
    (line,) = (line for line in told.splitlines() if line.startswith("vertical"))
    assert f"{100 * found.covered[-3].found.value:.0f} (" in line


def test_failed_runs_do_not_count():
    table = table_of()
    table.loc[:9, "status"] = "failed"
    (found,) = honesty(STUDY, table)
    assert found.draws == DRAWS - 10


def test_a_table_without_uncertainties_shows_nothing():
    assert honesty(STUDY, table_of().drop(columns="calibration_nees")) == []


def test_without_a_whole_covariance_there_is_no_nees():
    table = table_of()
    table["calibration_nees"], table["calibration_nees_unknowns"] = np.nan, 0
    (found,) = honesty(STUDY, table)
    assert np.isnan(found.nees)
    assert "NEES" not in verdict(found)


def test_the_table_has_a_line_for_each_direction():
    frame = coverage_table(honesty(STUDY, table_of()))
    assert list(frame["direction"]) == list(DIRECTIONS)
    assert (frame["coverage_95_binomial_low"] < frame["coverage_95"]).all()
