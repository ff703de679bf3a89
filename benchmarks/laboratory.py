"""The scenario `laboratory` with and without corrections: python -m benchmarks.laboratory [DIR [SEEDS [NAME ...]]].

Errors, how many of them the 95 % intervals cover, and the doubts, for each seed and each set of corrections; the lag
of the panel is given as it was simulated, as if it had been measured. Measurements are kept in DIR (by default
out/laboratory) and found again, whatever has changed since. A seed takes some ten minutes on 2 cores.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from benchmarks.rows import Row, keep, show
from pdvc.experiment import DESCRIPTION, read_experiment
from pdvc.late_light import LatePart
from pdvc.measurement import Measurement
from pdvc.measurement_file import read_measurement, write_measurement
from pdvc.options import DEFAULT, MeasureOptions
from pdvc.protocol import measure
from simulator.scanner import simulate
from simulator.scenario import Scenario, load_scenario
from simulator.truth import read_truth
from validation.scoring.scores import Scores, score


def corrections(scenario: Scenario) -> dict[str, MeasureOptions]:
    """Return the sets of corrections, by name: none, those that are found, and the lag that is given, too."""
    found: dict[str, Any] = {"brightness": "air", "self_calibration": "motion", "outliers_over": 8.0}
    lag = scenario.scanner.lag
    parts = (
        LatePart(share=lag.share, time_s=lag.time_s),
        LatePart(share=lag.afterglow_share, time_s=lag.afterglow_time_s),
    )
    changes: dict[str, dict[str, Any]] = {"none": {}, "found": found, "all": {**found, "lag": parts}}
    return {name: DEFAULT.model_copy(update=change) for name, change in changes.items()}


def measured(scenario: Scenario, options: MeasureOptions, experiment: Path, file: Path) -> Measurement:
    """Return the measurement of a scenario, which is simulated first; each only where it is not there."""
    if file.exists():
        return read_measurement(file)
    if not (experiment / DESCRIPTION).exists():
        simulate(scenario, experiment)
    found = measure(read_experiment(experiment), options)
    write_measurement(found, file)
    return found


def row_of(name: str, scenario: Scenario, scores: Scores, measurement: Measurement) -> Row:
    """Return a row of the table."""
    errors, covered = vars(scores.error_voxel), vars(scores.calibration.coverage_95)
    return {
        "corrections": name,
        "seed": scenario.seed,
        **{f"{each}, voxel": f"{error:.4f}" for each, error in errors.items()},
        "strain": f"{scores.strain_rms:.2e}",
        **{f"{each} covered": f"{share:.2f}" for each, share in covered.items()},
        "doubts": scores.doubts or "none",
        "measure, s": f"{sum(measurement.provenance.seconds.values()):.0f}",
    }


def main() -> None:
    """Run the seeds, print and keep a table."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/laboratory")
    seeds = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    laboratory, rows = load_scenario("laboratory"), list[Row]()
    for seed in range(laboratory.seed, laboratory.seed + seeds):
        scenario = laboratory.model_copy(update={"seed": seed})
        for name, options in corrections(scenario).items():
            if name in (sys.argv[3:] or corrections(scenario)):
                measurement = measured(scenario, options, folder / f"experiment-{seed}", folder / f"{name}-{seed}.nc")
                scores = score(measurement, read_truth(folder / f"experiment-{seed}"), scenario=name)
                rows.append(row_of(name, scenario, scores, measurement))
                show(rows[-1])
    keep(rows, "laboratory")


if __name__ == "__main__":
    main()
