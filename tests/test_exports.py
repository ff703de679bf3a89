"""What is written for other programs: against closed forms, and read back by code that is not the writer's."""

from __future__ import annotations

import base64
import csv
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet

import pdvc
from pdvc.experiment import read_experiment
from pdvc.measurement_file import write_measurement
from pdvc.volume import DIRECTIONS, Hull
from simulator.scanner import simulate
from tests import synthetic_records as records
from tests.command_line import only_line, pdvc_bench
from tests.laws import law
from tests.small_case import textured
from validation.doors.astra import cone_vec
from validation.doors.formats import read_scan
from validation.doors.geometry_files import read_geometry
from validation.doors.material import motion_of
from validation.doors.motion_table import MATERIAL, SPATIAL, default_points, motion_table, write_csv, write_parquet
from validation.doors.paraview import write_series
from validation.doors.surface import AROUND, surface_of
from validation.doors.volume_tiff import write_volume
from validation.testing.small_cases import small_options, small_scenario

STRAIN, OFFSET = records.tensile_history()
TRUTH, AMPLITUDE = records.stretched(STRAIN, OFFSET)


@pytest.fixture(scope="module")
def stretched():
    return records.measurement(AMPLITUDE)


def vtu(path):
    """Return the points, the cells and the fields of a grid, by VTK's description of its files."""
    piece = ElementTree.parse(path).getroot().find("UnstructuredGrid/Piece")
    types = {"Float32": "<f4", "Float64": "<f8", "Int64": "<i8", "UInt8": "<u1"}

    def arrays(place):
        found = {}
        for each in piece.find(place):
            content = base64.b64decode(each.text)
            length = int(np.frombuffer(content[:8], "<u8")[0])
            assert length == len(content) - 8
            values = np.frombuffer(content[8:], types[each.get("type")])
            components = int(each.get("NumberOfComponents"))
            found[each.get("Name")] = values.reshape(-1, components) if components > 1 else values
        return found

    cells = arrays("Cells")
    assert (cells["types"] == 9).all()
    np.testing.assert_array_equal(np.diff(cells["offsets"]), 4)
    return arrays("Points")["points"], cells["connectivity"].reshape(-1, 4), arrays("PointData"), arrays("CellData")


class TestMaterialPoints:
    def test_move_as_the_closed_form_says(self, stretched):
        """x = X + e Z e_z + d."""
        for step in (0, 12, 23):
            motion = motion_of(stretched, step)
            rest, expected = TRUTH.point_mm, TRUTH.point_mm + TRUTH.displacement_mm[step]
            between = motion.observed(expected)
            assert 0.8 < between.mean() < 1  # beyond the sections the motion is that of the outermost
            np.testing.assert_allclose(motion.current(rest[between]), expected[between], atol=1e-8)

    def test_are_stretched_by_the_strain_with_the_deviation_that_pdvc_states(self, stretched):
        height = records.HEIGHT_MM
        told = pdvc.strain(stretched, height, steps=[20])
        on_axis = np.stack([0 * height, 0 * height, height], axis=1)
        strain, deviation = motion_of(stretched, 20).strain(on_axis[:-1], on_axis[1:])
        np.testing.assert_allclose(strain, told["strain"][0], atol=1e-12)
        np.testing.assert_allclose(strain, STRAIN[20], atol=1e-12)
        np.testing.assert_allclose(deviation, told["deviation"][0], rtol=1e-9)

    def test_of_a_bent_sample_are_stretched_on_one_side_only(self):
        """Sections that turn about y by an angle that grows along z: the strain is -x times its slope."""
        amplitude = np.zeros_like(AMPLITUDE)
        slope = 0.01  # rad per mm
        # a rotation's amplitude is the displacement, in voxels, at the sections' radius
        amplitude[..., 4] = slope * records.HEIGHT_MM * 0.6 / records.VOXEL_MM
        motion = motion_of(records.measurement(amplitude), 3)
        z = (records.HEIGHT_MM[:-1] + records.HEIGHT_MM[1:]) / 2
        for x in (-0.4, 0.4):
            lower, upper = (np.stack([x + 0 * z, 0 * z, z + up], axis=1) for up in (-0.1, 0.1))
            found, _ = motion.strain(lower, upper)
            np.testing.assert_allclose(found / (1 + found), -slope * x, atol=1e-9)

    @law(20)
    @given(seed=st.integers(0, 999), size=st.floats(0, 3))
    def test_are_found_again_where_they_came_from(self, seed, size):
        rng = np.random.default_rng(seed)
        measured = records.measurement(rng.normal(0, size, (records.STEPS, 9, 6)))
        motion = motion_of(measured, 5)
        rest = rng.uniform(-4, 4, (20, 3)) * [0.15, 0.15, 1]
        moved = motion.current(rest)
        np.testing.assert_allclose(moved - motion.displacement(moved), rest, atol=1e-8)

    def test_a_motion_that_folds_the_sample_is_told(self):
        amplitude = np.zeros_like(AMPLITUDE)
        amplitude[:, ::2, 2] = 200
        with pytest.raises(ValueError, match="step 2: expected a place for each material point, found that the"):
            motion_of(records.measurement(amplitude), 2).current(np.array([[0, 0, 0.1]]))

    def test_steps_that_were_not_measured_have_none(self):
        amplitude = AMPLITUDE.copy()
        amplitude[3] = np.nan
        assert motion_of(records.measurement(amplitude), 3) is None


class TestTheSurface:
    def test_moves_with_the_material(self, stretched, tmp_path):
        surface = surface_of(stretched)
        path = write_series(stretched, surface, tmp_path)
        sets = ElementTree.parse(path).getroot().findall("Collection/DataSet")
        assert [float(each.get("timestep")) for each in sets] == stretched.recording.time_s.tolist()
        for step in (0, 15, 23):
            points, cells, of_points, of_cells = vtu(tmp_path / sets[step].get("file"))
            moved = OFFSET[step] + STRAIN[step] * surface.flat_mm * [0, 0, 1]
            seen = of_points["observed"] == 1
            np.testing.assert_allclose(points[seen], (surface.flat_mm + moved)[seen], atol=1e-7)
            assert seen.mean() > 0.8
            np.testing.assert_allclose(of_points["displacement_mm"][seen], moved[seen], atol=1e-6)
            assert np.isnan(of_points["displacement_mm"][~seen]).all()
            # what is beyond the sections by now was not observed
            outside = (points[:, 2] < records.HEIGHT_MM[0] - 1e-6) | (points[:, 2] > records.HEIGHT_MM[-1] + 1e-6)
            np.testing.assert_array_equal(seen, ~outside)
            known = np.isfinite(of_cells["strain"])
            assert known.mean() > 0.8
            np.testing.assert_allclose(of_cells["strain"][known], STRAIN[step], atol=1e-6)
            turned = stretched.turned_std(step, points) * records.VOXEL_MM
            np.testing.assert_allclose(of_points["deviation_mm"][seen], turned[seen], rtol=1e-5)
            assert (of_cells["strain_deviation"][known] > 0).all()
            assert cells.max() == len(points) - 1

    def test_is_a_round_bar_as_thick_as_the_section_is_from_corner_to_corner(self, stretched):
        points = surface_of(stretched).points_mm
        np.testing.assert_allclose(np.hypot(points[..., 0], points[..., 1]), 2 * stretched.motion.basis.radius_mm)

    def test_is_closed_around_and_seen_from_outside(self, stretched):
        surface = surface_of(stretched)
        points, cells = surface.flat_mm, surface.quads()
        corner = points[cells]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 3] - corner[:, 0])
        assert ((normal * corner.mean(axis=1))[:, :2].sum(axis=1) > 0).all()
        lower, upper = surface.edges_mm()
        np.testing.assert_allclose(lower, (corner[:, 0] + corner[:, 1]) / 2)
        np.testing.assert_allclose(upper, (corner[:, 2] + corner[:, 3]) / 2)
        edges = np.sort(np.concatenate([cells[:, [k, (k + 1) % 4]] for k in range(4)]), axis=1)
        _, shared = np.unique(edges, axis=0, return_counts=True)
        assert (shared == 1).sum() == 2 * AROUND  # only top and bottom are open
        assert shared.max() == 2

    def test_is_the_outline_where_the_experiment_tells_it(self, stretched):
        """A hull of half-planes around an ellipse off the axis: each ring's reach is that of the nearest of them."""
        normals, middle = Hull.normals(), np.array([0.1, -0.2])
        support = middle @ normals.T + np.hypot(*(normals * [0.5, 0.3]).T)
        below = support - 0.1
        hull = Hull(z_mm=-5.0, slab_mm=5.0, support_mm=np.stack([below, support]))
        points = surface_of(stretched, hull).points_mm
        np.testing.assert_allclose(points[0, :, 2], -4.0)
        # every point is on the hull: inside all half-planes, and on one of them
        for ring, wall in ((0, below), (-1, support)):
            beyond = points[ring, :, :2] @ normals.T - wall
            np.testing.assert_allclose(beyond.max(axis=1), 0, atol=1e-12)
        assert DIRECTIONS * 2 == AROUND

    def test_what_was_not_observed_moves_as_what_is_next_to_it(self, tmp_path):
        measured = records.measurement(AMPLITUDE, unobserved=(8,))
        surface = surface_of(measured)
        assert surface.points_mm[-1, 0, 2] == records.HEIGHT_MM[7]
        write_series(measured, surface, tmp_path)
        points, _, of_points, _ = vtu(tmp_path / "motion_00023.vtu")
        assert np.isfinite(points).all()
        assert 0.5 < of_points["observed"].mean() < 1

    def test_has_no_numbers_about_a_section_between_that_was_not_observed(self, tmp_path):
        """Nor on either side of it, up to the next one that was."""
        measured = records.measurement(AMPLITUDE, unobserved=(4,))
        write_series(measured, surface_of(measured), tmp_path)
        points, _, of_points, _ = vtu(tmp_path / "motion_00000.vtu")
        low, high = records.HEIGHT_MM[[3, 5]]
        between = (points[:, 2] > low + 1e-6) & (points[:, 2] < high - 1e-6)
        assert between.any()
        assert np.isnan(of_points["displacement_mm"][between]).all()
        z = points[:, 2]
        beside = ((z < low - 1e-6) & (z > -3.9)) | ((z > high + 1e-6) & (z < 3.5))
        assert np.isfinite(of_points["displacement_mm"][beside]).all()

    def test_needs_two_sections(self):
        measured = records.measurement(AMPLITUDE[:, :1])
        with pytest.raises(ValueError, match="surface: expected at least 2 observed sections, found 1"):
            surface_of(measured)


class TestTheTable:
    def rows(self, columns, coordinates, step):
        return (columns["coordinates"] == coordinates) & (columns["step"] == step)

    def test_is_right_in_both_coordinates(self, stretched):
        points, gauge = default_points(stretched)
        columns = motion_table(stretched, points, gauge)
        assert len(set(map(len, columns.values()))) == 1
        for step in (0, 18):
            spatial, material = (self.rows(columns, name, step) for name in (SPATIAL, MATERIAL))
            here = np.stack([columns[f"{axis}_mm"] for axis in "xyz"], axis=1)
            rest = np.stack([columns[f"rest_{axis}_mm"] for axis in "xyz"], axis=1)
            u = np.stack([columns[f"u_{axis}_mm"] for axis in "xyz"], axis=1)
            np.testing.assert_array_equal(here[spatial], points)
            np.testing.assert_array_equal(rest[material], points)
            known = np.isfinite(u).all(axis=1)
            np.testing.assert_allclose((rest + u)[known], here[known], atol=1e-8)
            # a material point moves by d + e Z e_z
            wanted = OFFSET[step] + STRAIN[step] * points * [0, 0, 1]
            np.testing.assert_allclose((here - rest)[material], wanted, atol=1e-8)
            told = pdvc.displacement(stretched, points, steps=[step])
            np.testing.assert_allclose(u[spatial], told["displacement"][0], atol=1e-12)
            deviation = np.stack([columns[f"std_{name}_mm"] for name in ("across", "vertical", "along")], axis=1)
            np.testing.assert_allclose(deviation[spatial], told["deviation"][0], rtol=1e-12)
            strain = columns["strain"][spatial].reshape(8, 5)
            between = pdvc.strain(stretched, steps=[step])
            np.testing.assert_allclose(strain, np.repeat(between["strain"].values.T, 5, axis=1), atol=1e-12)
            of_strain = columns["strain_std"][spatial].reshape(8, 5)
            np.testing.assert_allclose(of_strain[:, 0], between["deviation"][0], rtol=1e-9)

    def test_has_no_numbers_where_nothing_was_observed(self, stretched):
        columns = motion_table(stretched, np.array([[0.0, 0.0, 9.0], [0.0, 0.0, 3.5], [0.0, 0.0, 0.0]]), 0.5)
        outside, at_end, inside = (columns["point"] == k for k in range(3))
        for name in ("u_x_mm", "std_along_mm", "strain", "strain_std"):
            assert np.isnan(columns[name][outside]).all()
            assert np.isfinite(columns[name][inside]).all()
        spatial = columns["coordinates"] == SPATIAL
        assert np.isnan(columns["strain"][at_end & spatial]).all()  # half its gauge is beyond the sections
        assert np.isfinite(columns["u_z_mm"][at_end & spatial]).all()

    def test_is_the_same_as_text_and_as_parquet(self, stretched, tmp_path):
        columns = motion_table(stretched, np.array([[0.0, 0.0, 9.0], [0.1, 0.2, 0.3]]), 0.4)
        write_csv(tmp_path / "motion.csv", columns)
        write_parquet(tmp_path / "motion.parquet", columns)
        with (tmp_path / "motion.csv").open(newline="") as file:
            text = list(csv.DictReader(file))
        packed = parquet.read_table(tmp_path / "motion.parquet").to_pydict()
        assert list(text[0]) == list(packed) == list(columns)
        for name, values in columns.items():
            read = [row[name] for row in text]
            if name == "coordinates":
                assert read == packed[name] == values.tolist()
            else:
                expected = [None if value != value else value for value in values.tolist()]
                assert packed[name] == expected
                assert [float(value) if value else None for value in read] == expected


def test_a_volume_has_its_voxel_size_where_imagej_looks(tmp_path):
    volume = textured()
    write_volume(tmp_path / "volume.tif", volume)
    with tifffile.TiffFile(tmp_path / "volume.tif") as tiff:
        assert tiff.is_imagej
        told = tiff.imagej_metadata
        np.testing.assert_array_equal(tiff.asarray(), volume.values)
        assert (told["slices"], told["unit"]) == (volume.grid.shape[0], "mm")
        assert told["spacing"] == pytest.approx(volume.grid.voxel_mm)
        for name in ("XResolution", "YResolution"):
            pixels, per = tiff.pages.first.tags[name].value
            assert per / pixels == pytest.approx(volume.grid.voxel_mm, rel=1e-6)
        x = volume.grid.origin_mm[0]
        assert f"centre of the first voxel: x = {x!r} mm" in told["Info"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A small experiment, simulated, with a motion in closed form in place of its measurement."""
    folder = tmp_path_factory.mktemp("measured")
    scenario = small_scenario({})
    simulate(scenario, folder / "experiment", workers=1)
    write_measurement(records.measurement(AMPLITUDE), folder / "motion.nc")
    (folder / "options.toml").write_text(small_options(scenario).template())
    return folder


class TestTheCommand:
    def test_writes_all_that_is_asked_for(self, measured, tmp_path):
        result = pdvc_bench(
            "export", measured / "motion.nc", "--experiment", measured / "experiment",
            "--options", measured / "options.toml", "--vtk", tmp_path / "vtk", "--csv", tmp_path / "motion.csv",
            "--parquet", tmp_path / "motion.parquet", "--volume", tmp_path / "volume.tif",
            "--geometry", tmp_path / "geometry.xml", "--series", "test", "--nxtomo", tmp_path / "both.nx",
        )  # fmt: skip
        assert result.exit_code == 0, result.stderr
        written = [line.removeprefix("written: ") for line in result.stderr.splitlines() if line.startswith("written")]
        names = ("vtk/motion.pvd", "motion.csv", "motion.parquet", "volume.tif", "geometry.xml", "both.nx")
        assert written == [str(tmp_path / name) for name in names]
        experiment = read_experiment(measured / "experiment")
        assert len(list((tmp_path / "vtk").glob("*.vtu"))) == records.STEPS
        points, _, _, _ = vtu(tmp_path / "vtk" / "motion_00000.vtu")
        # its fillets are thicker than its ligament
        reach = np.hypot(points[:, 0], points[:, 1]).reshape(-1, AROUND).max(axis=1)
        assert reach[0] > 1.3 * reach.min()
        values, angle_deg = read_geometry(tmp_path / "geometry.xml")
        assert len(angle_deg) == len(experiment.test)
        assert values["source_axis_mm"] == pytest.approx(experiment.geometry.source_axis_mm)
        scan = read_scan(f"{tmp_path / 'both.nx'}::test")
        np.testing.assert_array_equal(scan.images.read(5), experiment.test.counts[5])
        volume = tifffile.imread(tmp_path / "volume.tif")
        # the sample is where its outline is: its middle half of the slices is full of it
        assert volume[volume.shape[0] // 2].max() > 0.2 * volume.max()

    def test_of_a_measurement_alone_or_of_a_folder_alone(self, measured, tmp_path):
        assert pdvc_bench("export", measured / "motion.nc", "--vtk", tmp_path / "vtk").exit_code == 0
        result = pdvc_bench("export", measured / "experiment", "--geometry", tmp_path / "vectors.csv")
        assert result.exit_code == 0, result.stderr
        experiment = read_experiment(measured / "experiment")
        rows = np.loadtxt(tmp_path / "vectors.csv", delimiter=",", skiprows=1)
        np.testing.assert_array_equal(rows, cone_vec(experiment.geometry, experiment.reference.angle_rad))

    def test_asks_where_and_over_which_length(self, measured, tmp_path):
        (tmp_path / "points.csv").write_text("x_um,y_um,z_mm\n100,0,0.5\n")
        result = pdvc_bench(
            "export", measured / "motion.nc", "--csv", tmp_path / "motion.csv", "--points", tmp_path / "points.csv",
            "--gauge-mm", 0.2,
        )  # fmt: skip
        assert result.exit_code == 0, result.stderr
        with (tmp_path / "motion.csv").open(newline="") as file:
            row = next(row for row in csv.DictReader(file) if row["coordinates"] == SPATIAL and row["step"] == "17")
        opened = pdvc.read_measurement(measured / "motion.nc")
        told = pdvc.displacement(opened, [[0.1, 0, 0.5]], steps=[17])["displacement"][0, 0]
        np.testing.assert_allclose([float(row[f"u_{axis}_mm"]) for axis in "xyz"], told)

    @pytest.mark.parametrize(
        ("arguments", "told"),
        [
            (
                ["motion.nc"],
                "export: expected at least one of --vtk, --csv, --parquet, --volume, --geometry, --nxtomo",
            ),
            (
                ["motion.nc", "--volume", "v.tif"],
                "--volume: expected an experiment: --experiment DIR",
            ),
            (
                ["experiment", "--vtk", "out"],
                "--vtk: expected a measurement, as measure writes it",
            ),
            (
                ["motion.nc", "--csv", "m.csv", "--gauge-mm", "0"],
                "--gauge-mm: expected a length above 0 mm, found 0",
            ),
            (["experiment", "--experiment", "experiment", "--geometry", "g.xml"], "expected a measurement before it"),
            (["experiment", "--geometry", "g.json"], "g.json: expected a geometry file, .xml of RTK or .csv"),
            (["none.nc", "--csv", "m.csv"], "none.nc: expected a measurement file, found none"),
            (["motion.nc", "--csv", "m.csv", "--points", "none.csv"], "none.csv: expected a table, found none"),
        ],
    )
    def test_answers_in_one_line(self, measured, tmp_path, monkeypatch, arguments, told):
        monkeypatch.chdir(measured)
        result = pdvc_bench("export", *arguments)
        assert result.exit_code == 2
        assert told in only_line(result)


def test_nxtomo_is_laid_out_by_the_definition(tmp_path, measured):
    """What NXtomo requires, by its own list: https://manual.nexusformat.org/classes/applications/NXtomo.html."""
    assert pdvc_bench("export", measured / "experiment", "--nxtomo", tmp_path / "both.nx").exit_code == 0
    classes = {
        "": "NXentry", "instrument": "NXinstrument", "instrument/source": "NXsource",
        "instrument/detector": "NXdetector", "sample": "NXsample", "data": "NXdata",
    }  # fmt: skip
    with h5py.File(tmp_path / "both.nx") as file:
        for entry in ("reference", "test"):
            for place, name in classes.items():
                assert file[f"{entry}/{place}"].attrs["NX_class"] == name
            assert file[f"{entry}/definition"][()] == b"NXtomo"
            frames = file[f"{entry}/instrument/detector/data"].shape[0]
            assert file[f"{entry}/instrument/detector/image_key"].shape == (frames,)
            assert file[f"{entry}/sample/rotation_angle"].shape == (frames,)
            for link in ("data", "image_key", "rotation_angle"):
                assert len(file[f"{entry}/data/{link}"]) == frames


def test_a_measurement_of_other_steps_is_a_shorter_series(tmp_path):
    amplitude = AMPLITUDE.copy()
    amplitude[5:] = np.nan
    write_measurement(records.measurement(amplitude), tmp_path / "motion.nc")
    result = pdvc_bench("export", tmp_path / "motion.nc", "--vtk", tmp_path, "--csv", tmp_path / "motion.csv")
    assert result.exit_code == 0, result.stderr
    assert len(list(tmp_path.glob("*.vtu"))) == 5
