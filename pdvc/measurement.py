"""The Measurement record: what was recovered, how well it fits, and its NetCDF file."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from pdvc.sections import SectionBasis
from pdvc.verdict import UNCHECKED, Doubt, Stop, Verdict
from pdvc.whole import read_netcdf, write_netcdf

Floats = NDArray[np.float64]
_COVARIANCE_AXES = ("function", "coefficient", "coefficient_")
FORMAT = 3
"""Raised whenever a file of an older version can no longer be read."""


class MeasurementError(ValueError):
    """Say which measurement file cannot be read, and why."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Hold one stage of the protocol: its modes in the order found, and why it stopped."""

    name: str
    """``rigid`` or ``deformation``."""
    scale: int
    """Pixels of the radiographs binned into one."""
    solver: str
    """Name of the solver."""
    unknowns: int
    """Number of unknown amplitudes: time functions x sections x motions."""
    temporal: Floats
    """alpha (mode, step), without unit; no mode for a solver that has none."""
    spatial: Floats
    """Section amplitudes (mode, section, motion) in voxels; one section in the rigid stage."""
    rms: Floats
    """Rms residual over used pixels and steps before each pass and after the last, grey levels."""
    stop: Stop
    """Why the stage ended, for machines."""
    stop_reason: str
    """Why the stage ended, in words and numbers."""
    last_change_voxel: float = float("nan")
    """Rms displacement of the last change, voxels; NaN for a solver by modes."""

    @property
    def modes(self) -> int:
        """Return the number of modes found."""
        return len(self.temporal)


@dataclass(frozen=True, kw_only=True)
class ResidualTests:
    """Hold how the final residual compares with the noise of radiographs, reference views and flats."""

    chi2_reduced: float
    """chi2 / (N - p): mean square of the residuals, each over its standard deviation; 1 if they are noise only."""
    lag1_row: float
    """Correlation of the residual with that of the next row."""
    lag1_column: float
    """Correlation with the next column."""
    lag1_row_expected: float
    """The same for noise alone, which is not white once a reference view has been interpolated."""
    lag1_column_expected: float


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """Hold a measured motion of a sample; voxels are `voxel_mm` large."""

    title: str
    voxel_mm: float
    source_axis_mm: float
    angle_rad: Floats
    """(step,)"""
    time_s: Floats
    """(step,)"""
    force_N: Floats
    """(step,)"""
    window: tuple[int, int, int, int]
    """Used part of the detector at scale 1: row_from, row_to, column_from, column_to."""
    basis: SectionBasis
    time_functions: Floats
    """Orthonormal time functions (function, step)."""
    amplitude: Floats
    """Section amplitudes (step, section, motion), voxels; NaN in sections that were not observed."""
    amplitude_std: Floats
    """Standard deviation of `amplitude`, voxels, from noise and prior; NaN where unknown."""
    covariance: Floats
    """Covariance of all coefficients (function * section * motion, the same), voxel^2, from noise and prior;
    (function, section * motion, the same) where nothing joins the functions."""
    data_share: Floats
    """1 - posterior / prior variance of each amplitude (step, section, motion): 1 where the data
    determine it, 0 where only the prior does."""
    observed: NDArray[np.bool_]
    """(section,) whether the used pixels saw the section."""
    stages: tuple[Stage, ...]
    snr_reprojection_db: Floats
    """SNR of the reference views against the re-projected volume (view,), dB."""
    snr_initial_db: Floats
    """SNR (step,) without any motion, dB."""
    snr_rigid_db: Floats
    """SNR (step,) after the rigid stage, dB."""
    snr_final_db: Floats
    """SNR (step,) at the end, dB."""
    snr_noise_db: Floats
    """SNR (step,) that the noise of the radiographs alone would leave, dB; NaN where the noise is unknown."""
    residual_initial: NDArray[np.float32]
    """Residual fields (step, row, column) over the window, grey levels (air 0, largest attenuation 1)."""
    residual_rigid: NDArray[np.float32]
    residual_final: NDArray[np.float32]
    residual_tests: ResidualTests | None = None
    """Whether the final residual is the noise that was expected; None: not asked."""
    std_by_source: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """What noise of radiographs, views and flats, and the prior, each make of the standard deviation of u on the axis:
    rms over steps and observed sections, voxels, across the beam, vertical, along the beam. Squares add up."""
    verdict: Verdict = UNCHECKED
    """What speaks against the measurement."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time spent, by part: at least ``reconstruct`` and ``measure``."""
    options: str = ""
    """The resolved options as TOML."""
    versions: str = ""
    """Versions of this package and of the libraries that compute."""

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns of the last stage."""
        return self.stages[-1].unknowns

    def displacement(self, step: int, points_mm: Floats) -> Floats:
        """Return u (point, 3) in voxels at points (point, 3) in mm of the current configuration of a step.

        NaN where an unobserved section takes part.
        """
        return self.basis.displacement(self.amplitude[step], points_mm)

    def turned_std(self, step: int, points_mm: Floats) -> Floats:
        """Return the standard deviations (point, 3), voxels, across the beam, vertical and along the beam.

        At points (point, 3) in mm of the current configuration; from noise and prior.
        """
        return turned_std(self.basis, self._step_covariance(step), float(self.angle_rad[step]), points_mm)

    def strain_std(self, step: int, height_mm: Floats) -> Floats:
        """Return the standard deviation (height - 1,) of the axial strain between current heights on the axis."""
        return strain_std(self.basis, self._step_covariance(step), height_mm, self.voxel_mm)

    def _step_covariance(self, step: int) -> Floats:
        if not self.time_functions[:, step].any():  # nothing was measured at this step
            return np.full((np.prod(self.basis.shape),) * 2, np.nan)
        return step_covariance(self.covariance, self.time_functions, step)


def step_covariance(covariance: Floats, time_functions: Floats, step: int) -> Floats:
    """Return the covariance (unknown, unknown), voxel^2, of one step's amplitudes, from that of all coefficients."""
    sigma = time_functions[:, step]
    if covariance.ndim == 3:
        return np.asarray(np.tensordot(sigma**2, covariance, axes=1))
    functions = len(sigma)
    blocks = covariance.reshape(functions, -1, functions, len(covariance) // functions)
    return np.asarray(np.einsum("f,fngm,g->nm", sigma, blocks, sigma, optimize=True))


def turned_std(basis: SectionBasis, covariance: Floats, angle_rad: float, points_mm: Floats) -> Floats:
    """Return the standard deviations of u (point, 3), voxels, across the beam, vertical and along the beam.

    `covariance` (section * motion, the same), voxel^2, is that of one step's amplitudes; `points_mm` (point, 3).
    """
    shapes = (directions(angle_rad) @ basis.shapes(points_mm).reshape(len(points_mm), 3, -1)).reshape(
        3 * len(points_mm), -1
    )
    variance = ((shapes @ covariance) * shapes).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0)).reshape(-1, 3))


def strain_std(basis: SectionBasis, covariance: Floats, height_mm: Floats, voxel_mm: float) -> Floats:
    """Return the standard deviation (height - 1,) of the strain between heights on the axis, without unit."""
    points = np.zeros((len(height_mm), 3))
    points[:, 2] = height_mm
    vertical = basis.shapes(points)[:, 2].reshape(len(points), -1)
    difference = np.diff(vertical, axis=0) * voxel_mm / np.diff(height_mm)[:, None]
    variance = ((difference @ covariance) * difference).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0)))


def directions(angle_rad: ArrayLike) -> Floats:
    """Return the directions in which one radiograph sees differently well, at stage angles (...,): (..., 3, 3).

    Rows: across the beam e_c, vertical e_z, along the beam e_b (`pdvc.geometry`).
    """
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    zero = np.zeros_like(c)
    rows = ((-s, -c, zero), (zero, zero, zero + 1), (c, -s, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def write_measurement(measurement: Measurement, path: Path) -> None:
    """Write the measurement as NetCDF, under its name only when it is complete."""
    m = measurement
    data = xr.Dataset(
        {
            "angle": ("step", m.angle_rad, {"units": "rad"}),
            "time": ("step", m.time_s, {"units": "s"}),
            "force": ("step", m.force_N, {"units": "N"}),
            "step_doubts": ("step", [", ".join(m.verdict.of_step(t)) for t in range(len(m.angle_rad))]),
            "section_height": ("section", m.basis.height_mm, {"units": "mm"}),
            "time_functions": (("function", "step"), m.time_functions),
            "amplitude": (("step", "section", "motion"), m.amplitude, {"units": "voxel"}),
            "amplitude_std": (("step", "section", "motion"), m.amplitude_std, {"units": "voxel"}),
            "covariance": (_COVARIANCE_AXES[-m.covariance.ndim :], m.covariance, {"units": "voxel^2"}),
            "displacement_std": (("step", "section", "direction"), _axis_std(m), {"units": "voxel"}),
            "strain_std": (("step", "interval"), _axis_strain_std(m)),
            "data_share": (("step", "section", "motion"), m.data_share),
            "observed": ("section", m.observed.astype(np.int8)),
            "snr_reprojection": ("view", m.snr_reprojection_db, {"units": "dB"}),
            "snr_initial": ("step", m.snr_initial_db, {"units": "dB"}),
            "snr_rigid": ("step", m.snr_rigid_db, {"units": "dB"}),
            "snr_final": ("step", m.snr_final_db, {"units": "dB"}),
            "snr_noise": ("step", m.snr_noise_db, {"units": "dB"}),
            "residual_initial": (("step", "row", "column"), m.residual_initial),
            "residual_rigid": (("step", "row", "column"), m.residual_rigid),
            "residual_final": (("step", "row", "column"), m.residual_final),
        },
        coords={"motion": list(m.basis.motions), "direction": ["across", "vertical", "along"]},
        attrs={
            "format": FORMAT,
            "title": m.title,
            "voxel_mm": m.voxel_mm,
            "source_axis_mm": m.source_axis_mm,
            "section_radius_mm": m.basis.radius_mm,
            "window": np.array(m.window),
            "verdict": m.verdict.word,
            "doubts": json.dumps([asdict(doubt) for doubt in m.verdict.doubts]),
            "options": m.options,
            "versions": m.versions,
            **{f"seconds_{name}": value for name, value in m.seconds.items()},
            **(
                {f"residual_{name}": value for name, value in asdict(m.residual_tests).items()}
                if m.residual_tests
                else {}
            ),
        },
    )
    for n, stage in enumerate(m.stages):
        name = f"stage{n}"
        data[f"{name}_temporal"] = ((f"{name}_mode", "step"), stage.temporal)
        # a rigid stage has one section, and may have fewer motions
        own = stage.spatial.shape[1:] != m.basis.shape
        axes = (f"{name}_section", f"{name}_motion") if own else ("section", "motion")
        data[f"{name}_spatial"] = ((f"{name}_mode", *axes), stage.spatial, {"units": "voxel"})
        data[f"{name}_rms"] = (f"{name}_pass", stage.rms)
        for key in ("name", "scale", "solver", "unknowns", "stop_reason", "last_change_voxel"):
            data.attrs[f"{name}_{key}"] = getattr(stage, key)
        data.attrs[f"{name}_stop"] = str(stage.stop)
    data.attrs["stages"] = len(m.stages)
    packed = {name: _packing(data[name].values) for name in data if str(name).startswith("residual_")}
    if m.std_by_source:
        data = data.assign_coords(source=list(m.std_by_source))
        data["std_by_source"] = (("source", "direction"), np.array(list(m.std_by_source.values())), {"units": "voxel"})
    write_netcdf(path, data, packed)


def _axis_std(m: Measurement) -> Floats:
    """Return the standard deviations of u on the axis at each section (step, section, direction), voxels."""
    points = np.zeros((len(m.basis.height_mm), 3))
    points[:, 2] = m.basis.height_mm
    result = np.stack([m.turned_std(step, points) for step in range(len(m.angle_rad))])
    return np.where(np.isnan(m.amplitude).any(axis=2, keepdims=True), np.nan, result)


def _axis_strain_std(m: Measurement) -> Floats:
    """Return the standard deviations of the strain between neighbouring sections (step, section - 1)."""
    result = np.stack([m.strain_std(step, m.basis.height_mm) for step in range(len(m.angle_rad))])
    unknown = np.asarray(np.isnan(m.amplitude).any(axis=2))
    return np.where(unknown[:, 1:] | unknown[:, :-1], np.nan, result)


def _packing(values: NDArray[np.float32]) -> dict[str, object]:
    """Return how to store grey levels as 16-bit integers: in steps of 1e-4, or coarser ones if they need it."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    return {"dtype": "int16", "scale_factor": max(1e-4, largest / 32767), "_FillValue": -32768}


def read_measurement(path: Path) -> Measurement:
    """Read a measurement file; raises MeasurementError where it is none."""
    if not path.is_file():
        raise MeasurementError(f"{path}: expected a measurement file, found none")
    try:
        data = read_netcdf(path)
        if data.attrs.get("format") != FORMAT:
            raise ValueError(f"found format {data.attrs.get('format')}")
        return _unpack(data)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise MeasurementError(f"{path}: expected a measurement of format {FORMAT}: {error}") from None


def _unpack(data: xr.Dataset) -> Measurement:
    def get(name: str) -> Floats:
        return np.asarray(data[name].values)

    attrs = data.attrs
    stages = tuple(
        Stage(
            name=str(attrs[f"{name}_name"]),
            scale=int(attrs[f"{name}_scale"]),
            solver=str(attrs[f"{name}_solver"]),
            unknowns=int(attrs[f"{name}_unknowns"]),
            temporal=get(f"{name}_temporal"),
            spatial=get(f"{name}_spatial"),
            rms=get(f"{name}_rms"),
            stop=Stop(attrs[f"{name}_stop"]),
            stop_reason=str(attrs[f"{name}_stop_reason"]),
            last_change_voxel=float(attrs[f"{name}_last_change_voxel"]),
        )
        for name in (f"stage{n}" for n in range(int(attrs["stages"])))
    )
    row_from, row_to, column_from, column_to = (int(value) for value in attrs["window"])
    return Measurement(
        title=str(attrs["title"]),
        voxel_mm=float(attrs["voxel_mm"]),
        source_axis_mm=float(attrs["source_axis_mm"]),
        angle_rad=get("angle"),
        time_s=get("time"),
        force_N=get("force"),
        window=(row_from, row_to, column_from, column_to),
        basis=SectionBasis(
            height_mm=get("section_height"),
            radius_mm=float(attrs["section_radius_mm"]),
            motions=tuple(str(name) for name in data["motion"].values),
        ),
        time_functions=get("time_functions"),
        amplitude=get("amplitude"),
        amplitude_std=get("amplitude_std"),
        covariance=get("covariance"),
        data_share=get("data_share"),
        observed=get("observed").astype(bool),
        stages=stages,
        snr_reprojection_db=get("snr_reprojection"),
        snr_initial_db=get("snr_initial"),
        snr_rigid_db=get("snr_rigid"),
        snr_final_db=get("snr_final"),
        snr_noise_db=get("snr_noise"),
        residual_initial=get("residual_initial").astype(np.float32),
        residual_rigid=get("residual_rigid").astype(np.float32),
        residual_final=get("residual_final").astype(np.float32),
        residual_tests=ResidualTests(
            **{each.name: float(attrs[f"residual_{each.name}"]) for each in fields(ResidualTests)}
        )
        if "residual_chi2_reduced" in attrs
        else None,
        std_by_source={
            str(name): (float(values[0]), float(values[1]), float(values[2]))
            for name, values in zip(data["source"].values, get("std_by_source"), strict=True)
        }
        if "source" in data
        else {},
        verdict=Verdict(
            doubts=tuple(Doubt(**{**each, "steps": tuple(each["steps"])}) for each in json.loads(str(attrs["doubts"])))
        ),
        seconds={
            name.removeprefix("seconds_"): float(value)
            for name, value in attrs.items()
            if str(name).startswith("seconds_")
        },
        options=str(attrs["options"]),
        versions=str(attrs["versions"]),
    )
