"""Efficiency of the weighted direct solve on `in-space`, and what the rest is: python -m benchmarks.efficiency.

For each noise: the Cramer-Rao bound, the reference scan counted as data; what the standard deviation would be if only
the radiographs of the test were noisy, then with the noise of the reference views, then with that of the flats, which
is what the measurement states (the shares are those on the axis, at the sections); and the scatter over noise draws,
and the bias that they leave.
All in voxels, rms over material points and steps. Efficiency is bound over scatter. Some 4 minutes on 2 cores.
"""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, keep, show
from pdvc.gauss_newton import GaussNewton
from pdvc.history import PAPER
from pdvc.options import MeasureOptions, StageOptions
from pdvc.protocol import measure
from pdvc.sections import RIGID, names_of
from simulator.scenario import load_scenario
from validation.batch.trial import simulated
from validation.scoring.bound import bound_of
from validation.scoring.interval_calibration import interval_calibration
from validation.scoring.scores import point_errors
from validation.study.summary import estimates

DRAWS = 10
DIRECT = StageOptions(solver=GaussNewton(most_passes=12, least_change_voxel=2e-4))
OPTIONS = MeasureOptions(
    section_motions=names_of(RIGID),
    time=PAPER,
    weighting="noise",
    rigid=(DIRECT.model_copy(update={"scale": "coarse"}), DIRECT.model_copy(update={"scale": 2})),
    deformation=(DIRECT.model_copy(update={"scale": 2}), DIRECT),
)
"""The method `weighted`, with the bases of the scenario's motion."""


def main() -> None:
    """Carry out the draws, print and keep a table."""
    rows: list[Row] = []
    base = load_scenario("in-space")
    with tempfile.TemporaryDirectory() as name:
        shared = Path(name)
        for photons, readout in ((1e3, 30.0), (base.detector.photons_per_pixel, base.detector.readout_noise_counts)):
            detector = base.detector.model_copy(update={"photons_per_pixel": photons, "readout_noise_counts": readout})
            scenario = base.model_copy(update={"detector": detector})
            bound, truth = bound_of(scenario, OPTIONS, shared / "clean")
            errors, sources, stated = [], [], []
            for repetition in range(DRAWS):
                with simulated(scenario.model_copy(update={"repetition": repetition}), shared) as (experiment, _, _):
                    found = measure(experiment, OPTIONS)
                    errors.append(point_errors(found, truth).components)
                    sources.append(found.motion.std_by_source)
                    stated.append(asdict(interval_calibration(found, truth, errors[-1]).predicted))
            least = asdict(bound.quantities(truth.point_mm, truth.displacement_mm))
            for k, direction in enumerate(("across_beam", "vertical", "along_beam")):
                predicted = np.sqrt(np.mean([each[direction] ** 2 for each in stated]))
                square = {name: np.mean([each[name][k] ** 2 for each in sources]) for name in sources[0]}
                scale = predicted / np.sqrt(sum(square.values()))
                seen = estimates([each[..., k] for each in errors])
                row: Row = {
                    "photons": f"{photons:.0e}",
                    "direction": direction.replace("_", " "),
                    "bound": f"{least[direction]:.5f}",
                    "radiographs": f"{scale * np.sqrt(square['radiographs']):.5f}",
                    "and views": f"{scale * np.sqrt(square['radiographs'] + square['views']):.5f}",
                    "and flats": f"{predicted:.5f}",
                    "scatter": f"{seen['random'].value:.5f}",
                    "bias": f"{seen['bias'].value:.5f}",
                    "efficiency": f"{least[direction] / seen['random'].value:.2f}",
                }
                rows.append(row)
                show(row)
    keep(rows, "efficiency")


if __name__ == "__main__":
    main()
