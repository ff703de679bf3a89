"""Scans of any format, by the ending of their name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from validation.doors.nikon import read_nikon
from validation.doors.north_star import read_north_star
from validation.doors.nxtomo import read_nxtomo
from validation.doors.refusal import refused
from validation.doors.scan import Scan
from validation.doors.tiff import SUFFIXES, read_table_scan, read_tiff_scan

NXTOMO = (".nx", ".nxs", ".h5", ".hdf5", ".hdf", ".nexus")
NORTH_STAR = (".nsipro", ".nsihdr")
KNOWN = f"{', '.join(NXTOMO)} (NXtomo), .xtekct (Nikon), .nsipro (North Star), .csv or a folder (single TIFFs), .tif"


def read_scan(name: str, given: Mapping[str, float] | None = None) -> Scan:
    """Read a scan; `name` is a path, or FILE::ENTRY for an entry of an NXtomo file.

    What is `given` of the geometry elsewhere is not looked for. Raises FormatError, in one line, for a file of no
    known format and for whatever is wrong within.
    """
    given = given or {}
    file, _, entry = name.partition("::")
    path = Path(file)
    ending = path.suffix.lower()
    if ending in NXTOMO:
        return read_nxtomo(path, entry, given)
    if entry:
        raise refused(path, "", f"NXtomo before ::, {', '.join(NXTOMO)}", ending or "no ending")
    if ending == ".xtekct":
        return read_nikon(path, given)
    if ending in NORTH_STAR:
        return read_north_star(path)
    if ending == ".csv":
        return read_table_scan(path)
    if path.is_dir() or ending in SUFFIXES:
        return read_tiff_scan(path)
    raise refused(path, "", f"a scan: {KNOWN}", "another ending" if path.exists() else "none")
