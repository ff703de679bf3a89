"""Show how the error of `in-space` falls with the noise, and what sets its floor.

Run with `python benchmarks/noise.py`; about two minutes on two cores. Writes benchmarks/results/noise.csv.
"""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

from pdvc.experiment import read_experiment
from pdvc.measure import MeasureOptions, measure
from simulator.scanner import simulate
from simulator.scenario import Scenario, load_scenario
from simulator.truth import read_truth
from validation.scores import score

PHOTONS = (1e3, 4e3, 1.6e4, 1e5, 4e5, 4e6)
VIEWS = (150, 600)
"""The built-in scenario has 150 reference views; four times as many show their part in the floor."""
RESULTS = Path(__file__).parent / "results" / "noise.csv"


def variant(photons: float, views: int) -> Scenario:
    """Return in-space with another number of photons for each pixel and frame, and of reference views."""
    base = load_scenario("in-space")
    return base.model_copy(
        update={
            "detector": base.detector.model_copy(update={"photons_per_pixel": photons}),
            "acquisition": base.acquisition.model_copy(update={"reference_views": views}),
        }
    )


def main() -> None:
    """Simulate, measure and score each variant; print and keep a table."""
    rows = []
    for views in VIEWS:
        for photons in PHOTONS if views == VIEWS[0] else PHOTONS[-2:]:
            with tempfile.TemporaryDirectory() as folder:
                simulate(variant(photons, views), Path(folder))
                measurement = measure(read_experiment(Path(folder)), MeasureOptions())
                scores = score(measurement, read_truth(Path(folder)))
            row = {
                "photons": f"{photons:.0f}",
                "views": views,
                "noise_limit_db": f"{scores.snr_db.noise_limit:.1f}",
                "final_db": f"{scores.snr_db.final:.1f}",
                "across_beam": f"{scores.error_voxel.across_beam:.4f}",
                "across_random": f"{scores.random_voxel.across_beam:.4f}",
                "vertical": f"{scores.error_voxel.vertical:.4f}",
                "vertical_random": f"{scores.random_voxel.vertical:.4f}",
                "along_beam": f"{scores.error_voxel.along_beam:.3f}",
                "strain_rms": f"{scores.strain_rms:.1e}",
            }
            rows.append(row)
            print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    RESULTS.parent.mkdir(exist_ok=True)
    with RESULTS.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
