"""The measurement's NetCDF file: every field comes back, and what is no measurement is refused by name."""

from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
import xarray as xr

from pdvc.measurement import MeasurementError
from pdvc.measurement_file import _ARRAYS, read_measurement, write_measurement
from pdvc.sections import CONTRACTION, RIGID, SectionBasis
from tests import synthetic_records as records

RESIDUALS = ("residual_initial", "residual_rigid", "residual_final")


@pytest.fixture(scope="module")
def measured():
    amplitude = np.random.default_rng(5).normal(size=(records.STEPS, 9, 6))
    record = records.measurement(amplitude, unobserved=(0, 8), title="dog-bone, 'A' # 1")
    residual = record.fit.residual_final.copy()
    residual[3, :2] = np.nan
    return records.altered(record, residual_final=residual, snr_noise_db=np.full(records.STEPS, np.nan), options="")


def assert_same(one, two, name):
    if isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, two, err_msg=name)
        assert one.dtype == two.dtype, name
    else:
        assert one == two or (one != one and two != two), name  # NaN is not equal to itself


def test_every_field_comes_back(measured, tmp_path):
    write_measurement(measured, tmp_path / "a.nc")
    again = read_measurement(tmp_path / "a.nc")
    assert again.verdict == measured.verdict
    for part in ("recording", "motion", "fit", "provenance"):
        one, two = getattr(measured, part), getattr(again, part)
        for field in fields(one):
            if field.name not in (*RESIDUALS, "basis", "stages"):
                assert_same(getattr(one, field.name), getattr(two, field.name), field.name)
    for field in fields(measured.motion.basis):
        assert_same(getattr(measured.motion.basis, field.name), getattr(again.motion.basis, field.name), field.name)
    assert len(again.fit.stages) == len(measured.fit.stages)
    for one, two in zip(measured.fit.stages, again.fit.stages, strict=True):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(two, field.name), field.name)


def test_the_table_of_the_file_names_every_array_of_the_record(measured):
    """What is added to the record and forgotten in the table would be lost."""
    kept = {each.attribute for each in _ARRAYS}
    for part in ("recording", "motion", "fit"):
        record = getattr(measured, part)
        arrays = [each.name for each in fields(record) if isinstance(getattr(record, each.name), np.ndarray)]
        assert {f"{part}.{name}" for name in arrays} <= kept


def test_residuals_come_back_to_half_their_quantum_and_their_gaps_as_gaps(measured, tmp_path):
    write_measurement(measured, tmp_path / "a.nc")
    again = read_measurement(tmp_path / "a.nc")
    for name in RESIDUALS:
        np.testing.assert_allclose(getattr(again.fit, name), getattr(measured.fit, name), atol=5.1e-5, err_msg=name)
    assert np.isnan(again.fit.residual_final[3, :2]).all()


def test_residuals_too_large_for_the_quantum_come_back_with_a_coarser_one(measured, tmp_path):
    residual = measured.fit.residual_initial.copy()
    residual[0, 0, 0] = 5
    write_measurement(records.altered(measured, residual_initial=residual), tmp_path / "a.nc")
    again = read_measurement(tmp_path / "a.nc")
    np.testing.assert_allclose(again.fit.residual_initial, residual, atol=0.51 * 5 / 32767)


def test_stages_with_other_motions_than_the_sections_come_back(tmp_path):
    """The rigid body has six motions where the sections contract, too."""
    record = records.measurement(np.random.default_rng(0).normal(size=(records.STEPS, 9, 7)))
    basis = SectionBasis(height_mm=record.motion.basis.height_mm, radius_mm=0.6, motions=(*RIGID, CONTRACTION))
    rigid = replace(record.fit.stages[0], spatial=np.random.default_rng(1).normal(size=(5, 1, 6)))
    stages = (rigid, *record.fit.stages[1:])
    write_measurement(records.altered(record, basis=basis, stages=stages), tmp_path / "a.nc")
    again = read_measurement(tmp_path / "a.nc")
    assert again.motion.basis.motions == basis.motions
    for one, two in zip(again.fit.stages, stages, strict=True):
        np.testing.assert_array_equal(one.spatial, two.spatial)


def test_a_displacement_is_unknown_only_next_to_an_unobserved_section(measured):
    first, second, third = measured.motion.basis.height_mm[:3]
    u = measured.motion.displacement(4, np.array([[0, 0, (first + second) / 2], [0.1, 0, (second + third) / 2]]))
    np.testing.assert_array_equal(np.isnan(u).any(axis=1), [True, False])


def test_a_solver_without_modes_has_none_when_read_back(measured, tmp_path):
    stage = replace(
        measured.fit.stages[1], solver="gauss-newton", temporal=np.empty((0, 24)), spatial=np.empty((0, 9, 6))
    )
    write_measurement(records.altered(measured, stages=(measured.fit.stages[0], stage)), tmp_path / "a.nc")
    again = read_measurement(tmp_path / "a.nc").fit.stages[1]
    assert again.modes == 0
    assert again.spatial.shape == (0, 9, 6)


def test_nothing_but_the_finished_file_is_left(measured, tmp_path):
    write_measurement(measured, tmp_path / "results" / "a.nc")
    assert [path.name for path in (tmp_path / "results").iterdir()] == ["a.nc"]


# h5netcdf complains, when collected, that the file it could not open has no state to close
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_a_truncated_file_is_refused_by_name(measured, tmp_path, share):
    path = tmp_path / "a.nc"
    write_measurement(measured, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(MeasurementError, match=r"a\.nc: expected a measurement of format 4"):
        read_measurement(path)


def test_another_netcdf_file_is_refused_by_name(tmp_path):
    xr.Dataset({"a": ("x", np.arange(3))}).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(MeasurementError, match=r"a\.nc: expected a measurement of format 4"):
        read_measurement(tmp_path / "a.nc")


def test_another_format_is_refused_with_its_number(measured, tmp_path):
    write_measurement(measured, tmp_path / "a.nc")
    with h5py.File(tmp_path / "a.nc", "r+") as file:
        file.attrs["format"] = 99
    with pytest.raises(MeasurementError, match=r"a\.nc: expected a measurement of format 4: found format 99"):
        read_measurement(tmp_path / "a.nc")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(MeasurementError, match=r"a\.nc: expected a measurement file, found none"):
        read_measurement(tmp_path / "a.nc")
