"""Which factors matter, and for what: Morris' elementary effects and Sobol's indices of a study's runs, by SALib.

What is asked of each combination of the factors are the error, its bias and random part, and how many errors the 95 %
intervals cover. Bias and random part are those over the repetitions (`validation.study.summary`). One repetition alone
has those of a single run (`validation.scoring.scores`): the mean over the steps of a material point's error, and what
is left of it; the strain has no such parts. Let y be one of these and x_j the j-th factor, 0 to 1 over its range.

- Morris: d_j = (y(x + h e_j) - y(x)) / h, one for each trajectory. mu* is the mean of |d_j|, mu that of d_j, sigma the
  deviation of d_j: how much y changes from one end of the range to the other; which way; and by how much that depends
  on where, and on the other factors (Campolongo et al., Environ. Model. Softw. 22 (2007) 1509-1518).
- Sobol: with independent factors, even over their ranges, S_j = Var(E(y | x_j)) / Var(y) is the share of the variance
  that x_j has by itself, ST_j = 1 - Var(E(y | all but x_j)) / Var(y) the share in which it takes part.

Intervals are SALib's: 1.96 bootstrap deviations over trajectories, or samples, each way. They tell how few there were,
and hold for these noise draws and this one scanner.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from validation.scoring.bootstrap import Estimate
from validation.study.description import Study
from validation.study.points import ANALYSED, LEVELS, block_length, unit_points, unit_problem
from validation.study.summary import QUANTITIES

Floats = NDArray[np.float64]

RESAMPLES = 1000
LEVEL = 0.95
LEAST_BLOCKS = 2
"""Trajectories or samples; fewer tell nothing."""
COVERED = "covered"
"""Part that is the share of the errors which the 95 % intervals hold."""
PARTS = ("error", "bias", "random", COVERED)
"""What influences are taken of, where it is known."""


@dataclass(frozen=True, kw_only=True)
class Influence:
    """What one factor does to one quantity; NaN where it cannot be told."""

    factor: str
    """Its column."""
    part: str
    """One of `PARTS`."""
    quantity: str
    """One of `QUANTITIES`."""
    whole: Estimate
    """Morris: mu*, in the unit of the quantity, from one end of the range to the other. Sobol: ST."""
    alone: Estimate
    """Morris: mu, which has no interval. Sobol: S."""
    sigma: float
    """Morris: sigma; Sobol: NaN."""
    blocks: int
    """Trajectories or samples of which all runs were done."""


def influences(study: Study, summary: pd.DataFrame, scores: pd.DataFrame) -> list[Influence]:
    """Return the influence of each factor on each known part of each quantity; none of a design that is no such.

    `summary` and `scores` have a row for each combination, in their order (`validation.study.summary`).
    """
    if study.design not in ANALYSED or study.samples is None:
        return []
    names = [factor.column for factor in study.factor]
    points = unit_points(study.design, len(names), study.samples, study.seed)  # type: ignore[arg-type]
    found = []
    for part, quantity, values in _asked(study, summary, scores):
        x, y, blocks = whole_blocks(points, values, block_length(study.design, len(names)))
        for name, (whole, alone, sigma) in zip(names, analysed(study.design, x, y, study.seed), strict=True):
            where = {"factor": name, "part": part, "quantity": quantity}
            found.append(Influence(**where, whole=whole, alone=alone, sigma=sigma, blocks=blocks))
    return found


def whole_blocks(points: Floats, values: Floats, length: int) -> tuple[Floats, Floats, int]:
    """Return points and values of those blocks of a design in which every value is known, and how many these are."""
    known = np.isfinite(values).reshape(-1, length).all(axis=1)
    kept = np.repeat(known, length)
    return points[kept], values[kept], int(known.sum())


def analysed(design: str, points: Floats, values: Floats, seed: int) -> list[tuple[Estimate, Estimate, float]]:
    """Return for each factor whole, alone and sigma, as in `Influence`, from whole blocks of a design.

    Where nothing changes the value at all, no factor matters to Morris, and Sobol has no variance to share.
    """
    factors = points.shape[1]
    nothing = Estimate(value=np.nan)
    if len(values) < LEAST_BLOCKS * block_length(design, factors):
        return [(nothing, nothing, np.nan)] * factors
    limits = {"num_resamples": RESAMPLES, "conf_level": LEVEL}
    if design == "morris":
        from SALib.analyze import morris

        found = morris.analyze(
            unit_problem(factors), points, values, num_levels=LEVELS, seed=np.random.default_rng(seed), **limits
        )
        mean = [Estimate(value=float(mu)) for mu in found["mu"]]
        return list(zip(_around(found, "mu_star"), mean, map(float, found["sigma"]), strict=True))
    if np.ptp(values) == 0:
        return [(nothing, nothing, np.nan)] * factors
    from SALib.analyze import sobol

    # SALib takes a seed of 0 for none
    found = sobol.analyze(unit_problem(factors), values, calc_second_order=False, seed=seed + 1, **limits)
    return [(whole, alone, np.nan) for whole, alone in zip(_around(found, "ST"), _around(found, "S1"), strict=True)]


def _around(found: Mapping[str, Any], name: str) -> list[Estimate]:
    """Return SALib's numbers of each factor with their intervals."""
    return [
        Estimate(value=float(value), low=float(value - half), high=float(value + half))
        for value, half in zip(found[name], found[f"{name}_conf"], strict=True)
    ]


def _asked(study: Study, summary: pd.DataFrame, scores: pd.DataFrame) -> Iterator[tuple[str, str, Floats]]:
    """Return part, quantity and the values of all combinations, of what any of them knows."""
    split = summary if study.repetitions > 1 else scores
    for part in PARTS:
        for quantity in QUANTITIES:
            if part == COVERED:
                column, table = f"calibration_coverage_95_{quantity.removeprefix('voxel_')}", scores
            else:
                column, table = f"{part}_{quantity}", summary if part == "error" else split
            if column in table and table[column].notna().any():
                yield part, quantity, table[column].to_numpy(dtype=float)


def ranked(found: Sequence[Influence]) -> list[str]:
    """Return the factors, the one first that matters most.

    Its place is the mean over parts and quantities of its share of the largest influence there.
    """
    rows = pd.DataFrame([(each.factor, each.part, each.quantity, each.whole.value) for each in found])
    rows.columns = pd.Index(["factor", "part", "quantity", "whole"])
    most = rows.groupby(["part", "quantity"])["whole"].transform("max")
    share = (rows["whole"] / most.where(most > 0)).groupby(rows["factor"], sort=False).mean()
    return [str(name) for name in share.sort_values(ascending=False, kind="stable").index]


def influence_table(study: Study, found: Sequence[Influence]) -> pd.DataFrame:
    """Return a row for each factor, part and quantity; columns are called as in Morris' and Sobol's papers."""
    whole, alone = ("mu_star", "mu") if study.design == "morris" else ("total", "first")
    rows = []
    for each in found:
        row: dict[str, object] = {"factor": each.factor, "part": each.part, "quantity": each.quantity}
        row |= {whole: each.whole.value, f"{whole}_low": each.whole.low, f"{whole}_high": each.whole.high}
        row |= {alone: each.alone.value}
        if study.design == "morris":
            row |= {"sigma": each.sigma}
        else:
            row |= {f"{alone}_low": each.alone.low, f"{alone}_high": each.alone.high}
        rows.append(row | {"blocks": each.blocks})
    return pd.DataFrame(rows)
