"""How straight grey levels are after beam hardening was fitted: python -m benchmarks.hardening [SCENARIO ...].

For a few paths L through the sample, d ln G / d ln L - 1 of the polynomial G(q) that is fitted to a scenario's
reference scan, along the exact attenuation q(L) of its beam in matrix and graphite, mixed evenly. Zero is due: a
section that becomes thinner by a per cent is then seen so. Of `quick` and `jailin2018`, some 2 minutes on 2 cores.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, keep, show
from pdvc.experiment import read_experiment
from pdvc.options import DEFAULT
from pdvc.setup import set_up
from simulator.scanner import simulate
from simulator.scenario import load_scenario
from simulator.xray import beam, direct_transmission

PATHS_MM = (0.7, 0.9, 1.1, 1.3, 1.5)


def main() -> None:
    """Simulate, fit, print and keep a table."""
    rows: list[Row] = []
    for name in sys.argv[1:] or ("quick", "jailin2018"):
        scenario = load_scenario(name)
        with tempfile.TemporaryDirectory() as folder:
            simulate(scenario, Path(folder))
            polynomial = set_up(read_experiment(Path(folder)), DEFAULT).outline.polynomial
        share = scenario.graphite.volume_fraction
        length = np.linspace(0.3, 2.0, 3401)
        q = -np.log(direct_transmission(beam(scenario.xray), length * (1 - share), length * share))
        grey = sum(c * q ** (k + 1) for k, c in enumerate(polynomial))
        slope = np.interp(PATHS_MM, length, np.gradient(np.log(grey), np.log(length)))
        rows.append(
            {"scenario": name, **{f"{path} mm": f"{s - 1:.4f}" for path, s in zip(PATHS_MM, slope, strict=True)}}
        )
        show(rows[-1])
    keep(rows, "hardening")


if __name__ == "__main__":
    main()
