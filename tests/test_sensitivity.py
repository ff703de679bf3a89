"""Which factors matter: designs and analysis against closed forms, through the same path as a study's."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulator.scenario import load_scenario
from tests.laws import law
from validation.study.description import Study, combinations, study_file, trials_of
from validation.study.sensitivity import Influence, analysed, influence_table, influences, ranked
from validation.study.sensitivity_figures import influence_picture
from validation.study.summary import QUANTITIES

KEYS = ("scenario.misalignment.lean_deg", "scenario.misalignment.tilt_deg", "scenario.misalignment.slant_deg")
QUANTITY = "voxel_vertical"
BASE = {"scenario": load_scenario("laboratory").model_dump(mode="json")}


def study_of(design: str, samples: int, *, low: float = 0.0, high: float = 1.0, seed: int = 0) -> Study:
    factors = [{"key": key, "name": f"x{n}", "low": low, "high": high} for n, key in enumerate(KEYS)]
    described = {"name": "made-up", "design": design, "samples": samples, "seed": seed, "repetitions": 1}
    return Study.parse({**described, "factor": factors}, where="made up")


def found_of(study: Study, function: Callable[..., np.ndarray], spoil: int | None = None) -> list[Influence]:
    """Return the influences on the error, were it this function of the factors; one run of them may have failed."""
    table = pd.DataFrame([each.factors for each in combinations(study, BASE)])
    error = function(*(table[name].to_numpy(copy=True) for name in table))
    if spoil is not None:
        error[spoil] = np.nan
    summary = table.assign(**{f"error_{quantity}": np.nan for quantity in QUANTITIES})
    return influences(study, summary.assign(**{f"error_{QUANTITY}": error}), table)


class TestClosedForms:
    def test_indices_of_ishigami_s_function_are_found(self):
        a, b = 7.0, 0.1
        study = study_of("sobol", 1024, low=-math.pi, high=math.pi)
        found = found_of(study, lambda x, y, z: np.sin(x) + a * np.sin(y) ** 2 + b * z**4 * np.sin(x))
        # Ishigami and Homma (1990): variances of x, of y, and of x with z
        x, y, xz = (1 + b * math.pi**4 / 5) ** 2 / 2, a**2 / 8, 8 * b**2 * math.pi**8 / 225
        first, whole = np.array([x, y, 0]), np.array([x + xz, y, xz])
        assert {(each.part, each.quantity, each.blocks) for each in found} == {("error", QUANTITY, 1024)}
        np.testing.assert_allclose([each.alone.value for each in found], first / (x + y + xz), atol=0.05)
        np.testing.assert_allclose([each.whole.value for each in found], whole / (x + y + xz), atol=0.05)
        for each, share in zip(found, whole / (x + y + xz), strict=True):
            # 1.96 deviations; twice that leaves one in ten thousand outside
            assert abs(each.whole.value - share) < 2 * each.whole.half_width < 0.2
        assert ranked(found) == ["x0", "x1", "x2"]

    @law(20)
    @given(st.lists(st.floats(-5, 5), min_size=3, max_size=3), st.floats(0.1, 10), st.integers(2, 6))
    def test_a_linear_function_changes_by_its_slopes_over_the_range_everywhere(self, slopes, width, samples):
        study = study_of("morris", samples, low=-1.0, high=-1.0 + width)
        found = found_of(study, lambda *x: sum(c * each for c, each in zip(slopes, x, strict=True)))
        change = np.multiply(slopes, width)
        np.testing.assert_allclose([each.alone.value for each in found], change, atol=1e-9)
        np.testing.assert_allclose([each.whole.value for each in found], abs(change), atol=1e-9)
        np.testing.assert_allclose([each.sigma for each in found], 0, atol=1e-9)

    def test_what_one_factor_does_to_another_is_in_sigma(self):
        # d(xy)/dx = y, which is at each of the four levels alike: deviation of 0, 1/3, 2/3, 1
        found = found_of(study_of("morris", 400), lambda x, y, z: x * y + z)
        deviation = np.std([0, 1 / 3, 2 / 3, 1])
        np.testing.assert_allclose([each.sigma for each in found], [deviation, deviation, 0], atol=0.03)
        np.testing.assert_allclose([each.whole.value for each in found], [0.5, 0.5, 1], atol=0.04)


class TestWhatIsMissing:
    @pytest.mark.parametrize("design", ["morris", "sobol"])
    def test_a_run_that_failed_takes_its_block_with_it_and_no_other(self, design):
        study = study_of(design, 8)
        length = study.combinations // 8
        spoilt = found_of(study, lambda x, y, z: x + 2 * y, spoil=length + 1)
        assert {each.blocks for each in spoilt} == {7}
        points = np.array([list(each.factors.values()) for each in combinations(study, BASE)])
        left = np.delete(points, np.arange(length, 2 * length), axis=0)
        expected = analysed(design, left, left @ [1.0, 2.0, 0.0], study.seed)
        assert [each.whole for each in spoilt] == [whole for whole, _, _ in expected]

    def test_nothing_is_told_where_no_block_is_whole(self):
        for each in found_of(study_of("morris", 2), lambda x, y, z: +x, spoil=0):
            assert math.isnan(each.whole.value)
            assert each.blocks == 1

    def test_where_nothing_changes_no_factor_matters_and_no_variance_is_shared(self):
        assert [each.whole.value for each in found_of(study_of("morris", 3), lambda x, y, z: 0 * x)] == [0, 0, 0]
        sobol = found_of(study_of("sobol", 4), lambda x, y, z: 0 * x)
        assert all(math.isnan(each.whole.value) for each in sobol)
        assert ranked(sobol) == ["x0", "x1", "x2"]

    def test_a_grid_has_no_influences(self):
        assert influences(Study.parse({"name": "x"}, where="made up"), pd.DataFrame(), pd.DataFrame()) == []


def test_another_seed_is_another_design_and_the_same_seed_the_same():
    for design in ("morris", "sobol"):
        first, again, other = (combinations(study_of(design, 4, seed=seed), BASE) for seed in (0, 0, 1))
        assert first == again != other


def test_a_relative_factor_multiplies_all_its_keys_from_none_to_twice_what_is_usual():
    path = study_file("which-error-matters")
    study = Study.read(path)
    found = trials_of(study, path)
    usual = load_scenario("laboratory").scanner
    assert sorted({trial.factors["spot_drift"] for trial in found}) == pytest.approx([0, 2 / 3, 4 / 3, 2])
    for trial in found:
        at, size = trial.scenario.scanner, trial.factors
        assert at.focal_spot.drift_mm == pytest.approx([size["spot_drift"] * d for d in usual.focal_spot.drift_mm])
        assert at.stage.shake_mm == pytest.approx(size["stage"] * usual.stage.shake_mm)
        assert at.stage.backlash_deg == pytest.approx(size["stage"] * usual.stage.backlash_deg)
        assert at.panel.bad_clusters == round(size["bad_pixels"] * usual.panel.bad_clusters)
        assert at.focal_spot.drift_time_s == usual.focal_spot.drift_time_s


def test_the_figure_has_the_strongest_factor_on_top_and_its_table_the_papers_names():
    study = study_of("morris", 6)
    found = found_of(study, lambda x, y, z: x - 3 * y)
    first, ax = influence_picture(study, found).figure.axes[:2]
    assert [label.get_text() for label in first.get_yticklabels()] == ["x1", "x0", "x2"]
    assert [bar.get_width() for bar in ax.patches] == pytest.approx([3, 1, 0])
    (marks,) = (line for line in ax.get_lines() if line.get_marker() == "|")
    assert marks.get_xdata() == pytest.approx([-3, 1, 0])
    table = influence_table(study, found).set_index("factor")
    assert table["mu"].to_dict() == pytest.approx({"x0": 1, "x1": -3, "x2": 0})
    assert {"mu_star", "sigma"} <= set(table)
    assert "total" not in table


def test_shares_of_few_samples_are_drawn_on_axes_that_hold_shares():
    study = study_of("sobol", 4)
    found = found_of(study, lambda x, y, z: x - 3 * y)
    ax = influence_picture(study, found).figure.axes[1]
    assert ax.get_xlim() == (-0.25, 1.5)
    assert [bar.get_width() for bar in ax.patches] == [each.whole.value for each in (found[1], found[0], found[2])]
    table = influence_table(study, found).set_index("factor")
    assert table["total"].to_dict() == {each.factor: each.whole.value for each in found}
    assert table["first"].to_dict() == {each.factor: each.alone.value for each in found}
