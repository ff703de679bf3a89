"""What a study found: bias, random part and rms of the error for each combination of its factors, over repetitions.

The error e of a material point at a step, in one direction, is drawn anew by every repetition r = 1 .. R. Its mean
over repetitions estimates what no averaging removes, its deviation what noise does. With angle brackets for the
mean over repetitions, and a bar for the mean over the points and steps that all repetitions score,

    random^2 = bar( R / (R - 1) ( <e^2> - <e>^2 ) )
    bias^2   = bar( <e>^2 ) - random^2 / R           the mean's own noise taken off; 0 where that leaves less
    error^2  = bar( <e^2> )

so that error^2 = bias^2 + random^2. (Scores of one run take their bias over the *steps*: what noise adds to all steps
alike is bias there, and random here.) All three follow from the products G_rs = bar(e_r e_s), on which intervals are
bootstrapped: repetitions are drawn with replacement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import bootstrap

from validation.batch.engine import ERRORS
from validation.scoring.bootstrap import Estimate
from validation.study.description import Study

Floats = NDArray[np.float64]

QUANTITIES = ("voxel_across_beam", "voxel_vertical", "voxel_along_beam", "strain")
"""What errors are taken of; names of columns end with these."""
PARTS = ("error", "bias", "random")
LEAST_REPETITIONS = 3
"""Below, no interval is given."""
RESAMPLES = 999


def summarise(study: Study, table: pd.DataFrame, folder: Path) -> pd.DataFrame:
    """Return a row for each combination: factors, runs done and failed, and the estimates of each part and quantity.

    Columns are ``error_voxel_across_beam`` and so on, with ``_low`` and ``_high``; and ``bound_...``, the mean over
    the runs, where the table has it.
    """
    rows = []
    for combination, runs in by_combination(study, table):
        done = runs[runs["status"] == "done"]
        row = {**combination, "runs": len(done), "failed": len(runs) - len(done)}
        errors = [_read(folder / ERRORS / f"{key}.npz") for key in done["key"]]
        for k, quantity in enumerate(QUANTITIES):
            for part, estimate in estimates([each[k] for each in errors], study.seed).items():
                row |= {f"{part}_{quantity}": estimate.value}
                row |= {f"{part}_{quantity}_low": estimate.low, f"{part}_{quantity}_high": estimate.high}
            if f"bound_{quantity}" in table:
                row[f"bound_{quantity}"] = done[f"bound_{quantity}"].mean()
        rows.append(row)
    return pd.DataFrame(rows)


def mean_scores(study: Study, table: pd.DataFrame) -> pd.DataFrame:
    """Return for each combination the mean over its runs of every score of a single run."""
    left_out = ("seed", "repetition", *(factor.column for factor in study.factor))
    numbers = [name for name in table.select_dtypes("number").columns if name not in left_out]
    return pd.DataFrame(
        [{**combination, **runs[numbers].mean().to_dict()} for combination, runs in by_combination(study, table)]
    )


def by_combination(study: Study, table: pd.DataFrame) -> Iterator[tuple[dict[str, object], pd.DataFrame]]:
    """Split a study's table into its combinations, in their order."""
    names = [factor.column for factor in study.factor]
    for start in range(0, len(table), study.repetitions):
        runs = table.iloc[start : start + study.repetitions]
        yield {name: runs[name].iloc[0] for name in names}, runs


def estimates(errors: Sequence[NDArray[np.floating]], seed: int = 0) -> dict[str, Estimate]:
    """Return error, bias and random part from the errors of each repetition, arrays of one shape; NaN is left out.

    One repetition alone cannot tell bias from random; fewer than `LEAST_REPETITIONS` give no interval.
    """
    if not errors:
        return {part: Estimate(value=np.nan) for part in PARTS}
    stacked = np.stack([np.ravel(each).astype(float) for each in errors])
    stacked = stacked[:, np.isfinite(stacked).all(axis=0)]
    if not stacked.shape[1]:
        return {part: Estimate(value=np.nan) for part in PARTS}
    products = stacked @ stacked.T / stacked.shape[1]
    found = {
        "error": _with_interval(products, _mean_square, _mean_square, seed),
        "bias": _with_interval(products, _bias_square, _square_of_mean, seed),
        "random": _with_interval(products, _variance, _spread, seed),
    }
    return {part: found[part] for part in PARTS}


def _mean_square(products: Floats) -> Floats:
    return np.asarray(np.trace(products, axis1=-2, axis2=-1) / products.shape[-1])


def _square_of_mean(products: Floats) -> Floats:
    return np.asarray(products.mean(axis=(-2, -1)))


def _spread(products: Floats) -> Floats:
    return np.maximum(_mean_square(products) - _square_of_mean(products), 0)


def _variance(products: Floats) -> Floats:
    count = products.shape[-1]
    return _spread(products) * count / (count - 1) if count > 1 else np.full(products.shape[:-2], np.nan)


def _bias_square(products: Floats) -> Floats:
    return np.asarray(np.maximum(_square_of_mean(products) - _variance(products) / products.shape[-1], 0))


def _with_interval(
    products: Floats, square: Callable[[Floats], Floats], known: Callable[[Floats], Floats], seed: int
) -> Estimate:
    """Return the root of a square, with the interval that its estimates from resampled repetitions fill.

    Those are drawn from the repetitions as if these were all there is; what they estimate is `known` there exactly. By
    how much the square itself differs from that, the interval is moved.
    """
    value, count = float(square(products)), len(products)
    if count < LEAST_REPETITIONS:
        return Estimate(value=float(np.sqrt(value)))

    def resampled(drawn: NDArray[np.intp], axis: int) -> Floats:
        chosen = np.moveaxis(drawn, axis, -1)
        return square(products[chosen[..., :, None], chosen[..., None, :]])

    found = bootstrap(
        (np.arange(count),),
        resampled,
        n_resamples=RESAMPLES,
        batch=max(1, 2_000_000 // count**2),
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(seed),
    )
    low, high = (float(np.sqrt(max(end + value - float(known(products)), 0))) for end in found.confidence_interval)
    return Estimate(value=float(np.sqrt(value)), low=low, high=high)


def _read(path: Path) -> tuple[NDArray[np.float32], ...]:
    """Return the errors of one run for each quantity."""
    with np.load(path) as kept:
        return *np.moveaxis(kept["points"], -1, 0), kept["strain"]
