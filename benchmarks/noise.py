"""Show how the error of `in-space` falls with the noise, and what sets its floor.

Run with `python -m benchmarks.noise`; about four minutes on two cores. Writes benchmarks/results/noise.csv.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.rows import Row, keep, show
from pdvc.experiment import read_experiment
from pdvc.options import MeasureOptions
from pdvc.protocol import measure
from simulator.scanner import simulate
from simulator.scenario import Scenario, load_scenario
from simulator.truth import read_truth
from validation.scoring.scores import score

CASES = (
    (1e3, 150, 1),
    (4e3, 150, 1),
    (1.6e4, 150, 1),
    (1e5, 150, 1),
    (4e5, 150, 1),
    (4e6, 150, 1),
    (4e6, 600, 1),
    (4e6, 300, 2),
)
"""Photons for each pixel and frame, reference views, and how many times finer the pixels are."""


def variant(photons: float, views: int, finer: int) -> Scenario:
    """Return in-space with other numbers of photons (pixel and frame), reference views, and pixels per length."""
    base = load_scenario("in-space")
    geometry = base.geometry
    return base.model_copy(
        update={
            "detector": base.detector.model_copy(update={"photons_per_pixel": photons}),
            "acquisition": base.acquisition.model_copy(update={"reference_views": views}),
            "geometry": geometry.model_copy(
                update={
                    "pixel_mm": geometry.pixel_mm / finer,
                    "rows": geometry.rows * finer,
                    "columns": geometry.columns * finer,
                }
            ),
            "discarded_rows": base.discarded_rows * finer,
        }
    )


def main() -> None:
    """Simulate, measure and score each variant; print and keep a table."""
    rows: list[Row] = []
    for photons, views, finer in CASES:
        with tempfile.TemporaryDirectory() as folder:
            simulate(variant(photons, views, finer), Path(folder))
            measurement = measure(read_experiment(Path(folder)), MeasureOptions())
            scores = score(measurement, read_truth(Path(folder)))
        micrometres = measurement.recording.voxel_mm * 1e3
        row: Row = {
            "photons": f"{photons:.0f}",
            "views": views,
            "voxel_um": f"{micrometres:.1f}",
            "noise_limit_db": f"{scores.snr_db.noise_limit:.1f}",
            "final_db": f"{scores.snr_db.final:.1f}",
            "across_voxel": f"{scores.error_voxel.across_beam:.4f}",
            "vertical_voxel": f"{scores.error_voxel.vertical:.4f}",
            "along_voxel": f"{scores.error_voxel.along_beam:.3f}",
            "across_um": f"{scores.error_voxel.across_beam * micrometres:.3f}",
            "vertical_um": f"{scores.error_voxel.vertical * micrometres:.3f}",
            "strain_rms": f"{scores.strain_rms:.1e}",
        }
        rows.append(row)
        show(row)
    keep(rows, "noise")


if __name__ == "__main__":
    main()
