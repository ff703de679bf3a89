"""Files of other programs against these programs themselves: python -m benchmarks.doors

Each check needs a package that this project does not: nxtomo, axitom (whose package holds one radiograph of a tensile
specimen from a Nikon scanner), mbirjax, itk-rtk, astra-toolbox and vtk, all on PyPI. One that is not installed is
left out, and named. With all of them two minutes, most of it for RTK to load.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import tifffile

from benchmarks.rows import Row, keep, show
from pdvc.experiment import GeometryEntry
from tests import foreign_scans as foreign
from tests import synthetic_records as records
from tests.synthetic_experiments import experiment
from tests.test_geometry_files import ANGLES, SCANNER
from validation.doors.astra import cone_vec
from validation.doors.formats import read_scan
from validation.doors.geometry_files import read_geometry, write_geometry
from validation.doors.nxtomo import write_nxtomo
from validation.doors.paraview import write_series
from validation.doors.rtk import rtk_matrices, rtk_parameters
from validation.doors.surface import surface_of


def nxtomo_reads(folder: Path) -> str:
    """Let nxtomo read what is written here."""
    from nxtomo.application.nxtomo import NXtomo

    written = experiment()
    write_nxtomo(folder / "ours.nx", written)
    found = NXtomo().load(str(folder / "ours.nx"), "test", detector_data_as="as_numpy_array")
    detector, series, geometry = found.instrument.detector, written.test, written.geometry
    before = len(written.darks) + len(written.flats)
    np.testing.assert_array_equal(detector.data[before:], series.counts)
    np.testing.assert_array_equal([key.value for key in detector.image_key], [2, 1, 1, 0, 0, 0])
    angle = found.sample.rotation_angle.to("rad").magnitude[before:]
    lengths = {
        "distance": (detector.distance, geometry.source_detector_mm - geometry.source_axis_mm),
        "source": (found.instrument.source.distance, -geometry.source_axis_mm),
        "pixel": (detector.x_pixel_size, geometry.pixel_mm),
    }
    off = max(abs(value.to("mm").magnitude - due) for value, due in lengths.values())
    return (
        f"counts and keys equal; angles within {np.abs(angle - series.angle_rad).max():.0e} rad, lengths {off:.0e} mm"
    )


def nxtomo_writes(folder: Path) -> str:
    """Read what nxtomo writes, with a flip, an alignment frame, and lengths in mm, cm and m."""
    from nxtomo.application.nxtomo import NXtomo
    from nxtomo.nxobject.nxdetector import ImageKey
    from pint import get_application_registry

    unit, made = get_application_registry(), NXtomo()
    detector = made.instrument.detector
    detector.data = np.random.default_rng(0).integers(0, 65535, (7, 5, 4)).astype(np.uint16)
    kinds = [ImageKey.DARK_FIELD, ImageKey.FLAT_FIELD, *[ImageKey.PROJECTION] * 4, ImageKey.ALIGNMENT]
    detector.image_key_control = np.array(kinds)
    made.sample.rotation_angle = np.arange(7.0) * 10 * unit.degree
    detector.x_pixel_size = detector.y_pixel_size = 0.2 * unit.millimeter
    detector.distance = 27.0 * unit.centimeter
    made.instrument.source.distance = -0.03 * unit.meter
    detector.x_rotation_axis_pixel_position = 1.25
    detector.set_transformation_from_lr_flipped(True)
    made.save(str(folder / "theirs.nx"), data_path="/entry0000")
    scan = read_scan(str(folder / "theirs.nx"))
    assert scan.flats is not None
    assert scan.darks is not None
    np.testing.assert_array_equal([scan.images.read(k) for k in range(4)], detector.data[2:6, :, ::-1])
    np.testing.assert_array_equal(scan.flats.read(0), detector.data[1, :, ::-1])
    np.testing.assert_array_equal(scan.darks.read(0), detector.data[0, :, ::-1])
    np.testing.assert_allclose(scan.angle_deg, [20, 30, 40, 50])
    # of the stored columns 0 .. 3 the axis is at 1.25: mirrored, at 1.75, a quarter of a pixel right of the middle
    due = {"source_axis_mm": 30, "source_detector_mm": 300, "pixel_mm": 0.2, "column_shift_mm": -0.05}
    off = max(abs(scan.geometry[key] - value) for key, value in due.items())
    return f"counts, flats, darks and angles equal; lengths within {off:.0e} mm"


def axitom_holds(folder: Path) -> str:
    """Read the Nikon radiograph of a tensile specimen that axitom's package holds, one of 3142, as axitom does."""
    import axitom

    data = Path(axitom.__file__).parent / "tests" / "example_data"
    due = axitom.config_from_xtekct(str(data / "radiogram.xtekct"))
    text = (data / "radiogram.xtekct").read_text()
    transmission = tifffile.imread(data / "radiogram.tif")
    # the package holds it corrected, as floats: the counts that it was, by its white level
    counts = np.round(60000 * transmission).astype(np.uint16)
    name = next(line.partition("=")[2] for line in text.splitlines() if line.startswith("Name="))
    tifffile.imwrite(folder / f"{name}_0001.tif", counts)
    (folder / "scan.xtekct").write_text(text.replace("Projections=3142", "Projections=1"))
    scan = read_scan(str(folder / "scan.xtekct"))
    np.testing.assert_array_equal(scan.images.read(0)[:, ::-1], counts)
    told = {
        "source_axis_mm": due.source_to_object_dist,
        "source_detector_mm": due.source_to_detector_dist,
        "pixel_mm": due.pixel_size_u,
        "column_shift_mm": 0.0,
        "roll_deg": 0.0,
    }
    off = max(abs(scan.geometry[key] - value) for key, value in told.items())
    assert scan.images.size == (due.n_pixels_v, due.n_pixels_u)
    return f"{counts.shape[0]} x {counts.shape[1]} px equal, distances and pixel within {off:.0e} mm"


def mbirjax_reads(folder: Path) -> str:
    """Let MBIRJAX read a North Star scan that is written here, and project the marker by its own geometry."""
    from mbirjax.cone_beam import ConeBeamModel
    from mbirjax.preprocess import nsi

    written = foreign.write_north_star(folder, roll_deg=0.0)
    text = written.path.read_text()
    written.path.write_text(text.replace("<Result>", "<Radiograph>\n  <crop>0 0 0 0\n</Radiograph>\n<Result>"))
    # MBIRJAX asks for a list of defective pixels, which may be empty
    (folder / "Corrections" / "none.defect").write_text("<Defective Pixels>\n</Defective Pixels>\n")
    images, _, _, parameters, _ = nsi.load_scans_and_params(str(folder), verbose=0)
    required, optional = nsi.convert_nsi_to_mbirjax_params(parameters)
    scan = read_scan(str(written.path))
    # MBIRJAX reads counts as shares of the largest
    counts = np.round(images * 65535)
    np.testing.assert_array_equal([scan.images.read(k) for k in range(scan.images.count)], counts)
    told = {
        "source_axis_mm": required["source_iso_dist"],
        "source_detector_mm": required["source_detector_dist"],
        "column_shift_mm": -optional["det_channel_offset"],
        "row_shift_mm": -optional["det_row_offset"],
    }
    off = max(abs(scan.geometry[key] - float(value)) for key, value in told.items())
    # MBIRJAX: z down, the source at +y, x with the columns; of ours x is along the beam and y to the left, at angle 0
    x, y, z = written.marker_mm
    far, right, down = x, -y, -z
    places = []
    for angle in np.asarray(required["angles"]):
        c, s = np.cos(angle), np.sin(angle)
        u, v, _ = ConeBeamModel.geometry_xyz_to_uv_mag(
            c * right + s * far, s * right - c * far, down, told["source_detector_mm"], 10.0
        )
        places.append(ConeBeamModel.detector_uv_to_mn(
            u, v, foreign.PIXEL_MM, foreign.PIXEL_MM, optional["det_channel_offset"], optional["det_row_offset"],
            foreign.ROWS, foreign.COLUMNS,
        ))  # fmt: skip
    entry = GeometryEntry.parse({**scan.geometry, "rows": foreign.ROWS, "columns": foreign.COLUMNS}, where="")
    assert scan.angle_deg is not None
    due = foreign.expected_centres(entry.cone_beam(), np.deg2rad(scan.angle_deg), written.marker_mm)
    return f"images equal; offsets within {off:.0e} mm, marker within {np.abs(np.array(places) - due).max():.0e} px"


def rtk_reads(folder: Path) -> str:
    """Let RTK read the XML that is written here; it refuses matrices that are not those of their parameters."""
    from itk import RTK as rtk

    write_geometry(folder / "ours.xml", SCANNER, ANGLES)
    found = rtk.read_geometry(str(folder / "ours.xml"))
    matrices = np.array([
        [[found.GetMatrix(k)(i, j) for j in range(4)] for i in range(3)] for k in range(len(ANGLES))
    ])  # fmt: skip
    off = np.abs(matrices - rtk_matrices(*rtk_parameters(SCANNER, ANGLES))).max()
    rtk.write_geometry(found, str(folder / "theirs.xml"))
    values, angle_deg = read_geometry(folder / "theirs.xml")
    told = {key: value for key, value in GeometryEntry.model_fields.items() if key in values}
    ours = {**SCANNER.__dict__, "roll_deg": np.rad2deg(SCANNER.roll_rad)}
    back = max(abs(values[key] - ours[key]) for key in told)
    turned = np.abs((angle_deg - np.rad2deg(ANGLES) + 180) % 360 - 180).max()
    return f"matrices within {off:.0e}; written by RTK and read here: {back:.0e} mm, {turned:.0e} degrees"


def astra_means(_: Path) -> str:
    """Let ASTRA turn its geometry ``cone`` into vectors, which needs no GPU: its rows go up, so that v is reversed."""
    import astra

    right_px, down_px = 4.5, -7.25
    geometry = replace(
        SCANNER, column_shift_mm=right_px * SCANNER.pixel_mm, row_shift_mm=down_px * SCANNER.pixel_mm, roll_rad=0.0
    )
    # at ASTRA's angle its source is at (sin, -cos), ours at (-cos, sin)
    angle = np.arctan2(-np.cos(ANGLES), -np.sin(ANGLES))
    behind = geometry.source_detector_mm - geometry.source_axis_mm
    pitch = (geometry.pixel_mm, geometry.pixel_mm)
    size = (geometry.rows, geometry.columns)
    cone = astra.create_proj_geom("cone", *pitch, *size, angle, geometry.source_axis_mm, behind)
    vectors = astra.geom_postalignment(astra.geom_2vec(cone), (right_px, -down_px))["Vectors"]
    vectors[:, 9:] *= -1
    return f"vectors within {np.abs(vectors - cone_vec(geometry, ANGLES)).max():.0e} mm"


def vtk_reads(folder: Path) -> str:
    """Let VTK read the grids that are written here."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    strain, offset = records.tensile_history()
    measured = records.measurement(records.stretched(strain, offset)[1])
    surface = surface_of(measured)
    write_series(measured, surface, folder)
    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(folder / "motion_00023.vtu"))
    reader.Update()
    grid = reader.GetOutput()
    points = vtk_to_numpy(grid.GetPoints().GetData())
    moved = vtk_to_numpy(grid.GetPointData().GetArray("displacement_mm"))
    seen = vtk_to_numpy(grid.GetPointData().GetArray("observed")) == 1
    found = vtk_to_numpy(grid.GetCellData().GetArray("strain"))
    off = np.abs((points - surface.flat_mm - moved)[seen]).max()
    of_strain = np.nanmax(np.abs(found - strain[23]))
    return f"{grid.GetNumberOfCells()} cells; moved points within {off:.0e} mm, strain {of_strain:.0e}"


CHECKS: dict[str, tuple[str, str, Callable[[Path], str]]] = {
    "NXtomo, written here": ("nxtomo", "nxtomo", nxtomo_reads),
    "NXtomo, read here": ("nxtomo", "nxtomo", nxtomo_writes),
    "Nikon, read here": ("axitom", "axitom", axitom_holds),
    "North Star, read here": ("mbirjax", "mbirjax", mbirjax_reads),
    "RTK's geometry, both ways": ("itk-rtk", "itk", rtk_reads),
    "ASTRA's vectors": ("astra-toolbox", "astra", astra_means),
    "VTK, written here": ("vtk", "vtkmodules", vtk_reads),
}
"""What is checked: the package by its name on PyPI, the module by which it is found, and how."""


def main() -> int:
    """Carry out each check whose package is installed; print and keep a table."""
    rows: list[Row] = []
    for what, (package, module, check) in CHECKS.items():
        if find_spec(module) is None:
            print(f"{what}: left out, as {package} is not installed: pip install {package}", file=sys.stderr)
            continue
        with tempfile.TemporaryDirectory() as folder:
            rows.append({"what": what, "against": package, "found": check(Path(folder))})
        show(rows[-1])
    if rows:
        keep(rows, "doors")
    return 0


if __name__ == "__main__":
    sys.exit(main())
