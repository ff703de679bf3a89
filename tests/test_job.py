"""The main job on a tiny scenario, done once as a user does it, and what it leaves."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest

from pdvc.experiment import DESCRIPTION, Description, write_description
from pdvc.measurement_file import read_measurement
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
    # each step has amplitudes of its own, of which there are more than of data that tell them apart
    assert found["nees"] is None
    assert "NEES =" not in page
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


@pytest.fixture(scope="module")
def turned(job):
    """Return a copy of the experiment whose stage is said to turn the other way."""
    folder, _ = job
    copy = folder / "turned"
    shutil.copytree(folder / "out" / "experiment", copy, ignore=shutil.ignore_patterns("truth"))
    description = Description.read(copy / DESCRIPTION)
    stacks = {name: getattr(description, name) for name in ("reference", "test")}
    other = {
        name: stack.model_copy(update={"angle_deg": tuple(-angle for angle in stack.angle_deg)})
        for name, stack in stacks.items()
    }
    write_description(copy, description.model_copy(update=other))
    return copy


def test_inspect_shows_what_is_found_and_proposed(job):
    folder, _ = job
    picture = folder / "look.png"
    result = pdvc_bench("inspect", folder / "out" / "experiment", "-o", picture)
    assert result.exit_code == 0, result.stderr
    assert "nothing speaks against these data" in result.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    found = " ".join(result.stdout.split())
    assert "60 reference views, 25 steps" in found
    assert re.search(r"loading begins after step (9|10|11) ", found)
    measured = read_measurement(folder / "out" / "measurement.nc")
    assert f"discard_rows = {measured.recording.window[0]}" in found
    assert f"unknowns {measured.fit.unknowns} " in found


def test_inspect_names_a_stage_that_turns_the_other_way(turned, job):
    folder, _ = job
    result = pdvc_bench("inspect", turned, "-o", folder / "turned.png")
    assert result.exit_code == 0, result.stderr
    assert re.search(r"rotation-sign: opposite views fit together with -(0\.9|1\.0)\d times", result.stdout)
    assert "give reference and test angles the other sign" in result.stdout


def test_inspect_refuses_what_cannot_be_measured(job):
    folder, _ = job
    copy = folder / "dark"
    shutil.copytree(folder / "out" / "experiment", copy)
    shutil.copy(copy / "darks.tif", copy / "flats.tif")
    result = pdvc_bench("inspect", copy, "-o", folder / "never.png")
    assert result.exit_code == 2
    assert "flats.tif: expected more counts than the darks" in only_line(result)
    assert not (folder / "never.png").exists()


def test_a_measurement_that_failed_says_so_everywhere(turned, job):
    folder, _ = job
    out = folder / "turned.nc"
    result = pdvc_bench("measure", turned, "-o", out)
    assert result.exit_code == 3, result.stderr
    assert "verdict: failed" in result.stderr
    assert "rotation-sign" in result.stderr
    verdict = read_measurement(out).verdict
    assert verdict.word == "failed"
    assert "rotation-sign" in verdict.names
    assert pdvc_bench("report", out, "-o", folder / "turned-page").exit_code == 0
    page = (folder / "turned-page" / "report.html").read_text()
    assert page.index('<span class="failed">failed</span>') < page.index("<h2>Summary</h2>")
    assert "Nothing below is to be believed." in page
    assert "<td>rotation-sign</td>" in page


def test_console_scores_and_file_tell_the_same_verdict(job):
    """So few and coarse pixels leave more than noise, at steps that see a flat face along the beam above all."""
    folder, result = job
    verdict = read_measurement(folder / "out" / "measurement.nc").verdict
    assert set(verdict.names) <= {"step-residual", "more-than-noise"}
    assert f"verdict: {verdict.word}" in result.stderr
    scores = json.loads((folder / "out" / "scores.json").read_text())
    assert (scores["verdict"], scores["doubts"]) == (verdict.word, ", ".join(verdict.names))
