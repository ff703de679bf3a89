"""The Measurement record: what was recovered, how well it fits, and its NetCDF file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pdvc.sections import SectionBasis

Floats = NDArray[np.float64]
FORMAT = 1
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
    stop_reason: str
    """Why the stage ended, and what a user can do about it."""

    @property
    def modes(self) -> int:
        """Return the number of modes found."""
        return len(self.temporal)


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


def write_measurement(measurement: Measurement, path: Path) -> None:
    """Write the measurement as NetCDF, under its name only when it is complete."""
    m = measurement
    data = xr.Dataset(
        {
            "angle": ("step", m.angle_rad, {"units": "rad"}),
            "time": ("step", m.time_s, {"units": "s"}),
            "force": ("step", m.force_N, {"units": "N"}),
            "section_height": ("section", m.basis.height_mm, {"units": "mm"}),
            "time_functions": (("function", "step"), m.time_functions),
            "amplitude": (("step", "section", "motion"), m.amplitude, {"units": "voxel"}),
            "amplitude_std": (("step", "section", "motion"), m.amplitude_std, {"units": "voxel"}),
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
        coords={"motion": list(m.basis.motions)},
        attrs={
            "format": FORMAT,
            "title": m.title,
            "voxel_mm": m.voxel_mm,
            "source_axis_mm": m.source_axis_mm,
            "section_radius_mm": m.basis.radius_mm,
            "window": np.array(m.window),
            "options": m.options,
            "versions": m.versions,
            **{f"seconds_{name}": value for name, value in m.seconds.items()},
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
        for key in ("name", "scale", "solver", "unknowns", "stop_reason"):
            data.attrs[f"{name}_{key}"] = getattr(stage, key)
    data.attrs["stages"] = len(m.stages)
    packed = {name: _packing(data[name].values) for name in data if str(name).startswith("residual_")}
    partial = path.with_name(path.name + ".partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    data.to_netcdf(partial, engine="h5netcdf", encoding=packed)
    partial.replace(path)


def _packing(values: NDArray[np.float32]) -> dict[str, object]:
    """Return how to store grey levels as 16-bit integers: in steps of 1e-4, or coarser ones if they need it."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    return {"dtype": "int16", "scale_factor": max(1e-4, largest / 32767), "_FillValue": -32768}


def read_measurement(path: Path) -> Measurement:
    """Read a measurement file; raises MeasurementError where it is none."""
    if not path.is_file():
        raise MeasurementError(f"{path}: expected a measurement file, found none")
    try:
        with xr.open_dataset(path, engine="h5netcdf") as data:
            if data.attrs.get("format") != FORMAT:
                raise ValueError(f"found format {data.attrs.get('format')}")
            return _unpack(data.load())
    except (OSError, KeyError, ValueError) as error:
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
            stop_reason=str(attrs[f"{name}_stop_reason"]),
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
        seconds={
            name.removeprefix("seconds_"): float(value)
            for name, value in attrs.items()
            if str(name).startswith("seconds_")
        },
        options=str(attrs["options"]),
        versions=str(attrs["versions"]),
    )
