"""The comparison: what is run, the tables, and the whole command with made-up methods from a made-up package."""

from __future__ import annotations

import csv
import json
import tomllib

import numpy as np
import pytest
from matplotlib.figure import Figure

from pdvc.settings import SettingsError
from simulator.scenario import Scenario
from tests.command_line import install, only_line, pdvc_bench
from tests.tiny_scenarios import SHORT
from validation.compare.comparison import Comparison, with_scans
from validation.compare.figures import Point, cost_figure, draw_cost, draw_steps, steps_figure, style_of
from validation.compare.paired import QUANTITIES
from validation.compare.tables import TextTable, number, with_bounds, with_interval
from validation.methods.registry import Method
from validation.report.figures import new_figure
from validation.scoring.bootstrap import Estimate


def tiny(**changes):
    values = tomllib.loads(SHORT)
    for key, value in changes.items():
        values[key] = {**values.get(key, {}), **value} if isinstance(value, dict) else value
    return Scenario.parse(values, where="tiny")


def by_projections(experiment):
    """Do nothing."""


def by_scans(experiment):
    """Do nothing."""


PROJECTIONS = Method(name="projections", measure=by_projections, assumes="Assume nothing.")
SCANS = Method(name="scans", measure=by_scans, assumes="Assume that the test may be held.", looks_at="volumes")


# What is run


def test_scans_are_spread_over_the_loading():
    plateau, steps = 10, 25
    scenario = tiny(acquisition={"test_steps": steps})
    assert with_scans(scenario).interrupted.steps == (13, 15, 17, 20, 22, 24)
    assert with_scans(scenario).loading.plateau_steps == plateau
    few = tiny(acquisition={"test_steps": 13})
    assert with_scans(few).interrupted.steps == (11, 12)


def test_scans_that_a_scenario_asks_for_stay():
    scenario = tiny(interrupted={"steps": [3, 5]})
    assert with_scans(scenario) == scenario


def test_methods_meet_the_same_noise_and_only_those_that_need_them_the_scans():
    comparison = Comparison(scenarios=(tiny(seed=5),), methods=(PROJECTIONS, SCANS), repetitions=2)
    found = [(run.method, run.scenario.repetition, bool(run.scenario.interrupted.steps)) for run in comparison.runs()]
    assert found == [("projections", 0, False), ("scans", 0, True), ("projections", 1, False), ("scans", 1, True)]
    for run in comparison.runs():
        same = run.scenario.model_copy(update={"interrupted": tiny().interrupted, "repetition": 0})
        assert same == tiny(seed=5)


def test_what_was_added_is_said_only_where_something_was():
    with_its_own = tiny(name="own", interrupted={"steps": [5]})
    comparison = Comparison(scenarios=(tiny(), with_its_own), methods=(PROJECTIONS, SCANS), repetitions=1)
    notes = comparison.notes()
    assert list(notes) == ["tiny"]
    assert "3 were added, at steps 11, 12, 13" in notes["tiny"]
    assert Comparison(scenarios=(tiny(),), methods=(PROJECTIONS,), repetitions=1).notes() == {}


@pytest.mark.parametrize(
    ("scenarios", "methods", "told"),
    [
        ((), (PROJECTIONS,), "scenarios: expected some, each of another name, given none"),
        ((tiny(), tiny(seed=1)), (PROJECTIONS,), "each of another name, given tiny, tiny"),
        ((tiny(),), (SCANS, SCANS), "methods: expected some, each of another name, given scans, scans"),
    ],
)
def test_names_are_not_given_twice(scenarios, methods, told):
    with pytest.raises(SettingsError, match=told):
        Comparison(scenarios=scenarios, methods=methods, repetitions=1)


# Tables


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (np.nan, "—"),
        (0.0094012, "0.00940"),
        (-1.2345, "-1.23"),
        (727.0, "727"),
        (2816.4, "2816"),
        (1.5e7, "1.50e+07"),
        (3.2e-6, "3.20e-06"),
    ],
)
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "half", "scale", "text"),
    [
        (0.47458, 0.0123, 1, "0.475 ± 0.012"),
        (0.00094, 0.000013, 1e3, "0.940 ± 0.013"),
        (123.4, 27.0, 1, "123 ± 27"),
        (0.11273, 1e-7, 1, "0.11273 ± 0.00000"),
        (0.3, np.nan, 1, "0.300"),
        (0.3, 0.0, 1, "0.300"),
        (np.nan, np.nan, 1, "—"),
    ],
)
def test_intervals_are_half_widths_with_two_digits(value, half, scale, text):
    assert with_interval(Estimate(value=value, low=value - half, high=value + half), scale) == text


@pytest.mark.parametrize(
    ("low", "value", "high", "text"),
    [
        (0.0101, 0.0123, 0.0161, "0.0123 [0.0101, 0.0161]*"),
        (-0.2, -0.15, -0.1, "-0.150 [-0.200, -0.100]*"),
        (-0.1, 0.05, 0.15, "0.05 [-0.10, 0.15]"),
        (np.nan, 0.05, np.nan, "0.0500"),
    ],
)
def test_differences_have_the_bounds_of_their_interval_and_a_star_without_zero(low, value, high, text):
    assert with_bounds(Estimate(value=value, low=low, high=high)) == text


def test_a_table_as_markdown_and_latex():
    table = TextTable(
        caption="50 % of a_b", head=("method", "strain, 10⁻³"), rows=(("a & b", "1.0 ± 0.1*"), ("c", "—"))
    )
    assert table.markdown().splitlines() == [
        "50 % of a_b",
        "",
        "| method | strain, 10⁻³ |",
        "| --- | ---: |",
        "| a & b | 1.0 ± 0.1* |",
        "| c | — |",
    ]
    text = table.latex()
    assert r"\caption{50 \% of a\_b}" in text
    assert r"method & strain, 10$^{-3}$ \\" in text
    assert r"a \& b & 1.0 $\pm$ 0.1$^*$ \\" in text
    assert text.isascii()


# Figures


def test_points_are_drawn_where_they_belong():
    style = style_of(["one", "two"])
    points = [
        Point(method="one", cost=0.2, error=Estimate(value=0.01, low=0.008, high=0.013)),
        Point(method="two", cost=25.0, error=Estimate(value=0.05)),
    ]
    figure, (ax,) = new_figure(5, 4)
    draw_cost(points, ax, style=style, cost="min", error="voxel")
    data, _, bars = ax.containers[0]
    np.testing.assert_allclose(data.get_xydata(), [[0.2, 0.01]])
    np.testing.assert_allclose(bars[0].get_segments()[0], [[0.2, 0.008], [0.2, 0.013]])
    (low_x, high_x), (low_y, high_y) = ax.get_xlim(), ax.get_ylim()
    assert low_x < 0.2 < 25 < high_x
    assert low_y < 0.008 < 0.05 < high_y
    figure.draw_without_rendering()


def test_steps_that_were_not_measured_are_not_drawn():
    line, scans = np.full(12, 0.1), np.full(12, np.nan)
    scans[[3, 7]] = 0.2
    _, (ax,) = new_figure(5, 4)
    draw_steps({"line": line, "scans": scans}, ax, style=style_of(["line", "scans"]), error="voxel")
    assert [len(each.get_xdata()) for each in ax.lines] == [12, 2]
    assert [each.get_linestyle() for each in ax.lines] == ["-", "None"]
    assert ax.lines[1].get_marker() == "s"


def test_figures_have_a_panel_for_each_quantity_and_one_legend():
    nothing = Estimate(value=np.nan)
    points = {name: [Point(method="one", cost=1.0, error=nothing)] for name in QUANTITIES}
    for figure in (cost_figure(points, ["one"], "s"), steps_figure({"one": np.full((3, 4), 0.1)}, ["one"])):
        assert isinstance(figure, Figure)
        assert len(figure.axes) == len(QUANTITIES)
        assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one"]
        figure.draw_without_rendering()


# The whole command

MODULE = '''
"""Three methods that tell what they were handed."""

import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from pdvc.gauss_newton import GaussNewton
from pdvc.protocol import measure
from pdvc.options import MeasureOptions, StageOptions
from validation.methods.registry import Method

OPTIONS = MeasureOptions(
    sections=4,
    rigid=(StageOptions(scale="coarse", solver=GaussNewton(most_passes=4)),),
    deformation=(StageOptions(scale=1, solver=GaussNewton(most_passes=2)),),
)


def note(method, experiment):
    counts = hashlib.sha256(np.ascontiguousarray(experiment.test.counts).tobytes()).hexdigest()
    with (Path(os.environ["PDVC_TEST_DIARY"]) / "diary").open("a") as diary:
        scans = [scan.step for scan in experiment.interrupted]
        diary.write(json.dumps({"method": method, "counts": counts, "scans": scans}) + "\\n")


def every(experiment):
    note("every", experiment)
    return measure(experiment, OPTIONS)


def few(experiment):
    note("few", experiment)
    found = measure(experiment, OPTIONS)
    amplitude = np.full_like(found.motion.amplitude, np.nan)
    steps = [scan.step for scan in experiment.interrupted]
    amplitude[steps] = found.motion.amplitude[steps]
    return replace(found, motion=replace(found.motion, amplitude=amplitude))


def broken(experiment):
    note("broken", experiment)
    raise ValueError("radiographs: expected other ones,\\n found these")


def wrong(experiment):
    return 7


EVERY = Method(name="every", measure=every, assumes="Assume that four sections will do.")
FEW = Method(name="few", measure=few, assumes="Assume that scans are taken.", looks_at="volumes")
BROKEN = Method(name="broken", measure=broken, assumes="Assume too much.")
WRONG = Method(name="wrong", measure=wrong, assumes="Assume that a number will do.")
'''


@pytest.fixture(scope="module")
def done(tmp_path_factory, address):
    """Compare made-up methods as a user does it, and again in this process; tests below look at what that left."""
    folder = tmp_path_factory.mktemp("compare")
    methods = {name: f"made_up_methods:{name.upper()}" for name in ("every", "few", "broken", "wrong")}
    install(folder, methods, MODULE, name="made_up_methods")
    (folder / "tiny.toml").write_text(SHORT)
    arguments = ("compare", folder / "tiny.toml", "--methods", "every,few,broken,wrong", "-o", folder / "out")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setenv("PDVC_TEST_DIARY", str(folder))
        first = pdvc_bench(*arguments, "--repetitions", 2, "--workers", 1)
        assert first.exit_code == 0, first.stderr
        diary = [json.loads(line) for line in (folder / "diary").read_text().splitlines()]
        page = (folder / "out" / "comparison.html").read_text()
        (folder / "diary").unlink()
        again = pdvc_bench(*arguments, "--repetitions", 2, "--scheduler", address)
        assert again.exit_code == 0, again.stderr
        repeated = [json.loads(line)["method"] for line in (folder / "diary").read_text().splitlines()]
    return folder / "out", first, diary, page, repeated


def test_all_methods_are_handed_the_same_radiographs(done):
    _, _, diary, _, _ = done
    by_method = {name: [each for each in diary if each["method"] == name] for name in ("every", "few", "broken")}
    assert {len(each) for each in by_method.values()} == {2}
    counts = [{each["counts"] for each in entries} for entries in by_method.values()]
    assert counts[0] == counts[1] == counts[2]
    assert len(counts[0]) == 2  # and the repetitions other noise
    assert [each["scans"] for each in by_method["few"]] == [[11, 12, 13]] * 2
    assert [each["scans"] for each in by_method["every"]] == [[], []]


def test_the_table_has_a_row_for_each_method_and_a_failure_is_one_of_them(done):
    out, first, _, _, _ = done
    with (out / "methods.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["every", "few", "broken", "wrong"]
    assert [row["steps_measured"] for row in rows.values()] == ["14", "3", "0", "0"]
    assert {row["steps_common"] for row in rows.values()} == {"3"}
    assert rows["every"]["radiographs"] == str(36 + 14)
    assert rows["few"]["radiographs"] == str(36 * 4)
    assert rows["broken"]["reason"] == "ValueError: radiographs: expected other ones, found these"
    assert rows["wrong"]["reason"] == "ValueError: method 'wrong': expected it to return a Measurement, got int"
    assert rows["broken"]["failed"] == "2"
    # the same estimate at the same steps is the same error; over all steps it is another
    assert rows["every"]["error_vertical"] == rows["few"]["error_vertical"]
    assert rows["every"]["own_error_vertical"] != rows["every"]["error_vertical"]
    assert rows["few"]["own_error_vertical"] == rows["few"]["error_vertical"]
    assert "| every | 50 |" in first.stdout


def test_the_page_tells_what_was_added_what_failed_and_what_is_assumed(done):
    out, first, _, page, _ = done
    assert "tiny: it has no interrupted scans; 3 were added, at steps 11, 12, 13." in first.stderr
    assert "3 were added, at steps 11, 12, 13" in page
    assert "ValueError: radiographs: expected other ones, found these" in page
    assert "Assume that four sections will do." in page
    assert "This is not told" not in page
    assert "Fewer than 3" in page
    assert "Two orders of magnitude in acquisition time" in page
    # both made the same estimate, so that scans are no more exact
    assert "times across 1.00, vertical 1.00, along 1.00, strain 1.00." in page
    figures = sorted(path.name for path in (out / "figures").iterdir())
    assert figures == ["tiny_computing_time.png", "tiny_machine_time.png", "tiny_steps.png"]
    assert page.count("data:image/png;base64,") == 3
    assert "http" not in page
    assert not list(out.rglob("*.partial"))


def test_the_same_numbers_are_in_every_table(done):
    out, first, _, page, _ = done
    markdown, latex = (out / "methods.md").read_text(), (out / "methods.tex").read_text()
    assert first.stdout.startswith(markdown)
    for line in markdown.splitlines():
        if line.startswith("| every"):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            assert " & ".join(cells).replace("±", r"$\pm$") in latex
            for cell in cells:
                assert f"<td>{cell}</td>" in page
    with (out / "differences.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["method"], row["other"]) == ("every", "few")
    assert float(row["error_across_beam"]) == 0
    with (out / "by_step.csv").open() as file:
        steps = [(row["method"], int(row["step"])) for row in csv.DictReader(file)]
    assert steps == [*(("every", step) for step in range(14)), *(("few", step) for step in (11, 12, 13))]


def test_asked_again_only_what_failed_is_tried_again(done):
    *_, repeated = done
    assert repeated == ["broken", "broken"]


# Mistakes


def test_an_unknown_method_is_answered_before_any_work(tmp_path):
    result = pdvc_bench("compare", "quick", "--methods", "pgd,gauss-newtn", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "did you mean 'gauss-newton'?" in only_line(result)
    assert not (tmp_path / "out").exists()


def test_a_method_that_cannot_be_used_here_is_answered_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    result = pdvc_bench("compare", "quick", "--methods", "pgd,spam", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert only_line(result).startswith("error: method 'spam': expected the program spam-reg, found none: pip install")
    assert not (tmp_path / "out").exists()


def test_an_unknown_scenario_is_answered_before_any_work(tmp_path):
    result = pdvc_bench("compare", "quick", "rigd", "--methods", "pgd", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert "did you mean 'rigid'?" in only_line(result)
    assert not (tmp_path / "out").exists()


def test_a_scheduler_that_does_not_answer_is_named(tmp_path):
    arguments = ("--methods", "pgd", "--scheduler", "nowhere", "-o", tmp_path / "out")
    result = pdvc_bench("compare", "quick", *arguments)
    assert result.exit_code == 2
    assert only_line(result).startswith("error: --scheduler nowhere: expected the address of a Dask scheduler")
