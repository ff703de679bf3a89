"""Radiographs as TIFF: one stack, or a folder of single images, with or without a table of what was recorded.

A folder of single images has a table ``radiographs.csv``: a column ``file``, and what is known of ``angle``, ``time``
and ``force``, each with its unit (`validation.doors.tables`). Where there is a column ``step``, it tells the order;
else the lines do. Without a table, images come in the order of the numbers in their names, and nothing else is known.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tifffile

from pdvc.radiograph_table import TABLE
from pdvc.stacks import ExperimentError, read_radiograph, read_stack
from validation.doors.quantities import ANGLE, FORCE, TIME, Units
from validation.doors.refusal import FormatError, refused
from validation.doors.scan import Counts, Floats, Images, Recorded, Scan
from validation.doors.tables import TextTable, read_table

SUFFIXES = (".tif", ".tiff")
FORCES = ("force", "load")
"""Names that a column of forces may have."""


def read_tiff_stack(path: Path) -> Images:
    """Return the images of one TIFF; raises FormatError where it holds no stack of uint16 counts."""
    try:
        with tifffile.TiffFile(path) as tiff:
            rows, columns = (int(size) for size in tiff.series[0].shape[-2:])
        counts = read_stack(path, (rows, columns))
    except ExperimentError as error:
        raise FormatError(str(error)) from None
    except FileNotFoundError:
        raise refused(path, "", "a TIFF", "none") from None
    except Exception as error:  # a damaged header makes tifffile and what it calls raise errors of every kind
        raise refused(path, "", "a TIFF", error) from None
    return Images(count=len(counts), size=(rows, columns), read=lambda k: np.array(counts[k]).astype(np.uint16))


def read_tiff_files(paths: Sequence[Path], size: tuple[int, int] | None = None) -> Images:
    """Return images that are single TIFFs, of a size or else that of the first; each is checked when it is read."""
    if not paths:
        raise FormatError("expected at least one TIFF, found none")
    height, width = size or read_tiff_stack(paths[0]).size

    def read(k: int) -> Counts:
        try:
            return read_radiograph(paths[k], (height, width), where=f"the scan of {paths[0].name}").astype(np.uint16)
        except ExperimentError as error:
            raise FormatError(str(error)) from None

    return Images(count=len(paths), size=(height, width), read=read)


def tiffs_of(folder: Path, start: str = "") -> list[Path]:
    """Return the TIFFs of a folder whose names begin with `start`, in the order of the numbers in their names."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.name.startswith(start)]
    return sorted(found, key=lambda path: [int(part) if part.isdigit() else part for part in _parts(path.name)])


def read_images(path: Path) -> Images:
    """Return flats or darks: one TIFF stack, or a folder of TIFFs."""
    if not path.is_dir():
        return read_tiff_stack(path)
    found = tiffs_of(path)
    if not found:
        raise refused(path, "", "TIFFs", "none")
    return read_tiff_files(found)


def read_tiff_scan(path: Path) -> Scan:
    """Return a scan from one TIFF stack, or from a folder of single TIFFs and its table, if there is one."""
    if not path.is_dir():
        return Scan(source=path, images=read_tiff_stack(path))
    table = path / TABLE
    if not table.is_file():
        return Scan(source=path, images=read_images(path))
    return read_table_scan(table)


def read_table_scan(path: Path) -> Scan:
    """Return a scan from a table of single TIFFs, which lie relative to it."""
    table = read_table(path)
    files, order = table.texts("file"), _order(table)
    images = read_tiff_files([path.parent / files[k] for k in order])
    return Scan(source=path, images=images).told(_recorded(table))


def read_recorded(path: Path) -> Recorded:
    """Return what a table tells of angles, times and forces, one line for each radiograph."""
    return _recorded(read_table(path))


def _recorded(table: TextTable) -> Recorded:
    order = _order(table)

    def told(names: tuple[str, ...], units: Units) -> Floats | None:
        return table.numbers(names, units)[order] if table.has(*names) else None

    return Recorded(angle_deg=told(("angle",), ANGLE), time_s=told(("time",), TIME), force_N=told(FORCES, FORCE))


def _order(table: TextTable) -> list[int]:
    """Return the rows in the order of their steps; raises FormatError unless each step from 0 on has one."""
    if not table.has("step"):
        return list(range(len(table.lines)))
    steps = table.texts("step")
    places = {text: row for row, text in enumerate(steps)}
    missing = [str(step) for step in range(len(steps)) if str(step) not in places]
    if missing:
        raise refused(table.path, "step", f"each step from 0 to {len(steps) - 1} once", f"none {missing[0]}")
    return [places[str(step)] for step in range(len(steps))]


def _parts(name: str) -> list[str]:
    return re.split(r"(\d+)", name)
