"""What is written for other programs, of a measurement and of an experiment, as one record; and writing it."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pdvc.experiment import Experiment, read_experiment
from pdvc.measurement import Measurement
from pdvc.measurement_file import read_measurement
from pdvc.options import DEFAULT, MeasureOptions
from pdvc.preparation import reference_volume
from pdvc.progress import Progress, silent
from pdvc.setup import Setup, set_up
from validation.doors.geometry_files import write_geometry
from validation.doors.motion_table import (
    check_parquet,
    default_points,
    motion_table,
    read_points,
    write_csv,
    write_parquet,
)
from validation.doors.nxtomo import write_nxtomo
from validation.doors.paraview import write_series
from validation.doors.refusal import FormatError, refused
from validation.doors.surface import surface_of
from validation.doors.volume_tiff import write_volume

OF_MEASUREMENT = ("vtk", "csv", "parquet")
OF_EXPERIMENT = ("volume", "geometry", "nxtomo")


@dataclass(frozen=True, kw_only=True)
class Export:
    """Where what is asked for goes; None: it is not asked for."""

    vtk: Path | None = None
    """A folder."""
    csv: Path | None = None
    parquet: Path | None = None
    points: Path | None = None
    """A table of points at which both tables ask; None: midway between sections."""
    gauge_mm: float | None = None
    """Length over which their strain is; None: the height of a section."""
    volume: Path | None = None
    geometry: Path | None = None
    series: str = "reference"
    """Whose angles the geometry is of: reference, test."""
    nxtomo: Path | None = None
    options: MeasureOptions | None = None
    """For what is made of an experiment, outline and volume; None: those of the measurement, or the default ones."""
    work: Path | None = None
    """Where these may be kept already, and are kept."""

    def write(self, source: Path, experiment: Path | None = None, *, progress: Progress = silent) -> list[Path]:
        """Write what is asked for, of a measurement file and its experiment folder, or of such a folder alone.

        Returns what was written. Raises ValueError, in one line, where what is asked for is not of what is given.
        """
        self._check(source, experiment)
        folder = source if source.is_dir() else experiment
        measurement = None if source.is_dir() else read_measurement(source)
        opened = None if folder is None else read_experiment(folder)
        setup = None
        if opened is not None and (self.vtk is not None or self.volume is not None):
            chosen = self.options or (DEFAULT if measurement is None else _options_of(measurement, source))
            setup = set_up(opened, chosen, work=self.work, progress=progress)
        written: list[Path] = []
        if measurement is not None:
            written += self._of_measurement(measurement, setup, progress)
        if opened is not None:
            written += self._of_experiment(opened, setup, progress)
        return written

    def _check(self, source: Path, experiment: Path | None) -> None:
        """Raise ValueError, or ImportError, unless what is asked for can be made of what is given."""
        asked = [name for name in (*OF_MEASUREMENT, *OF_EXPERIMENT) if getattr(self, name) is not None]
        if not asked:
            options = ", ".join(f"--{name}" for name in (*OF_MEASUREMENT, *OF_EXPERIMENT))
            raise FormatError(f"export: expected at least one of {options}, found none")
        if self.parquet is not None:
            check_parquet()
        if self.gauge_mm is not None and not self.gauge_mm > 0:
            raise refused("--gauge-mm", "", "a length above 0 mm", self.gauge_mm)
        if source.is_dir() and experiment is not None:
            raise refused("--experiment", "", "a measurement before it", f"{source}, a folder")
        for name in asked:
            if name in OF_MEASUREMENT and source.is_dir():
                raise refused(source, f"--{name}", "a measurement, as measure writes it", "an experiment folder")
            if name in OF_EXPERIMENT and not source.is_dir() and experiment is None:
                raise refused(source, f"--{name}", "an experiment: --experiment DIR", "a measurement alone")

    def _of_measurement(self, measurement: Measurement, setup: Setup | None, progress: Progress) -> Iterator[Path]:
        if self.vtk is not None:
            surface = surface_of(measurement, None if setup is None else setup.outline.hull)
            yield write_series(measurement, surface, self.vtk, progress=progress)
        if self.csv is not None or self.parquet is not None:
            points, gauge_mm = default_points(measurement)
            if self.points is not None:
                points = read_points(self.points)
            columns = motion_table(measurement, points, self.gauge_mm or gauge_mm)
            if self.csv is not None:
                write_csv(self.csv, columns)
                yield self.csv
            if self.parquet is not None:
                write_parquet(self.parquet, columns)
                yield self.parquet

    def _of_experiment(self, experiment: Experiment, setup: Setup | None, progress: Progress) -> Iterator[Path]:
        if self.volume is not None and setup is not None:
            write_volume(self.volume, reference_volume(setup, 1, progress))
            yield self.volume
        if self.geometry is not None:
            angle_rad = (experiment.test if self.series == "test" else experiment.reference).angle_rad
            write_geometry(self.geometry, experiment.geometry, angle_rad)
            yield self.geometry
        if self.nxtomo is not None:
            write_nxtomo(self.nxtomo, experiment)
            yield self.nxtomo


def _options_of(measurement: Measurement, source: Path) -> MeasureOptions:
    """Return the options by which a measurement was made."""
    return MeasureOptions.parse(tomllib.loads(measurement.provenance.options), where=f"{source}: options")
