"""What a laboratory hands over, and what it tells besides, as one record; and the experiment that it makes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from validation.doors.assembly import Assembled, assembled, forces_during
from validation.doors.formats import read_scan
from validation.doors.geometry_files import read_geometry
from validation.doors.refusal import FormatError, refused
from validation.doors.scan import Floats, Images, Scan
from validation.doors.tiff import read_images, read_recorded


@dataclass(frozen=True, kw_only=True)
class ForceRecord:
    """The record of a testing machine: `validation.doors.assembly.forces_during` tells how it is read."""

    path: Path
    time_column: str = "time"
    force_column: str | None = None
    clock_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Request:
    """The files of an experiment, and what they do not tell."""

    reference: str
    """A path, or FILE::ENTRY, as `validation.doors.formats.read_scan` takes it."""
    test: str
    flats: Path | None = None
    """A TIFF stack or a folder of TIFFs, in place of what the scans hold."""
    darks: Path | None = None
    reference_table: Path | None = None
    """Angles, times and forces, a line for each view: stands above what the files tell."""
    test_table: Path | None = None
    period_s: float | None = None
    """Time from one radiograph of the test to the next."""
    start_s: float = 0.0
    """Time of its first one, with a period."""
    forces: ForceRecord | None = None
    no_forces: bool = False
    """Whether no force was recorded: zeros are written."""
    geometry_file: Path | None = None
    geometry: Mapping[str, float] = field(default_factory=dict)
    """Keys of `pdvc.experiment.GeometryEntry`, mm and degrees: stand above what files tell."""
    mirror_columns: bool = False
    """Whether images are stored left to right exchanged, beyond what the format says; and so on."""
    mirror_rows: bool = False
    turn_back: bool = False
    title: str = ""
    material: str = ""
    acquisition: Mapping[str, float] = field(default_factory=dict)
    """As `pdvc.experiment.AcquisitionEntry`."""

    def assembled(self) -> Assembled:
        """Read what is asked for, and put it together; raises FormatError or SettingsError, in one line."""
        if self.forces is not None and self.no_forces:
            raise FormatError("--no-forces: expected without --forces, found both")
        in_file: Mapping[str, float] = {}
        angle_deg: Floats | None = None
        if self.geometry_file is not None:
            in_file, angle_deg = read_geometry(self.geometry_file)
        given = {**in_file, **self.geometry}
        reference = self._scan(self.reference, self.reference_table, given)
        if reference.angle_deg is None and angle_deg is not None:
            reference = replace(reference, angle_deg=angle_deg)
        return assembled(
            reference,
            self._with_forces(self._with_times(self._scan(self.test, self.test_table, given))),
            given=given,
            flats=self._images(self.flats),
            darks=self._images(self.darks),
            title=self.title,
            material=self.material,
            acquisition=self.acquisition,
        )

    def _scan(self, name: str, table: Path | None, given: Mapping[str, float]) -> Scan:
        scan = read_scan(name, given)
        if table is not None:
            scan = scan.told(read_recorded(table))
        scan = scan.mirrored(columns=self.mirror_columns, rows=self.mirror_rows)
        return scan.turned_back() if self.turn_back else scan

    def _images(self, path: Path | None) -> Images | None:
        return None if path is None else read_images(path).mirrored(columns=self.mirror_columns, rows=self.mirror_rows)

    def _with_times(self, test: Scan) -> Scan:
        if self.period_s is None:
            return test
        return replace(test, time_s=self.start_s + self.period_s * np.arange(float(test.images.count)))

    def _with_forces(self, test: Scan) -> Scan:
        if self.no_forces:
            return replace(test, force_N=np.zeros(test.images.count))
        if self.forces is None:
            return test
        if test.time_s is None:
            raise refused(
                test.source, "time_s", "times of the radiographs, to look up --forces at", "none: give --period-s"
            )
        record = self.forces
        found = forces_during(
            record.path,
            test.time_s,
            time_column=record.time_column,
            force_column=record.force_column,
            clock_s=record.clock_s,
        )
        return replace(test, force_N=found)
