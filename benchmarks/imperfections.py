"""What each imperfection of a scanner costs: python -m benchmarks.imperfections [DIR [PART ...]].

Each part of the scenario `laboratory` alone, at its size there, on `quick`; then all of them: errors, how many of
them the 95 % intervals cover, and the verdict. Runs are kept in DIR (by default out/imperfections) and found again.
All of it takes some half an hour on 2 cores.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from benchmarks.rows import Row, keep, show
from pdvc.options import DEFAULT
from simulator.scenario import Scenario, load_scenario
from validation.job import Job, run

PARTS: dict[str, tuple[str, ...]] = {
    "quick": (),
    "across": ("misalignment.axis_across_mm", "misalignment.column_shift_mm"),
    "distances": ("misalignment.source_axis_mm", "misalignment.source_detector_mm"),
    "roll": ("misalignment.roll_deg",),
    "tilt-slant": ("misalignment.tilt_deg", "misalignment.slant_deg"),
    "row-shift": ("misalignment.row_shift_mm",),
    "lean": ("misalignment.lean_deg",),
    "stage": ("scanner.stage",),
    "shake": ("scanner.stage.shake_mm",),
    "turning-0.1": ("acquisition.exposure_samples", "acquisition.exposure_share"),
    "spot-size": ("scanner.focal_spot.size_mm",),
    "spot-drift": ("scanner.focal_spot.drift_mm", "scanner.focal_spot.drift_time_s"),
    "beam-drift": ("scanner.open_beam.drift_per_hour",),
    "current": ("scanner.open_beam.current_spread",),
    "open-beam": ("scanner.open_beam",),
    "scatter": ("scanner.scatter",),
    "panel-blur": ("detector.blur_px", "scanner.panel.scintillator_blur_px"),
    "gain-drift": ("scanner.panel.gain_drift_per_hour",),
    "nonlinearity": tuple(
        f"scanner.panel.{key}" for key in ("nonlinearity", "nonlinearity_spread", "saturation_counts")
    ),
    "bad-zingers": tuple(
        f"scanner.panel.{key}"
        for key in ("zingers_per_cm2_min", "zinger_counts", "bad_clusters", "bad_cluster_px", "bad_columns")
    ),
    "quick-lag": ("scanner.lag.share", "scanner.lag.time_s"),
    "afterglow": ("scanner.lag.afterglow_share", "scanner.lag.afterglow_time_s"),
    "lag": ("scanner.lag",),
}
"""Names of parts, and the keys that they take from `laboratory`."""
LATER = {"turning-1": {"exposure_samples": 9, "exposure_share": 1.0}}
"""Exposed all the time while the stage turns, as the paper's frames may have been; not in `laboratory`."""


def scenario_of(part: str) -> Scenario:
    """Return `quick` with one part of `laboratory`, or `laboratory` itself."""
    if part == "laboratory":
        return load_scenario(part)
    values: dict[str, Any] = load_scenario("quick").model_dump(mode="json")
    real: dict[str, Any] = load_scenario("laboratory").model_dump(mode="json")
    values["name"] = part
    values["acquisition"].update(LATER.get(part, {}))
    for key in PARTS.get(part, ()):
        to, of = values, real
        *tables, last = key.split(".")
        for table in tables:
            to, of = to[table], of[table]
        to[last] = of[last]
    return Scenario.parse(values, where=part)


def main() -> None:
    """Run the parts, print and keep a table."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/imperfections")
    rows: list[Row] = []
    for part in sys.argv[2:] or (*PARTS, *LATER, "laboratory"):
        scores = run(Job(scenario=scenario_of(part), options=DEFAULT, folder=folder / part)).scores
        errors, covered = vars(scores.error_voxel), vars(scores.calibration.coverage_95)
        rows.append(
            {
                "part": part,
                **{f"{name}, voxel": f"{error:.4f}" for name, error in errors.items()},
                "strain": f"{scores.strain_rms:.2e}",
                **{f"{name} covered": f"{share:.2f}" for name, share in covered.items()},
                "doubts": scores.doubts or "none",
            }
        )
        show(rows[-1])
    keep(rows, "imperfections")


if __name__ == "__main__":
    main()
