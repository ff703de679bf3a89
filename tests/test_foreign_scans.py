"""Scans of other programs: a marker is seen where each format's frame puts it; what is wrong is told in one line."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from pdvc.experiment import GeometryEntry, read_experiment
from pdvc.geometry import ConeBeam
from tests import foreign_scans as foreign
from tests.laws import law
from tests.radiograph_files import random_counts
from tests.synthetic_experiments import experiment
from validation.doors.formats import read_scan
from validation.doors.geometry_files import read_geometry, write_geometry
from validation.doors.nxtomo import read_nxtomo, write_nxtomo
from validation.doors.refusal import FormatError

OURS = {
    "source_axis_mm": foreign.TO_AXIS_MM,
    "source_detector_mm": foreign.TO_DETECTOR_MM,
    "pixel_mm": foreign.PIXEL_MM,
}


def check_marker(written, given=None, within_px=0.02):
    """Read a scan, and find the marker of each view where `pdvc.geometry` sees it; return the scan."""
    scan = read_scan(str(written.path), given)
    rows, columns = scan.images.size
    entry = GeometryEntry.parse({**scan.geometry, **(given or {}), "rows": rows, "columns": columns}, where="test")
    found = [foreign.centre(scan.images.read(k)) for k in range(scan.images.count)]
    expected = foreign.expected_centres(entry.cone_beam(), np.deg2rad(scan.angle_deg), written.marker_mm)
    # it moves across, and up and down by its distance from the source: a mirrored scan that turns back would not
    assert (np.ptp(expected, axis=0) > (0.3, 10)).all()
    np.testing.assert_allclose(found, expected, atol=within_px)
    for key, value in OURS.items():
        assert entry.model_dump()[key] == pytest.approx(value, rel=1e-6)
    return scan


class TestWhereTheMarkerIsSeen:
    @pytest.mark.parametrize(("roll_deg", "offset_mm"), [(0.0, 0.0), (0.8, 0.4), (-0.8, -0.4)])
    def test_nikon(self, tmp_path, roll_deg, offset_mm):
        scan = check_marker(foreign.write_nikon(tmp_path, roll_deg=roll_deg, offset_mm=offset_mm))
        assert (scan.flats.read(0) == 60000).all()
        assert "white level, 60000 counts" in scan.notes[0]

    def test_nikon_with_the_newer_keys(self, tmp_path):
        newer = {"CentreOfRotationTop": None, "CentreOfRotationBottom": None, "ObjectRoll": 0.8, "ObjectOffsetX": 0.04}
        check_marker(foreign.write_nikon(tmp_path, roll_deg=0.8, offset_mm=0.4, **newer))

    def test_nikon_in_centimetres(self, tmp_path):
        tenth = {
            "Units": "cm",
            "SrcToObject": 3.0,
            "SrcToDetector": 30.0,
            "DetectorPixelSizeX": 0.05,
            "DetectorPixelSizeY": 0.05,
        }
        check_marker(foreign.write_nikon(tmp_path, roll_deg=0, offset_mm=0, **tenth))

    @pytest.mark.parametrize("clockwise", [True, False])
    @pytest.mark.parametrize(
        ("flips", "rotate"), [((False, False), 0), ((True, False), 90), ((False, True), 180), ((True, True), 270)]
    )
    def test_north_star(self, tmp_path, clockwise, flips, rotate):
        scan = check_marker(foreign.write_north_star(tmp_path, clockwise=clockwise, flips=flips, rotate=rotate))
        assert scan.flats.size == scan.darks.size == scan.images.size
        assert (scan.flats.read(0) == foreign.FLAT).all()

    @pytest.mark.parametrize("flips", [(False, False), (True, False), (False, True), (True, True)])
    @pytest.mark.parametrize("old", [False, True])
    def test_nxtomo(self, tmp_path, flips, old):
        scan = check_marker(foreign.write_nexus(tmp_path / "scan.nx", flips=flips, old=old))
        assert scan.images.count == foreign.VIEWS  # an invalid frame is none
        assert (scan.flats.count, scan.darks.count) == (2, 1)
        assert (scan.darks.read(0) == foreign.DARK).all()

    @pytest.mark.parametrize("flips", [(True, False), (False, True)])
    def test_nxtomo_with_the_axes_of_older_files(self, tmp_path, flips):
        check_marker(foreign.write_nexus(tmp_path / "scan.nx", flips=flips, esrf=True))

    def test_nxtomo_in_radians(self, tmp_path):
        check_marker(foreign.write_nexus(tmp_path / "scan.nxs", radians=True))

    def test_a_pixel_that_is_given_still_places_the_axis(self, tmp_path):
        written = foreign.write_nexus(tmp_path / "scan.nx")
        with h5py.File(written.path, "a") as file:
            del file["entry0000/instrument/detector/x_pixel_size"].attrs["units"]
        check_marker(written, {"pixel_mm": foreign.PIXEL_MM})

    def test_single_tiffs(self, tmp_path):
        scan = check_marker(foreign.write_single_tiffs(tmp_path), OURS)
        np.testing.assert_allclose(scan.time_s, 2.0 * np.arange(foreign.VIEWS) + 1)
        np.testing.assert_allclose(scan.force_N, 250 + 10 * np.arange(foreign.VIEWS))

    @pytest.mark.parametrize(("columns", "rows"), [(True, False), (False, True), (True, True)])
    def test_mirrored_images_have_a_mirrored_geometry(self, tmp_path, columns, rows):
        """A mirrored scan of a mirrored marker: both mirrored back are what they were."""
        scan = read_scan(str(foreign.write_nexus(tmp_path / "scan.nx").path))
        scan = replace(scan, geometry={**scan.geometry, "roll_deg": 1.5})
        mirrored = scan.mirrored(columns=columns, rows=rows)
        size = dict(zip(("rows", "columns"), scan.images.size, strict=True))

        def seen(geometry, angle_deg, marker):
            beam = GeometryEntry.parse({**geometry, **size}, where="test").cone_beam()
            return foreign.expected_centres(beam, np.deg2rad(angle_deg), np.array(marker))

        angle, marker = scan.angle_deg, np.array([0.2, 0.4, 0.5])
        expected = seen(scan.geometry, angle, marker)
        if columns:
            expected[:, 1] = size["columns"] - 1 - expected[:, 1]
        if rows:
            expected[:, 0] = size["rows"] - 1 - expected[:, 0]
        # the mirror image of the sample turns the other way
        sense = -1 if columns else 1
        found = seen(mirrored.geometry, sense * angle, marker * [1, sense, -1 if rows else 1])
        np.testing.assert_allclose(found, expected, atol=1e-9)
        image = scan.images.read(3)[:: -1 if rows else 1, :: -1 if columns else 1]
        np.testing.assert_array_equal(mirrored.images.read(3), image)
        assert scan.turned_back().angle_deg == pytest.approx(-scan.angle_deg)


lengths = st.floats(0.01, 900.0)


@st.composite
def geometries(draw):
    to_axis = draw(lengths)
    return ConeBeam(
        source_axis_mm=to_axis,
        source_detector_mm=to_axis + draw(lengths),
        pixel_mm=draw(st.floats(0.001, 1)),
        rows=4,
        columns=3,
        column_shift_mm=draw(st.floats(-5, 5)),
        row_shift_mm=draw(st.floats(-5, 5)),
        roll_rad=draw(st.sampled_from([0.0, 0.02, -1.1])),
    )


@law(25)
@given(geometry=geometries(), seed=st.integers(0, 99))
def test_what_is_written_as_nxtomo_is_read_again(geometry, seed):
    written = experiment(geometry, seed)
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "both.nx"
        write_nxtomo(path, written)
        for entry, series in (("reference", written.reference), ("test", written.test)):
            scan = read_nxtomo(path, entry)
            np.testing.assert_array_equal([scan.images.read(k) for k in range(len(series))], series.counts)
            np.testing.assert_array_equal([scan.flats.read(k) for k in range(2)], written.flats)
            np.testing.assert_array_equal([scan.darks.read(0)], written.darks)
            np.testing.assert_allclose(np.deg2rad(scan.angle_deg), series.angle_rad, atol=1e-12)
            np.testing.assert_array_equal(scan.time_s, series.time_s)
            np.testing.assert_array_equal(scan.force_N, series.force_N)
            found = GeometryEntry.parse({**scan.geometry, "rows": 4, "columns": 3}, where="test").cone_beam()
            for key in ConeBeam.__dataclass_fields__:
                assert getattr(found, key) == pytest.approx(getattr(geometry, key), rel=1e-9, abs=1e-9)
        assert not list(Path(name).glob("*.partial"))


def nexus(tmp_path, change):
    path = foreign.write_nexus(tmp_path / "scan.nx").path
    with h5py.File(path, "a") as file:
        change(file["entry0000"])
    return path


def replaced(entry, place, value, units=None):
    del entry[place]
    entry[place] = value
    if units:
        entry[place].attrs["units"] = units


DETECTOR = "instrument/detector"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda e: e.__delitem__("definition"), "definition: expected one entry NXtomo, found none"),
        (lambda e: e.__delitem__(f"{DETECTOR}/data"), "detector/data: expected a dataset, found none"),
        (lambda e: e.__delitem__(f"{DETECTOR}/image_key"), "image_key: expected a dataset, found none"),
        (
            lambda e: replaced(e, f"{DETECTOR}/image_key", [0, 1]),
            r"expected whole counts \(2 as image_key, row, column\)",
        ),
        (
            lambda e: replaced(e, f"{DETECTOR}/image_key", [1] * 16),
            r"image_key: expected radiographs, 0, found only \[1\]",
        ),
        (lambda e: replaced(e, f"{DETECTOR}/data", np.ones((16, 4, 3))), r"whole counts .*found float64 of shape"),
        (
            lambda e: replaced(e, "sample/rotation_angle", np.zeros(3)),
            "16 numbers, one for each frame, found",
        ),
        (
            lambda e: replaced(e, f"{DETECTOR}/x_pixel_size", 0.5),
            "x_pixel_size: expected an attribute units, found none",
        ),
        (
            lambda e: replaced(e, f"{DETECTOR}/distance", 2.0, "inch"),
            "distance: units: expected a unit, .* found 'inch'",
        ),
        (lambda e: replaced(e, f"{DETECTOR}/y_pixel_size", 0.6, "mm"), "square pixels, 0.5 mm, found 0.6 mm"),
        (
            lambda e: replaced(e, f"{DETECTOR}/distance", "far", "mm"),
            r"distance: expected a number, found \['?b?'?far",
        ),
        (
            lambda e: replaced(e, f"{DETECTOR}/data", np.full((16, 4, 3), 70000)),
            r"data: frame 3: expected counts from 0 to 65535, found 70000 to 70000",
        ),
        (
            lambda e: e[f"{DETECTOR}/transformations/flip_x"].write_direct(np.array(17.0)),
            "transformations: expected a turn about y by 0 or 180 degrees, found 17",
        ),
        (
            lambda e: e.attrs.__setitem__("NeXus_Coordinate_System", "IEC"),
            "NeXus_Coordinate_System: expected McStas or ESRF, found 'IEC'",
        ),
    ],
)
def test_wrong_nxtomo_files_are_answered_in_one_line(tmp_path, change, told):
    path = nexus(tmp_path, change)
    with pytest.raises(FormatError, match=told) as caught:
        read_scan(str(path)).images.read(0)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_alignment_frames_are_no_radiographs(tmp_path):
    """The package nxtomo marks them in a key of its own, and as radiographs in that of the definition."""
    keys = np.array([2, 1, 1, *[0] * (foreign.VIEWS - 2), -1, -1, 3])
    path = nexus(tmp_path, lambda e: e.__setitem__(f"{DETECTOR}/image_key_control", keys))
    scan = read_scan(str(path))
    assert scan.images.count == len(scan.angle_deg) == foreign.VIEWS - 2


def test_one_of_several_entries_is_chosen_by_its_name(tmp_path):
    path = tmp_path / "both.nx"
    write_nxtomo(path, experiment())
    with pytest.raises(FormatError, match=r"found 2: choose by both.nx::NAME among reference, test"):
        read_scan(str(path))
    assert read_scan(f"{path}::test").images.count == 3
    with pytest.raises(FormatError, match="rest: expected an entry, found none; there is reference, test"):
        read_scan(f"{path}::rest")
    with pytest.raises(FormatError, match=r"expected NXtomo before ::, .*found .xtekct"):
        read_scan("scan.xtekct::test")


def test_angles_without_units_are_taken_as_degrees_and_noted(tmp_path):
    path = nexus(tmp_path, lambda e: e["sample/rotation_angle"].attrs.__delitem__("units"))
    scan = read_scan(str(path))
    assert scan.angle_deg[1] - scan.angle_deg[0] == 30
    assert "no units: taken as degrees" in scan.notes[0]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"SrcToObject": None}, "SrcToObject: expected a number, found none"),
        ({"SrcToObject": "far"}, "SrcToObject: expected a number, found 'far'"),
        ({"Projections": 13}, "Projections: expected 13 TIFFs in .*, found 12"),
        ({"Projections": 12.5}, "Projections: expected a whole number from 1 on, found 12.5"),
        (
            {"DetectorPixelsX": 40},
            r"bar_0001.tif: expected one image \(46, 40\) as in the scan of bar_0001.tif",
        ),
        (
            {"DetectorPixelSizeY": 0.6},
            "DetectorPixelSizeY: expected square pixels, DetectorPixelSizeX = 0.5 mm",
        ),
        ({"Units": "inch"}, "Units: expected a unit, one of mm, .*found 'inch'"),
        ({"InputFolderName": "raw"}, "InputFolderName: expected a folder of TIFFs, found none at .*raw"),
        ({"DetectorOffsetX": 1.5}, "DetectorOffsetX: expected 0, or column_shift_mm given, found 1.5"),
        ({"ObjectTilt": 0.5}, "ObjectTilt: expected 0, or roll_deg given, found 0.5"),
    ],
)
def test_wrong_nikon_files_are_answered_in_one_line(tmp_path, changes, told):
    path = foreign.write_nikon(tmp_path, **changes).path
    with pytest.raises(FormatError, match=told) as caught:
        read_scan(str(path)).images.read(0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ((("<source>", "<sauce>"),), "Result: source: expected a value, found none"),
        ((("<Result>", "<Results>"),), "Result: expected a section <Result>, found none"),
        ((("<axis>0.0 1.0", "<axis>0.0"),), r"Result: axis: expected 3 numbers, found '0\.0 0\.0'"),
        (
            (("<axis>0.0 1.0 0.0", "<axis>0.0 1.0 0.1"),),
            "an axis across the beam, within 0.5 degrees, found 5.71",
        ),
        ((("<number>12", "<number>11"),), "Object Radiograph: number: expected 11 TIFFs in Radiographs, found 12"),
        ((("<clockwise>True", "<clockwise>yes"),), "Processed: clockwise: expected True or False, found 'yes'"),
        ((("<rotate>0", "<rotate>45"),), "Correction: rotate: expected 0, 90, 180 or 270 degrees, found 45"),
        ((("<pitch>0.5 0.5", "<pitch>0.5 0.4"),), "pitch: expected square pixels, mm, found 0.5 x 0.4"),
    ],
)
def test_wrong_north_star_files_are_answered_in_one_line(tmp_path, changes, told):
    path = foreign.write_north_star(tmp_path, changes=changes).path
    with pytest.raises(FormatError, match=told) as caught:
        read_scan(str(path))
    assert "\n" not in str(caught.value)


def test_the_header_of_a_reconstructed_volume_is_no_scan(tmp_path):
    (tmp_path / "volume.nsihdr").write_text("<Volume>")
    with pytest.raises(FormatError, match=r"expected the project of a scan, .nsipro, found the header of a recon"):
        read_scan(str(tmp_path / "volume.nsihdr"))


def test_a_geometry_report_is_not_read_and_told(tmp_path):
    path = foreign.write_north_star(tmp_path).path
    (tmp_path / "Geometry Report.rtf").write_text("Image center (95.707, 123.072) [mm]")
    (note,) = read_scan(str(path)).notes
    assert note.startswith(f"{tmp_path / 'Geometry Report.rtf'}: not read")


def test_too_many_folders_of_radiographs_are_told(tmp_path):
    path = foreign.write_north_star(tmp_path).path
    (tmp_path / "Radiographs-2").mkdir()
    with pytest.raises(FormatError, match=r"expected one folder Radiographs\*, found Radiographs, Radiographs-2"):
        read_scan(str(path))


TABLE = "file,angle_deg\nr0.tif,0\nr1.tif,10\n"


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ("", "line 1: expected names of columns, found an empty file"),
        ("file,angle_deg\n", "expected rows of numbers below the names of columns, found none"),
        (
            TABLE.replace("angle_deg", "angle_grad"),
            r"column 'angle_grad': expected a unit, one of deg, .*'grad'",
        ),
        (TABLE.replace("angle_deg", "angle"), "column 'angle': expected a unit, .* found ''"),
        (TABLE.replace("10", "ten"), "line 3: angle_deg: expected a number, found 'ten'"),
        (TABLE.replace("10", "10,4"), "line 3: expected 2 fields, as line 1 has, found 3"),
        (TABLE.replace("file", "name"), "line 1: expected one column file, found name, angle_deg"),
        ("step," + TABLE.replace("\nr", "\n1,r"), "step: expected each step from 0 to 1 once, found none 0"),
        (TABLE.replace("r1", "r77"), "r77.tif: expected a TIFF, found none"),
        (
            TABLE.replace("r1", "small"),
            r"small.tif: expected one image \(46, 38\) as in the scan of r0.tif, found",
        ),
        (TABLE.replace("r1", "float"), "float.tif: expected uint16 counts, found float32"),
        (TABLE.replace("r0", "text"), "text.tif: expected a TIFF, found not a TIFF file"),
    ],
)
def test_wrong_tables_of_single_tiffs_are_answered_in_one_line(tmp_path, table, told):
    foreign.write_single_tiffs(tmp_path)
    tifffile.imwrite(tmp_path / "small.tif", random_counts(1, (4, 3)))
    tifffile.imwrite(tmp_path / "float.tif", np.ones((46, 38), np.float32))
    (tmp_path / "text.tif").write_text("no TIFF at all")
    (tmp_path / "radiographs.csv").write_text(table)
    with pytest.raises(FormatError, match=told) as caught:
        read_scan(str(tmp_path)).images.read(1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["none.nx", "none.xtekct", "none.nsipro", "none.csv", "none.tif", "none.xyz", "none"])
def test_what_is_not_there_is_told(tmp_path, name):
    with pytest.raises(FormatError, match=f"{name}: expected .* found none"):
        read_scan(str(tmp_path / name))


def test_text_is_no_hdf5(tmp_path):
    (tmp_path / "scan.h5").write_text("no HDF5 at all")
    with pytest.raises(FormatError, match=r"scan.h5: expected an NXtomo file, HDF5, found .*signature"):
        read_scan(str(tmp_path / "scan.h5"))


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory):
    """One file of each format, with all that belongs to it."""
    folder = tmp_path_factory.mktemp("whole")
    for name in ("nikon", "star", "single"):
        (folder / name).mkdir()
    geometry = ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=4, columns=3)
    for name in ("geometry.xml", "geometry.csv"):
        write_geometry(folder / name, geometry, np.array([0.1, 0.2]))
    foreign.write_single_tiffs(folder / "single")
    return [
        (foreign.write_nikon(folder / "nikon").path, read_scan),
        (foreign.write_north_star(folder / "star").path, read_scan),
        (folder / "single" / "radiographs.csv", read_scan),
        (folder / "single" / "r0.tif", read_scan),
        (folder / "geometry.xml", read_geometry),
        (folder / "geometry.csv", read_geometry),
    ]


@law(120)
@given(data=st.data())
def test_whatever_is_in_a_file_the_answer_is_a_scan_or_one_line(whole_files, data):
    """A part of a good file is left out, or other bytes stand in its place."""
    path, read = data.draw(st.sampled_from(whole_files))
    content = path.read_bytes()
    start, length = data.draw(st.integers(0, len(content))), data.draw(st.integers(0, 60))
    odd = st.sampled_from([b"", b"nan", b"-1", b"1e400", b"<", b"\n"])
    other = data.draw(st.one_of(odd, st.binary(max_size=20)))
    changed = path.with_name(f"changed{path.suffix}")
    changed.write_bytes(content[:start] + other + content[start + length :])
    told = "a file: expected a scan"
    try:
        found = read(changed if read is read_geometry else str(changed))
        if read is read_scan:
            found.images.read(0)
    except FormatError as error:
        told = str(error)
    finally:
        changed.unlink()
    assert "\n" not in told
    assert ": expected " in told


@law(15)
@given(share=st.floats(0, 0.999))
def test_a_cut_nxtomo_file_is_answered_in_one_line(share):
    with tempfile.TemporaryDirectory() as name:
        path = foreign.write_nexus(Path(name) / "scan.nx").path
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(FormatError, match="expected an NXtomo file, HDF5, found") as caught:
            read_scan(str(path))
        assert "\n" not in str(caught.value)


def test_single_tiffs_without_a_table_come_in_the_order_of_their_numbers(tmp_path):
    for k in (0, 2, 10, 1):
        tifffile.imwrite(tmp_path / f"img{k}.tif", np.full((5, 4), k, np.uint16))
    scan = read_scan(str(tmp_path))
    assert [int(scan.images.read(k)[0, 0]) for k in range(4)] == [0, 1, 2, 10]
    assert scan.angle_deg is None
    tifffile.imwrite(tmp_path / "stack.tif", random_counts(1, (3, 5, 4)), photometric="minisblack")
    assert read_scan(str(tmp_path / "stack.tif")).images.count == 3


def test_a_written_folder_reads_as_the_experiment_that_was_put_together(tmp_path):
    """The same experiment by its folder and in memory; the folder is refused once it is complete."""
    from validation.doors.assembly import assembled, experiment_of, write_folder

    reference = read_scan(str(foreign.write_nexus(tmp_path / "scan.nx").path))
    (tmp_path / "test").mkdir()
    test = read_scan(str(foreign.write_single_tiffs(tmp_path / "test").path))
    whole = assembled(reference, test, title="bar", acquisition={"frames": 4})
    assert any("no times" in note for note in whole.notes)
    write_folder(whole, tmp_path / "out")
    read, made = read_experiment(tmp_path / "out"), experiment_of(whole)
    assert (read.geometry, read.frames, read.title) == (made.geometry, made.frames, made.title)
    for name in ("reference", "test"):
        for key in ("counts", "angle_rad", "time_s", "force_N"):
            np.testing.assert_array_equal(getattr(getattr(read, name), key), getattr(getattr(made, name), key))
    np.testing.assert_array_equal(read.flats, made.flats)
    np.testing.assert_array_equal(read.darks, made.darks)
    with pytest.raises(FormatError, match=r"out: expected a folder without experiment.toml"):
        write_folder(whole, tmp_path / "out")
