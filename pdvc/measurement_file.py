"""A measurement as a NetCDF file, or as an xarray dataset: names, axes and units stand in one table.

Besides what it reads back, a file holds what another program would want and could not easily work out: standard
deviations of displacement and strain on the axis, and the doubts that concern each step.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pdvc.correction import correction_of, text_of
from pdvc.deviations import BEAM
from pdvc.measurement import (
    Fit,
    MeasuredMotion,
    Measurement,
    MeasurementError,
    Provenance,
    Recording,
    ResidualTests,
    Stage,
)
from pdvc.sections import SectionBasis, SectionPattern
from pdvc.verdict import Doubt, Stop, Verdict
from pdvc.whole import read_netcdf, write_netcdf

Floats = NDArray[np.float64]

FORMAT = 4
"""Raised whenever a file of an older version can no longer be read."""


@dataclass(frozen=True)
class _Kept:
    """An array of a measurement under its name in the file."""

    name: str
    attribute: str
    """Where it is in the record."""
    axes: tuple[str, ...]
    unit: str = ""
    kind: str = "f8"
    """Type that is read back."""


_ARRAYS = (
    _Kept("angle", "recording.angle_rad", ("step",), "rad"),
    _Kept("time", "recording.time_s", ("step",), "s"),
    _Kept("force", "recording.force_N", ("step",), "N"),
    _Kept("section_height", "motion.basis.height_mm", ("section",), "mm"),
    _Kept("time_functions", "motion.time_functions", ("function", "step")),
    _Kept("amplitude", "motion.amplitude", ("step", "section", "motion"), "voxel"),
    _Kept("amplitude_std", "motion.amplitude_std", ("step", "section", "motion"), "voxel"),
    # without "function" where all functions have one covariance together
    _Kept("covariance", "motion.covariance", ("function", "coefficient", "coefficient_"), "voxel^2"),
    _Kept("data_share", "motion.data_share", ("step", "section", "motion")),
    _Kept("observed", "motion.observed", ("section",), kind="bool"),
    _Kept("snr_reprojection", "fit.snr_reprojection_db", ("view",), "dB"),
    _Kept("snr_initial", "fit.snr_initial_db", ("step",), "dB"),
    _Kept("snr_rigid", "fit.snr_rigid_db", ("step",), "dB"),
    _Kept("snr_final", "fit.snr_final_db", ("step",), "dB"),
    _Kept("snr_noise", "fit.snr_noise_db", ("step",), "dB"),
    _Kept("residual_initial", "fit.residual_initial", ("step", "row", "column"), kind="f4"),
    _Kept("residual_rigid", "fit.residual_rigid", ("step", "row", "column"), kind="f4"),
    _Kept("residual_final", "fit.residual_final", ("step", "row", "column"), kind="f4"),
)
_NUMBERS = {
    "title": "recording.title",
    "voxel_mm": "recording.voxel_mm",
    "source_axis_mm": "recording.source_axis_mm",
    "section_radius_mm": "motion.basis.radius_mm",
    "options": "provenance.options",
    "versions": "provenance.versions",
}
"""Attributes of the file that are numbers and texts of the record as they stand."""
_OF_A_STAGE = tuple(each.name for each in fields(Stage) if each.name not in ("temporal", "spatial", "rms"))


def dataset_of(measurement: Measurement) -> xr.Dataset:
    """Return a measurement as an xarray dataset, as `write_measurement` writes it."""
    m = measurement
    arrays = {}
    for kept in _ARRAYS:
        values = attrgetter(kept.attribute)(m)
        stored = values.astype(np.int8) if values.dtype == bool else values
        arrays[kept.name] = (kept.axes[-values.ndim :], stored, {"units": kept.unit} if kept.unit else {})
    data = xr.Dataset(
        {
            **arrays,
            "step_doubts": ("step", [", ".join(m.verdict.of_step(t)) for t in range(m.recording.steps)]),
            "motion_pattern": (("motion", "row_of_map", "column_of_map"), _patterns(m.motion.basis)),
            "displacement_std": (("step", "section", "direction"), _axis_std(m), {"units": "voxel"}),
            "strain_std": (("step", "interval"), _axis_strain_std(m)),
        },
        coords={"motion": list(m.motion.basis.names), "direction": list(BEAM)},
        attrs={
            "format": FORMAT,
            **{name: attrgetter(attribute)(m) for name, attribute in _NUMBERS.items()},
            "window": np.array(m.recording.window),
            "verdict": m.verdict.word,
            "doubts": json.dumps([asdict(doubt) for doubt in m.verdict.doubts]),
            **{f"seconds_{name}": value for name, value in m.provenance.seconds.items()},
            **{f"residual_{name}": value for name, value in _tests(m.fit.residual_tests).items()},
            "stages": len(m.fit.stages),
            **({} if m.correction is None else {"self_calibration": text_of(m.correction)}),
        },
    )
    for n, stage in enumerate(m.fit.stages):
        name = f"stage{n}"
        data[f"{name}_temporal"] = ((f"{name}_mode", "step"), stage.temporal)
        # a rigid stage has one section, and may have fewer motions
        own = stage.spatial.shape[1:] != m.motion.basis.shape
        axes = (f"{name}_section", f"{name}_motion") if own else ("section", "motion")
        data[f"{name}_spatial"] = ((f"{name}_mode", *axes), stage.spatial, {"units": "voxel"})
        data[f"{name}_rms"] = (f"{name}_pass", stage.rms)
        for key in _OF_A_STAGE:
            value = getattr(stage, key)
            data.attrs[f"{name}_{key}"] = str(value) if isinstance(value, Stop) else value
    if m.fit.outliers is not None:
        data["outliers"] = (("step", "row", "column"), m.fit.outliers.astype(np.int8))
    if m.recording.brightness is not None:
        data["brightness"] = (("step", "value_and_std"), m.recording.brightness)
    sources = m.motion.std_by_source
    if sources:
        data = data.assign_coords(source=list(sources))
        data["std_by_source"] = (("source", "direction"), np.array(list(sources.values())), {"units": "voxel"})
    return data


def write_measurement(measurement: Measurement, path: Path) -> None:
    """Write the measurement as NetCDF, under its name only when it is complete."""
    data = dataset_of(measurement)
    packed = {name: _packing(data[name].values) for name in data if str(name).startswith("residual_")}
    write_netcdf(path, data, packed)


def read_measurement(path: Path | str) -> Measurement:
    """Read a measurement file; raises MeasurementError where it is none."""
    path = Path(path)
    if not path.is_file():
        raise MeasurementError(f"{path}: expected a measurement file, found none")
    try:
        data = read_netcdf(path)
        if data.attrs.get("format") != FORMAT:
            raise ValueError(f"found format {data.attrs.get('format')}")
        return _measurement_of(data)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise MeasurementError(f"{path}: expected a measurement of format {FORMAT}: {error}") from None


def _measurement_of(data: xr.Dataset) -> Measurement:
    """Return the measurement that a dataset holds: each field of the table under its part's name."""
    attrs = data.attrs
    found: dict[str, Any] = {kept.attribute: data[kept.name].values.astype(kept.kind) for kept in _ARRAYS}
    found |= {attribute: attrs[name] for name, attribute in _NUMBERS.items()}
    row_from, row_to, column_from, column_to = (int(value) for value in attrs["window"])
    names, patterns = data["motion"].values, data["motion_pattern"].values
    basis = SectionBasis(
        height_mm=found["motion.basis.height_mm"],
        radius_mm=float(found["motion.basis.radius_mm"]),
        motions=tuple(SectionPattern.of(str(name), one) for name, one in zip(names, patterns, strict=True)),
    )
    doubts = (Doubt(**{**each, "steps": tuple(each["steps"])}) for each in json.loads(str(attrs["doubts"])))
    return Measurement(
        recording=Recording(
            **{**_part(found, "recording"), "window": (row_from, row_to, column_from, column_to)},
            brightness=data["brightness"].values if "brightness" in data else None,
        ),
        motion=MeasuredMotion(**_part(found, "motion"), basis=basis, std_by_source=_sources(data)),
        fit=Fit(
            **_part(found, "fit"),
            stages=tuple(_stage(data, f"stage{n}") for n in range(int(attrs["stages"]))),
            residual_tests=_tests_of(attrs),
            outliers=data["outliers"].values.astype(bool) if "outliers" in data else None,
        ),
        provenance=Provenance(
            **_part(found, "provenance"),
            seconds={
                str(name).removeprefix("seconds_"): float(value)
                for name, value in attrs.items()
                if str(name).startswith("seconds_")
            },
        ),
        verdict=Verdict(doubts=tuple(doubts)),
        correction=correction_of(str(attrs["self_calibration"])) if "self_calibration" in attrs else None,
    )


def _part(found: Mapping[str, Any], part: str) -> dict[str, Any]:
    """Return the fields of one part of the record, numbers and texts as Python's own."""
    own = {name.removeprefix(f"{part}."): value for name, value in found.items() if name.startswith(f"{part}.")}
    return {
        name: value if isinstance(value, np.ndarray) else value.item() if isinstance(value, np.generic) else value
        for name, value in own.items()
        if "." not in name
    }


def _stage(data: xr.Dataset, name: str) -> Stage:
    attrs = data.attrs
    return Stage(
        name=str(attrs[f"{name}_name"]),
        scale=int(attrs[f"{name}_scale"]),
        solver=str(attrs[f"{name}_solver"]),
        unknowns=int(attrs[f"{name}_unknowns"]),
        temporal=np.asarray(data[f"{name}_temporal"].values),
        spatial=np.asarray(data[f"{name}_spatial"].values),
        rms=np.asarray(data[f"{name}_rms"].values),
        stop=Stop(attrs[f"{name}_stop"]),
        stop_reason=str(attrs[f"{name}_stop_reason"]),
        last_change_voxel=float(attrs[f"{name}_last_change_voxel"]),
    )


def _tests(tests: ResidualTests | None) -> dict[str, float]:
    return {} if tests is None else asdict(tests)


def _tests_of(attrs: Mapping[str, Any]) -> ResidualTests | None:
    if "residual_chi2_reduced" not in attrs:
        return None
    return ResidualTests(**{each.name: float(attrs[f"residual_{each.name}"]) for each in fields(ResidualTests)})


def _sources(data: xr.Dataset) -> dict[str, tuple[float, float, float]]:
    if "source" not in data:
        return {}
    rows = zip(data["source"].values, data["std_by_source"].values.tolist(), strict=True)
    return {str(name): (across, vertical, along) for name, (across, vertical, along) in rows}


def _patterns(basis: SectionBasis) -> Floats:
    """Return what each motion is (motion, 3, 4), so that a file tells it wherever it is read."""
    return np.stack([motion.pattern() for motion in basis.motions])


def _axis_std(m: Measurement) -> Floats:
    """Return the standard deviations of u on the axis at each section (step, section, direction), voxels."""
    points = np.zeros((len(m.motion.basis.height_mm), 3))
    points[:, 2] = m.motion.basis.height_mm
    result = np.stack([m.turned_std(step, points) for step in range(m.recording.steps)])
    return np.where(np.isnan(m.motion.amplitude).any(axis=2, keepdims=True), np.nan, result)


def _axis_strain_std(m: Measurement) -> Floats:
    """Return the standard deviations of the strain between neighbouring sections (step, section - 1)."""
    result = np.stack([m.strain_std(step, m.motion.basis.height_mm) for step in range(m.recording.steps)])
    unknown = np.asarray(np.isnan(m.motion.amplitude).any(axis=2))
    return np.where(unknown[:, 1:] | unknown[:, :-1], np.nan, result)


def _packing(values: NDArray[np.float32]) -> dict[str, object]:
    """Return how to store grey levels as 16-bit integers: in steps of 1e-4, or coarser ones if they need it."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    return {"dtype": "int16", "scale_factor": max(1e-4, largest / 32767), "_FillValue": -32768}
