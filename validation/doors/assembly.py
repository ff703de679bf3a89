"""A reference scan and a test, each of any format, put together into one experiment and its folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.experiment import (
    DARKS,
    DESCRIPTION,
    FLATS,
    REFERENCE,
    TEST,
    Description,
    Experiment,
    GeometryEntry,
    Series,
    StackEntry,
    StackWriter,
    write_description,
)
from pdvc.progress import Progress, silent
from validation.doors.quantities import FORCE, TIME
from validation.doors.refusal import FormatError, refused
from validation.doors.scan import Floats, Images, Scan
from validation.doors.tables import read_table
from validation.doors.tiff import FORCES

NEEDED = ("source_axis_mm", "source_detector_mm", "pixel_mm")
SAME = 1e-6
"""Share by which two files may differ in what they tell of the same scanner: what rounding leaves."""


@dataclass(frozen=True, kw_only=True)
class Assembled:
    """All of an experiment, its images still where they are."""

    description: Description
    images: Mapping[str, Images]
    """The stacks, by their place in the folder."""
    notes: tuple[str, ...]
    """What was taken for granted, one line each."""


def assembled(
    reference: Scan,
    test: Scan,
    *,
    given: Mapping[str, float] | None = None,
    flats: Images | None = None,
    darks: Images | None = None,
    title: str = "",
    material: str = "",
    acquisition: Mapping[str, float] | None = None,
) -> Assembled:
    """Put two scans together; what is `given` of the geometry, mm and degrees, stands above what the files tell.

    Flats and darks are the reference scan's, else the test's, unless given. Where nothing tells times and forces of
    the reference scan, views are counted and forces are zero: a measurement does not look at them. `acquisition` as
    `pdvc.experiment.AcquisitionEntry`. Raises FormatError or SettingsError, in one line, for what is missing, and
    where sizes or geometries differ.
    """
    notes = [*reference.notes, *(note for note in test.notes if note not in reference.notes)]
    reference_entry, test_entry = _at_rest(reference, notes), _under_load(test)
    images = {
        REFERENCE: reference.images,
        TEST: test.images,
        FLATS: _found("flats", flats, reference.flats, test.flats, reference.source),
        DARKS: _found("darks", darks, reference.darks, test.darks, reference.source),
    }
    size = reference.images.size
    for place, stack in images.items():
        if stack.size != size:
            expected = f"images of {size[0]} x {size[1]} px, as of {reference.source}"
            raise refused(test.source if place == TEST else place, "", expected, f"{stack.size[0]} x {stack.size[1]}")
    geometry = _geometry(reference, test, given or {})
    values = {
        "title": title or reference.title or test.title,
        "material": material,
        "geometry": {**geometry, "rows": size[0], "columns": size[1]},
        "acquisition": dict(acquisition or {}),
        "reference": reference_entry.model_dump(),
        "test": test_entry.model_dump(),
    }
    return Assembled(description=Description.parse(values, where=DESCRIPTION), images=images, notes=tuple(notes))


def write_folder(whole: Assembled, folder: Path, *, progress: Progress = silent) -> None:
    """Write an experiment folder, its description last; raises FormatError where there is one already."""
    if (folder / DESCRIPTION).exists():
        raise refused(folder, "", f"a folder without {DESCRIPTION}, or none yet", "an experiment")
    for place, stack in whole.images.items():
        path = folder / place
        for left in (path, *path.parent.glob(f"{path.name}.*")):  # of another import that was broken off
            left.unlink(missing_ok=True)
        with StackWriter(path, (stack.count, *stack.size)) as writer:
            for k in range(stack.count):
                writer.write(k, stack.read(k))
                progress(place, k + 1, stack.count)
    write_description(folder, whole.description)


def experiment_of(whole: Assembled) -> Experiment:
    """Return the experiment with all its images in memory, as `pdvc.read_experiment` returns it from a folder."""
    told, acquisition = whole.description, whole.description.acquisition
    return Experiment(
        title=told.title,
        material=told.material,
        geometry=told.geometry.cone_beam(),
        frames=acquisition.frames,
        photons_per_count=acquisition.photons_per_count,
        readout_noise_counts=acquisition.readout_noise_counts,
        reference=_series(whole.images[REFERENCE], told.reference),
        test=_series(whole.images[TEST], told.test),
        flats=_stack(whole.images[FLATS]),
        darks=_stack(whole.images[DARKS]),
    )


def forces_during(
    path: Path, time_s: Floats, *, time_column: str = "time", force_column: str | None = None, clock_s: float = 0.0
) -> Floats:
    """Return the force (radiograph,), N, by a testing machine's record, at the times (radiograph,), s, of radiographs.

    `clock_s` is what the machine's clock shows when the scanner's shows 0. Forces are interpolated linearly; raises
    FormatError, in one line, where times of the record do not increase, or do not cover those of the radiographs.
    """
    table = read_table(path)
    time = table.numbers([time_column], TIME)
    force = table.numbers(FORCES if force_column is None else [force_column], FORCE)
    if np.any(np.diff(time) <= 0):
        line = table.lines[int(np.flatnonzero(np.diff(time) <= 0)[0]) + 1]
        raise refused(path, f"line {line}: time", "times that increase", "one that does not")
    wanted = time_s + clock_s
    if wanted.min() < time[0] or wanted.max() > time[-1]:
        raise refused(
            path, "time", f"a record of {wanted.min():g} to {wanted.max():g} s", f"{time[0]:g} to {time[-1]:g} s"
        )
    return np.asarray(np.interp(wanted, time, force))


def _at_rest(scan: Scan, notes: list[str]) -> StackEntry:
    """Return what was recorded with the reference scan, with what is not told filled in, and noted."""
    count = scan.images.count
    if scan.time_s is None:
        notes.append(f"{scan.source}: no times: views of the reference scan are counted, 0 s, 1 s, ...")
    if scan.force_N is None:
        notes.append(f"{scan.source}: no forces: zeros for the reference scan")
    return _recorded(
        _told(scan, "angle_deg"),
        np.arange(float(count)) if scan.time_s is None else scan.time_s,
        np.zeros(count) if scan.force_N is None else scan.force_N,
    )


def _under_load(scan: Scan) -> StackEntry:
    return _recorded(*(_told(scan, key) for key in ("angle_deg", "time_s", "force_N")))


def _recorded(angle_deg: Floats, time_s: Floats, force_N: Floats) -> StackEntry:
    return StackEntry(
        angle_deg=tuple(angle_deg.tolist()), time_s=tuple(time_s.tolist()), force_N=tuple(force_N.tolist())
    )


def _told(scan: Scan, key: str) -> Floats:
    values: Floats | None = getattr(scan, key)
    if values is None:
        raise refused(scan.source, key, f"{scan.images.count} numbers, one for each radiograph", f"none{_HOW[key]}")
    return values


_HOW = {
    "angle_deg": ": give a table (--reference-table, --test-table)",
    "time_s": ": give --period-s, or a table (--test-table)",
    "force_N": ": give --forces, a table (--test-table), or --no-forces",
}


def _found(name: str, given: Images | None, first: Images | None, second: Images | None, source: Path) -> Images:
    for images in (given, first, second):
        if images is not None:
            return images
    raise refused(source, name, "at least one image", f"none: give --{name}")


def _geometry(reference: Scan, test: Scan, given: Mapping[str, float]) -> dict[str, float]:
    """Return the geometry: what is given, else what the files tell, which must be the same."""
    result = dict(given)
    for key in GeometryEntry.model_fields:
        told = [(scan.source, scan.geometry[key]) for scan in (reference, test) if key in scan.geometry]
        if key in given or not told:
            continue
        (first, value), (last, other) = told[0], told[-1]
        if abs(value - other) > SAME * max(abs(value), abs(other), 1.0):
            raise refused(last, key, f"{value:g} as in {first}", f"{other:g}: give --{key.replace('_', '-')}")
        result[key] = value
    missing = [key for key in NEEDED if key not in result]
    if missing:
        options = " and ".join(f"--{key.replace('_', '-')}" for key in missing)
        raise FormatError(
            f"{reference.source}: {', '.join(missing)}: expected a length, found none there nor in {test.source}: "
            f"give {options}, or --geometry"
        )
    return result


def _series(images: Images, entry: StackEntry) -> Series:
    return Series(
        counts=_stack(images),
        angle_rad=np.deg2rad(entry.angle_deg),
        time_s=np.asarray(entry.time_s),
        force_N=np.asarray(entry.force_N),
    )


def _stack(images: Images) -> NDArray[np.uint16]:
    return np.stack([images.read(k) for k in range(images.count)])
