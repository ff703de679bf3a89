"""Figures draw what they are given: checked on the artists, and that every file is written."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from tests import synthetic_records as records
from validation.report import figures
from validation.scoring.centre_line import centre_line
from validation.scoring.deviations import centre_line_deviation
from validation.scoring.scores import point_errors


@pytest.fixture(scope="module")
def case():
    truth, amplitude = records.stretched(*records.tensile_history())
    return records.measurement(amplitude, unobserved=(8,)), truth


def test_a_figure_is_written_as_matplotlib_would_write_it(case, tmp_path):
    """Colour bars too, which take their place from the layout."""
    measurement, _ = case
    written = []
    for name in ("ours", "theirs"):
        figure, axes = figures.new_figure(8, 4, 3)
        figures.draw_residuals(measurement.fit.residual_initial[[3, 12, 20]], ["a", "b", "c"], axes, limit=1.0)
        if name == "ours":
            text = figures.save(figure, tmp_path / name, dpi=70)
        else:
            figure.savefig(tmp_path / name, dpi=70, format="png")
        written.append((tmp_path / name).read_bytes())
    assert written[0] == written[1] == base64.b64decode(text)


def test_residuals_of_a_row_share_one_symmetric_scale(case):
    measurement, _ = case
    fields = measurement.fit.residual_initial[[3, 12, 20]]
    _, axes = figures.new_figure(8, 4, 3)
    limit = figures.scale_limit(list(fields))
    figures.draw_residuals(fields, ["a", "b", "c"], axes, limit=limit)
    assert {ax.images[0].get_clim() for ax in axes} == {(-limit, limit)}
    assert np.quantile(np.abs(fields), 0.998) <= limit


@pytest.mark.parametrize("value", [1e-6, 0.0123, 0.1, 0.999, 7.3, 4e5])
def test_scale_limits_are_round_and_just_large_enough(value):
    limit = figures.scale_limit([np.array([value, -value])])
    assert value * 0.999 <= limit <= 1.6 * value
    assert f"{limit:.1e}".endswith(("0e", "5e")) or limit == pytest.approx(float(f"{limit:.1e}"))


def test_scale_of_an_empty_residual_is_one():
    assert figures.scale_limit([np.zeros((4, 5))]) == 1.0


def test_translations_are_those_of_the_record(case):
    measurement, truth = case
    _, (ax,) = figures.new_figure(7, 3)
    centre = centre_line(measurement, truth)
    figures.draw_translations(centre, ax)
    drawn = [line.get_ydata() for line in ax.lines]
    np.testing.assert_allclose(drawn[:3], drawn[3:], atol=1e-9)


def test_force_marks_the_selected_steps(case):
    measurement, _ = case
    _, (ax,) = figures.new_figure(7, 3)
    figures.draw_force(measurement.recording.time_s, measurement.recording.force_N, [3, 20], ax)
    np.testing.assert_array_equal(ax.lines[1].get_xdata(), measurement.recording.time_s[[3, 20]])


def test_difference_maps_vanish_for_a_perfect_measurement_and_hide_the_unobserved(case):
    measurement, truth = case
    centre = centre_line(measurement, truth)
    for figure in figures.stretch_maps(centre):
        difference = figure.axes[2].collections[0].get_array()
        assert np.ma.masked_invalid(difference).mask.any()
        assert np.nanmax(np.abs(difference)) < 1e-9
        assert figure.axes[0].collections[0].get_clim() == figure.axes[1].collections[0].get_clim()


def test_maps_without_truth_have_one_panel(case):
    measurement, _ = case
    for figure in figures.stretch_maps(centre_line(measurement)):
        assert len(figure.axes) == 2  # the map and its colour bar


@pytest.mark.parametrize(
    ("errors", "scale"),
    [(np.zeros((5, 3)), "linear"), (np.geomspace(1e-3, 2, 15).reshape(5, 3) - 1e-3, "log")],
    ids=["a perfect measurement", "errors over decades"],
)
def test_errors_are_drawn_as_they_are_but_for_those_of_zero_which_a_logarithm_has_no_place_for(errors, scale):
    figure, (ax,) = figures.new_figure(7, 3)
    figures.draw_errors(errors, ax)
    figure.draw_without_rendering()
    assert ax.get_yscale() == scale
    low, high = ax.get_ylim()
    assert len(ax.lines) == 3
    for line, values in zip(ax.lines, errors.T, strict=True):
        drawn = np.asarray(line.get_ydata())
        np.testing.assert_array_equal(np.isnan(drawn), values == 0)
        np.testing.assert_array_equal(drawn[values > 0], values[values > 0])
        assert (low <= drawn[values > 0]).all()
        assert (drawn[values > 0] <= high).all()


def test_errors_by_step(case):
    measurement, truth = case
    figure, (ax,) = figures.new_figure(7, 3)
    figures.draw_errors(point_errors(measurement, truth).by_step() + 0.01, ax)
    assert [line.get_label() for line in ax.lines] == ["across the beam", "vertical", "along the beam"]
    figure.draw_without_rendering()


def test_snr_without_known_noise_has_no_limit_line(case):
    measurement, _ = case
    unknown = np.full(records.STEPS, np.nan)
    _, (ax,) = figures.new_figure(7, 3)
    m = measurement
    figures.draw_snr(m.fit.snr_initial_db, m.fit.snr_rigid_db, m.fit.snr_final_db, unknown, float("nan"), ax)
    assert len(ax.lines) == 3


def test_radiographs_show_the_used_window(case):
    measurement, _ = case
    images = np.random.default_rng(1).random((2, 80, 40))
    figure, axes = figures.new_figure(6, 4, 2)
    figures.draw_radiographs(images, ["a", "b"], axes, window=measurement.recording.window)
    np.testing.assert_array_equal(axes[0].lines[0].get_xdata(), np.array([6, 34, 34, 6, 6]) - 0.5)
    figure.draw_without_rendering()


def test_steps_measured_alone_are_drawn_as_dots_and_steps_in_a_row_as_a_line():
    for by_step, marker in ((np.ones((6, 3)), "None"), (np.where(np.arange(6)[:, None] % 2, np.nan, 1.0), ".")):
        _, (ax,) = figures.new_figure(7, 3)
        figures.draw_errors(np.broadcast_to(by_step, (6, 3)), ax)
        assert {line.get_marker() for line in ax.lines} <= {marker, marker.lower()}


def test_the_noise_floor_is_drawn_beside_the_true_scatter_where_there_is_one():
    levels, scatter = np.linspace(-3, 3, 9), np.arange(27.0).reshape(9, 3)
    _, (ax,) = figures.new_figure(7, 3)
    figures.draw_noise_floor(levels, scatter, levels[::2], 2 * scatter[::2], ax)
    solid, dashed = ax.lines[0:6:2], ax.lines[1:6:2]
    for k in range(3):
        np.testing.assert_array_equal(solid[k].get_ydata(), scatter[:, k])
        np.testing.assert_array_equal(dashed[k].get_ydata(), 2 * scatter[::2, k])
        assert solid[k].get_color() == dashed[k].get_color()
    _, (ax,) = figures.new_figure(7, 3)
    figures.draw_noise_floor(levels, scatter, None, None, ax)
    assert len(ax.lines) == 3


def test_a_band_is_two_standard_deviations_around_the_error(case):
    measurement, truth = case
    centre = centre_line_deviation(measurement, truth)
    figure = figures.error_bands(centre)
    assert len(figure.axes) == 12  # three heights, three directions and the strain
    levels = [
        np.flatnonzero(np.isclose(centre.level_mm, float(ax.get_ylabel()[4:-3]), atol=0.006))
        for ax in figure.axes[::4]
    ]
    for row, (level,) in enumerate(levels):
        histories = [*zip(centre.error[:, level].T, centre.std[:, level].T, strict=True)]
        histories.append((100 * centre.strain_error[:, level], 100 * centre.strain_std[:, level]))
        for ax, (error, std) in zip(figure.axes[4 * row : 4 * row + 4], histories, strict=True):
            np.testing.assert_array_equal(ax.lines[1].get_ydata(), error)
            (band,) = ax.collections
            corners = band.get_paths()[0].vertices
            for step in (3, 17):
                at = np.unique(corners[corners[:, 0] == step, 1])
                np.testing.assert_allclose(at[[0, -1]], [error[step] - 2 * std[step], error[step] + 2 * std[step]])
    assert centre.level_mm[levels[0][0]] > centre.level_mm[levels[2][0]]


def test_bands_of_steps_measured_alone_are_bars():
    _, (ax,) = figures.new_figure(7, 3)
    values = np.array([np.nan, 1.0, np.nan, 3.0])
    figures.draw_band(values, np.full(4, 0.5), ax)
    (bars,) = ax.collections
    ends = np.array([segment[:, 1] for segment in bars.get_segments() if len(segment)])
    np.testing.assert_allclose(ends[np.isfinite(ends).all(axis=1)], [[0, 2], [2, 4]])


def test_maps_of_standard_deviations_hide_the_unobserved(case):
    measurement, _ = case
    centre = centre_line_deviation(measurement)
    figure = figures.std_maps(centre)
    maps = [np.ma.filled(ax.collections[0].get_array(), np.nan) for ax in figure.axes[:4]]
    for k in range(3):
        np.testing.assert_array_equal(maps[k], centre.std[..., k].T)
    np.testing.assert_array_equal(maps[3], 100 * centre.strain_std.T)
    assert np.isnan(maps[0][8]).all()
    assert np.isfinite(maps[0][:8]).all()
    figure.draw_without_rendering()


def test_without_truth_standard_deviations_are_drawn_against_the_step(case):
    measurement, _ = case
    centre = centre_line_deviation(measurement)
    figure = figures.std_histories(centre)
    assert [len(ax.lines) for ax in figure.axes] == [3, 3, 3, 3]
    drawn = {line.get_label(): line.get_ydata() for line in figure.axes[1].lines}
    for level in (1, 3, 5):
        np.testing.assert_array_equal(drawn[f"z = {centre.level_mm[level]:.2f} mm"], centre.std[:, level, 1])


def test_uncertainties_of_a_motion_that_nobody_saw_can_be_drawn():
    measurement = records.measurement(np.full((records.STEPS, 9, 6), np.nan))
    centre = centre_line_deviation(measurement)
    assert np.isnan(centre.std).all()
    for figure in (figures.std_maps(centre), figures.std_histories(centre)):
        figure.draw_without_rendering()
