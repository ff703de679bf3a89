"""What is recovered of a strain wave, from profiles and motions in closed form; and what a study makes of it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from pdvc.options import MeasureOptions
from simulator.kinematics import SectionMotion
from tests import synthetic_records as records
from tests.laws import law
from tests.tiny_scenarios import trial
from validation.batch.engine import ERRORS
from validation.batch.trial import PROFILE
from validation.console import resolved_table
from validation.methods import own
from validation.methods.registry import find_method
from validation.scoring.resolution import LAST_STEPS, StrainProfile, recovered_share, recovery, strain_profile
from validation.study.description import Study, study_file, trials_of
from validation.study.page import write_study_report
from validation.study.resolution import cut_off_mm, resolution_table, resolutions
from validation.study.resolution_figures import resolution_picture

HEIGHT = np.linspace(-4.1, 3.9, 61)
GROWTH = np.linspace(0.5, 1.0, 7)[:, None]


def wave(wavelength, phase=0.0):
    return 0.02 * GROWTH * np.sin(2 * np.pi * HEIGHT / wavelength + phase)


def profile(measured, true):
    return StrainProfile(height_mm=HEIGHT, measured=measured, true=true)


WAVELENGTHS, PHASES = st.floats(0.5, 8.0), st.floats(0.0, 2 * np.pi)


class TestProfiles:
    @law(60)
    @given(WAVELENGTHS, PHASES, st.floats(-2.0, 2.0), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
    def test_a_share_of_the_wave_is_found_whatever_the_mean_strains(self, wavelength, phase, share, mean, true_mean):
        true = wave(wavelength, phase)
        found = recovered_share(profile(mean + share * true, true_mean + true), wavelength)
        assert found == pytest.approx(share, abs=1e-9)

    @law(30)
    @given(WAVELENGTHS, PHASES)
    def test_a_wave_a_quarter_of_its_length_away_is_not_recovered(self, wavelength, phase):
        found = recovered_share(profile(wave(wavelength, phase + np.pi / 2), wave(wavelength, phase)), wavelength)
        assert found == pytest.approx(0, abs=1e-9)

    @law(40)
    @given(WAVELENGTHS, PHASES, st.integers(0, 999), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
    def test_it_is_linear_in_the_measured_strain(self, wavelength, phase, seed, a, b):
        one, other = np.random.default_rng(seed).normal(size=(2, *wave(1.0).shape))
        true = wave(wavelength, phase)

        def share(measured):
            return recovered_share(profile(measured, true), wavelength)

        scale = abs(a * share(one)) + abs(b * share(other)) + 1
        assert share(a * one + b * other) == pytest.approx(a * share(one) + b * share(other), abs=1e-9 * scale)

    def test_noise_alone_is_recovered_as_nothing_in_the_mean_and_scatters_as_the_sum_says(self):
        """Least squares over whole waves: each coefficient has variance 2 sigma^2 / intervals."""
        rng, draws, sigma = np.random.default_rng(7), 4000, 0.005
        height = np.arange(60) * 0.1
        true = 0.02 * GROWTH * np.sin(2 * np.pi * height / 2.0)
        shares = np.array(
            [
                recovered_share(
                    StrainProfile(height_mm=height, measured=sigma * rng.normal(size=true.shape), true=true), 2.0
                )
                for _ in range(draws)
            ]
        )
        due = sigma * np.sqrt(2 / 60 / (0.02**2 * (GROWTH**2).sum()))
        assert shares.std() == pytest.approx(due, rel=4 / np.sqrt(2 * draws))
        assert abs(shares.mean()) < 4 * due / np.sqrt(draws)

    def test_intervals_that_were_not_always_observed_do_not_count(self):
        true = wave(1.5)
        measured = 0.7 * true
        measured[2, :9] = np.nan
        measured[:, -4:] = np.nan
        measured[3, :9] = 100.0
        assert recovered_share(profile(measured, np.where(np.isfinite(measured), true, np.nan)), 1.5) == pytest.approx(
            0.7
        )

    def test_less_than_a_wave_and_no_wave_tell_nothing(self):
        true = wave(7.9)
        assert recovered_share(profile(true, true), 7.9) == pytest.approx(1)
        assert np.isnan(recovered_share(profile(true, true), 8.1))
        assert np.isnan(recovered_share(profile(true, 0 * true), 2.0))
        assert np.isnan(recovered_share(profile(np.nan * true, np.nan * true), 2.0))


def section_wave(wavelength=4.0, strain=1e-3):
    """Return a truth that moves with the sections of `synthetic_records`, its amplitudes, and its growth.

    u_z of the sections is the integral of a sine, and grows over the test: a motion that a measurement holds exactly.
    """
    load = np.linspace(0, 1, records.STEPS)
    k = 2 * np.pi / wavelength
    shift = np.zeros((records.STEPS, len(records.HEIGHT_MM), 3))
    shift[..., 2] = -load[:, None] * strain / k * np.cos(k * records.HEIGHT_MM)
    motion = SectionMotion(height_mm=records.HEIGHT_MM, translation_mm=shift, rotation_rad=0 * shift)
    points = records.material_points(np.linspace(-3.8, 3.4, 61))
    moved = np.stack([motion.forward(points, step) - points for step in range(records.STEPS)])
    amplitude = np.concatenate([shift, 0 * shift], axis=2) / records.VOXEL_MM
    return records.ClosedFormTruth(points, moved), amplitude, load


class TestMotions:
    @pytest.mark.parametrize("share", [1.0, 0.5, 0.0])
    def test_a_perfect_measurement_recovers_all_and_one_of_half_the_motion_half(self, share):
        truth, amplitude, _ = section_wave()
        every_step = np.sqrt(records.STEPS) * np.eye(records.STEPS)
        measured = records.altered(records.measurement(share * amplitude), time_functions=every_step)
        found = recovery(strain_profile(measured, truth), measured, truth, 4.0)
        assert found.recovered == pytest.approx(share, abs=1e-9)
        assert found.recoverable == pytest.approx(1, abs=1e-6)

    def test_time_functions_that_do_not_follow_the_wave_cannot_recover_it(self):
        """One constant function makes the mean of the load of all steps."""
        truth, amplitude, load = section_wave(strain=1e-5)
        measured = records.altered(records.measurement(amplitude), time_functions=np.ones((1, records.STEPS)))
        last = load[-LAST_STEPS:]
        due = (load.mean() * last).sum() / (last**2).sum()
        found = recovery(strain_profile(measured, truth), measured, truth, 4.0)
        assert found.recoverable == pytest.approx(due, rel=1e-4)

    def test_the_profile_lies_between_all_levels_at_the_last_steps(self):
        truth, amplitude, load = section_wave(strain=1e-4)
        found = strain_profile(records.measurement(amplitude), truth)
        np.testing.assert_allclose(
            found.height_mm, (np.linspace(-3.8, 3.4, 61)[1:] + np.linspace(-3.8, 3.4, 61)[:-1]) / 2
        )
        assert found.measured.shape == found.true.shape == (LAST_STEPS, 60)
        np.testing.assert_allclose(found.measured, found.true, atol=1e-12)
        # between two sections the strain of a motion in the solver's space is that between these
        slope = np.diff(amplitude[-1, :, 2] * records.VOXEL_MM) / np.diff(records.HEIGHT_MM)
        middle = np.interp(-1.625, found.height_mm, found.true[-1])  # between the sections at -2.1 and -1.15
        assert middle == pytest.approx(slope[2] / (1 - slope[2]), rel=1e-6)
        np.testing.assert_allclose(found.true[-4] / found.true[-1], load[-4] / load[-1], rtol=2e-3)


class TestCutOff:
    @law(60)
    @given(st.floats(0.3, 5.0), st.floats(1.0, 4.0))
    def test_a_curve_that_is_linear_in_the_logarithm_is_read_exactly_from_either_side(self, cut_off, slope):
        wavelength = np.geomspace(0.2, 8.0, 9)
        curve = 0.9 + 0.1 * slope * np.log(wavelength / cut_off)
        curve[np.searchsorted(wavelength, cut_off) + 1 :] = 1.0
        assert cut_off_mm(wavelength, curve) == pytest.approx(cut_off, rel=1e-9)
        assert cut_off_mm(wavelength, 2 - curve) == pytest.approx(cut_off, rel=1e-9)

    def test_the_last_crossing_counts(self):
        wavelength = np.array([1.0, 2.0, 4.0, 8.0])
        assert cut_off_mm(wavelength, np.array([0.95, 0.5, 0.8, 1.0])) == pytest.approx(4 * np.sqrt(2))
        assert cut_off_mm(wavelength, np.array([0.1, 0.9, 0.9, 1.05])) == pytest.approx(2)

    def test_a_curve_that_never_crosses_has_none(self):
        wavelength = np.array([1.0, 2.0, 4.0])
        for curve in ([0.95, 0.97, 1.0], [0.1, 0.5, 0.89], [0.95, 0.97, 0.89], [0.5, 1.0, np.nan], [0.9, 1.0, 1.2]):
            assert np.isnan(cut_off_mm(wavelength, np.array(curve)))


WAVES, DRAWS, SIGMA = (1.0, 2.0, 4.0), 40, {"fine": 2e-3, "coarse": 5e-4, "blind": 1e-3}
CURVES = {"fine": (0.8, 1.0, 1.0), "coarse": (0.2, 0.8, 1.0), "blind": (0.0, 0.1, 0.2)}
LOUDER = {1.0: 0.5, 2.0: 1.0, 4.0: np.sqrt(1.75)}
"""Noise at each wavelength, 1 in the rms."""
STUDY = Study.parse(
    {
        "name": "made-up",
        "repetitions": DRAWS,
        "factor": [
            # out of order, as a study may have them
            {"key": "scenario.motion.ripple.wavelength_mm", "values": [4.0, 1.0, 2.0]},
            {"key": "options.sections", "values": [29, 8, 2], "name": "method", "names": list(CURVES)},
        ],
    },
    where="here",
)


@pytest.fixture(scope="module")
def made_up(tmp_path_factory):
    """Return the table and the folder of a study whose methods recover `CURVES`, with noise of `SIGMA`."""
    folder, rng, rows = tmp_path_factory.mktemp("made-up"), np.random.default_rng(11), []
    (folder / ERRORS).mkdir()
    for length in (4.0, 1.0, 2.0):
        for method, curve in CURVES.items():
            for repetition in range(DRAWS):
                key = f"{method}-{length}-{repetition}"
                strain = 0.01 + SIGMA[method] * LOUDER[length] * rng.normal(size=(10, 50))
                strain[:, 0] = np.nan
                errors = {"points": np.zeros((4, 2, 3)), "strain": np.zeros((4, 2))}
                np.savez(folder / ERRORS / f"{key}.npz", **{PROFILE: strain.astype(np.float32)}, **errors)
                share = curve[WAVES.index(length)]
                rows.append(
                    {
                        "wavelength_mm": length,
                        "method": method,
                        "repetition": repetition,
                        "seconds": 1.0,
                        "status": "done",
                        "verdict": "trusted",
                        "doubts": "",
                        "key": key,
                        "recovered": share + 0.01 * rng.normal(),
                        "recoverable": min(share + 0.05, 1.0),
                    }
                )
    return pd.DataFrame(rows), folder


class TestAStudy:
    def test_methods_have_their_resolution_their_noise_and_their_indicator(self, made_up):
        table, folder = made_up
        fine, coarse, blind = resolutions(STUDY, table, folder)
        assert [each.combination for each in (fine, coarse, blind)] == [{"method": name} for name in CURVES]
        np.testing.assert_array_equal(fine.wavelength_mm, WAVES)
        # linear in the logarithm of the wavelength: half way from 0.8 to 1.0, a third of it from 0.85
        assert fine.resolution_mm.value == pytest.approx(np.sqrt(2), rel=0.02)
        assert coarse.resolution_mm.value == pytest.approx(2 * np.sqrt(2), rel=0.02)
        assert fine.resolution_mm.low < fine.resolution_mm.value < fine.resolution_mm.high
        # the mean of 40 shares is known to 0.0016: a slope of 0.2 an octave, so 0.8 % of the wavelength
        assert fine.resolution_mm.half_width / fine.resolution_mm.value == pytest.approx(
            1.96 * 0.01 / np.sqrt(2 * DRAWS) * np.log(2) / 0.2, rel=0.4
        )
        assert coarse.recoverable_mm == pytest.approx(2 * 2 ** (1 / 3), rel=1e-9)
        for each, name in zip((fine, coarse, blind), CURVES, strict=True):
            # 49 intervals at 10 steps of each of three wavelengths
            assert each.sigma == pytest.approx(SIGMA[name], rel=3 / np.sqrt(2 * 49 * 10 * 3 * (DRAWS - 1)))
            assert each.repetitions == DRAWS
        assert fine.indicator_um == pytest.approx(2e-3 * np.sqrt(2) * 1e3, rel=0.03)  # strain times mm, in um
        assert fine.strain_indicator_um_mm == pytest.approx(2e-3 * 2 * 1e3, rel=0.05)
        assert (fine.outside, blind.outside) == ("", "> 4")
        assert [each.recoverable_outside for each in (fine, coarse, blind)] == ["", "", "> 4"]
        assert np.isnan(blind.resolution_mm.value)
        assert np.isnan(blind.indicator_um)

    def test_a_method_that_resolves_all_wavelengths_is_told_as_finer(self, made_up):
        table, folder = made_up
        (found, *_) = resolutions(STUDY, table.assign(recovered=1.05, recoverable=1.0), folder)
        assert (found.outside, found.recoverable_outside) == ("< 1", "< 1")
        (found, *_) = resolutions(STUDY, table.assign(recovered=1.15), folder)
        assert found.outside == "> 4"

    def test_a_draw_that_failed_at_one_wavelength_counts_at_none(self, made_up):
        table, folder = made_up
        failed = table.copy()
        failed.loc[3, ["status", "recovered"]] = ["failed", np.nan]
        found = resolutions(STUDY, failed, folder)
        assert [each.repetitions for each in found] == [DRAWS - 1, DRAWS, DRAWS]
        assert np.isfinite(found[0].resolution_mm.value)

    def test_one_draw_has_no_noise(self, made_up):
        table, folder = made_up
        alone = Study.parse({**STUDY.model_dump(mode="json"), "repetitions": 1}, where="here")
        (found, *_) = resolutions(alone, table[table["repetition"] == 0], folder)
        assert np.isnan(found.sigma)
        assert found.resolution_mm.value == pytest.approx(np.sqrt(2), rel=0.1)
        assert np.isnan(found.resolution_mm.low)

    def test_another_study_resolves_nothing(self, made_up):
        table, folder = made_up
        assert resolutions(Study(name="x"), table, folder) == []

    def test_a_study_all_of_whose_runs_failed_still_has_its_table_and_figure(self, made_up):
        table, folder = made_up
        found = resolutions(STUDY, table.assign(status="failed"), folder)
        assert [each.repetitions for each in found] == [0, 0, 0]
        assert np.isnan(resolution_table(found)["resolution_mm"]).all()
        assert [each.outside for each in found] == ["", "", ""]
        resolution_picture(found).figure.canvas.draw()

    def test_the_page_and_its_folder_show_them_too(self, made_up, monkeypatch):
        table, folder = made_up
        monkeypatch.setattr("validation.study.page.study_pictures", lambda *_: [])
        page, _ = write_study_report(folder, STUDY, "", table, where="a machine")
        written = pd.read_csv(folder / "resolution.csv").set_index("method")
        found = resolutions(STUDY, table, folder)
        assert written.loc["coarse", "resolution_mm"] == pytest.approx(found[1].resolution_mm.value)
        assert (folder / "figures" / "spatial_resolution.png").exists()
        text = page.read_text()
        assert "<th>2 mm</th>" in text
        row = text.partition("<td>coarse</td>")[2].partition("</tr>")[0]
        cells = [cell.partition("</td>")[0] for cell in row.split("<td>")[1:]]
        values = [float(cell.partition(" ")[0]) for cell in cells]
        sigma, d = 1e3 * found[1].sigma, found[1].resolution_mm.value
        due = [0.2, 0.8, 1.0, d, found[1].recoverable_mm, sigma, sigma * d, sigma * d**2]
        np.testing.assert_allclose(values, due, rtol=0.02)

    def test_table_console_and_figure_show_what_was_found(self, made_up):
        table, folder = made_up
        found = resolutions(STUDY, table, folder)
        frame = resolution_table(found).set_index("method")
        assert frame.loc["fine", "resolution_mm"] == found[0].resolution_mm.value
        assert frame.loc["fine", "indicator_um"] == pytest.approx(
            1e3 * frame.loc["fine", "noise_strain"] * frame.loc["fine", "resolution_mm"]
        )
        console = Console(width=120, record=True)
        console.print(resolved_table(STUDY, found))
        said = console.export_text()
        assert f"{found[0].resolution_mm.value:.2f} (" in said
        assert "> 4" in said
        left, right = resolution_picture(found).figure.axes
        curves = {line.get_label(): line for line in left.lines}
        for each in found:
            (name,) = each.combination.values()
            np.testing.assert_allclose(curves[name].get_ydata(), [share.value for share in each.recovered])
        np.testing.assert_allclose(right.lines[0].get_ydata(), 1e3 * found[0].noise)
        assert right.get_ylim()[0] == 0


class TestTheBuiltInStudy:
    def test_its_methods_are_those_that_are_compared(self, monkeypatch):
        path = study_file("resolution")
        given_options = []
        monkeypatch.setattr(own, "measure", lambda _, *options: given_options.append((*options, MeasureOptions())[0]))
        methods = {}
        for each in trials_of(Study.read(path), path):
            methods.setdefault(each.factors["method"], each)
        assert list(methods) == ["smoother", "gauss-newton", "weighted", "each-step", "pgd"]
        for name, each in methods.items():
            geometry = each.scenario.geometry.cone_beam()
            experiment = SimpleNamespace(geometry=geometry, test=range(each.scenario.acquisition.test_steps))
            find_method(name).measure(experiment)
            due = given_options[-1]
            if name == "pgd":  # the paper's ramp starts at its own step 50
                ramp = due.time[-1].model_copy(update={"start": "onset"})
                due = due.model_copy(update={"time": (*due.time[:-1], ramp)})
            assert each.options == due, name

    def test_every_wave_is_resolved_by_the_simulation_and_seen_whole(self):
        path = study_file("resolution")
        for each in trials_of(Study.read(path), path):
            ripple = each.scenario.motion.ripple
            assert "ripple" in each.scenario.motion.ingredients
            assert 8 * 0.05 <= ripple.wavelength_mm < 2 * each.scenario.view_mm - 1
            assert each.scenario.acquisition.test_steps - each.scenario.loading.plateau_steps > LAST_STEPS


def test_a_run_with_a_ripple_tells_what_it_recovers_and_keeps_its_strain(tmp_path):
    """Long waves are recovered: sections 0.9 mm apart, a wave of 6 mm. Without a wave there is nothing to tell."""
    motion = {"ingredients": ["ripple", "compliance"], "ripple": {"strain": 0.03, "wavelength_mm": 6.0}}
    found = replace(trial(motion=motion), options=MeasureOptions(sections=10)).carry_out(tmp_path)
    assert found.scores["recoverable"] == pytest.approx(1, abs=0.03)
    assert found.scores["recovered"] == pytest.approx(1, abs=0.03)
    strain = found.arrays[PROFILE]
    assert strain.shape == (LAST_STEPS, 80)
    assert np.nanmax(np.abs(strain[-1])) == pytest.approx(0.03, rel=0.3)
    still = trial({"sections": 10}, motion={"ingredients": []}).carry_out(tmp_path)
    assert np.isnan([still.scores["recovered"], still.scores["recoverable"]]).all()
    assert PROFILE not in still.arrays
