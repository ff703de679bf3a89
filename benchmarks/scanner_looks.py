"""What an experiment tells of its scanner before it is measured: python -m benchmarks.scanner_looks DIR [DIR ...].

Beam by the air beside the sample, trends of the reference views, what both would be doubted for if the motion were
stated with the deviations of `quick`, and the time of each look.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from pdvc.air_level import air_level, doubts_of_air, worth_voxel
from pdvc.experiment import read_experiment
from pdvc.options import DEFAULT
from pdvc.preparation import at_rest
from pdvc.scanner_checks import reference_trends
from pdvc.setup import set_up
from pdvc.view_trends import doubts_of_views

STATED_VOXEL = {"across_voxel": 0.0035, "vertical_voxel": 0.011, "along_voxel": 0.1}
"""Deviations across the beam, vertical and along the beam, about those of `quick`."""


def look(folder: Path) -> None:
    """Print what a folder tells."""
    experiment = read_experiment(folder)
    setup = set_up(experiment, DEFAULT)
    scale, distance = max(setup.options.scales), setup.geometry.source_axis_mm / setup.geometry.voxel_mm
    rest = at_rest(setup, scale)
    started = time.process_time()
    air, by_air = air_level(experiment, setup.calibration), time.process_time()
    trends, by_views = reference_trends(setup, rest, scale), time.process_time()
    print(f"{folder}: processor time {by_air - started:.2f} s for air, {by_views - by_air:.2f} s for the views")
    doubts = []
    if air is not None:
        worth = worth_voxel(experiment.reference.counts[0], setup.calibration, distance)
        off = air.test[:, 0].mean() - air.reference[:, 0].mean()
        print(
            f"  beam: {off:+.4%} of the test over the reference scan, {np.ptp(air.reference[:, 0]):.3%} within that, "
            f"each image +- {air.test[:, 1].mean():.4%}; a per cent is worth {worth / 100:.1f} voxel"
        )
        angles = experiment.reference.angle_rad, experiment.test.angle_rad
        doubts += doubts_of_air(air, *angles, worth_voxel=worth, stated_voxel=STATED_VOXEL["along_voxel"])
    if trends is not None:
        for name, (value, std) in vars(trends).items():
            print(f"  {name}: {value:+.5f} +- {std:.5f}")
        doubts += doubts_of_views(trends, **STATED_VOXEL, source_axis_voxel=distance)
    for doubt in doubts:
        print(f"  {doubt}")


def main() -> None:
    """Run from the command line."""
    for folder in sys.argv[1:]:
        look(Path(folder))


if __name__ == "__main__":
    main()
