"""`pdvc-bench import`: from the files of a laboratory to an experiment folder, as a user does it."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile

from pdvc.experiment import read_experiment
from pdvc.geometry import ConeBeam
from tests import foreign_scans as foreign
from tests.command_line import only_line, pdvc_bench
from tests.radiograph_files import random_counts
from tests.synthetic_experiments import experiment
from validation.doors.assembly import forces_during
from validation.doors.geometry_files import write_geometry
from validation.doors.nxtomo import write_nxtomo
from validation.doors.refusal import FormatError

PAGE = (Path(__file__).parents[1] / "docs" / "doors.md").read_text(encoding="utf-8")
RECORD = "Time [s];Load [kN];Stroke [mm]\n-5,0;0,2;0\n5,0;0,3;0,1\n45,0;0,7;0,5\n"
"""As a testing machine in a country with decimal commas writes it."""


@pytest.fixture
def laboratory(tmp_path):
    """A scan at rest as NXtomo, a test as single TIFFs with angles alone, and the testing machine's record."""
    for name in ("scan", "test"):
        (tmp_path / name).mkdir()
    foreign.write_nexus(tmp_path / "scan.nx")
    foreign.write_single_tiffs(tmp_path / "test", forces=False)
    (tmp_path / "machine.csv").write_text(RECORD)
    return tmp_path


def arguments(folder, *more):
    return ["import", "--reference", folder / "scan.nx", "--test", folder / "test", "-o", folder / "out", *more]


def test_a_scan_a_test_and_a_record_become_an_experiment(laboratory):
    result = pdvc_bench(*arguments(laboratory, "--forces", laboratory / "machine.csv", "--material", "cast iron"))
    assert result.exit_code == 0, result.stderr
    opened = read_experiment(laboratory / "out")
    geometry = opened.geometry
    assert (geometry.rows, geometry.columns, opened.material) == (foreign.ROWS, foreign.COLUMNS, "cast iron")
    assert (geometry.source_axis_mm, geometry.source_detector_mm) == pytest.approx((30.0, 300.0))
    assert (len(opened.reference), len(opened.test), len(opened.flats), len(opened.darks)) == (12, 12, 2, 1)
    time = 2.0 * np.arange(12) + 1
    np.testing.assert_allclose(opened.test.time_s, time)
    np.testing.assert_allclose(opened.test.force_N, np.where(time < 5, 250 + 10 * time, 300 + 10 * (time - 5)))
    np.testing.assert_allclose(opened.test.angle_rad, np.deg2rad(30.0 * np.arange(12) + 5))
    np.testing.assert_array_equal(opened.test.counts[3], tifffile.imread(laboratory / "test" / "r3.tif"))
    # what was taken for granted is told
    assert "views of the reference scan are counted" in result.stderr
    assert "zeros for the reference scan" in result.stderr


def test_options_tell_what_the_files_do_not(laboratory):
    """Two TIFF stacks without anything: angles from tables, distances and times from options."""
    folder = laboratory / "plain"
    folder.mkdir()
    views, steps = random_counts(1, (4, 5, 3)), random_counts(2, (2, 5, 3))
    for name, counts in (("views", views), ("steps", steps), ("flats", views[:2]), ("darks", views[2:3])):
        tifffile.imwrite(folder / f"{name}.tif", counts, photometric="minisblack")
    (folder / "views.csv").write_text("angle_rad\n0\n1.5\n3.0\n4.5\n")
    (folder / "steps.csv").write_text("angle_deg,force_N\n0,1\n7,2\n")
    result = pdvc_bench(
        "import", "--reference", folder / "views.tif", "--test", folder / "steps.tif", "-o", folder / "out",
        "--reference-table", folder / "views.csv", "--test-table", folder / "steps.csv",
        "--flats", folder / "flats.tif", "--darks", folder / "darks.tif", "--source-axis-mm", 30, "--period-s", 2,
        "--source-detector-mm", 300, "--pixel-mm", 0.5, "--column-shift-mm", 0.7, "--turn-back", "--mirror-columns",
        "--start-s", 1, "--frames", 5, "--photons-per-count", 3.5, "--readout-noise-counts", 2, "--title", "plain",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    opened = read_experiment(folder / "out")
    assert opened.geometry == ConeBeam(
        source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=5, columns=3, column_shift_mm=0.7
    )
    np.testing.assert_array_equal(opened.reference.counts, views[..., ::-1])
    np.testing.assert_array_equal(opened.flats, views[:2, :, ::-1])
    np.testing.assert_allclose(opened.reference.angle_rad, [0, -1.5, -3.0, -4.5])
    np.testing.assert_allclose(opened.test.angle_rad, np.deg2rad([0, -7]))
    np.testing.assert_allclose(opened.test.time_s, [1, 3])
    np.testing.assert_allclose(opened.test.force_N, [1, 2])
    assert (opened.frames, opened.photons_per_count, opened.readout_noise_counts) == (5, 3.5, 2.0)
    assert opened.title == "plain"


@pytest.mark.parametrize("ending", ["xml", "csv"])
def test_a_geometry_file_tells_distances_and_angles(laboratory, ending):
    path, angle = laboratory / f"geometry.{ending}", np.deg2rad(30.0 * np.arange(12) + 5)
    told = ConeBeam(
        source_axis_mm=31.0,
        source_detector_mm=310.0,
        pixel_mm=0.5,
        rows=46,
        columns=38,
        row_shift_mm=0.4,
        roll_rad=0.01,
    )
    write_geometry(path, told, angle)
    (laboratory / "test" / "radiographs.csv").rename(laboratory / "table.csv")
    result = pdvc_bench(
        "import", "--reference", laboratory / "test", "--test", laboratory / "scan.nx", "-o", laboratory / "out",
        "--geometry", path, "--pixel-mm", 0.5, "--roll-deg", 2, "--period-s", 2, "--no-forces",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    opened = read_experiment(laboratory / "out")
    assert opened.geometry.source_axis_mm == pytest.approx(31.0)
    assert opened.geometry.row_shift_mm == pytest.approx(0.4)
    assert np.rad2deg(opened.geometry.roll_rad) == pytest.approx(2)  # an option stands above the file
    np.testing.assert_allclose(opened.reference.angle_rad, angle, atol=1e-9)
    assert (opened.test.force_N == 0).all()


def test_both_entries_of_an_nxtomo_file_are_the_experiment_again(tmp_path):
    written = experiment()
    path = tmp_path / "both.nx"
    write_nxtomo(path, written)
    result = pdvc_bench(
        "import", "--reference", f"{path}::reference", "--test", f"{path}::test", "-o", tmp_path / "out"
    )
    assert result.exit_code == 0, result.stderr
    opened = read_experiment(tmp_path / "out")
    for name in ("reference", "test"):
        found, expected = getattr(opened, name), getattr(written, name)
        np.testing.assert_array_equal(found.counts, expected.counts)
        for key in ("angle_rad", "time_s", "force_N"):
            np.testing.assert_allclose(getattr(found, key), getattr(expected, key), atol=1e-12)
    np.testing.assert_array_equal(opened.flats, written.flats)
    assert opened.geometry.column_shift_mm == pytest.approx(written.geometry.column_shift_mm)
    assert opened.geometry.roll_rad == pytest.approx(written.geometry.roll_rad)


class TestThePage:
    @pytest.fixture(autouse=True)
    def files(self, tmp_path, monkeypatch):
        """Lay out what the page begins with: a Nikon scan, single TIFFs, and a record."""
        for name in ("scan", "during-the-test"):
            (tmp_path / name).mkdir()
        foreign.write_nikon(tmp_path / "scan")
        foreign.write_single_tiffs(tmp_path / "during-the-test", forces=False)
        (tmp_path / "machine.csv").write_text(RECORD)
        monkeypatch.chdir(tmp_path)

    def test_its_first_command_makes_an_experiment(self, tmp_path):
        found = re.search(r"^pdvc-bench (import (?:.*\\\n)*.*)$", PAGE, re.MULTILINE)
        result = pdvc_bench(*shlex.split(found[1].replace("\\\n", "")))
        assert result.exit_code == 0, result.stderr
        opened = read_experiment(tmp_path / "bar")
        assert (opened.material, opened.photons_per_count) == ("cast iron", 40)
        np.testing.assert_allclose(opened.test.time_s, 2.0 * np.arange(12))

    def test_its_python_makes_the_same(self):
        (block,) = [text for text in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "Request(" in text]
        session: dict[str, object] = {}
        exec(compile(block, "doors.md", "exec"), session)
        found = session["experiment"]
        assert found.geometry.source_axis_mm == foreign.TO_AXIS_MM
        np.testing.assert_allclose(found.test.force_N[[0, 5]], [250, 350])


def refused(*arguments):
    result = pdvc_bench(*arguments)
    assert result.exit_code == 2
    return only_line(result)


class TestWhatIsMissingOrDoesNotFit:
    def test_forces(self, laboratory):
        assert (
            "test/radiographs.csv: force_N: expected 12 numbers, one for each radiograph, found none: give --forces"
            in (refused(*arguments(laboratory)))
        )
        told = refused(*arguments(laboratory, "--forces", laboratory / "machine.csv", "--no-forces"))
        assert "--no-forces: expected without --forces" in told

    def test_times(self, laboratory):
        table = laboratory / "test" / "radiographs.csv"
        table.write_text(table.read_text().replace("time_s", "note"))
        assert "time_s: expected 12 numbers, one for each radiograph, found none: give --period-s" in (
            refused(*arguments(laboratory, "--no-forces"))
        )
        told = refused(*arguments(laboratory, "--forces", laboratory / "machine.csv"))
        assert "time_s: expected times of the radiographs, to look up --forces at, found none: give --period-s" in told

    def test_angles(self, laboratory):
        (laboratory / "test" / "radiographs.csv").unlink()
        told = refused(*arguments(laboratory, "--no-forces", "--period-s", 2))
        assert "angle_deg: expected 12 numbers, one for each radiograph, found none: give a table" in told

    def test_flats(self, laboratory):
        shutil.move(laboratory / "scan.nx", laboratory / "test.nx")
        swapped = ["--reference", laboratory / "test", "--test", laboratory / "test", "-o", laboratory / "out"]
        lengths = ["--source-axis-mm", 30, "--source-detector-mm", 300, "--pixel-mm", 0.5]
        told = refused("import", *swapped, *lengths, "--no-forces")
        assert "flats: expected at least one image, found none: give --flats" in told

    def test_distances(self, laboratory):
        flats = ["--flats", laboratory / "test", "--darks", laboratory / "test"]
        both = ["--reference", laboratory / "test", "--test", laboratory / "test", "-o", laboratory / "out"]
        told = refused("import", *both, *flats, "--no-forces", "--pixel-mm", 0.5)
        assert "source_axis_mm, source_detector_mm: expected a length, found none there nor in" in told
        assert "give --source-axis-mm and --source-detector-mm, or --geometry" in told
        told = refused("import", *both, *flats, "--no-forces", "--pixel-mm", 0.5, "--source-axis-mm", 30,
                       "--source-detector-mm", 20)  # fmt: skip
        assert "geometry: expected source_detector_mm above source_axis_mm = 30.0 mm" in told

    def test_two_scanners(self, laboratory):
        (laboratory / "nikon").mkdir()
        path = foreign.write_nikon(laboratory / "nikon", SrcToObject=31.0).path
        told = refused("import", "--reference", laboratory / "scan.nx", "--test", path, "-o", laboratory / "out",
                       "--period-s", 2, "--no-forces")  # fmt: skip
        assert "bar.xtekct: source_axis_mm: expected 30 as in" in told
        assert "found 31: give --source-axis-mm" in told

    def test_two_sizes(self, laboratory):
        tifffile.imwrite(laboratory / "small.tif", random_counts(1, (2, 5, 3)), photometric="minisblack")
        told = refused(*arguments(laboratory, "--no-forces", "--flats", laboratory / "small.tif"))
        assert told.startswith("error: flats.tif: expected images of 46 x 38 px, as of")
        assert told.endswith("found 5 x 3")

    def test_a_table_of_another_length(self, laboratory):
        (laboratory / "table.csv").write_text("angle_deg\n1\n2\n")
        told = refused(*arguments(laboratory, "--no-forces", "--test-table", laboratory / "table.csv"))
        assert "angle_deg: expected 12 numbers, one for each radiograph, found 2" in told

    def test_an_experiment_is_not_written_over(self, laboratory):
        assert pdvc_bench(*arguments(laboratory, "--no-forces")).exit_code == 0
        told = refused(*arguments(laboratory, "--no-forces"))
        assert "out: expected a folder without experiment.toml, or none yet, found an experiment" in told

    def test_what_a_broken_import_left_is_begun_anew(self, laboratory):
        """A radiograph in the middle is cut: nothing passes for complete, and the next import is whole."""
        path = laboratory / "test" / "r7.tif"
        whole = path.read_bytes()
        path.write_bytes(whole[:-100])
        result = pdvc_bench(*arguments(laboratory, "--no-forces"))
        assert result.exit_code == 2
        assert "r7.tif: expected 3752 bytes, found 3652" in result.stderr.splitlines()[-1]
        assert not (laboratory / "out" / "experiment.toml").exists()
        path.write_bytes(whole)
        assert pdvc_bench(*arguments(laboratory, "--no-forces")).exit_code == 0
        assert len(read_experiment(laboratory / "out").test) == 12
        assert not [each for each in (laboratory / "out").rglob("*") if each.suffix in (".partial", ".count")]


class TestTheRecordOfATestingMachine:
    TIMES = np.array([0.0, 10.0])

    @pytest.mark.parametrize(
        "text",
        [
            "time_s,force_N\n0,100\n10,200\n",
            "Time (min)\tLoad (kN)\n0\t0.1\n0.16666666666666667\t0.2\n",
            '"Time","Extension","Load"\n"(s)","(mm)","(N)"\n"0","0","100"\n"10","1","200"\n',
            "\ufefftime [ms];force [N]\n0,0;100,0\n10000,0;200,0\n",
        ],
    )
    def test_is_read_as_it_is_written(self, tmp_path, text):
        path = tmp_path / "record.csv"
        path.write_text(text, encoding="utf-8")
        np.testing.assert_allclose(forces_during(path, self.TIMES), [100, 200])
        np.testing.assert_allclose(forces_during(path, self.TIMES / 2, clock_s=2.5), [125, 175])

    def test_columns_may_have_names_of_their_own(self, tmp_path):
        path = tmp_path / "record.csv"
        path.write_text("t [s],F1 [N],F2 [N]\n0,1,5\n10,2,6\n")
        np.testing.assert_allclose(forces_during(path, self.TIMES, time_column="t", force_column="F2"), [5, 6])
        with pytest.raises(FormatError, match=r"line 1: expected one column force or load, found t \[s\], F1 \[N\]"):
            forces_during(path, self.TIMES, time_column="t")

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            ("time_s,force_N\n0,1\n5,2\n", "time: expected a record of 0 to 10 s, found 0 to 5 s"),
            ("time_s,force_N\n0,1\n20,2\n20,3\n", "line 4: time: expected times that increase"),
            ("time_s,force_lbf\n0,1\n", "column 'force_lbf': expected a unit, one of N, newton, kN, mN, found 'lbf'"),
            ("time_s,force_N,load_N\n0,1,1\n", "expected one column force or load, found 2: force_N, load_N"),
        ],
    )
    def test_is_refused_in_one_line(self, tmp_path, text, told):
        path = tmp_path / "record.csv"
        path.write_text(text)
        with pytest.raises(FormatError, match=told) as caught:
            forces_during(path, self.TIMES)
        assert "\n" not in str(caught.value)
