"""Many draws of an experiment whose law is known: one draw carried out, and what a table of them says."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from pdvc.identify.options import IdentifyOptions
from simulator.scenario import load_scenario
from tests.command_line import pdvc_bench
from validation.batch.trial import Trial
from validation.identify.draws import METHODS, draws
from validation.identify.recovery import recovery
from validation.identify.study import identified_trials, recovery_of
from validation.identify.truth import truth_of
from validation.study.description import Factor, Study
from validation.testing.small_cases import small_options, small_scenario


def test_a_draw_scores_every_method_and_other_noise_and_texture_move_all_of_them(tmp_path):
    one, other = draws(small_scenario({"discarded_rows": 15}), IdentifyOptions(), 2)
    assert one.key != other.key
    assert [draw.columns["texture"] for draw in (one, other)] == [1, 2]
    first, second = one.carry_out(tmp_path).scores, other.carry_out(tmp_path).scores
    assert set(first) == set(one.score_columns)
    for method in METHODS:
        for name in truth_of(small_scenario().loading):
            assert np.isfinite(first[f"{method}:{name}"])
            assert first[f"{method}:{name}_deviation"] > 0
        assert first[f"{method}:hardening_MPa"] != second[f"{method}:hardening_MPa"]
    # a pixel is a tenth of this sample, and nodules are three, which dent its faces
    assert abs(first["area_error"]) < 0.15


def test_coverage_bias_and_random_error_are_those_of_the_draws():
    """Errors of a known bias and scatter, stated half as large as they are by one method."""
    scenario, rng, count = load_scenario("quick"), np.random.default_rng(0), 4000
    table = {"status": ["done"] * count + ["failed"]}
    for method in METHODS:
        table[f"seconds_{method}"] = np.append(np.full(count, 2.0), np.nan)
        for name, true in truth_of(scenario.loading).items():
            table[f"{method}:{name}"] = np.append(np.log(true) + 0.02 + 0.05 * rng.standard_normal(count), np.nan)
            stated = 0.025 if method == "two-step" else np.hypot(0.05, 0.02)
            table[f"{method}:{name}_deviation"] = np.append(np.full(count, stated), np.nan)
    table["crosshead:exponent"][:] = np.nan
    found = recovery(pd.DataFrame(table), scenario).set_index(["method", "parameter"])
    assert ("crosshead", "exponent") not in found.index
    row = found.loc[("integrated", "yield_MPa")]
    assert row["draws"] == count
    assert row["bias"] == pytest.approx(0.02, abs=3e-3)
    assert row["random"] == pytest.approx(0.05, rel=0.05)
    assert row["covered"] == pytest.approx(0.95, abs=0.015)
    assert row["z"] == pytest.approx(1.0, abs=0.05)
    assert found.loc[("two-step", "yield_MPa"), "covered"] < 0.7
    assert found.loc[("two-step", "yield_MPa"), "z"] > 2


def test_a_study_of_laws_tells_what_was_recovered_and_that_a_wrong_law_is_doubted(tmp_path, monkeypatch):
    # so small a test tells laws apart by about two in log evidence
    monkeypatch.setattr("pdvc.identify.result.STRONG", 0.5)
    scenario = small_scenario({"discarded_rows": 15})
    trial = Trial(scenario=scenario, options=small_options(scenario), factors={"photons": 8000.0})
    study = Study(
        name="laws",
        laws=("ludwik", "linear"),
        repetitions=1,
        factor=(Factor(key="scenario.detector.photons_per_pixel", name="photons", values=(8000.0,)),),
    )
    (run,) = identified_trials(study, [trial])
    scores = run.carry_out(tmp_path).scores
    assert set(scores) == set(run.score_columns)
    table = pd.DataFrame([{**run.columns, **scores, "status": "done"}])
    recovered, said = recovery_of(study, [trial], table)
    assert set(recovered["method"]) == set(METHODS)
    assert (recovered["photons"] == 8000).all()
    row = said.iloc[0]
    assert (row["runs"], row["right"], row["linear_doubted"], row["ludwik_doubted"]) == (1, 1, 1, 0)
    assert row["ahead"] > 0


def test_a_study_of_a_law_that_is_none_is_refused(tmp_path):
    study = tmp_path / "laws.toml"
    study.write_text('name = "laws"\nlaws = ["hooke"]\n', encoding="utf-8")
    told = pdvc_bench("study", str(study), "-o", str(tmp_path / "out"))
    assert told.exit_code == 2
    assert "law: expected one of" in told.output
