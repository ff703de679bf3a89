"""The Experiment record, and its folder on disk: what a scanner hands over, and nothing else.

A folder is readable without this software::

    experiment.toml              geometry, acquisition, and for each radiograph: angle, time, force
    reference/radiographs.tif    uint16 counts (view, row, column): a full turn, sample nearly unloaded
    test/radiographs.tif         uint16 counts (step, row, column): one radiograph per load step
    flats.tif                    uint16 counts (image, row, column), without the sample
    darks.tif                    uint16 counts (image, row, column), without X-rays
    interrupted/NN/radiographs.tif   uint16 counts (view, row, column): a full turn while the test was held at a
                                 step; none, or one for each [[interrupted]] entry, NN = 00, 01, ... in their order

`experiment.toml` is written last, so that a folder without it is known to be unfinished.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pdvc.geometry import ConeBeam
from pdvc.settings import Settings, SettingsError
from pdvc.stacks import DESCRIPTION, ExperimentError, StackWriter, read_stack
from pdvc.whole import write_whole

REFERENCE = "reference/radiographs.tif"
TEST = "test/radiographs.tif"
FLATS = "flats.tif"
DARKS = "darks.tif"

Length = Annotated[float, Field(gt=0, le=1e9)]
Shift = Annotated[float, Field(ge=-1e9, le=1e9)]
Pixels = Annotated[int, Field(ge=1, le=100_000)]
"""Rows or columns of a detector."""
Recorded = tuple[Annotated[float, Field(ge=-1e9, le=1e9)], ...]
"""One number for each radiograph; beyond these limits it is a slip, and powers of it overflow."""


def interrupted_stack(scan: int) -> str:
    """Return the file, within the folder, of an interrupted scan, by its place among the [[interrupted]] entries."""
    return f"interrupted/{scan:02d}/radiographs.tif"


class GeometryEntry(Settings):
    """The scanner: see `pdvc.geometry` for the frame."""

    source_axis_mm: Length
    """distance from the source to the rotation axis, mm"""
    source_detector_mm: Length
    """distance from the source to the detector, mm"""
    pixel_mm: Length
    """pitch of the detector pixels as stored, mm"""
    rows: Pixels
    """detector rows as stored"""
    columns: Pixels
    """detector columns as stored"""
    column_shift_mm: Shift = 0.0
    """detector centre to the right of the source-axis line, mm"""
    row_shift_mm: Shift = 0.0
    """detector centre below the source-axis line, mm"""
    roll_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """detector turned in its plane, from columns towards rows, degrees"""

    @model_validator(mode="after")
    def _detector_behind_axis(self) -> Self:
        if self.source_detector_mm <= self.source_axis_mm:
            raise ValueError(f"source_detector_mm above source_axis_mm = {self.source_axis_mm} mm")
        least = max(1e-9 * self.source_detector_mm, 1e-9)
        if self.pixel_mm < least or self.source_axis_mm < least:
            raise ValueError(f"pixel_mm and source_axis_mm of at least {least:.3g} mm, a billionth of the distances")
        return self

    def cone_beam(self) -> ConeBeam:
        """Return the geometry as a value, angles in rad."""
        values = self.model_dump()
        return ConeBeam(roll_rad=float(np.deg2rad(values.pop("roll_deg"))), **values)


class AcquisitionEntry(Settings):
    """How the counts were made. The noise entries may be left out: then the noise is not known."""

    frames: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """frames averaged into each stored image"""
    photons_per_count: Annotated[float, Field(gt=1e-6, le=1e12)] | None = None
    """detected photons that make one count of one frame"""
    readout_noise_counts: Annotated[float, Field(ge=0, le=65535)] | None = None
    """standard deviation of the readout of one frame, counts"""


class StackEntry(Settings):
    """One stack of radiographs: one number for each image."""

    angle_deg: Recorded
    """stage angle, counter-clockwise from above, degrees"""
    time_s: Recorded
    """time of the middle of the exposure, s"""
    force_N: Recorded
    """axial force on the sample, N"""

    @model_validator(mode="after")
    def _same_length(self) -> Self:
        lengths = {len(self.angle_deg), len(self.time_s), len(self.force_N)}
        if len(lengths) != 1 or 0 in lengths:
            raise ValueError(
                "one angle_deg, time_s and force_N for each radiograph "
                f"(found {len(self.angle_deg)}, {len(self.time_s)} and {len(self.force_N)})"
            )
        return self


class InterruptedEntry(StackEntry):
    """A full scan of the sample while the test was held at one of its steps."""

    step: Annotated[int, Field(ge=0)]
    """step of the test, counted from 0, at which it was held"""


class Description(Settings):
    """The whole of `experiment.toml`."""

    title: str = ""
    """a line for figures and reports"""
    material: str = ""
    """what the sample is made of, for the reader"""
    geometry: GeometryEntry
    """distances in mm, seen from above with the source on the left"""
    acquisition: AcquisitionEntry = AcquisitionEntry()
    """how each image was made"""
    reference: StackEntry
    """reference/radiographs.tif"""
    test: StackEntry
    """test/radiographs.tif"""
    interrupted: tuple[InterruptedEntry, ...] = ()
    """interrupted/NN/radiographs.tif, in this order: full scans while the test was held; usually none"""

    @model_validator(mode="after")
    def _held_at_steps_of_the_test(self) -> Self:
        check_held_steps(
            tuple(scan.step for scan in self.interrupted), len(self.test.angle_deg), "[[interrupted]] step"
        )
        return self


def check_held_steps(held: tuple[int, ...], steps: int, key: str) -> None:
    """Raise ValueError unless the steps at which a test was held are some of its steps, in order, none twice."""
    if any(later <= earlier for earlier, later in pairwise(held)):
        raise ValueError(f"{key}: increasing step numbers, got {', '.join(map(str, held))}")
    if held and held[-1] >= steps:
        raise ValueError(f"{key} below {steps}, the number of steps of the test, got {held[-1]}")


@dataclass(frozen=True, kw_only=True)
class Series:
    """A stack of radiographs and what was recorded with each."""

    counts: NDArray[np.uint16]
    """Counts (image, row, column); a memory map where the file allows."""
    angle_rad: NDArray[np.float64]
    time_s: NDArray[np.float64]
    force_N: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.counts)


@dataclass(frozen=True, kw_only=True)
class InterruptedScan:
    """A full scan of the sample in the state of one step, while the test was held there."""

    step: int
    """Step of the test, counted from 0."""
    series: Series


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Everything that a measurement may look at."""

    title: str
    material: str
    geometry: ConeBeam
    frames: int
    """Frames averaged into each image."""
    photons_per_count: float | None
    """Photons that make one count of one frame; None where the laboratory does not know."""
    readout_noise_counts: float | None
    """Readout noise of one frame, counts; None where the laboratory does not know."""
    reference: Series
    test: Series
    flats: NDArray[np.uint16]
    darks: NDArray[np.uint16]
    interrupted: tuple[InterruptedScan, ...] = ()
    """Full scans at some steps, in the order of the steps; only volume correlation looks at them."""


def read_experiment(folder: Path | str, *, planned: bool = False) -> Experiment:
    """Open an experiment folder; the stacks stay on disk where their TIFF is uncompressed.

    `planned`: the test is still to be made, of which only angles, times and forces are known, and has no counts.
    Raises ExperimentError or SettingsError, in one line, for whatever is missing, truncated or inconsistent.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ExperimentError(f"{folder}: expected an experiment folder, found none")
    description = Description.read(folder / DESCRIPTION)
    geometry = description.geometry.cone_beam()
    acquisition, size = description.acquisition, (geometry.rows, geometry.columns)
    return Experiment(
        title=description.title,
        material=description.material,
        geometry=geometry,
        frames=acquisition.frames,
        photons_per_count=acquisition.photons_per_count,
        readout_noise_counts=acquisition.readout_noise_counts,
        reference=_series(folder, REFERENCE, description.reference, "reference", geometry),
        test=_planned(description.test) if planned else _series(folder, TEST, description.test, "test", geometry),
        flats=read_stack(folder / FLATS, size),
        darks=read_stack(folder / DARKS, size),
        interrupted=tuple(
            InterruptedScan(
                step=entry.step,
                series=_series(folder, interrupted_stack(n), entry, f"interrupted.{n}", geometry),
            )
            for n, entry in enumerate(() if planned else description.interrupted)
        ),
    )


def write_description(folder: Path, description: Description) -> None:
    """Write `experiment.toml`, which declares the folder complete: call it last."""
    write_whole(folder / DESCRIPTION, description.template().encode())


def _series(folder: Path, name: str, entry: StackEntry, key: str, geometry: ConeBeam) -> Series:
    counts = read_stack(folder / name, (geometry.rows, geometry.columns))
    if len(counts) != len(entry.angle_deg):
        raise ExperimentError(
            f"{folder / name}: expected {len(entry.angle_deg)} radiographs, "
            f"one for each {key}.angle_deg in {DESCRIPTION}, found {len(counts)}"
        )
    return _recorded(counts, entry)


def _planned(entry: StackEntry) -> Series:
    return _recorded(np.zeros((len(entry.angle_deg), 0, 0), dtype=np.uint16), entry)


def _recorded(counts: NDArray[np.uint16], entry: StackEntry) -> Series:
    return Series(
        counts=counts,
        angle_rad=np.deg2rad(entry.angle_deg),
        time_s=np.asarray(entry.time_s),
        force_N=np.asarray(entry.force_N),
    )


__all__ = [
    "DESCRIPTION",
    "AcquisitionEntry",
    "Description",
    "Experiment",
    "ExperimentError",
    "GeometryEntry",
    "InterruptedEntry",
    "InterruptedScan",
    "Series",
    "SettingsError",
    "StackEntry",
    "StackWriter",
    "check_held_steps",
    "interrupted_stack",
    "read_experiment",
    "write_description",
]
