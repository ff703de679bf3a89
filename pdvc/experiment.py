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

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Self

import numpy as np
import tifffile
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pdvc.geometry import ConeBeam
from pdvc.settings import Settings, SettingsError

DESCRIPTION = "experiment.toml"
REFERENCE = "reference/radiographs.tif"
TEST = "test/radiographs.tif"
FLATS = "flats.tif"
DARKS = "darks.tif"

Positive = Annotated[float, Field(gt=0)]


def interrupted_stack(scan: int) -> str:
    """Return the file, within the folder, of an interrupted scan, by its place among the [[interrupted]] entries."""
    return f"interrupted/{scan:02d}/radiographs.tif"


class ExperimentError(ValueError):
    """Say which file of an experiment folder is wrong, what was expected and what was found."""


class GeometryEntry(Settings):
    """The scanner: see `pdvc.geometry` for the frame."""

    source_axis_mm: Positive
    """distance from the source to the rotation axis, mm"""
    source_detector_mm: Positive
    """distance from the source to the detector, mm"""
    pixel_mm: Positive
    """pitch of the detector pixels as stored, mm"""
    rows: Annotated[int, Field(ge=1)]
    """detector rows as stored"""
    columns: Annotated[int, Field(ge=1)]
    """detector columns as stored"""
    column_shift_mm: float = 0.0
    """detector centre to the right of the source-axis line, mm"""
    row_shift_mm: float = 0.0
    """detector centre below the source-axis line, mm"""
    roll_deg: float = 0.0
    """detector turned in its plane, from columns towards rows, degrees"""

    @model_validator(mode="after")
    def _detector_behind_axis(self) -> Self:
        if self.source_detector_mm <= self.source_axis_mm:
            raise ValueError(f"source_detector_mm above source_axis_mm = {self.source_axis_mm} mm")
        return self

    def cone_beam(self) -> ConeBeam:
        """Return the geometry as a value, angles in rad."""
        values = self.model_dump()
        return ConeBeam(roll_rad=float(np.deg2rad(values.pop("roll_deg"))), **values)


class AcquisitionEntry(Settings):
    """How the counts were made. The noise entries may be left out: then the noise is not known."""

    frames: Annotated[int, Field(ge=1)] = 1
    """frames averaged into each stored image"""
    photons_per_count: Positive | None = None
    """detected photons that make one count of one frame"""
    readout_noise_counts: Annotated[float, Field(ge=0)] | None = None
    """standard deviation of the readout of one frame, counts"""


class StackEntry(Settings):
    """One stack of radiographs: one number for each image."""

    angle_deg: tuple[float, ...]
    """stage angle, counter-clockwise from above, degrees"""
    time_s: tuple[float, ...]
    """time of the middle of the exposure, s"""
    force_N: tuple[float, ...]
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
    """Hold a stack of radiographs and what was recorded with each."""

    counts: NDArray[np.uint16]
    """Counts (image, row, column); a memory map where the file allows."""
    angle_rad: NDArray[np.float64]
    time_s: NDArray[np.float64]
    force_N: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.counts)


@dataclass(frozen=True, kw_only=True)
class InterruptedScan:
    """Hold a full scan of the sample in the state of one step, while the test was held there."""

    step: int
    """Step of the test, counted from 0."""
    series: Series


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Hold everything that a measurement may look at."""

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


def read_experiment(folder: Path) -> Experiment:
    """Open an experiment folder; the stacks stay on disk where their TIFF is uncompressed.

    Raises ExperimentError or SettingsError, in one line, for whatever is missing, truncated or inconsistent.
    """
    if not folder.is_dir():
        raise ExperimentError(f"{folder}: expected an experiment folder, found none")
    description = Description.read(folder / DESCRIPTION)
    geometry = description.geometry.cone_beam()
    acquisition = description.acquisition
    return Experiment(
        title=description.title,
        material=description.material,
        geometry=geometry,
        frames=acquisition.frames,
        photons_per_count=acquisition.photons_per_count,
        readout_noise_counts=acquisition.readout_noise_counts,
        reference=_series(folder, REFERENCE, description.reference, "reference", geometry),
        test=_series(folder, TEST, description.test, "test", geometry),
        flats=_stack(folder / FLATS, geometry),
        darks=_stack(folder / DARKS, geometry),
        interrupted=tuple(
            InterruptedScan(
                step=entry.step,
                series=_series(folder, interrupted_stack(n), entry, f"interrupted.{n}", geometry),
            )
            for n, entry in enumerate(description.interrupted)
        ),
    )


def write_description(folder: Path, description: Description) -> None:
    """Write `experiment.toml`, which declares the folder complete: call it last."""
    path = folder / DESCRIPTION
    partial = path.with_suffix(".toml.partial")
    partial.write_text(description.template(), encoding="utf-8")
    partial.replace(path)


class StackWriter:
    """Write a stack image by image, under a provisional name until it is complete.

    A writer opened again on the same path and shape goes on where the last one stopped: `done` images
    are there already. Use as a context manager; the file gets its name only if all images were written.
    """

    def __init__(self, path: Path, shape: tuple[int, int, int]) -> None:
        self.path = path
        self._partial = path.with_name(path.name + ".partial")
        self._count = path.with_name(path.name + ".count")
        self._shape = shape
        path.parent.mkdir(parents=True, exist_ok=True)
        self.done = self._resume()
        if self.done < 0:
            self.done = 0
            path.unlink(missing_ok=True)
            self._count.write_text("0")
            # the whole file is laid out now, so that a full disk is met before the work, not after it
            with tifffile.TiffWriter(self._partial, bigtiff=_too_large(shape)) as tiff:
                blank = np.zeros(shape[1:], dtype=np.uint16)
                tiff.write((blank for _ in range(shape[0])), shape=shape, dtype=np.uint16, photometric="minisblack")
        self._map: Any = _open_map(self._partial, shape) if self.done < shape[0] else None

    def write(self, index: int, image: NDArray[np.uint16]) -> None:
        """Store the next image, counts (row, column); images come in order."""
        if index != self.done or self._map is None:
            raise ValueError(f"{self.path}: expected image {self.done} next, got {index}")
        self._map[index] = image
        self.done += 1
        if self.done % 16 == 0:
            self._save()

    def _resume(self) -> int:
        if self.path.exists() and not self._partial.exists():
            with tifffile.TiffFile(self.path) as tiff:
                series = tiff.series[0]
                complete = series.size == int(np.prod(self._shape)) and series.dtype == np.uint16
            return self._shape[0] if complete else -1
        if not (self._partial.exists() and self._count.exists()):
            return -1
        try:
            found = tifffile.memmap(self._partial, mode="r")
            if found.size != int(np.prod(self._shape)):
                return -1
            return min(int(self._count.read_text()), self._shape[0])
        except (ValueError, OSError, tifffile.TiffFileError):
            return -1

    def _save(self) -> None:
        self._map.flush()
        self._count.write_text(str(self.done))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._map is not None:
            self._save()
            self._map = None
        # a process that was killed between the last image and its name left only the naming to do
        if self.done == self._shape[0] and self._partial.exists():
            self._partial.replace(self.path)
            self._count.unlink()


def _open_map(path: Path, shape: tuple[int, int, int]) -> Any:
    pages = tifffile.memmap(path, mode="r+")
    assert isinstance(pages, np.memmap)
    # tifffile drops an axis of length one
    return np.memmap(path, dtype=pages.dtype, mode="r+", offset=pages.offset, shape=shape)


def _too_large(shape: Sequence[int]) -> bool:
    return int(np.prod(shape)) * 2 > 2**32 - 2**25


def _series(folder: Path, name: str, entry: StackEntry, key: str, geometry: ConeBeam) -> Series:
    counts = _stack(folder / name, geometry)
    if len(counts) != len(entry.angle_deg):
        raise ExperimentError(
            f"{folder / name}: expected {len(entry.angle_deg)} radiographs, "
            f"one for each {key}.angle_deg in {DESCRIPTION}, found {len(counts)}"
        )
    return Series(
        counts=counts,
        angle_rad=np.deg2rad(entry.angle_deg),
        time_s=np.asarray(entry.time_s),
        force_N=np.asarray(entry.force_N),
    )


def _stack(path: Path, geometry: ConeBeam) -> NDArray[np.uint16]:
    counts = _read_tiff(path)
    if counts.dtype.newbyteorder("=") != np.uint16:  # ImageJ writes big-endian
        raise ExperimentError(f"{path}: expected uint16 counts, found {counts.dtype}")
    if counts.ndim == 2:
        counts = counts[None]
    if counts.shape[1:] != (geometry.rows, geometry.columns):
        raise ExperimentError(
            f"{path}: expected (image, {geometry.rows}, {geometry.columns}) as in {DESCRIPTION}, found {counts.shape}"
        )
    return counts


def _declared_images(tiff: tifffile.TiffFile) -> int | None:
    """Return how many images the file's own notes promise, as tifffile and ImageJ write them; None without."""
    for notes in tiff.shaped_metadata or ():
        if "shape" in notes:
            return int(np.prod(notes["shape"][:-2]))
    images = (tiff.imagej_metadata or {}).get("images")
    return None if images is None else int(images)


def _read_tiff(path: Path) -> NDArray[Any]:
    if not path.is_file():
        raise ExperimentError(f"{path}: expected a TIFF stack, found none")
    try:
        with tifffile.TiffFile(path) as tiff:
            if len(tiff.series) != 1:
                raise ExperimentError(f"{path}: expected one stack of equal images, found {len(tiff.series)} series")
            series = tiff.series[0]
            needed = series.dataoffset + series.nbytes if series.dataoffset is not None else 0
            if path.stat().st_size < needed:
                raise ExperimentError(f"{path}: truncated: expected {needed} bytes, found {path.stat().st_size}")
            declared = _declared_images(tiff)
            if declared is not None and declared != len(tiff.pages) and declared != len(series):
                raise ExperimentError(f"{path}: truncated: expected {declared} images, found {len(tiff.pages)}")
            if series.dataoffset is not None:
                return tifffile.memmap(path, mode="r")
            return series.asarray()
    except ExperimentError:
        raise
    except (tifffile.TiffFileError, ValueError, OSError, LookupError, struct.error, zlib.error) as error:
        raise ExperimentError(f"{path}: expected a TIFF stack, cannot read it: {error}") from None


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
