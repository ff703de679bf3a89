"""Geometries for ASTRA and RTK, and back: by the equations of docs/frame.md, written out anew here."""

from __future__ import annotations

import re
import tempfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdvc.experiment import GeometryEntry
from pdvc.geometry import ConeBeam
from tests.foreign_scans import expected_centres
from tests.laws import law
from validation.doors.astra import cone_vec, from_cone_vec
from validation.doors.geometry_files import read_geometry, write_geometry
from validation.doors.refusal import FormatError
from validation.doors.rtk import rtk_matrices, rtk_parameters

PAGE = Path(__file__).parents[1] / "docs" / "frame.md"
SCANNER = ConeBeam(
    source_axis_mm=28.57,
    source_detector_mm=800.0,
    pixel_mm=0.2996,
    rows=238,
    columns=108,
    column_shift_mm=1.3,
    row_shift_mm=-2.1,
    roll_rad=0.03,
)
ANGLES = np.linspace(-1.0, 9.0, 23)

lengths = st.floats(0.1, 900.0)


@st.composite
def scanners(draw):
    to_axis = draw(lengths)
    return ConeBeam(
        source_axis_mm=to_axis,
        source_detector_mm=to_axis + draw(lengths),
        pixel_mm=draw(st.floats(0.005, 1)),
        rows=draw(st.integers(2, 40)),
        columns=draw(st.integers(2, 40)),
        column_shift_mm=draw(st.floats(-50, 50)),
        row_shift_mm=draw(st.floats(-50, 50)),
        roll_rad=draw(st.floats(-1.5, 1.5)),
    )


turns = st.lists(st.floats(-2.5, 2.5), min_size=1, max_size=8).map(lambda steps: np.cumsum([0.3, *steps]))


def same(found, geometry):
    for field in fields(ConeBeam):
        value = getattr(geometry, field.name)
        assert getattr(found, field.name) == pytest.approx(value, rel=1e-6, abs=1e-6), field.name


def geometry_of(values, geometry, **given):
    size = {"rows": geometry.rows, "columns": geometry.columns}
    return GeometryEntry.parse({**values, **size, **given}, where="test").cone_beam()


def differ_by_turns(first, second):
    return np.abs((np.asarray(first) - second + 180) % 360 - 180).max()


@law(40)
@given(geometry=scanners(), angle_rad=turns)
def test_what_is_written_is_read_again(geometry, angle_rad):
    with tempfile.TemporaryDirectory() as folder:
        for name, given_mm in (("scan.csv", {}), ("scan.xml", {"pixel_mm": geometry.pixel_mm})):
            path = Path(folder) / name
            write_geometry(path, geometry, angle_rad)
            values, angle_deg = read_geometry(path)
            same(geometry_of(values, geometry, **given_mm), geometry)
            assert differ_by_turns(angle_deg, np.rad2deg(angle_rad)) < 1e-6
            # no jump of a turn between neighbours that are less than half of one apart
            np.testing.assert_allclose(np.diff(angle_deg), np.diff(np.rad2deg(angle_rad)), atol=1e-6)


@law(40)
@given(geometry=scanners(), angle_rad=turns, seed=st.integers(0, 999))
def test_the_matrices_of_rtk_see_points_where_the_frame_does(geometry, angle_rad, seed):
    """The detector's coordinates: x with the columns, y against the rows, (0, 0) in the middle of the image."""
    point = np.random.default_rng(seed).uniform(-0.3, 0.3, 3) * geometry.source_axis_mm
    x, y, z = point
    common, gantry = rtk_parameters(geometry, angle_rad)
    seen = rtk_matrices(common, gantry) @ np.array([y, z, x, 1.0])
    columns = seen[:, 0] / seen[:, 2] / geometry.pixel_mm + (geometry.columns - 1) / 2
    rows = (geometry.rows - 1) / 2 - seen[:, 1] / seen[:, 2] / geometry.pixel_mm
    expected = expected_centres(geometry, angle_rad, point)
    scale = 1e-9 * max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(np.stack([rows, columns], axis=1), expected, atol=scale)


def test_the_twelve_numbers_mean_what_they_say():
    """Pixel (r, c) is at the middle + (c - (n - 1) / 2) u + (r - (m - 1) / 2) v, on the ray from the source."""
    vectors = cone_vec(SCANNER, ANGLES)
    point = np.array([0.3, -0.2, 1.1])
    places = []
    for source, middle, u, v in vectors.reshape(-1, 4, 3):
        _, c, r = np.linalg.solve(np.stack([point - source, -u, -v], axis=1), middle - source)
        places.append((r + (SCANNER.rows - 1) / 2, c + (SCANNER.columns - 1) / 2))
    np.testing.assert_allclose(places, expected_centres(SCANNER, ANGLES, point), atol=1e-9)


def test_the_code_of_the_page_makes_the_same_vectors():
    (block,) = [
        text for text in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "cone_vec(" in text
    ]
    session: dict[str, object] = {}
    exec(compile(block, "frame.md", "exec"), session)
    np.testing.assert_array_equal(session["cone_vec"](SCANNER, ANGLES), cone_vec(SCANNER, ANGLES))


def test_the_xml_is_as_rtk_writes_it(tmp_path):
    path = tmp_path / "geometry.xml"
    write_geometry(path, replace(SCANNER, roll_rad=0.0), np.array([0.0, 0.1]))
    lines = [line.strip() for line in path.read_text().splitlines()]
    head = ['<?xml version="1.0"?>', "<!DOCTYPE RTKGEOMETRY>", '<RTKThreeDCircularGeometry version="3">']
    assert lines[:3] == head
    assert "<SourceToIsocenterDistance>28.57</SourceToIsocenterDistance>" in lines
    assert "<ProjectionOffsetY>2.1</ProjectionOffsetY>" in lines
    assert "<GantryAngle>180.0</GantryAngle>" in lines
    assert not any("InPlaneAngle" in line for line in lines)  # 0 is not written
    assert lines.count("<Matrix>") == 2


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda t: t.replace("RTKThreeD", "RTKTwoD"),
            r"<RTKThreeDCircularGeometry> of version 2 or 3, found <RTKTwoD",
        ),
        (lambda t: t.replace('"3"', '"1"'), "found <RTKThreeDCircularGeometry> of version 1"),
        (lambda t: t[:200], "expected a geometry of RTK, XML, found"),
        (lambda t: t.split("  <Projection>")[0] + "</RTKThreeDCircularGeometry>", "Projection: expected at least one"),
        (lambda t: t.replace(">28.57<", ">near<"), "SourceToIsocenterDistance: expected a number, found 'near'"),
        (
            lambda t: t.replace(">28.57<", ">28.6<"),
            "Projection 0: Matrix: expected that of its parameters",
        ),
        (
            lambda t: t.replace("    <Gantry", "<SourceToIsocenterDistance>9</SourceToIsocenterDistance><Gantry", 1),
            "SourceToIsocenterDistance: expected the same for all projections, found 9 to 28.57",
        ),
        (
            lambda t: t.replace("  <Projection>", "<OutOfPlaneAngle>2</OutOfPlaneAngle><Projection>", 1),
            "OutOfPlaneAngle: expected 0, found 2",
        ),
    ],
)
def test_wrong_geometries_of_rtk_are_answered_in_one_line(tmp_path, change, told):
    path = tmp_path / "geometry.xml"
    write_geometry(path, SCANNER, ANGLES)
    path.write_text(change(path.read_text()))
    with pytest.raises(FormatError, match=told) as caught:
        read_geometry(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def vectors_with(**changes):
    """Return the vectors of `SCANNER`, some of them changed by a function of their (angle, 3)."""
    parts = zip(("source", "middle", "u", "v"), np.hsplit(cone_vec(SCANNER, ANGLES), 4), strict=True)
    return np.hstack([changes[name](part) if name in changes else part for name, part in parts])


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"v": lambda v: -v},
            "u, v: expected u to the right and v downwards for an eye at the source, found u to the left or v upwards",
        ),
        ({"v": lambda v: 1.1 * v}, r"u, v: expected square pixels, found \|u\| = 0.2996, \|v\| = 0.32956 mm"),
        ({"v": lambda v: v * [1, 1, 1.1]}, "u, v: expected square pixels|source: expected a beam"),
        ({"source": lambda s: s + np.array([0, 0, 1])}, "source: expected a beam through the z axis, level"),
        (
            {"source": lambda s: s * np.linspace(1, 1.1, 23)[:, None]},
            "source_axis_mm: expected the same for all views",
        ),
        (
            {"middle": lambda d: d + [0, 0, 1] * np.arange(23)[:, None]},
            "row_shift_mm: expected the same for all views",
        ),
    ],
)
def test_vectors_that_are_no_turning_stage_are_answered_in_one_line(changes, told):
    with pytest.raises(FormatError, match=told) as caught:
        from_cone_vec(vectors_with(**changes), "scan.csv")
    assert "\n" not in str(caught.value)


def test_other_geometry_files_are_refused(tmp_path):
    with pytest.raises(FormatError, match=r"scan.json: expected a geometry file, .xml of RTK or .csv .*, found .json"):
        read_geometry(tmp_path / "scan.json")
    with pytest.raises(FormatError, match=r"none.xml: expected a geometry of RTK, XML, found none"):
        read_geometry(tmp_path / "none.xml")
    (tmp_path / "short.csv").write_text("source_x_mm,source_y_mm\n1,2\n")
    with pytest.raises(FormatError, match=r"short.csv: line 1: expected one column source_z, found source_x_mm"):
        read_geometry(tmp_path / "short.csv")
