"""What many draws say of the methods: bias, random error, coverage of 95 % intervals, computing time."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pdvc.identify.result import CONFIDENT
from simulator.scenario import Scenario
from validation.identify.draws import METHODS
from validation.identify.truth import truth_of


def recovery(table: pd.DataFrame, scenario: Scenario) -> pd.DataFrame:
    """Return a row for each method and parameter of the draws that were done.

    Columns: `method`, `parameter`, `draws`, `true`, `bias` and `random`, both relative, `stated`, the rms of the
    stated relative deviations, `z`, the rms of errors over these, `covered`, the share of 95 % intervals that hold the
    truth, and `seconds`, the median.
    """
    done = table[table["status"] == "done"]
    rows = []
    for method in METHODS:
        for name, true in truth_of(scenario.loading).items():
            error = (done[f"{method}:{name}"] - np.log(true)).to_numpy()
            deviation = done[f"{method}:{name}_deviation"].to_numpy()
            told = np.isfinite(error)
            if not told.any():
                continue
            error, deviation = error[told], deviation[told]
            rows.append(
                {
                    "method": method,
                    "parameter": name,
                    "draws": int(told.sum()),
                    "true": true,
                    "bias": float(error.mean()),
                    "random": float(error.std(ddof=1)) if told.sum() > 1 else np.nan,
                    "stated": float(np.sqrt(np.mean(deviation**2))),
                    "z": float(np.sqrt(np.mean((error / deviation) ** 2))),
                    "covered": float(np.mean(np.abs(error) < CONFIDENT * deviation)),
                    "seconds": float(done[f"seconds_{method}"].median()),
                }
            )
    return pd.DataFrame(rows)
