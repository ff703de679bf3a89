"""Bias, random part and error over repetitions, and their intervals."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.laws import law
from validation.study.description import Study
from validation.study.figures import study_pictures
from validation.study.page import write_study_report
from validation.study.score_figures import score_pictures
from validation.study.summary import PARTS, QUANTITIES, estimates, mean_scores, summarise


def test_two_draws_by_hand():
    bias, spread = 0.3, 0.04
    found = estimates([np.full((5, 4), bias + spread), np.full((5, 4), bias - spread)])
    assert found["error"].value == pytest.approx(np.sqrt(bias**2 + spread**2), rel=1e-12)
    assert found["random"].value == pytest.approx(np.sqrt(2) * spread, rel=1e-12)
    assert found["bias"].value == pytest.approx(np.sqrt(bias**2 - spread**2), rel=1e-12)
    assert np.isnan(found["error"].low)


@law(30)
@given(st.integers(2, 12), st.integers(1, 30), st.integers(0, 99))
def test_squares_add_up(repetitions, points, seed):
    errors = np.random.default_rng(seed).normal(1.0, 0.1, (repetitions, points))
    found = estimates(list(errors))
    assert found["bias"].value ** 2 + found["random"].value ** 2 == pytest.approx(found["error"].value ** 2, rel=1e-9)
    assert found["random"].value == pytest.approx(np.sqrt(errors.var(axis=0, ddof=1).mean()), rel=1e-9)


def test_points_that_one_draw_leaves_out_count_in_none():
    errors = np.random.default_rng(0).normal(size=(6, 40))
    holed = errors.copy()
    holed[2, 10] = np.nan
    assert estimates(list(holed)) == estimates(list(np.delete(errors, 10, axis=1)))
    assert all(np.isnan(found.value) for found in estimates(list(np.full((3, 5), np.nan))).values())


def test_one_draw_has_an_error_but_neither_bias_nor_random_part():
    found = estimates([np.array([3.0, -4.0])])
    assert found["error"].value == pytest.approx(np.sqrt(12.5))
    assert np.isnan([found["bias"].value, found["random"].value]).all()


def test_intervals_hold_the_truth_about_as_often_as_they_say():
    rng = np.random.default_rng(20180704)
    bias = rng.normal(size=50)
    truth = {"bias": np.sqrt(np.mean(bias**2)), "random": 0.5, "error": np.sqrt(np.mean(bias**2) + 0.25)}
    held = dict.fromkeys(PARTS, 0)
    for _ in range(100):
        found = estimates(list(bias + 0.5 * rng.normal(size=(25, 50))))
        for part in PARTS:
            assert found[part].low <= found[part].value <= found[part].high
            held[part] += found[part].low <= truth[part] <= found[part].high
    # 95 expected, deviation 2; the bootstrap is known to be some per cent short at 25 draws
    assert min(held.values()) >= 85


FACTORS = [
    {"key": "scenario.detector.photons_per_pixel", "values": [500.0, 2000.0, 8000.0], "log": True},
    {"key": "options.sections", "values": [4, 8]},
]


def made_up(folder, factors, *, repetitions=5, noise=1.0, **changes):
    """Return a study and its table, with errors of known size: noise falls with the root of the photons."""
    values = {"name": "made-up", "title": "Made up", "repetitions": repetitions, "factor": factors, **changes}
    study = Study.parse(values, where="made up")
    rng, rows = np.random.default_rng(1), []
    (folder / "errors").mkdir()
    for photons in (500.0, 2000.0, 8000.0):
        for sections in (4, 8) if len(factors) > 1 else (4,):
            for repetition in range(repetitions):
                key = f"{photons:g}-{sections}-{repetition}"
                done = (photons, sections, repetition) != (2000.0, 4, 0)
                row = {"photons_per_pixel": photons, "sections": sections, "seed": 0, "repetition": repetition}
                row |= {"status": "done" if done else "failed", "reason": "" if done else "ValueError: <odd>"}
                row |= {"verdict": "trusted" if done else None, "doubts": "" if done else None}
                rows.append({**row, "error_voxel_vertical": 2.0 * sections, "seconds": 1.0, "key": key})
                size = noise / np.sqrt(photons)
                points = 0.01 + size * rng.normal(size=(20, 10, 3))
                if done:
                    np.savez(folder / "errors" / f"{key}.npz", points=points, strain=points[..., 0] / 10)
    return study, pd.DataFrame(rows)


def test_a_summary_has_a_row_for_each_combination(tmp_path):
    study, table = made_up(tmp_path, FACTORS)
    summary = summarise(study, table, tmp_path)
    assert list(summary["photons_per_pixel"]) == [500.0, 500.0, 2000.0, 2000.0, 8000.0, 8000.0]
    assert list(summary["sections"]) == [4, 8] * 3
    assert list(summary["runs"]) == [5, 5, 4, 5, 5, 5]
    assert list(summary["failed"]) == [0, 0, 1, 0, 0, 0]
    np.testing.assert_allclose(summary["random_voxel_vertical"], 1 / np.sqrt(summary["photons_per_pixel"]), rtol=0.1)
    np.testing.assert_allclose(summary["random_strain"], 0.1 / np.sqrt(summary["photons_per_pixel"]), rtol=0.1)
    np.testing.assert_allclose(summary["bias_voxel_along_beam"][4:], 0.01, rtol=0.1)
    assert "bound_strain" not in summary
    assert list(mean_scores(study, table)["error_voxel_vertical"]) == [8.0, 16.0] * 3


def test_a_bound_of_the_table_is_drawn_beside_the_random_part(tmp_path):
    study, table = made_up(tmp_path, FACTORS[:1])
    for quantity in QUANTITIES:
        table[f"bound_{quantity}"] = 0.8 / np.sqrt(table["photons_per_pixel"])
    summary = summarise(study, table, tmp_path)
    (picture,) = study_pictures(study, summary)
    assert picture.name == "error_against_photons_per_pixel"
    for ax in picture.figure.axes:
        *parts, bound = ax.get_lines()
        assert [line.get_label() for line in parts] == ["error, rms", "bias", "random part"]
        np.testing.assert_allclose(bound.get_ydata(), summary["bound_strain"])
        assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
        assert [float(tick) for tick in ax.get_xticks()] == [500.0, 2000.0, 8000.0]


def test_several_factors_have_a_figure_each_with_a_curve_for_each_value_of_the_other(tmp_path):
    study, table = made_up(tmp_path, FACTORS)
    photons, sections = study_pictures(study, summarise(study, table, tmp_path))
    for picture, curves in ((photons, 2), (sections, 3)):
        assert len(picture.figure.axes) == len(PARTS) * len(QUANTITIES)
        assert all(len(ax.get_lines()) == curves for ax in picture.figure.axes)
    first = sections.figure.axes[-1].get_lines()[0]
    assert first.get_label() == "photons per pixel: 500"
    assert len(first.get_xdata()) == 2


def test_a_factor_of_names_has_an_axis_of_names(tmp_path):
    names = ["few", "some", "many"]
    study, table = made_up(tmp_path, [{**FACTORS[0], "name": "light", "names": names}])
    table["light"] = table["photons_per_pixel"].map(dict(zip((500.0, 2000.0, 8000.0), names, strict=True)))
    (picture,) = study_pictures(study, summarise(study, table, tmp_path))
    ax = picture.figure.axes[0]
    assert [label.get_text() for label in ax.get_xticklabels()] == names
    assert ax.get_xscale() == "linear"


def test_one_draw_of_each_combination_is_drawn_as_points_without_intervals(tmp_path):
    design = {"design": "latin-hypercube", "samples": 3}
    factors = [{"key": "scenario.detector.photons_per_pixel", "low": 500.0, "high": 8000.0, "log": True}]
    study, table = made_up(tmp_path, factors, repetitions=1, **design)
    (picture,) = study_pictures(study, summarise(study, table, tmp_path))
    for ax in picture.figure.axes:
        (line,) = ax.get_lines()
        assert line.get_label() == "error, rms"
        assert not any(len(bars.get_segments()) for bars in ax.collections)


def test_a_score_is_drawn_against_each_factor_with_a_panel_for_each_value_of_the_last_one():
    light = {**FACTORS[0], "values": [500.0, 2000.0], "name": "light", "names": ["few", "some"]}
    frames = {"key": "scenario.detector.frames", "values": [1, 5, 25], "label": "frames averaged"}
    described = {"name": "x", "draw": ["stretch_share"], "factor": [light, FACTORS[1], frames]}
    rows = [(a, b, c) for a in ("few", "some") for b in (4, 8) for c in (1, 5, 25)]
    scores = pd.DataFrame(rows, columns=["light", "sections", "frames"])
    scores["stretch_share"] = scores["sections"] / 8 - scores["frames"] / 100
    pictures = score_pictures(Study.parse(described, where="made up"), scores)
    assert [each.name.removeprefix("stretch_share_against_") for each in pictures] == ["light", "sections", "frames"]
    by_light, by_sections, by_frames = (each.figure.axes for each in pictures)
    assert [ax.get_title() for ax in by_frames] == ["sections: 4", "sections: 8"]
    assert [ax.get_title() for ax in by_light] == [f"frames averaged: {number}" for number in (1, 5, 25)]
    for frames_, ax in zip((1, 5, 25), by_sections, strict=True):
        few, some = ax.get_lines()
        assert [few.get_label(), some.get_label()] == ["few", "some"]
        np.testing.assert_allclose(some.get_ydata(), [0.5 - frames_ / 100, 1 - frames_ / 100])
        assert few.get_linewidth() > 0
    assert pictures[1].figure.legends[0].get_title().get_text() == "light"
    assert [label.get_text() for label in by_light[0].get_xticklabels()] == ["few", "some"]
    assert [line.get_linewidth() for line in by_light[0].get_lines()] == [0, 0]


def test_a_score_of_scattered_combinations_is_a_cloud_of_points():
    sections = {"key": "options.sections", "values": [4, 8]}
    described = {"name": "x", "draw": ["stretch_share"], "factor": [FACTORS[0], sections], "samples": 4}
    study = Study.parse({**described, "design": "latin-hypercube"}, where="made up")
    scores = pd.DataFrame({"photons_per_pixel": [500.0, 2000.0] * 2, "sections": [4, 4, 8, 8], "stretch_share": 0.5})
    for picture in score_pictures(study, scores):
        (ax,) = picture.figure.axes
        (points,) = ax.get_lines()
        assert (points.get_linewidth(), len(points.get_xdata())) == (0, 4)


def test_the_page_tells_of_failed_runs_and_fetches_nothing(tmp_path):
    study, table = made_up(tmp_path, FACTORS)
    page, summary = write_study_report(tmp_path, study, 'name = "made-up"', table, where="a machine")
    text = page.read_text()
    assert "ValueError: &lt;odd&gt;" in text
    assert "1 of them failed" in text
    assert text.count("data:image/png;base64,") == len(list((tmp_path / "figures").iterdir())) == 2
    assert "http" not in text
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "summary.csv"), summary, check_dtype=False)
    assert (tmp_path / "scores.csv").exists()


def test_the_page_counts_the_measurements_that_are_doubted_and_why(tmp_path):
    study, table = made_up(tmp_path, FACTORS[:1])
    page = write_study_report(tmp_path, study, "", table, where="a machine")[0].read_text()
    assert "None: nothing speaks against any" in page
    table.loc[[0, 3], ["verdict", "doubts"]] = ("doubtful", "air-level, cut-ends")
    table.loc[[4], ["verdict", "doubts"]] = ("failed", "air-level")
    page = write_study_report(tmp_path, study, "", table, where="a machine")[0].read_text()
    assert "3 of the 15 are not trusted by their own checks: air-level 3, cut-ends 2." in page


def test_a_study_all_of_whose_runs_failed_still_has_its_page(tmp_path):
    study, table = made_up(tmp_path, FACTORS)
    page, summary = write_study_report(tmp_path, study, "", table.assign(status="failed"), where="a machine")
    assert list(summary["runs"]) == [0] * 6
    assert page.exists()
