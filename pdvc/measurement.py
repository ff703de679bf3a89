"""The Measurement record: what was recorded, the motion that was found, how well it fits, and how it was made."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pdvc.correction import Correction
from pdvc.deviations import step_covariance, strain_std, turned_std
from pdvc.sections import SectionBasis
from pdvc.verdict import UNCHECKED, Stop, Verdict

Floats = NDArray[np.float64]


class MeasurementError(ValueError):
    """A measurement cannot be read, or holds nothing to work with."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of the protocol as it was carried out: its modes in the order found, and why it stopped."""

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
    """How the final residual compares with the noise of radiographs, reference views and flats."""

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
class Recording:
    """What was recorded with the radiographs, and which part of them was used."""

    title: str
    voxel_mm: float
    """Voxel in which displacements are counted: a detector pixel seen at the rotation axis, mm."""
    source_axis_mm: float
    angle_rad: Floats
    """(step,)"""
    time_s: Floats
    """(step,)"""
    force_N: Floats
    """(step,)"""
    window: tuple[int, int, int, int]
    """Used part of the detector at scale 1: row_from, row_to, column_from, column_to."""
    brightness: Floats | None = None
    """Beam of each radiograph over that of the flats, by the air beside the sample, and its standard deviation
    (step, 2); None: not asked for, or no air seen."""

    @property
    def steps(self) -> int:
        """Return the number of steps."""
        return len(self.angle_rad)


@dataclass(frozen=True, kw_only=True)
class MeasuredMotion:
    """The motion that was found, and how well it is known."""

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
    std_by_source: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """What noise of radiographs, views and flats, and the prior, each make of the standard deviation of u on the axis:
    rms over steps and observed sections, voxels, across the beam, vertical, along the beam. Squares add up."""

    def displacement(self, step: int, points_mm: Floats) -> Floats:
        """Return u (point, 3) in voxels at points (point, 3) in mm of the current configuration of a step.

        NaN where an unobserved section takes part.
        """
        return self.basis.displacement(self.amplitude[step], points_mm)

    def step_covariance(self, step: int) -> Floats:
        """Return the covariance (unknown, unknown), voxel^2, of a step's amplitudes; NaN where it was not measured."""
        if not self.time_functions[:, step].any():
            return np.full((np.prod(self.basis.shape),) * 2, np.nan)
        return step_covariance(self.covariance, self.time_functions, step)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """How well the motion explains the radiographs."""

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
    outliers: NDArray[np.bool_] | None = None
    """(step, row, column) pixels of the window that were left out, where it was asked for."""
    residual_tests: ResidualTests | None = None
    """Whether the final residual is the noise that was expected; None: not asked."""

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns of the last stage."""
        return self.stages[-1].unknowns


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """How a measurement was made."""

    seconds: dict[str, float] = field(default_factory=dict)
    """Time spent, by part: at least ``reconstruct`` and ``measure``."""
    options: str = ""
    """The resolved options as TOML."""
    versions: str = ""
    """Versions of this package and of the libraries that compute."""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """A measured motion of a sample, with all that is known about it; `pdvc.measurement_file` keeps it in a file."""

    recording: Recording
    motion: MeasuredMotion
    fit: Fit
    provenance: Provenance = field(default_factory=Provenance)
    verdict: Verdict = UNCHECKED
    """What speaks against the measurement."""
    correction: Correction | None = None
    """What self-calibration found of the scanner, where it was asked for; the geometry was corrected by it."""

    def turned_std(self, step: int, points_mm: Floats) -> Floats:
        """Return the standard deviations (point, 3), voxels, across the beam, vertical and along the beam.

        At points (point, 3) in mm of the current configuration; from noise and prior.
        """
        angle_rad = float(self.recording.angle_rad[step])
        return turned_std(self.motion.basis, self.motion.step_covariance(step), angle_rad, points_mm)

    def strain_std(self, step: int, height_mm: Floats) -> Floats:
        """Return the standard deviation (height - 1,) of the axial strain between current heights on the axis."""
        return strain_std(self.motion.basis, self.motion.step_covariance(step), height_mm, self.recording.voxel_mm)


def unfitted(stages: tuple[Stage, ...], steps: int) -> Fit:
    """Return the fit of a method that compares no radiographs: SNRs are NaN, or empty, and residual fields empty."""
    nothing, unknown = np.zeros((steps, 0, 0), dtype=np.float32), np.full(steps, np.nan)
    return Fit(
        stages=stages,
        snr_reprojection_db=np.empty(0),
        snr_initial_db=unknown,
        snr_rigid_db=unknown,
        snr_final_db=unknown,
        snr_noise_db=unknown,
        residual_initial=nothing,
        residual_rigid=nothing,
        residual_final=nothing,
    )
