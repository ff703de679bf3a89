"""What the simulator knows and the measurement does not: the folder `truth` of an experiment.

`truth/scenario.toml` is the resolved scenario. `truth/displacement.nc` holds the displacement U(X, t) of
material points X, at `level` heights with five points each, in this order: the axis, and the four points
halfway from there to the corners of the section, counter-clockwise. Point number = 5 level + place.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pdvc.settings import SettingsError
from pdvc.whole import read_netcdf, write_netcdf, write_whole
from simulator.scenario import Course, Scenario
from simulator.specimen import section_mm, turn

Floats = NDArray[np.float64]

SCENARIO = "truth/scenario.toml"
DISPLACEMENT = "truth/displacement.nc"
LEVELS = 81
POINTS_PER_LEVEL = 5
FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The true motion of a grid of material points, in the frame of `pdvc.geometry`."""

    level_mm: Floats
    """Heights of the levels in the reference configuration (level,), mm, increasing."""
    point_mm: Floats
    """Material points X in the reference configuration (point, 3), mm; five for each level."""
    displacement_mm: Floats
    """U(X, t) = x - X (step, point, 3), mm."""
    force_N: Floats
    """Axial force without measurement noise (step,), N."""


def sample_truth(scenario: Scenario, course: Course) -> Truth:
    """Follow the material points over the height that the detector sees on the axis."""
    half = scenario.geometry.rows / 2 * scenario.geometry.cone_beam().voxel_mm
    level = np.linspace(-half, half, LEVELS)
    points = truth_points(scenario, level)
    moved = [course.motion.forward(points, step) - points for step in range(len(course.test_time_s))]
    return Truth(level_mm=level, point_mm=points, displacement_mm=np.stack(moved), force_N=course.history.force_N)


def truth_points(scenario: Scenario, level_mm: Floats) -> Floats:
    """Return the five material points of each level, (point, 3), mm."""
    half_x, half_y = section_mm(scenario.specimen, level_mm)
    place = np.array([[0, 0], [-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    points = np.empty((len(level_mm), POINTS_PER_LEVEL, 3))
    points[..., 0] = half_x[:, None] * place[:, 0]
    points[..., 1] = half_y[:, None] * place[:, 1]
    points[..., 2] = level_mm[:, None]
    return turn(scenario.specimen, points.reshape(-1, 3))


def write_scenario(folder: Path, scenario: Scenario) -> None:
    """Write the resolved scenario, whole or not at all."""
    write_whole(folder / SCENARIO, scenario.template().encode())


def write_truth(folder: Path, truth: Truth) -> None:
    """Write the displacement samples, whole or not at all."""
    dataset = xr.Dataset(
        {
            "point_mm": (("point", "component"), truth.point_mm, {"units": "mm"}),
            "displacement_mm": (("step", "point", "component"), truth.displacement_mm, {"units": "mm"}),
            "force_N": (("step",), truth.force_N, {"units": "N"}),
        },
        coords={
            "level_mm": (("level",), truth.level_mm, {"units": "mm"}),
            "component": ["x", "y", "z"],
        },
        attrs={"format": FORMAT, "points_per_level": POINTS_PER_LEVEL},
    )
    write_netcdf(folder / DISPLACEMENT, dataset)


def read_truth(folder: Path) -> Truth:
    """Read the displacement samples of an experiment folder; raises SettingsError where there are none."""
    path = folder / DISPLACEMENT
    if not path.is_file():
        raise SettingsError(f"{path}: expected the truth of a simulated experiment, found none")
    names = ("level_mm", "point_mm", "displacement_mm", "force_N")
    try:
        dataset = read_netcdf(path)
        return Truth(**{name: dataset[name].to_numpy() for name in names})
    except (KeyError, ValueError) as error:
        raise SettingsError(f"{path}: expected displacement samples, cannot read them: {error}") from None


def read_scenario(folder: Path) -> Scenario:
    """Read the scenario of a simulated experiment folder."""
    return Scenario.read(folder / SCENARIO)
