"""Compare a measurement by the process that compiles the kernels with later ones, bit by bit, and tell what it costs.

Run with `python -m benchmarks.first_use`; two minutes on two cores. Writes benchmarks/results/first_use.csv. Exit code
1 says that bits differ.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import xarray as xr

from benchmarks.rows import Row, keep, show
from pdvc.whole import read_netcdf

SCENARIO = "small"
CASES = (("compiles", {}), ("loads", {}), ("loads, one core", {"NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}))
"""Processes, one after the other, with one cache of kernels, empty at first."""


def measured(experiment: Path, file: Path, environment: dict[str, str]) -> xr.Dataset:
    """Measure an experiment in a process of its own; return what it wrote."""
    command = [sys.executable, "-m", "pdvc_bench", "measure", str(experiment), "-o", str(file)]
    subprocess.run(command, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, check=True)
    return read_netcdf(file)


def differing(one: xr.Dataset, other: xr.Dataset) -> list[str]:
    """Return the names of variables whose bits differ."""
    return [name for name in map(str, one.variables) if one[name].values.tobytes() != other[name].values.tobytes()]


def main() -> None:
    """Measure once for each case; print and keep a table."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        experiment = folder / "experiment"
        command = [sys.executable, "-m", "pdvc_bench", "simulate", SCENARIO, "-o", str(experiment)]
        subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
        first: xr.Dataset | None = None
        for k, (case, environment) in enumerate(CASES):
            environment = {"NUMBA_CACHE_DIR": str(folder / "cache"), **environment}
            found = measured(experiment, folder / f"{k}.nc", environment)
            first = first if first is not None else found
            apart = differing(first, found)

            row: Row = {
                "process": case,
                "compile_s": f"{found.attrs['seconds_compile']:.1f}",
                "differing": " ".join(apart) or "none",
            }
            rows.append(row)
            show(row)
    keep(rows, "first_use")
    sys.exit(any(row["differing"] != "none" for row in rows))


if __name__ == "__main__":
    main()
