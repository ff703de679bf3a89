"""What a test that is followed is watched for: each alarm where it is due, and none where nothing is wrong."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from pdvc.air_level import JOINED
from pdvc.alarms import BEFORE, QUIET, SPAN, Alarm, Watch
from pdvc.cells import CRACK, LEAST_STEPS, Cells
from pdvc.experiment import Experiment, read_experiment
from pdvc.geometry import ConeBeam
from pdvc.incoming import Arrival
from pdvc.measurement import ResidualTests
from pdvc.options import DEFAULT
from pdvc.record import StepLine
from pdvc.sections import CONTRACTION, RIGID, SectionBasis
from pdvc.setup import Setup, set_up
from pdvc.tracker import Taken
from pdvc.volume import DIRECTIONS, Hull
from simulator.scanner import simulate
from simulator.scenario import Scenario
from tests.laws import law
from tests.tiny_scenarios import TINY

GEOMETRY = ConeBeam(source_axis_mm=100.0, source_detector_mm=400.0, pixel_mm=0.2, rows=90, columns=60)
BASIS = SectionBasis(height_mm=np.linspace(-1.8, 1.8, 5), radius_mm=1.0, motions=(*RIGID, CONTRACTION))
HULL = Hull(z_mm=-2.2, slab_mm=0.2, support_mm=np.full((22, DIRECTIONS), 1.0))
STEP_RAD = np.deg2rad(15.0)


def seen_at(place_mm, angle_rad) -> tuple[float, float]:
    """Return the row and the column in which a point is seen, by the words of docs/frame.md alone."""
    x, y, z = place_mm
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    # the stage turns the sample counter-clockwise before a source at -x
    along, left = c * x - s * y, s * x + c * y
    larger = GEOMETRY.source_detector_mm / (GEOMETRY.source_axis_mm + along) / GEOMETRY.pixel_mm
    return (GEOMETRY.rows - 1) / 2 - larger * z, (GEOMETRY.columns - 1) / 2 - larger * left


def residuals(steps: int, seed: int, place_mm=None, since: int = 0, height: float = 0.0, shift_mm=(0.0, 0.0, 0.0)):
    """Yield residuals over their deviation: noise, and a spot where a place of the moved sample is seen."""
    rng = np.random.default_rng(seed)
    for t in range(steps):
        image = rng.standard_normal((GEOMETRY.rows, GEOMETRY.columns))
        if place_mm is not None and t >= since:
            row, column = seen_at(np.add(place_mm, shift_mm), t * STEP_RAD)
            r, c = np.indices(image.shape)
            image += height * np.exp(-0.5 * ((r - row) ** 2 + (c - column) ** 2) / 1.5**2)
        yield t, image.astype(np.float32)


def still() -> np.ndarray:
    return np.zeros(BASIS.shape)


@law(10)
@given(
    st.floats(0.0, 0.7),
    st.floats(0.0, 2 * np.pi),
    st.floats(-1.5, 1.5),
    st.tuples(*[st.floats(-6.0, 6.0)] * 3),
    st.integers(0, 2**31),
)
def test_a_spot_that_comes_up_is_found_where_it_is_on_the_sample(radius, direction, z, moved_voxel, seed):
    place = np.array([radius * np.cos(direction), radius * np.sin(direction), z])
    amplitude = still()
    amplitude[:, :3] = moved_voxel
    cells, shift = Cells(GEOMETRY, BASIS, HULL), np.array(moved_voxel) * GEOMETRY.voxel_mm
    spots = [
        cells.add(image, amplitude, t * STEP_RAD)
        for t, image in residuals(54, seed, place, since=30, height=6.0, shift_mm=shift)
    ]
    assert max(spot.score for spot in spots[LEAST_STEPS + 1 : 30]) < CRACK < max(spot.score for spot in spots[40:])
    # to a cell's side
    np.testing.assert_allclose(spots[-1].place_mm, place, atol=0.2)


def test_what_was_always_there_is_not_new_and_more_material_is_no_crack():
    for since, height in ((0, 3.0), (30, -3.0)):
        cells = Cells(GEOMETRY, BASIS, HULL)
        scores = [
            cells.add(image, still(), t * STEP_RAD).score
            for t, image in residuals(60, 1, (0.3, 0.2, 0.5), since=since, height=height)
        ]
        assert max(scores[LEAST_STEPS:]) < 8


def test_what_a_single_radiograph_shows_is_no_crack():
    cells = Cells(GEOMETRY, BASIS, HULL)
    images = dict(residuals(50, 1))
    for t, image in residuals(50, 1, (0.3, 0.2, 0.5), since=0, height=40.0):
        if t in (20, 32):
            images[t] = image
    scores = [cells.add(image, still(), t * STEP_RAD).score for t, image in images.items()]
    assert max(scores[LEAST_STEPS:]) < 8


def test_a_pixel_that_is_not_finite_and_a_sample_thinner_than_a_cell_do_no_harm():
    cells = Cells(GEOMETRY, BASIS, HULL)
    for t, image in residuals(20, 3, (0.3, 0.2, 0.5), since=12, height=8.0):
        image[10, 10] = np.nan if t == 5 else image[10, 10]
        spot = cells.add(image, still(), t * STEP_RAD)
    assert spot.score > 8
    thin = replace(HULL, support_mm=np.full((22, DIRECTIONS), 1e-3))
    assert Cells(GEOMETRY, BASIS, thin).add(image, still(), 0.0).score == 0


def test_cells_that_are_restored_go_on_as_if_nothing_had_been():
    one, other = Cells(GEOMETRY, BASIS, HULL), Cells(GEOMETRY, BASIS, HULL)
    images = list(residuals(14, 2))
    for t, image in images[:10]:
        one.add(image, still(), t * STEP_RAD)
    other.restore({name: values.copy() for name, values in one.kept().items()})
    assert [one.add(image, still(), 0.1) for _, image in images[10:]] == [
        other.add(image, still(), 0.1) for _, image in images[10:]
    ]


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Experiment:
    path: Path = tmp_path_factory.mktemp("alarms") / "experiment"
    simulate(Scenario.parse(tomllib.loads(TINY), where="tiny"), path)
    return read_experiment(path)


@pytest.fixture(scope="module")
def setup(experiment, tmp_path_factory) -> Setup:
    return set_up(experiment, DEFAULT, work=tmp_path_factory.mktemp("work"))


def arrival(experiment: Experiment, step: int, counts=None) -> Arrival:
    found = None if counts is None else np.array(counts, dtype=np.uint16)
    return Arrival.of(experiment.test, step, found)


def names(alarms) -> list[str]:
    return [alarm.name for alarm in alarms]


def test_radiographs_as_they_are_raise_no_alarm(experiment, setup):
    watch = Watch(setup)
    assert [watch.seen(arrival(experiment, t)) for t in range(len(experiment.test))] == [()] * len(experiment.test)


@pytest.mark.parametrize(("share", "spoils"), [(0.96, False), (1.04, False), (0.9, True), (0.0, True)])
def test_another_beam_is_told_and_one_far_off_spoils_the_radiograph(experiment, setup, share, spoils):
    dark, counts = np.mean(experiment.darks, axis=0), experiment.test.counts[3]
    (alarm,) = Watch(setup).seen(arrival(experiment, 3, np.maximum(dark + share * (counts - dark), 0)))
    assert (alarm.name, alarm.spoils) == ("beam", spoils)
    assert alarm.value == pytest.approx(abs(share - 1), abs=0.01)


def test_clipped_counts_are_told(experiment, setup):
    counts = np.minimum(experiment.test.counts[3], 0.97 * np.median(experiment.flats))
    assert "saturation" in names(Watch(setup).seen(arrival(experiment, 3, counts)))


def test_a_sample_at_the_edge_of_the_picture_is_told(experiment, setup):
    counts = ndimage.shift(experiment.test.counts[3], (0, 16), order=0, mode="nearest")
    assert names(Watch(setup).seen(arrival(experiment, 3, counts))) == ["out-of-view"]


def test_a_stage_that_stands_still_is_told_and_one_that_goes_on_is_not(experiment, setup):
    watch = Watch(setup)
    assert watch.seen(arrival(experiment, 4)) == ()
    for step in (5, 6):
        (alarm,) = watch.seen(arrival(experiment, step, experiment.test.counts[4]))
        assert (alarm.name, alarm.spoils) == ("stage", True)
    assert watch.seen(arrival(experiment, 7)) == ()


def motion(setup: Setup, step: int, *, jump=(0.0,) * 7, strain=None) -> tuple[StepLine, Taken]:
    """Return a step in which the sample is where it was expected, but for a jump of all sections, in voxels."""
    sections, motions = setup.sections.shape
    rng = np.random.default_rng(step)
    amplitude = 0.01 * rng.standard_normal((sections, motions)) + np.array(jump)
    flat = (0.0,) * (sections - 1)
    line = StepLine(
        step=step,
        file="",
        **dict.fromkeys(("angle_deg", "time_s", "force_N", "mean_strain", "mean_strain_std"), 0.0),
        displacement_voxel=((0.0, 0.0, 0.0),) * sections,
        displacement_std=((0.0, 0.0, 0.0),) * sections,
        strain=flat if strain is None else tuple(strain),
        strain_std=(1e-3,) * (sections - 1),
        chi2_reduced=1.0,
        passes=4,
        seconds=0.1,
        unix_s=0.0,
    )
    taken = Taken(
        amplitude=amplitude,
        covariance=np.zeros((sections * motions,) * 2),
        expected=np.zeros((sections, motions)),
        uncertain=1e-6 * np.eye(sections * motions),
        told=None,
        residual=np.zeros((119, 54), dtype=np.float32),
        tests=ResidualTests(
            chi2_reduced=1.0, lag1_row=0.0, lag1_column=0.0, lag1_row_expected=0.0, lag1_column_expected=0.0
        ),
        passes=4,
    )
    return line, taken


def test_a_jump_that_a_radiograph_shows_is_sudden_and_one_along_the_beam_is_not(setup):
    # from the source along x, so that y is across
    for which, due in ((0, []), (1, ["sudden"]), (2, ["sudden"]), (3, ["sudden"]), (4, []), (5, ["sudden"])):
        watch, jump = Watch(setup), np.zeros(7)
        jump[which] = 0.3
        for step in range(20):
            assert watch.followed(*motion(setup, step)) == ()
        assert names(watch.followed(*motion(setup, 20, jump=jump))) == due
        # one as old as that is not looked at
        assert watch.followed(*motion(setup, 20, jump=jump)) == ()


@pytest.mark.parametrize(("share", "due"), [(0.99, [JOINED - 1]), (1.0, [])])
def test_a_beam_that_drifted_a_little_is_told_once_enough_radiographs_show_it(experiment, setup, share, due):
    watch, dark, told = Watch(setup), np.mean(experiment.darks, axis=0), []
    for step in range(JOINED + 2):
        counts = np.rint(dark + share * (experiment.test.counts[step] - dark))
        assert watch.seen(arrival(experiment, step, counts)) == ()
        line, taken = motion(setup, step)
        line = replace(line, displacement_std=((0.1, 0.1, 0.5),) * len(line.displacement_std))
        told += [step for alarm in watch.new(step, watch.followed(line, taken)) if alarm.name == "beam-drift"]
    assert told == due


def test_nothing_is_unusual_before_it_is_known_what_is_usual(setup):
    watch = Watch(setup)
    for step in range(LEAST_STEPS):
        assert watch.followed(*motion(setup, step, jump=(0, 5.0 * (step % 2), 0, 0, 0, 0, 0))) == ()


def strains(setup: Setup, rates, rng) -> list[np.ndarray]:
    """Return strains that grow with rates (step, section) in front of noise."""
    grown = np.cumsum(rates, axis=0)
    return list(grown + 3e-4 * rng.standard_normal(grown.shape))


def test_a_section_that_stretches_beyond_its_part_is_told_with_its_height(setup):
    rng, sections = np.random.default_rng(5), len(setup.sections.height_mm) - 1
    shape = 1e-3 * np.exp(-0.5 * np.linspace(-2, 2, sections) ** 2)
    before, after = (1 + BEFORE) * SPAN, SPAN
    # all of them twice as fast is no localisation, one of them four times as fast is
    for at, due in ((None, set()), (sections // 2, {"localisation"})):
        rates = np.tile(shape, (before + after, 1))
        rates[before:] *= 2 if at is None else np.where(np.arange(sections) == at, 4, 1)
        watch, found = Watch(setup), []
        for step, strain in enumerate(strains(setup, rates, rng)):
            found += watch.followed(*motion(setup, step, strain=strain))
        assert set(names(found)) == due
        if at is not None:
            assert found[-1].place_mm[2] == pytest.approx(setup.sections.height_mm[at : at + 2].mean())


def test_an_alarm_that_goes_on_is_raised_again_after_some_steps(setup):
    watch, alarm = Watch(setup), Alarm(name="crack", value=9.0, limit=8.0, reason="")
    raised = [bool(watch.new(step, (alarm,))) for step in range(2 * QUIET + 1)]
    assert [step for step, new in enumerate(raised) if new] == [0, QUIET, 2 * QUIET]
    beam = replace(alarm, name="beam")
    assert watch.new(2 * QUIET + 1, (beam, alarm, beam)) == (beam,)


def test_a_watch_that_is_restored_goes_on_as_if_nothing_had_been(experiment, setup):
    one, other = Watch(setup), Watch(setup)
    rng = np.random.default_rng(3)
    for step in range(25):
        strain = 1e-3 * step + 1e-4 * rng.standard_normal(len(setup.sections.height_mm) - 1)
        one.seen(arrival(experiment, min(step, 20)))
        one.new(step, one.followed(*motion(setup, step, strain=strain)))
    one.new(24, (Alarm(name="crack", value=9.0, limit=8.0, reason=""),))
    other.restore({name: values.copy() for name, values in one.kept().items()})
    assert other.kept().keys() == one.kept().keys()
    for name, values in one.kept().items():
        np.testing.assert_array_equal(other.kept()[name], values)
    jump = motion(setup, 25, jump=(0, 0.3, 0, 0, 0, 0, 0))
    assert other.followed(*jump) == one.followed(*jump) != ()
