"""What goes through a test step by step: the page with a slider, in a browser too, and movies, frame by frame."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.animation import FFMpegWriter
from PIL import Image

from pdvc.measurement import unfitted
from pdvc.measurement_file import write_measurement
from simulator.scanner import simulate
from tests.browser import CHROMIUM, Browser
from tests.command_line import only_line, pdvc_bench
from validation.report import replay
from validation.report.movie import SHOWN, Frame, write_movie
from validation.report.steps import Steps
from validation.scoring.centre_line import centre_line
from validation.scoring.scores import score
from validation.testing.small_cases import SmallExperiment, small_scenario


@pytest.fixture(scope="module")
def steps():
    """Return the steps of a small experiment, with the truth."""
    case = SmallExperiment(small_scenario())
    return Steps(measurement=case.measurement, experiment=case.experiment, truth=case.truth)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, steps):
    """Return a folder with the experiment and the measurement as files."""
    folder = tmp_path_factory.mktemp("replay")
    simulate(small_scenario(), folder / "experiment")
    write_measurement(steps.measurement, folder / "motion.nc")
    return folder


def data_of(page: str):
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL).group(1))


def decoded(text: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))), dtype=float)


class TestWhatAStepShows:
    def test_profiles_are_the_motion_of_the_scores_with_their_stated_intervals(self, steps):
        across, vertical, along, strain = steps.profiles
        assert [each.name for each in steps.profiles] == [
            "across the beam",
            "vertical",
            "along the beam",
            "axial strain",
        ]
        centre = centre_line(steps.measurement, steps.truth)
        np.testing.assert_allclose(vertical.value, centre.measured[..., 2])
        # the directions of columns and of the beam, as the sample sees them: pdvc.geometry
        angle = steps.measurement.recording.angle_rad[:, None]
        x, y = centre.measured[..., 0], centre.measured[..., 1]
        np.testing.assert_allclose(across.value, -np.sin(angle) * x - np.cos(angle) * y, atol=1e-9)
        np.testing.assert_allclose(along.value, np.cos(angle) * x - np.sin(angle) * y, atol=1e-9)
        difference = (strain.value - strain.true) / 100
        rms = np.sqrt(np.nanmean(difference**2))
        assert rms == pytest.approx(score(steps.measurement, steps.truth).strain_rms)
        # the band of a step, at a section in the middle, from the covariance itself
        z = vertical.height_mm + vertical.true[3] * centre.voxel_mm
        k = int(np.nanargmin(abs(z)))
        std = steps.measurement.turned_std(3, np.array([[0, 0, z[k]]]))[0]
        assert np.isfinite(std).all()
        np.testing.assert_allclose([each.half[3, k] for each in (across, vertical, along)], 1.96 * std)

    def test_a_measurement_of_volumes_or_of_another_test_is_refused(self, steps):
        volumes = replace(steps.measurement, fit=unfitted((), steps.measurement.recording.steps))
        with pytest.raises(ValueError, match=r"expected residuals of radiographs, found none"):
            replace(steps, measurement=volumes)
        fewer = replace(steps.experiment.test, counts=steps.experiment.test.counts[:-1])
        with pytest.raises(ValueError, match=r"expected \d+ radiographs of a test, as were measured, found \d+"):
            replace(steps, experiment=replace(steps.experiment, test=fewer))
        narrow = replace(steps.experiment.test, counts=steps.experiment.test.counts[:, :, :-12])
        with pytest.raises(ValueError, match=r"of which a part was used, found \d+ x \d+ px"):
            replace(steps, experiment=replace(steps.experiment, test=narrow))


class TestThePage:
    def test_the_command_writes_a_page_that_fetches_nothing_and_holds_every_step(self, folder, steps):
        out = folder / "out" / "replay.html"
        result = pdvc_bench("replay", folder / "motion.nc", "--experiment", folder / "experiment", "-o", out)
        assert result.exit_code == 0, result.stderr
        assert f"page: {out}, 0." in result.stderr
        page = out.read_text()
        assert not re.search(r"https?:|src=\"[^d]|@import|import\s*[({\"']", page)
        data = data_of(page)
        count = steps.measurement.recording.steps
        assert {len(data[name]) for name in ("words", "radiographs", "residuals", "time_s")} == {count}
        assert data["profiles"][3]["true"] is None
        assert "truth" not in page

    def test_images_are_those_of_the_steps(self, steps):
        pictures = replay.pictures_of(steps, 1)
        for step in (0, 11):
            shown = 1 - decoded(pictures.radiographs[step]) / 255
            assert shown.shape == steps.shape
            assert abs(shown - np.clip(steps.radiograph(step), 0, 1)).max() < 0.08
            red, _, blue = decoded(pictures.residuals[step]).transpose(2, 0, 1)
            field = steps.measurement.fit.residual_final[step]
            strong = abs(field) > 0.2 * steps.limit
            assert strong.sum() > 20
            # red where the volume is denser than the radiograph
            assert np.mean((red - blue > 0)[strong] == (field > 0)[strong]) > 0.95

    def test_images_are_binned_until_the_page_is_small_enough_and_it_says_so(self, steps, tmp_path):
        whole = replay.pictures_of(steps, 1)
        pictures = replay.write_replay(tmp_path / "page.html", steps, most_bytes=3 * whole.size // 4)
        assert pictures.binning > 1
        assert pictures.size <= 3 * whole.size // 4
        page = (tmp_path / "page.html").read_text()
        assert f"a pixel is the mean of {pictures.binning} × {pictures.binning}" in page
        rows, columns = steps.shape
        assert decoded(pictures.radiographs[0]).shape == (rows // pictures.binning, columns // pictures.binning)
        assert "a pixel is the mean of" not in replay.page_of(steps, whole)

    def test_a_step_that_was_not_measured_has_no_residual_and_no_profile(self, steps):
        fit, motion = steps.measurement.fit, steps.measurement.motion
        field, amplitude = fit.residual_final.copy(), motion.amplitude.copy()
        field[4], amplitude[4] = np.nan, np.nan
        lost = replace(
            steps.measurement,
            fit=replace(fit, residual_final=field),
            motion=replace(motion, amplitude=amplitude),
        )
        some = replace(steps, measurement=lost)
        data = data_of(replay.page_of(some, replay.pictures_of(some, 4)))
        assert [step for step, each in enumerate(data["residuals"]) if each is None] == [4]
        assert set(data["profiles"][1]["value"][4]) == {None}
        frame = Frame.of(some)
        frame.show(4)
        assert np.isnan(np.asarray(frame.images[1].images[0].get_array(), dtype=float)).all()

    @pytest.mark.parametrize(
        ("arguments", "answer"),
        [
            ((), "--experiment: expected the folder that was measured"),
            (("--experiment", "{folder}/none"), "expected an experiment folder, found none"),
        ],
    )
    def test_what_is_missing_is_answered_in_one_line(self, folder, tmp_path, arguments, answer):
        given = [each.format(folder=folder) for each in arguments]
        result = pdvc_bench("replay", folder / "motion.nc", "-o", tmp_path / "page.html", *given)
        assert result.exit_code == 2
        assert answer in only_line(result)
        assert not (tmp_path / "page.html").exists()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on PATH: the page is not looked at")
class TestInABrowser:
    def test_slider_and_keys_move_radiograph_residual_and_profiles_together(self, steps, tmp_path):
        path = tmp_path / "replay.html"
        replay.write_replay(path, steps)
        last = steps.measurement.recording.steps - 1

        async def shown(browser):
            """Return which step the page tells, and that its images and profiles are those of this step."""
            await browser.wait_for("[...document.images].every((e) => e.complete && e.naturalWidth > 0)")
            return await browser.ask(SHOWN_NOW)

        async def press(browser, key):
            for kind in ("keyDown", "keyUp"):
                await browser.call("Input.dispatchKeyEvent", type=kind, key=key)
            return await shown(browser)

        async def main():
            async with Browser(tmp_path / "profile") as browser:
                await browser.open(path.as_uri(), 1500, 850)
                first = await shown(browser)
                assert first[:3] == [steps.words(0), 0, 0]
                right = await press(browser, "ArrowRight")
                assert right[:3] == [steps.words(1), 1, 1]
                assert all(now != before for now, before in zip(right[3:], first[3:], strict=True))
                # with the slider in focus a key moves one step, not two
                await browser.ask("document.getElementById('slider').focus()")
                assert (await press(browser, "ArrowRight"))[0] == steps.words(2)
                assert (await press(browser, "ArrowLeft")) == right
                assert (await press(browser, "End"))[1] == last
                assert (await press(browser, "ArrowRight"))[1] == last
                assert (await press(browser, "Home")) == first
                await browser.ask(f"slider.value = {last}; slider.dispatchEvent(new Event('input'))")
                assert (await shown(browser))[0] == steps.words(last)
                await browser.ask("document.getElementById('play').click()")
                await browser.wait_for(f"document.getElementById('words').textContent === '{steps.words(3)}'")
                assert browser.complaints == []

        asyncio.run(main())

    @pytest.mark.parametrize("size", [(1500, 850), (390, 844)])
    def test_nothing_is_cut_off_on_a_desk_or_a_phone(self, steps, tmp_path, size):
        path = tmp_path / "replay.html"
        replay.write_replay(path, steps)

        async def main():
            async with Browser(tmp_path / "profile") as browser:
                await browser.open(path.as_uri(), *size)
                await browser.wait_for("document.images[1].naturalWidth > 0")
                assert await browser.ask("document.documentElement.scrollWidth <= window.innerWidth")
                frame = await browser.ask(FRAME)
                top, bottom, left, right = steps.measurement.recording.window
                rows, columns = steps.shape
                assert frame == pytest.approx([left / columns, top / rows, right / columns, bottom / rows], abs=0.03)

        asyncio.run(main())


SHOWN_NOW = """(() => {
  const at = data.radiographs.indexOf(document.getElementById("radiograph").src.split(",")[1]);
  const residual = data.residuals.indexOf(document.getElementById("residual").src.split(",")[1]);
  const canvases = [...document.querySelectorAll("canvas")].map((each) => each.toDataURL());
  return [document.getElementById("words").textContent, at, residual, ...canvases];
})()""".replace("data.", "JSON.parse(document.getElementById('data').textContent).")
"""The words, of which step radiograph and residual are, and what the profiles look like."""
FRAME = """(() => {
  const image = document.getElementById("radiograph").getBoundingClientRect();
  const frame = document.querySelector(".frame").getBoundingClientRect();
  const x = (value) => (value - image.left) / image.width, y = (value) => (value - image.top) / image.height;
  return [x(frame.left), y(frame.top), x(frame.right), y(frame.bottom)];
})()"""
"""Where the frame of the used window is, as shares of the radiograph."""


class TestMovies:
    def test_the_command_writes_a_frame_for_every_third_step(self, folder, tmp_path):
        out = tmp_path / "movie.gif"
        arguments = ("--experiment", folder / "experiment", "--every", "6", "--speed", "4")
        result = pdvc_bench("movie", folder / "motion.nc", "-o", out, *arguments)
        assert result.exit_code == 0, result.stderr
        with Image.open(out) as gif:
            assert gif.n_frames == 3
            assert gif.info["duration"] == 250
            frames = []
            for n in range(3):
                gif.seek(n)
                frames.append(np.asarray(gif.convert("RGB"), dtype=int))
        # each part of a frame changes: radiograph, residual, profiles
        change = abs(frames[2] - frames[0]).sum(axis=2) > 60
        assert all(part.any() for part in np.array_split(change[60:-60], 4, axis=1))
        assert list(tmp_path.iterdir()) == [out]

    def test_a_frame_shows_the_step_that_it_says(self, steps):
        frame = Frame.of(steps)
        for step in (2, 15):
            frame.show(step)
            assert frame.figure.get_suptitle() == steps.words(step)
            np.testing.assert_array_equal(frame.images[1].images[0].get_array(), steps.residual(step))
            np.testing.assert_array_equal(frame.images[0].images[0].get_array(), steps.radiograph(step))
            for ax, name in zip(frame.profiles, SHOWN, strict=True):
                (profile,) = (each for each in steps.profiles if each.name == name)
                measured, true = ax.get_lines()
                np.testing.assert_array_equal(measured.get_xdata(), profile.value[step])
                np.testing.assert_array_equal(true.get_xdata(), profile.true[step])
                (band,) = ax.collections
                low, high = band.get_paths()[0].get_extents().intervalx
                assert (low, high) == pytest.approx(
                    (
                        np.nanmin(profile.value[step] - profile.half[step]),
                        np.nanmax(profile.value[step] + profile.half[step]),
                    )
                )

    @pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason="no ffmpeg on PATH: no MP4 is written")
    def test_an_mp4_is_written_where_ffmpeg_is(self, steps, tmp_path):
        write_movie(tmp_path / "movie.mp4", steps, every=9)
        assert (tmp_path / "movie.mp4").read_bytes()[4:8] == b"ftyp"

    @pytest.mark.skipif(not FFMpegWriter.isAvailable(), reason="no ffmpeg on PATH: no MP4 is written")
    def test_an_ffmpeg_that_cannot_is_told_and_leaves_nothing(self, steps, tmp_path, monkeypatch):
        writer = FFMpegWriter(codec="no-such-codec")
        monkeypatch.setattr("validation.report.movie.movie_writer", lambda *_: writer)
        with pytest.raises((ValueError, OSError)):
            write_movie(tmp_path / "movie.mp4", steps, every=18)
        assert list(tmp_path.iterdir()) == []

    def test_what_cannot_be_written_is_answered_in_one_line(self, folder, tmp_path, monkeypatch):
        monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
        for name, answer in {
            "movie.mp4": "expected the program ffmpeg for MP4, found none: install it, or ask for a .gif",
            "movie.avi": "expected a name that ends with .gif or .mp4, found '.avi'",
        }.items():
            arguments = ("--experiment", folder / "experiment", "-o", tmp_path / name)
            result = pdvc_bench("movie", folder / "motion.nc", *arguments)
            assert result.exit_code == 2
            assert answer in only_line(result)
        assert list(tmp_path.iterdir()) == []
