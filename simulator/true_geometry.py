"""The true geometry of each radiograph, in `truth/geometry.nc`: what a calibration of the scanner has to find.

Of each image, in the frame of `pdvc.geometry` that turns with the sample's platter: source and middle of the
detector, mm, and the unit vectors of growing columns and rows. A point x is seen where the line from the source
through x meets the plane of the detector, middle + a column + b row. Misalignment, errors of the stage and drift of
the focal spot are all in these vectors; where an exposure takes part of a turn, they are those of its middle. The
displacements of `simulator.truth` are those of the sample on its platter: what the stage does is not in them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pdvc.settings import SettingsError
from pdvc.whole import read_netcdf, write_netcdf
from simulator.images import aligner_of
from simulator.scenario import Course, Scenario
from simulator.stacks import Stack, moment_of, stacks_of

Floats = NDArray[np.float64]

GEOMETRY = "truth/geometry.nc"
FORMAT = 1
_VECTORS = {"source_mm": "mm", "detector_mm": "mm", "column": "1", "row": "1"}


@dataclass(frozen=True, kw_only=True)
class Views:
    """Where source and detector were at each image of a stack, as the platter sees them; (image, 3) each."""

    source_mm: Floats
    detector_mm: Floats
    """Middle of the detector."""
    column: Floats
    """Unit vector of growing columns."""
    row: Floats
    """Unit vector of growing rows."""


def true_geometry(scenario: Scenario, course: Course) -> dict[str, Views]:
    """Return the true geometry of each stack, by the name of its group in the file."""
    aligner = aligner_of(scenario)
    angles = {
        "reference": course.reference_angle_rad,
        "test": course.test_angle_rad,
        "interrupted": course.interrupted_angle_rad,
    }
    found = {}
    for stack in stacks_of(scenario):
        views = [
            aligner.at(float(angle), moment_of(scenario, stack, index)).in_sample_frame()
            for index, angle in enumerate(angles[stack.kind])
        ]
        vectors = dict(zip(_VECTORS, np.swapaxes(np.array(views), 0, 1), strict=True))
        found[_group(stack)] = Views(**vectors)
    return found


def write_geometry(folder: Path, views: Mapping[str, Views]) -> None:
    """Write the true geometry, whole or not at all."""
    variables = {
        f"{group}_{name}": ((f"{group}_image", "component"), getattr(each, name), {"units": unit})
        for group, each in views.items()
        for name, unit in _VECTORS.items()
    }
    dataset = xr.Dataset(variables, coords={"component": ["x", "y", "z"]}, attrs={"format": FORMAT})
    write_netcdf(folder / GEOMETRY, dataset)


def read_geometry(folder: Path) -> dict[str, Views]:
    """Read the true geometry of an experiment folder; raises SettingsError where there is none."""
    path = folder / GEOMETRY
    if not path.is_file():
        raise SettingsError(f"{path}: expected the true geometry of a simulated experiment, found none")
    try:
        dataset = read_netcdf(path)
        groups = [str(name).removesuffix("_source_mm") for name in dataset if str(name).endswith("_source_mm")]
        return {group: Views(**{name: dataset[f"{group}_{name}"].to_numpy() for name in _VECTORS}) for group in groups}
    except (KeyError, ValueError) as error:
        raise SettingsError(f"{path}: expected the geometry of each radiograph, cannot read it: {error}") from None


def _group(stack: Stack) -> str:
    return stack.kind if stack.step is None else f"interrupted_{stack.step}"
