import tomllib

import numpy as np
import pytest

from pdvc.settings import SettingsError
from simulator.imperfections import Imperfections
from simulator.misalignment import Misalignment
from simulator.scenario import Scenario, builtin_names, course_of, load_scenario


@pytest.mark.parametrize(
    "name", ["crack", "in-space", "jailin2018", "laboratory", "neck", "quick", "rigid", "slip", "small"]
)
def test_builtin_scenarios_load_and_are_named_after_their_file(name):
    assert name in builtin_names()
    assert load_scenario(name).name == name


@pytest.mark.parametrize("name", builtin_names())
def test_a_scenario_written_as_toml_reads_back_the_same(name, tmp_path):
    scenario = load_scenario(name)
    path = tmp_path / "mine.toml"
    path.write_text(scenario.template(), encoding="utf-8")
    assert load_scenario(path) == scenario


def test_every_key_is_explained():
    lines = [line for line in Scenario().template().splitlines() if line.strip()]
    assert all("#" in line for line in lines), [line for line in lines if "#" not in line]


def test_the_paper_scenario_has_the_papers_numbers():
    scenario = load_scenario("jailin2018")
    scanner = scenario.geometry.cone_beam()
    assert (scanner.rows, scanner.columns) == (954, 432)
    assert scanner.voxel_mm == pytest.approx(0.0107)
    assert 2 * scenario.view_mm == pytest.approx(754 * 0.0107)
    course = course_of(scenario)
    assert (len(course.reference_angle_rad), len(course.test_angle_rad)) == (600, 127)
    assert course.reference_time_s[-1] / 60 == pytest.approx(22, rel=0.01)
    assert course.test_angle_rad[50] == pytest.approx(2 * np.pi)
    assert course.history.force_N[49] == 250 < course.history.force_N[-1]


def test_quick_is_the_paper_four_times_coarser():
    quick, paper = load_scenario("quick"), load_scenario("jailin2018")
    assert quick.geometry.cone_beam().voxel_mm == pytest.approx(4 * paper.geometry.cone_beam().voxel_mm)
    assert quick.view_mm == pytest.approx(paper.view_mm, rel=0.005)
    assert (quick.specimen, quick.loading, quick.motion) == (paper.specimen, paper.loading, paper.motion)
    assert quick.graphite.mean_diameter_mm == 4 * paper.graphite.mean_diameter_mm


@pytest.mark.parametrize("name", ["crack", "neck", "slip"])
def test_a_fault_is_quick_until_it_begins(name):
    """The same sample, scanner and force, and the same strain before the step that its file tells."""
    faulty, quick = load_scenario(name), load_scenario("quick")
    same = ("seed", "specimen", "graphite", "geometry", "detector", "acquisition", "xray", "discarded_rows")
    assert all(getattr(faulty, key) == getattr(quick, key) for key in same)
    due, found = course_of(quick), course_of(faulty)
    begins = {"crack": 127, "neck": 96, "slip": 127}[name]
    np.testing.assert_array_equal(found.history.force_N[:begins], due.history.force_N[:begins])
    np.testing.assert_array_equal(found.history.strain[:begins], due.history.strain[:begins])
    # the neck of quick itself begins at step 119
    stray = np.abs(found.history.strain - due.history.strain)[begins:119].max(axis=1)
    assert np.all(np.diff(stray) > 0)
    assert stray[-1] > 0.02 if name == "neck" else not len(stray)


def test_the_slip_is_where_its_file_tells():
    due, found = (course_of(load_scenario(name)).motion for name in ("quick", "slip"))
    points = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.8], [0.4, 0.2, -3.0]])
    for step in range(127):
        stray = found.forward(points, step) - due.forward(points, step)
        assert stray.any() == (step >= 80)
        if step >= 80:
            # 0.05 mm down, and a hundredth of a radian and again about the axis; the tilts of the machine are small
            np.testing.assert_allclose(stray[0], [0, 0, -0.05], atol=3e-4)
            np.testing.assert_allclose(stray[2, :2], [-0.02 * 0.2, 0.02 * 0.4], atol=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[geometry]\nsource_axis_mm = -3.0", r"geometry\.source_axis_mm: expected greater than 0, given -3\.0"),
        ("[geometri]\nrows = 3", r"geometri: unknown key"),
        ("[loading]\nforce = 3", r"loading\.force: unknown key"),
        ('seed = "a"', r"seed: expected a valid integer.*, given 'a'"),
        ("[motion]\nsections = 1", r"motion\.sections: expected 0, or at least 2 sections, given 1"),
        (
            "[motion.ripple]\nwavelength_mm = 0.0",
            r"motion\.ripple\.wavelength_mm: expected greater than 0, given 0\.0",
        ),
        ("[motion.ripple]\nstrain = 1.0", r"motion\.ripple\.strain: expected less than 1, given 1\.0"),
        ('[motion]\ningredients = ["swim"]', r"motion\.ingredients\.0: expected 'tension', .*, given 'swim'"),
        (
            '[motion]\ningredients = ["slip"]\n[motion.slip]\nstep = 127',
            r"expected motion\.slip\.step below 127, the number of steps of the test, got 127",
        ),
        ("[motion.slip]\nshift_mm = [1.0]", r"motion\.slip\.shift_mm\.1: missing"),
        (
            "[loading]\nnecking_at_mm = -6.6",
            r"expected loading\.necking_at_mm inside the sample, at most 6\.5 mm from its middle, got -6\.6 mm",
        ),
        ("[crack]\nopening_mm = -1.0", r"crack\.opening_mm: expected greater than or equal to 0, given -1\.0"),
        (
            "[crack]\nopening_mm = 0.01\nfirst_step = 127",
            r"expected crack\.first_step below 127, the number of steps of the test, got 127",
        ),
        (
            "[crack]\nopening_mm = 0.01\nradius_mm = 0.5",
            r"expected crack\.centre_mm and crack\.radius_mm of a crack that stays graphite\.gap_mm = 0\.002 mm below "
            r"the sample's surface, got \[0\.0, 0\.0, 0\.0\] mm and 0\.5 mm: 0\.045 mm outside",
        ),
        ("[specimen]\nlength_mm = 5.0", r"expected specimen\.length_mm of at least 10\.\d+ mm"),
        (
            "[misalignment]\nsource_detector_mm = -790.0",
            r"expected misalignment of a scanner that there can be, geometry\.source_detector_mm: expected more than "
            r"source_axis_mm = 28\.57\d* mm, got 10\.0 mm",
        ),
        ("[misalignment]\nskew_deg = 1.0", r"misalignment\.skew_deg: unknown key"),
        ("[scanner]\nghosts = 1", r"scanner\.ghosts: unknown key"),
        (
            "[scanner.stage]\nwobble_deg = -0.1",
            r"scanner\.stage\.wobble_deg: expected greater than or equal to 0, given -0\.1",
        ),
        (
            "[scanner.stage]\nwobbles_per_turn = 0",
            r"scanner\.stage\.wobbles_per_turn: expected greater than or equal to 1, given 0",
        ),
        ("[scanner.focal_spot]\ndrift_mm = [0.1]", r"scanner\.focal_spot\.drift_mm\.1: missing"),
        (
            "[scanner.focal_spot]\ndrift_time_s = 0.0",
            r"scanner\.focal_spot\.drift_time_s: expected greater than 0, given 0\.0",
        ),
        (
            "[scanner.open_beam]\ntarget_attenuation = 0.1\nanode_deg = 5.0",
            r"expected scanner\.open_beam\.anode_deg above 10\.\d+ degrees, the beam's half opening towards the "
            r"anode, got 5\.0 degrees",
        ),
        ("[scanner.scatter]\nwidth_mm = 0.0", r"scanner\.scatter\.width_mm: expected greater than 0, given 0\.0"),
        (
            "[scanner.panel]\nsaturation_counts = 70000.0",
            r"scanner\.panel\.saturation_counts: expected less than or equal to 65535, given 70000\.0",
        ),
        (
            "[scanner.lag]\nshare = 0.6\nafterglow_share = 0.4",
            r"scanner\.lag: expected share and afterglow_share that sum to less than 1, got 0\.6 and 0\.4",
        ),
        ("discarded_rows = 477", r"discarded_rows below half of the 954 detector rows, got 477"),
        ("[interrupted]\nsteps = [0, 127]", r"expected interrupted\.steps below 127, the number of steps of the test"),
        ("[interrupted]\nsteps = [5, 4]", r"expected interrupted\.steps: increasing step numbers, got 5, 4"),
        ("[interrupted]\nsteps = [-1]", r"interrupted\.steps\.0: expected greater than or equal to 0, given -1"),
        ("[interrupted]\nviews = 0", r"interrupted\.views: expected greater than or equal to 1, given 0"),
        ("[motion", r"not valid TOML"),
    ],
)
def test_a_wrong_scenario_names_file_key_expected_and_given(text, message, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError, match=rf"mine\.toml: .*{message}") as caught:
        load_scenario(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_an_unknown_name_are_told_apart(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.toml: expected a TOML file, found none"):
        load_scenario(tmp_path / "none.toml")
    with pytest.raises(SettingsError, match=r"expected one of .*quick.*, given 'quik'; did you mean 'quick'\?"):
        load_scenario("quik")


def test_misalignment_adds_to_the_recorded_geometry():
    recorded = Scenario().geometry.cone_beam()
    true = Misalignment(column_shift_mm=0.3, roll_deg=2.0, source_axis_mm=0.5).true_geometry(recorded)
    assert true.column_shift_mm == 0.3
    assert true.roll_rad == pytest.approx(np.deg2rad(2))
    assert true.source_axis_mm == recorded.source_axis_mm + 0.5
    assert Misalignment().true_geometry(recorded) == recorded


def test_the_course_of_in_space_is_a_sum_of_the_papers_time_functions():
    course = course_of(load_scenario("in-space"))
    history, angle = course.history, course.test_angle_rad
    step = np.arange(127.0)
    ramp = np.maximum(step - 50, 0)
    table_1 = np.stack([history.force_N, np.sin(angle), np.cos(angle), step**0, step, ramp, ramp**2], axis=1)
    motion = course.motion
    for values in (motion.translation_mm, motion.rotation_rad):
        flat = values.reshape(127, -1)
        fit = table_1 @ np.linalg.lstsq(table_1, flat, rcond=None)[0]
        np.testing.assert_allclose(fit, flat, atol=1e-12)


def test_defaults_are_plain_toml():
    assert Scenario.parse(tomllib.loads(Scenario().template()), where="here") == Scenario()


def test_a_perfect_scanner_is_the_default_of_all_scenarios_but_the_laboratory():
    for name in builtin_names():
        scenario = load_scenario(name)
        real = (scenario.scanner, scenario.misalignment) != (Imperfections(), Misalignment())
        assert real == (name == "laboratory")


def test_the_laboratory_is_quick_with_everything_that_can_go_wrong_in_a_scanner():
    laboratory, quick = load_scenario("laboratory"), load_scenario("quick")
    same = ("seed", "specimen", "graphite", "geometry", "xray", "loading", "motion", "crack", "discarded_rows")
    assert all(getattr(laboratory, key) == getattr(quick, key) for key in same)
    sizes = {**vars(laboratory.misalignment), **vars(laboratory.scanner)}
    perfect = {**vars(Misalignment()), **vars(Imperfections())}
    assert all(sizes[name] != perfect[name] for name in perfect)
