"""What speaks against a result: each doubt is tripped by what it is about, and by nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdvc.cells import Spot
from pdvc.geometry import ConeBeam
from pdvc.measurement import ResidualTests
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.result_checks import cut_rows, doubts_of_result, doubts_of_solution, doubts_of_spots
from pdvc.verdict import Doubt, Stop, Verdict, explained_by, listed
from pdvc.volume import Grid, Volume, hull_of
from tests.synthetic_records import HEIGHT_MM, VOXEL_MM, altered, measurement, stretched, tensile_history

BEAM = ConeBeam(source_axis_mm=28.57, source_detector_mm=800.0, pixel_mm=0.2996 * 9, rows=80, columns=40)
"""Its used rows, 10 to 69 of 80, see the sections of the synthetic record, about."""
FUNCTIONS, SECTIONS, MOTIONS = 7, len(HEIGHT_MM), 6


def volume(half_height_mm: float = 6.0) -> Volume:
    """Return a bar of 1 x 1 mm, cut at a height."""
    count = round(2 * half_height_mm / 0.1)
    grid = Grid(shape=(count, 16, 16), voxel_mm=0.1, origin_mm=(-0.75, -0.75, -half_height_mm))
    inside = np.zeros(grid.shape, dtype=bool)
    inside[:, 3:13, 3:13] = True
    return Volume(values=np.zeros(grid.shape, dtype=np.float32), grid=grid, hull=hull_of(inside, grid, 4))


def result(**changes):
    """Return a measurement against which nothing speaks, but for what is changed."""
    _, amplitude = stretched(*tensile_history())
    found = measurement(amplitude)
    good = {
        "data_share": np.ones_like(found.motion.amplitude),
        "residual_tests": ResidualTests(
            chi2_reduced=1.1, lag1_row=0.1, lag1_column=0.1, lag1_row_expected=0.1, lag1_column_expected=0.1
        ),
    }
    return altered(found, **{**good, **changes})


def doubts(found, of=None, prior_voxel=30.0):
    return {each.name: each for each in doubts_of_result(found, of or volume(), BEAM, prior_voxel)}


def test_nothing_speaks_against_a_good_result():
    assert doubts(result()) == {}


def with_step(values, step, value):
    values = values.copy()
    values[step] = value
    return values


def strained(largest):
    """Return amplitudes of a uniform strain that grows to `largest`."""
    strain, offset = tensile_history()
    return stretched(strain / strain.max() * largest, 0 * offset)[1]


def holding(chi2):
    return replace(result().fit.residual_tests, chi2_reduced=chi2)


GOOD = result()
LAST = GOOD.fit.stages[-1]
DOUBTED = {
    "reference-volume": (result(snr_reprojection_db=np.full(40, 12.0), snr_final_db=np.full(24, 16.0)), False, ()),
    "not-explained": (result(snr_final_db=np.full(24, 12.0)), False, ()),
    "step-residual": (result(snr_final_db=with_step(GOOD.fit.snr_final_db, 9, 18.0)), False, (9,)),
    "more-than-noise": (result(residual_tests=holding(9.0)), False, ()),
    "noise-level": (result(residual_tests=holding(0.1)), False, ()),
    "unobserved": (result(observed=with_step(GOOD.motion.observed, 0, False)), False, ()),
    "strain": (result(amplitude=strained(0.7)), False, (20, 21, 22, 23)),
    "prior-alone": (result(data_share=0.3 * np.ones_like(GOOD.motion.amplitude)), False, ()),
    "not-converged": (result(stages=(GOOD.fit.stages[0], replace(LAST, stop=Stop.UNFINISHED))), False, ()),
    "force": (result(force_N=GOOD.recording.force_N * 1e6), False, ()),
    "not-finite": (result(amplitude=with_step(GOOD.motion.amplitude, 3, np.nan)), True, ()),
}


@pytest.mark.parametrize("name", DOUBTED)
def test_each_doubt_has_its_cause_alone(name):
    found, fatal, steps = DOUBTED[name]
    named = doubts(found)
    assert set(named) == {name}
    assert named[name].fatal == fatal
    assert named[name].steps == steps
    assert named[name].figure
    assert named[name].advice


def test_sections_that_change_places_are_no_motion_of_a_sample():
    amplitude = GOOD.motion.amplitude.copy()
    amplitude[5, 4, 2] += 2 * (HEIGHT_MM[1] - HEIGHT_MM[0]) / VOXEL_MM
    assert doubts(result(amplitude=amplitude))["folded"].steps == (5,)
    amplitude[:, 4, 2] += 2 * (HEIGHT_MM[1] - HEIGHT_MM[0]) / VOXEL_MM
    assert doubts(result(amplitude=amplitude))["folded"].fatal


def test_a_prior_that_is_too_narrow_is_told_by_its_own_deviations():
    assert "prior" in doubts(result(), prior_voxel=1.0)
    assert "prior" not in doubts(result(), prior_voxel=100.0)


def test_a_solution_that_hardly_moves_any_more_has_converged():
    still = replace(LAST, stop=Stop.UNFINISHED, last_change_voxel=0.004)
    assert doubts(result(stages=(GOOD.fit.stages[0], still))) == {}
    far = replace(still, last_change_voxel=0.4)
    assert set(doubts(result(stages=(GOOD.fit.stages[0], far)))) == {"not-converged"}


def test_what_is_explained_by_nothing_is_fatal():
    assert doubts(result(snr_final_db=np.full(24, 3.0)))["not-explained"].fatal
    assert doubts(result(snr_reprojection_db=np.full(40, 3.0)))["reference-volume"].fatal


def test_a_spot_that_comes_up_is_told_with_its_first_step_and_its_place():
    nowhere, there = (Spot(score=score, place_mm=(0.1, -0.2, 0.8)) for score in (3.0, 12.0))
    larger = Spot(score=30.0, place_mm=(0.3, 0.0, 0.7))
    assert doubts_of_spots([nowhere] * 20) == ()
    # the first steps tell what is usual
    assert doubts_of_spots([there] * 4 + [nowhere] * 16) == ()
    (doubt,) = doubts_of_spots([nowhere] * 10 + [there, nowhere, larger])
    assert (doubt.name, doubt.steps, doubt.fatal) == ("crack", (10, 12), False)
    assert "from step 10 on" in doubt.figure
    assert "x = 0.30, y = 0.00, z = 0.70 mm, by 30 deviations" in doubt.figure


def test_as_many_functions_as_steps_join_nothing():
    rng = np.random.default_rng(0)
    joined = result(time_functions=np.sqrt(24) * np.linalg.qr(rng.normal(size=(24, 24)))[0])
    assert "few-steps" in doubts(joined)
    assert "few-steps" not in doubts(result(time_functions=np.sqrt(24) * np.eye(24)))


# Rays through the cut ends


@given(half_mm=st.floats(2.3, 3.6), rise_mm=st.floats(-0.6, 0.6))
@settings(deadline=None, max_examples=30)
def test_rows_through_a_cut_end_are_those_whose_rays_leave_it(half_mm, rise_mm):
    """Oracle: points along the rays at both sides of the sample, moved back, one by one."""
    still = np.zeros_like(GOOD.motion.amplitude)
    still[..., 2] = rise_mm / VOXEL_MM
    found, cut = result(amplitude=still), volume(half_mm)
    low, high = cut.hull.box_mm()
    reach = np.hypot(*np.maximum(-low, high)[:2])
    bottom, top = cut.grid.origin_mm[2] + 0.1, cut.grid.origin_mm[2] + 0.1 * (cut.grid.shape[0] - 2)
    leave = 0
    for row in range(*found.recording.window[:2]):
        down = (row - (BEAM.rows - 1) / 2) * BEAM.pixel_mm / BEAM.source_detector_mm
        heights = [-down * (BEAM.source_axis_mm + side * reach) - rise_mm for side in (-1, 1)]
        leave += not all(bottom <= height <= top for height in heights)
    np.testing.assert_allclose(
        cut_rows(found, cut, BEAM), leave / (found.recording.window[1] - found.recording.window[0])
    )
    assert ("cut-ends" in doubts(found, cut)) == (
        leave / (found.recording.window[1] - found.recording.window[0]) > 0.02
    )


def test_the_rows_to_leave_out_are_enough():
    found = result(amplitude=0 * GOOD.motion.amplitude)
    advice = doubts(found, volume(2.6))["cut-ends"].advice
    rows = int(advice.rpartition("= ")[2])
    narrower = altered(found, window=(rows, BEAM.rows - rows, *found.recording.window[2:]))
    assert "cut-ends" not in doubts(narrower, volume(2.6))


def test_a_window_that_leaves_out_the_sample_s_edges_is_named():
    """Seen four times finer, half of the sample is some twenty columns wide."""
    finer = replace(BEAM, pixel_mm=BEAM.pixel_mm / 4, rows=4 * BEAM.rows, columns=4 * BEAM.columns)

    def names(left, right):
        found = altered(result(), window=(40, 280, left, right))
        return {each.name for each in doubts_of_result(found, volume(), finer, 30.0)}

    assert "narrow-window" in names(72, 88)
    assert "narrow-window" not in names(56, 104)


# Full scans, and the record


def test_a_measurement_from_scans_is_judged_at_its_scans():
    amplitude = np.full_like(GOOD.motion.amplitude, np.nan)
    amplitude[[4, 17]] = strained(0.7)[[20, 23]]
    found = result(amplitude=amplitude)
    (strain,) = doubts_of_solution(found, 300.0)
    assert (strain.name, strain.steps) == ("strain", (4, 17))


def test_the_word_follows_from_the_doubts_and_survives_the_file(tmp_path):
    mild, fatal = (
        Doubt(name="a-b", figure="1.5", advice="look", steps=(3, 7)),
        Doubt(name="c", figure="2", advice="stop", fatal=True),
    )
    words = [Verdict(doubts=each).word for each in ((), (mild,), (mild, fatal))]
    assert words == ["trusted", "doubtful", "failed"]
    found = replace(GOOD, verdict=Verdict(doubts=(mild, mild, fatal)))
    write_measurement(found, tmp_path / "m.nc")
    read = read_measurement(tmp_path / "m.nc")
    assert read.verdict == found.verdict
    assert read.verdict.names == ("a-b", "c")
    assert read.verdict.of_step(7) == ("a-b",)
    assert read.verdict.of_step(8) == ()
    assert [stage.stop for stage in read.fit.stages] == [stage.stop for stage in found.fit.stages]


def test_what_fails_is_told_with_the_doubts_before():
    doubt = Doubt(name="a", figure="1", advice="look", steps=(2,))
    told = r"no motion; what speaks against the data: a: 1 \(step 2\); look"
    with pytest.raises(ValueError, match=told), explained_by([doubt]):
        raise ValueError("no motion")


def test_long_lists_of_steps_are_cut():
    assert listed(range(3)) == "0, 1, 2"
    assert listed(range(50)) == "0, 1, 2, 3, 4, 5, 6, 7 and 42 more"
