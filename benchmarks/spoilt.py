"""Copies of an experiment folder with faults of the scanner: python -m benchmarks.spoilt FROM TO --beam 0.01.

The counts of a folder, simulated or not, are changed as a beam that drifts, a scanner that moved, or zingers and
debris would have changed them; the rest, and the truth, are those of the folder it was made from.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from pdvc.correction import MOTION, motion_after, moved_back, view_motion
from pdvc.experiment import REFERENCE, TEST, Experiment, Series, read_experiment
from pdvc.radiographs import calibrate, grey_levels

Counts = NDArray[np.uint16]


def wandering_beam(experiment: Experiment, share: float) -> dict[str, Counts]:
    """Return all radiographs in a beam that wanders at random by about a share, and jumps by half of it."""
    rng, dark, found = np.random.default_rng(5), experiment.darks.mean(axis=0), {}
    for name, series in ((REFERENCE, experiment.reference), (TEST, experiment.test)):
        count = len(series)
        walk = np.cumsum(rng.normal(size=count)) / np.sqrt(count)
        beam = 1 + share * walk + share / 2 * rng.normal(size=count)
        counts = dark + beam[:, None, None] * (series.counts - dark)
        found[name] = np.rint(counts).clip(0, 65535).astype(np.uint16)
    return found


def moved_views(experiment: Experiment, motion_px: dict[str, float]) -> dict[str, Counts]:
    """Return all radiographs of a scanner that moved during the scan, by `motion_px` as in `pdvc.correction`.

    What drifted stays where the last view had it, and the stage does in the test what it did in the scan.
    """
    calibration, views, test = calibrate(experiment), experiment.reference, experiment.test

    def moved(series: Series, way: NDArray[np.float64]) -> Counts:
        grey = (grey_levels(counts, calibration) for counts in series.counts)
        images = [moved_back(image, -px) for image, px in zip(grey, way, strict=True)]
        counts = calibration.dark + calibration.open_beam * np.exp(-np.stack(images))
        return np.rint(counts).clip(0, 65535).astype(np.uint16)

    return {
        REFERENCE: moved(views, view_motion(motion_px, views.angle_rad, views.time_s)),
        TEST: moved(test, motion_after(motion_px, test.angle_rad)),
    }


def zingers(experiment: Experiment, count: int) -> dict[str, Counts]:
    """Return radiographs of the test with so many zingers each; in some a dead spot, in some a piece of debris."""
    counts, rng = experiment.test.counts.copy(), np.random.default_rng(5)
    steps, rows, columns = counts.shape
    for t in range(steps):
        for _ in range(count):
            counts[t, rng.integers(rows), rng.integers(columns)] = 65535
        if t % 10 == 3:
            counts[t, rng.integers(rows // 4, 3 * rows // 4)] //= 2
        if t % 10 == 7:
            row, column = rng.integers(rows // 4, 3 * rows // 4), rng.integers(columns // 3, 2 * columns // 3)
            spot = np.s_[t, row : row + 5, column : column + 5]
            counts[spot] = counts[spot] * 0.6
    return {TEST: counts}


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, metavar="FROM")
    parser.add_argument("to", type=Path, metavar="TO")
    parser.add_argument("--beam", type=float, metavar="SHARE", help="a beam that wanders by this share")
    parser.add_argument("--zingers", type=int, metavar="N", help="zingers in each radiograph, some dead lines, debris")
    parser.add_argument(
        "--views", nargs="+", metavar="NAME=PX", help=f"how views, and the test, moved; names: {', '.join(MOTION)}"
    )
    options = parser.parse_args()
    shutil.copytree(options.source, options.to)
    experiment = read_experiment(options.source)
    changed: dict[str, Counts] = {}
    if options.beam is not None:
        changed |= wandering_beam(experiment, options.beam)
    if options.zingers is not None:
        changed |= zingers(experiment, options.zingers)
    if options.views:
        pairs = (each.split("=", maxsplit=1) for each in options.views)
        changed |= moved_views(experiment, {name: float(px) for name, px in pairs})
    for name, counts in changed.items():
        tifffile.imwrite(options.to / name, counts)


if __name__ == "__main__":
    main()
