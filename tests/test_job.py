"""The main job on a tiny scenario, done once as a user does it, and what it leaves."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest

from tests.command_line import only_line, pdvc_bench
from tests.tiny_scenarios import TINY


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """Do the main job once; the tests below look at what it left."""
    folder = tmp_path_factory.mktemp("job")
    scenario = folder / "tiny.toml"
    scenario.write_text(TINY)
    result = pdvc_bench("run", scenario, "-o", folder / "out", "--threads", 1)
    assert result.exit_code == 0, result.stderr
    return folder, result


def test_the_job_writes_all_it_promises(job):
    folder, result = job
    out = folder / "out"
    assert str(out / "report.html") in result.stderr
    assert "error across beam" in result.stdout
    for name in ("experiment/experiment.toml", "measurement.nc", "scores.json", "report.html"):
        assert (out / name).is_file()
    assert len(list((out / "figures").glob("*.png"))) == 13
    assert not list(out.rglob("*.partial"))


def test_the_report_tells_the_noise_floor_beside_the_true_error(job):
    folder, _ = job
    page = (folder / "out" / "report.html").read_text()
    table = page.partition('<table id="noise-floor">')[2].partition("</table>")[0]
    rows = [re.findall(r"<td>([^<]*)</td>", line) for line in table.splitlines() if "<td>" in line]
    assert [row[0].partition(" ")[0] for row in rows] == ["scatter", "scatter", "true", "true", "true"]
    values = np.array([row[1:] for row in rows], dtype=float)
    assert (values > 0).all()
    # over the whole test the same numbers as in the scores
    scores = json.loads((folder / "out" / "scores.json").read_text())["error_voxel"]
    assert values[4] == pytest.approx([scores[k] for k in ("across_beam", "vertical", "along_beam")], abs=1e-4)
    assert "over the first 11 steps" in page


def test_the_report_tells_whether_the_standard_deviations_are_right(job):
    folder, _ = job
    page = (folder / "out" / "report.html").read_text()
    table = page.partition('<table id="trust">')[2].partition("</table>")[0]
    rows = [re.findall(r"<td>([^<]*)</td>", line) for line in table.splitlines() if "<td>" in line]
    scores = json.loads((folder / "out" / "scores.json").read_text())
    found = scores["calibration"]
    for row, key in zip(rows, ("across_beam", "vertical", "along_beam", "strain"), strict=True):
        assert float(row[3]) == pytest.approx(found["z_rms"][key], abs=0.006)
        assert float(row[6]) == pytest.approx(100 * found["coverage_95"][key], abs=0.6)
    assert f"NEES = {found['nees']:.0f}" in page
    assert f"(N - p) = {scores['chi2_reduced']:.2f}" in page


def test_scores_are_complete_and_plausible(job):
    folder, _ = job
    values = json.loads((folder / "out" / "scores.json").read_text())
    assert values["scenario"] == "tiny"
    assert values["steps"] == 25
    assert values["peak_memory_gib"] > 0
    assert min(values["seconds"].values()) > 0
    assert values["snr_db"]["final"] > values["snr_db"]["initial"]
    assert values["error_voxel"]["across_beam"] < 0.3


def test_asked_again_the_job_repeats_only_scores_and_report(job):
    folder, _ = job
    out = folder / "out"
    kept = [out / "measurement.nc", out / "experiment" / "experiment.toml"]
    before = [path.stat().st_mtime_ns for path in kept]
    scores = (out / "scores.json").read_text()
    (out / "report.html").unlink()
    result = pdvc_bench("run", folder / "tiny.toml", "-o", out, "--threads", 1)
    assert result.exit_code == 0, result.stderr
    assert "experiment: finished before, kept" in result.stderr
    assert "measurement: finished before, kept" in result.stderr
    assert [path.stat().st_mtime_ns for path in kept] == before
    assert (out / "scores.json").read_text() == scores
    assert (out / "report.html").is_file()


def test_another_scenario_does_not_overwrite_a_job(job):
    folder, _ = job
    other = folder / "other.toml"
    other.write_text(TINY.replace("reference_views = 60", "reference_views = 61"))
    result = pdvc_bench("run", other, "-o", folder / "out")
    assert result.exit_code == 2
    assert "acquisition.reference_views differs" in only_line(result)


def test_score_and_report_alone_agree_with_the_run(job):
    folder, _ = job
    out = folder / "out"
    arguments = (out / "measurement.nc", "--truth", out / "experiment")
    alone = json.loads(pdvc_bench("score", *arguments).stdout)
    together = json.loads((out / "scores.json").read_text())
    for key in ("error_voxel", "bias_voxel", "random_voxel", "strain_rms", "snr_db", "modes"):
        assert alone[key] == together[key]
    result = pdvc_bench("report", *arguments, "-o", folder / "page")
    assert result.exit_code == 0, result.stderr
    assert len(list((folder / "page" / "figures").glob("*.png"))) == 13


def test_a_truncated_stack_is_named(job):
    folder, _ = job
    copy = folder / "copy"
    shutil.copytree(folder / "out" / "experiment", copy)
    with (copy / "test" / "radiographs.tif").open("r+b") as file:
        file.truncate(10_000)
    result = pdvc_bench("measure", copy, "-o", folder / "never.nc")
    assert result.exit_code == 2
    assert str(copy / "test" / "radiographs.tif") in only_line(result)
    assert not (folder / "never.nc").exists()


def test_an_interrupted_job_says_so_and_goes_on_to_the_same_counts(job, monkeypatch):
    folder, _ = job
    out = folder / "interrupted"

    def press_ctrl_c(_, task, done, total):
        if task == "test" and done == 7:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("validation.console.ProgressBars.__call__", press_ctrl_c)
        result = pdvc_bench("run", folder / "tiny.toml", "-o", out, "--threads", 1)
    assert result.exit_code == 130
    assert only_line(result) == "interrupted; give the same command again to go on from here"
    assert not (out / "experiment" / "experiment.toml").exists()
    result = pdvc_bench("simulate", folder / "tiny.toml", "-o", out / "experiment")
    assert result.exit_code == 0, result.stderr
    for name in ("reference/radiographs.tif", "test/radiographs.tif", "flats.tif", "darks.tif", "experiment.toml"):
        expected = (folder / "out" / "experiment" / name).read_bytes()
        assert (out / "experiment" / name).read_bytes() == expected, name
