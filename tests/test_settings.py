"""Records from TOML: what is wrong is named by its key, and what is written is read back."""

import pytest
from hypothesis import given

from pdvc.experiment import Description
from pdvc.gauss_newton import GaussNewton
from pdvc.history import Angle, Force, Polynomial, Ramp, Splines
from pdvc.options import MeasureOptions, StageOptions
from pdvc.pgd import Pgd
from pdvc.settings import SettingsError, read_toml
from simulator.scenario import Scenario
from tests.laws import law
from validation.testing.strategies import descriptions

VALID = {
    "geometry": {"source_axis_mm": 30.0, "source_detector_mm": 300.0, "pixel_mm": 0.5, "rows": 6, "columns": 4},
    "reference": {"angle_deg": [0.0, 90.0], "time_s": [0.0, 1.0], "force_N": [5.0, 5.0]},
    "test": {"angle_deg": [0.0], "time_s": [9.0], "force_N": [7.0]},
}


def changed(path, value):
    """Return VALID with one entry changed, or left out where the value is None."""
    table, key = path
    part = {name: entry for name, entry in {**VALID[table], key: value}.items() if entry is not None}
    return {**VALID, table: part}


def explained(values):
    with pytest.raises(SettingsError) as caught:
        Description.parse(values, where="a.toml")
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("a.toml: ")
    return text


def test_valid_values_pass():
    assert Description.parse(VALID, where="a.toml").geometry.rows == 6


def test_an_unknown_key_is_named():
    assert "geometry.colums: unknown key" in explained(changed(("geometry", "colums"), 4))


def test_a_missing_key_is_named():
    assert "geometry.pixel_mm: missing" in explained(changed(("geometry", "pixel_mm"), None))


def test_a_wrong_type_is_named_with_what_was_expected_and_given():
    text = explained(changed(("geometry", "pixel_mm"), "wide"))
    assert "geometry.pixel_mm: expected a valid number" in text
    assert "given 'wide'" in text


def test_a_negative_length_is_named_with_what_was_expected_and_given():
    text = explained(changed(("geometry", "source_axis_mm"), -30.0))
    assert "geometry.source_axis_mm: expected greater than 0, given -30.0" in text


def test_a_number_in_a_list_is_named_by_its_place():
    text = explained(changed(("test", "force_N"), [float("nan")]))
    assert "test.force_N.0: expected a finite number, given nan" in text


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        (("geometry", "rows"), "6", "geometry.rows: expected a valid integer, given '6'"),
        (("geometry", "rows"), 6.5, "geometry.rows: expected a valid integer"),
        (("geometry", "rows"), True, "geometry.rows: expected a valid integer, given True"),
        (("geometry", "pixel_mm"), "0.5", "geometry.pixel_mm: expected a valid number, given '0.5'"),
        (("geometry", "pixel_mm"), True, "geometry.pixel_mm: expected a valid number, given True"),
        (("test", "force_N"), ["7.0"], "test.force_N.0: expected a valid number, given '7.0'"),
        (("test", "force_N"), 7.0, "test.force_N: expected a valid array, given 7.0"),
    ],
)
def test_nothing_is_turned_into_the_type_it_should_be_of(path, value, expected):
    assert expected in explained(changed(path, value))


def test_whole_numbers_pass_for_lengths_and_lists_for_tuples():
    found = Description.parse(changed(("geometry", "source_axis_mm"), 30), where="a.toml")
    assert found.geometry.source_axis_mm == 30.0
    assert found.reference.angle_deg == (0.0, 90.0)


def test_every_wrong_key_is_named_at_once():
    text = explained(changed(("geometry", "rows"), 0) | {"comment": "hello"})
    assert "geometry.rows: expected greater than or equal to 1, given 0" in text
    assert "comment: unknown key" in text


def test_lists_of_unequal_length_are_refused_with_their_lengths():
    text = explained(changed(("reference", "time_s"), [0.0]))
    assert "reference: expected one angle_deg, time_s and force_N for each radiograph (found 2, 1 and 2)" in text


def test_a_detector_before_the_axis_is_refused():
    assert "source_detector_mm above source_axis_mm" in explained(changed(("geometry", "source_detector_mm"), 20.0))


def test_an_unknown_motion_is_named():
    with pytest.raises(
        SettingsError,
        match=r"section_motions: expected some of .*rotation_x.*'rotation_w' is none",
    ):
        MeasureOptions.parse({"section_motions": ["rotation_w"]}, where="options")


def test_an_unknown_kind_of_time_function_is_named_with_the_known_ones():
    with pytest.raises(SettingsError, match=r"time\.0: .*'wavelet'.*'splines'"):
        MeasureOptions.parse({"time": [{"kind": "wavelet"}]}, where="options")


def test_a_time_function_without_kind_is_answered_with_the_key():
    with pytest.raises(SettingsError, match=r"options: time\.0: kind: missing$"):
        MeasureOptions.parse({"time": [{"degree": 3}]}, where="options")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (changed(("reference", "time_s"), [0.0]), "for each radiograph (found 2, 1 and 2)"),
        (changed(("geometry", "pixel_mm"), {"x": 1, "y": 2}), "a valid number, given a table of 2 keys"),
        (changed(("test", "force_N"), [{"x": 1}]), "test.force_N.0: expected a valid number, given a table of 1 keys"),
        (
            changed(("geometry", "rows"), 10**5000),
            "expected a number of size below 1e+15, given a number of 16610 bits",
        ),
        (changed(("geometry", "pixel_mm"), 1e300), "expected a number of size below 1e+15, given 1e+300"),
    ],
)
def test_what_was_given_is_told_shortly_and_never_as_a_dictionary(values, expected):
    text = explained(values)
    assert text.endswith(expected)
    assert "{" not in text


def test_a_seed_may_be_any_number_of_64_bits():
    assert Scenario.parse({"seed": 2**63 - 1}, where="a.toml").seed == 2**63 - 1


def test_text_that_is_no_toml_is_refused_by_file(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("rows = = 5\n")
    with pytest.raises(SettingsError, match=r"a\.toml: not valid TOML"):
        read_toml(path)


def test_bytes_that_are_no_text_are_refused_by_file(tmp_path):
    path = tmp_path / "a.toml"
    path.write_bytes(b"title = '\xff\xfe'\n")
    with pytest.raises(SettingsError, match=r"a\.toml: not valid TOML"):
        read_toml(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SettingsError, match=r"b\.toml: expected a TOML file, found none"):
        Description.read(tmp_path / "b.toml")


def read_back(record, folder):
    path = folder / "record.toml"
    path.write_text(record.template(), encoding="utf-8")
    return type(record).read(path)


@law(60)
@given(record=descriptions())
def test_a_description_reads_back_as_it_was_written(tmp_path_factory, record):
    assert read_back(record, tmp_path_factory.mktemp("description")) == record


@pytest.mark.parametrize(
    "record",
    [
        MeasureOptions(),
        StageOptions(solver=GaussNewton(least_change_voxel=1e-4)),
        MeasureOptions(
            discard_rows=0,
            beam_hardening=(1.0, 0.25, 1e-3),
            section_motions=("translation_z", "contraction"),
            time=(Force(), Angle(harmonics=2), Polynomial(degree=3), Ramp(start=9, powers=(1, 3)), Splines(degree=1)),
        ),
    ],
    ids=["defaults", "stage", "all changed"],
)
def test_options_read_back_as_they_were_written(tmp_path, record):
    assert read_back(record, tmp_path) == record


def test_a_template_explains_every_entry():
    lines = [line for line in StageOptions().template().splitlines() if line]
    assert len(lines) == len(StageOptions.model_fields) + len(Pgd.model_fields)
    assert all(" # " in line for line in lines)
