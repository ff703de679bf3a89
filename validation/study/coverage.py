"""Whether the uncertainties that a measurement states are right, over the draws of a study: noise alone, or all.

Each draw contributes the shares of its errors that the 50, 90 and 95 % intervals cover, its mean z^2, and its NEES
(`validation.scoring.interval_calibration`). Averaged over the draws:

- a coverage has two intervals. The binomial one (Clopper and Pearson) counts each draw as one trial, as if all errors
  of a draw hung together: too wide, but never too narrow. The other is bootstrapped over the draws.
- NEES over its degrees of freedom, which is 1 if the covariance is right; the sum over R draws follows chi-square with
  R times as many degrees of freedom. With hundreds of unknowns and tens of draws its 95 % bounds are a per cent wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from validation.scoring.bootstrap import Estimate, bootstrapped
from validation.study.description import Study
from validation.study.summary import by_combination

LEVELS = (50, 90, 95)
TOO_SMALL = 1.15
"""A z rms above this is called too small an interval: 95 % then cover 91."""
DIRECTIONS = ("across_beam", "vertical", "along_beam", "strain")


@dataclass(frozen=True, kw_only=True)
class Covered:
    """The coverage of one interval in one direction."""

    level: int
    """Due, per cent."""
    direction: str
    found: Estimate
    """Mean share over the draws, with its bootstrapped interval."""
    binomial: tuple[float, float]
    """95 % interval of the share if each draw were one trial."""


@dataclass(frozen=True, kw_only=True)
class Honesty:
    """What the draws of one combination show."""

    combination: dict[str, object]
    draws: int
    covered: tuple[Covered, ...]
    predicted: dict[str, float]
    """By direction: rms of the standard deviations that the measurements stated; voxels, strain without unit."""
    z_rms: dict[str, float]
    """By direction: 1 is due; what is more says by which factor the intervals are too small."""
    nees: float
    """Mean NEES over its degrees of freedom; 1 is due. NaN where there is none."""
    nees_bounds: tuple[float, float]
    """Between which it is in 95 of 100 studies if the covariance is right."""
    chi2_reduced: float
    """Mean of chi2 / (N - p) of the residuals."""


def honesty(study: Study, table: pd.DataFrame) -> list[Honesty]:
    """Return what the finished runs of each combination show, or of all together; nothing without such columns."""
    if "calibration_nees" not in table:
        return []
    groups = [({}, table)] if study.pooled else list(by_combination(study, table))
    return [_of(combination, runs[runs["status"] == "done"]) for combination, runs in groups]


def _of(combination: dict[str, object], runs: pd.DataFrame) -> Honesty:
    covered = []
    for level in LEVELS:
        for direction in DIRECTIONS:
            shares = runs[f"calibration_coverage_{level}_{direction}"].to_numpy(dtype=float)
            shares = shares[np.isfinite(shares)]
            found = bootstrapped(shares)
            covered.append(
                Covered(level=level, direction=direction, found=found, binomial=_binomial(found.value, len(shares)))
            )
    freedom = float(runs["calibration_nees_unknowns"].sum())
    known = freedom > 0 and bool(np.isfinite(runs["calibration_nees"]).all())
    low, high = stats.chi2.ppf([0.025, 0.975], freedom) / freedom if known else (np.nan, np.nan)
    return Honesty(
        combination=combination,
        draws=len(runs),
        covered=tuple(covered),
        predicted={name: _rms(runs[f"calibration_predicted_{name}"]) for name in DIRECTIONS},
        z_rms={name: _rms(runs[f"calibration_z_rms_{name}"]) for name in DIRECTIONS},
        nees=float(runs["calibration_nees"].sum()) / freedom if known else np.nan,
        nees_bounds=(float(low), float(high)),
        chi2_reduced=float(runs["chi2_reduced"].mean()),
    )


def _binomial(share: float, trials: int) -> tuple[float, float]:
    """Return the 95 % interval of Clopper and Pearson; the number of successes need not be whole."""
    if not trials or not np.isfinite(share):
        return np.nan, np.nan
    hits = share * trials
    low = stats.beta.ppf(0.025, hits, trials - hits + 1) if hits > 0 else 0.0
    high = stats.beta.ppf(0.975, hits + 1, trials - hits) if hits < trials else 1.0
    return float(low), float(high)


def _rms(values: pd.Series) -> float:
    return float(np.sqrt((values.to_numpy(dtype=float) ** 2).mean())) if len(values) else np.nan


def verdict(found: Honesty) -> str:
    """Return in a sentence or two what the numbers say."""
    small = {name: z for name, z in found.z_rms.items() if z > TOO_SMALL}
    text = []
    if small:
        factors = ", ".join(f"{name.replace('_', ' ')} by a factor of {z:.2g}" for name, z in small.items())
        text.append(
            f"Intervals are too small: {factors}. What they lack is the error of the model, which no noise draw "
            "changes: a motion that sections and time functions cannot follow, or sampling."
        )
    else:
        text.append("Intervals are as wide as the errors ask for, in all directions and for the strain.")
    if np.isfinite(found.nees):
        low, high = found.nees_bounds
        inside = "within" if low <= found.nees <= high else "outside"
        text.append(f"NEES is {found.nees:.3f} of its degrees of freedom, {inside} {low:.3f} to {high:.3f}.")
    return " ".join(text)


def coverage_table(found: list[Honesty]) -> pd.DataFrame:
    """Return a row for each combination and direction: what was stated, what was covered, and NEES."""
    rows = []
    for each in found:
        for direction in DIRECTIONS:
            row: dict[str, object] = {**each.combination, "draws": each.draws, "direction": direction}
            row |= {"predicted": each.predicted[direction], "z_rms": each.z_rms[direction]}
            for one in each.covered:
                if one.direction == direction:
                    row[f"coverage_{one.level}"] = one.found.value
                    row |= {f"coverage_{one.level}_low": one.found.low, f"coverage_{one.level}_high": one.found.high}
                    low, high = one.binomial
                    row |= {f"coverage_{one.level}_binomial_low": low, f"coverage_{one.level}_binomial_high": high}
            row |= {"nees": each.nees, "nees_low": each.nees_bounds[0], "nees_high": each.nees_bounds[1]}
            rows.append(row | {"chi2_reduced": each.chi2_reduced})
    return pd.DataFrame(rows)
