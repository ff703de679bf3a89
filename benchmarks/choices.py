"""Show what the choices of the default protocol do to the error of `in-space` and `quick`.

Run with `python -m benchmarks.choices`; a quarter of an hour on two cores. Writes benchmarks/results/choices.csv.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.rows import Row, keep, show
from pdvc.experiment import read_experiment
from pdvc.gauss_newton import GaussNewton
from pdvc.options import MeasureOptions, StageOptions, paper_options
from pdvc.protocol import measure
from pdvc.sections import RIGID, names_of
from simulator.scanner import simulate
from simulator.scenario import load_scenario
from simulator.truth import read_truth
from validation.scoring.scores import score

DEFAULT = MeasureOptions()
TIME_FUNCTIONS = (*DEFAULT.deformation[:-1], StageOptions(scale=1, solver=GaussNewton()))
CHOICES = {
    "default": DEFAULT,
    "time functions": DEFAULT.model_copy(update={"deformation": TIME_FUNCTIONS}),
    "no contraction": DEFAULT.model_copy(update={"section_motions": names_of(RIGID)}),
    "systematic residual left": DEFAULT.model_copy(update={"subtract_systematic": False}),
    "fixed pattern left": DEFAULT.model_copy(update={"remove_pattern": False}),
    "views not sharpened": DEFAULT.model_copy(update={"sharpen": False}),
    "radiographs not filtered": DEFAULT.model_copy(update={"smooth_px": 0.0}),
    "weighted by noise": DEFAULT.model_copy(update={"weighting": "noise"}),
    "beam hardening left": DEFAULT.model_copy(update={"beam_hardening": "none"}),
    "paper protocol": paper_options(),
}


def main() -> None:
    """Simulate each scenario once, measure it in every way, print and keep a table."""
    rows: list[Row] = []
    for scenario in ("in-space", "quick"):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            simulate(load_scenario(scenario), folder / "experiment")
            experiment, truth = read_experiment(folder / "experiment"), read_truth(folder / "experiment")
            for choice, options in CHOICES.items():
                scores = score(measure(experiment, options, work=folder / "work"), truth)
                row: Row = {
                    "scenario": scenario,
                    "choice": choice,
                    "final_db": f"{scores.snr_db.final:.1f}",
                    "across_voxel": f"{scores.error_voxel.across_beam:.4f}",
                    "vertical_voxel": f"{scores.error_voxel.vertical:.4f}",
                    "along_voxel": f"{scores.error_voxel.along_beam:.3f}",
                    "strain_rms": f"{scores.strain_rms:.1e}",
                    "z_along": f"{scores.calibration.z_rms.along_beam:.2f}",
                }
                rows.append(row)
                show(row)
    keep(rows, "choices")


if __name__ == "__main__":
    main()
