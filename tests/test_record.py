"""The record of a test: whole lines or none, whatever was cut off."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc.record import AlarmLine, LostLine, MeasurementLine, PlanLine, Record, StepLine, read_record
from tests.laws import law

numbers = st.floats(-1e6, 1e6)
rows = st.lists(st.tuples(numbers, numbers, numbers), max_size=3).map(tuple)
several = st.lists(numbers, max_size=3).map(tuple)
SINGLE = (
    *("angle_deg", "time_s", "force_N", "mean_strain", "mean_strain_std"),
    *("chi2_reduced", "seconds", "unix_s"),
)
lines = st.one_of(
    st.builds(PlanLine, title=st.text(), steps=st.integers(0), height_mm=several, voxel_mm=numbers),
    st.builds(
        StepLine,
        **dict.fromkeys(("displacement_voxel", "displacement_std"), rows),
        **dict.fromkeys(("strain", "strain_std"), several),
        **dict.fromkeys(SINGLE, numbers),
    ),
    st.builds(LostLine, step=st.integers(-1), file=st.text(), reason=st.text(), left_out=st.booleans()),
    st.builds(
        AlarmLine,
        step=st.integers(0),
        alarm=st.text(),
        value=numbers,
        limit=numbers,
        reason=st.text(),
        place_mm=st.tuples(numbers, numbers, numbers),
    ),
    st.builds(MeasurementLine, file=st.text(), seconds=numbers),
)


@law(50)
@given(st.lists(lines, max_size=4), st.data())
def test_what_is_cut_anywhere_is_gone_on_with_after_its_last_whole_line(tmp_path_factory, some, data):
    path = tmp_path_factory.mktemp("record") / "motion.nc.record.jsonl"
    record = Record(path)
    for line in some:
        record.add(line)
    record.close()
    assert list(read_record(path)) == some
    whole = path.read_bytes()
    cut = data.draw(st.integers(0, len(whole)))
    path.write_bytes(whole[:cut])
    kept = some[: whole[:cut].count(b"\n")]
    assert list(read_record(path)) == kept
    again = Record(path)
    assert again.lines == [line.text() for line in kept]
    again.add(LostLine(step=3, file="a.tif", reason="why"))
    again.close()
    assert list(read_record(path)) == [*kept, LostLine(step=3, file="a.tif", reason="why")]


def test_a_line_is_one_line_of_json_that_says_what_it_is():
    line = LostLine(step=3, file="a.tif", reason="cut\nshort")
    assert "\n" not in line.text()
    assert json.loads(line.text()) == {
        "what": "lost",
        "step": 3,
        "file": "a.tif",
        "reason": "cut\nshort",
        "left_out": False,
    }


def test_what_is_not_finite_is_null_which_every_reader_knows(tmp_path):
    line = MeasurementLine(file="motion.nc", seconds=float("inf"))
    assert json.loads(line.text(), parse_constant=pytest.fail)["seconds"] is None
    (tmp_path / "record").write_text(line.text() + "\n", encoding="utf-8")
    (found,) = read_record(tmp_path / "record")
    assert math.isnan(found.seconds)


@pytest.mark.parametrize("text", ["{", "[]", '{"what": "weather"}', '{"what": "lost", "step": 1}'])
def test_what_is_no_record_is_refused_with_its_line(tmp_path, text):
    path = tmp_path / "record"
    path.write_text(LostLine(step=0, file="", reason="").text() + "\n" + text + "\n", encoding="utf-8")
    with pytest.raises(ValueError, match="record, line 2: expected a line of a record"):
        list(read_record(path))
