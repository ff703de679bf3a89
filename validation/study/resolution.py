"""Spatial resolution, noise, and both as one number, for each method of a study of strain waves.

A study with the wavelength lambda of the scenario's `ripple` as a factor is asked, for each combination of its other
factors (a method, say) and over its repetitions:

- which share of the wave's amplitude is recovered at each wavelength (`validation.scoring.resolution`), and which
  share could be, with the same sections and time functions;
- the **spatial resolution** d: the wavelength beyond which the amplitude is recovered to a tenth, interpolated in log
  lambda between those of the study. The last crossing counts; an amplitude that is too large by more is as wrong as
  one that is too small, which the DIC Challenge, whose curves attenuate, does not ask;
- the **measurement resolution** sigma: the standard deviation over the repetitions of the strain in an interval at a
  step, rms over intervals, the last steps, and wavelengths;
- the **metrological efficiency indicator** sigma d: less is better. Where a method trades one for the other, by longer
  windows or fewer sections, it stays about the same. For strains the DIC Challenge 2.0 takes sigma d^2, as their noise
  falls with the area of a window; both are given. Between sections h apart, each seen by its own rows, the noise of a
  strain goes as h^(-3/2), between the two.

Source: Reu et al., Experimental Mechanics 62, 2022, 639-654.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from validation.batch.engine import ERRORS
from validation.batch.trial import PROFILE
from validation.scoring.bootstrap import Estimate, bootstrapped
from validation.study.description import Factor, Study
from validation.study.summary import by_combination

Floats = NDArray[np.float64]

WAVELENGTH = "scenario.motion.ripple.wavelength_mm"
BIAS = 0.1
"""Share of the amplitude that may be missing, or too much, where a wavelength is resolved; as in the DIC Challenge."""


@dataclass(frozen=True, kw_only=True)
class Resolution:
    """What one method resolves; NaN where it is not known."""

    combination: dict[str, object]
    """Column and value of the factors other than the wavelength."""
    repetitions: int
    """Noise draws that were measured at every wavelength."""
    wavelength_mm: Floats
    """(wavelength,), mm, increasing."""
    recovered: tuple[Estimate, ...]
    """Share of the amplitude at each wavelength, mean over the repetitions."""
    recoverable: Floats
    """The same of the nearest motion that the method's sections and time functions can make."""
    noise: Floats
    """Standard deviation of the strain over the repetitions at each wavelength, without unit."""
    resolution_mm: Estimate
    """Spatial resolution d, mm."""
    recoverable_mm: float
    """The same if all were recovered that could be, mm."""

    @property
    def sigma(self) -> float:
        """Return the measurement resolution, 1 sigma of the strain, without unit."""
        return float(np.sqrt((self.noise**2).mean()))

    @property
    def indicator_um(self) -> float:
        """Return sigma d, um: what the noise of the strain makes over one spatial resolution."""
        return 1e3 * self.sigma * self.resolution_mm.value

    @property
    def strain_indicator_um_mm(self) -> float:
        """Return sigma d^2, um mm: the indicator as the DIC Challenge 2.0 takes it for strains."""
        return self.indicator_um * self.resolution_mm.value

    @property
    def outside(self) -> str:
        """Return on which side of the study's wavelengths the resolution is, as text in mm; nothing if it is known."""
        return _outside(self.wavelength_mm, np.array([share.value for share in self.recovered]))

    @property
    def recoverable_outside(self) -> str:
        """Return the same of `recoverable_mm`."""
        return _outside(self.wavelength_mm, self.recoverable)


def wavelength_factor(study: Study) -> Factor | None:
    """Return the factor that is the wavelength of a ripple, in a grid; None in any other study."""
    if study.design != "grid":
        return None
    return next((factor for factor in study.factor if factor.key == WAVELENGTH and not factor.names), None)


def resolutions(study: Study, table: pd.DataFrame, folder: Path) -> list[Resolution]:
    """Return what each combination of the other factors resolves; nothing in a study of anything else.

    `table` is the study's, `folder` that of its runs.
    """
    factor = wavelength_factor(study)
    if factor is None:
        return []
    groups: dict[tuple[object, ...], list[tuple[float, pd.DataFrame]]] = {}
    names = [each.column for each in study.factor if each is not factor]
    for combination, runs in by_combination(study, table):
        which = tuple(combination[name] for name in names)
        done = runs[runs["status"] == "done"].set_index("repetition")
        groups.setdefault(which, []).append((float(runs[factor.column].iloc[0]), done))
    return [
        _resolution(dict(zip(names, which, strict=True)), sorted(waves, key=lambda wave: wave[0]), folder)
        for which, waves in groups.items()
    ]


def _resolution(
    combination: dict[str, object], waves: Sequence[tuple[float, pd.DataFrame]], folder: Path
) -> Resolution:
    wavelength = np.array([length for length, _ in waves])
    # repetitions that are missing at some wavelength would bend the curve there
    shares = pd.concat([runs["recovered"] for _, runs in waves], axis=1).dropna().to_numpy(dtype=float)
    recoverable = np.array([runs["recoverable"].mean() for _, runs in waves])

    def crossing(draws: Floats) -> Floats:
        """Return the cut-off of the mean of some repetitions, given by their numbers (..., repetition)."""
        means = shares[draws.astype(int)].mean(axis=-2)
        return np.apply_along_axis(lambda mean: cut_off_mm(wavelength, mean), -1, means)

    return Resolution(
        combination=combination,
        repetitions=len(shares),
        wavelength_mm=wavelength,
        recovered=tuple(bootstrapped(column) for column in shares.T),
        recoverable=recoverable,
        noise=np.array([_noise(runs, folder) for _, runs in waves]),
        resolution_mm=bootstrapped(np.arange(len(shares)), crossing),
        recoverable_mm=cut_off_mm(wavelength, recoverable),
    )


def cut_off_mm(wavelength_mm: Floats, recovered: Floats) -> float:
    """Return the wavelength beyond which the share that is recovered differs from 1 by no more than `BIAS`, mm.

    Both (wavelength,), in the order of increasing wavelengths, mm. NaN where it lies outside: where the longest one is
    not recovered so far, or all of them are.
    """
    wrong = np.flatnonzero(~(np.abs(recovered - 1) <= BIAS))
    if not len(wrong) or wrong[-1] == len(recovered) - 1:
        return float("nan")
    last = wrong[-1]
    (before, after), ends = recovered[last : last + 2], np.log(wavelength_mm[last : last + 2])
    level = 1 + np.copysign(BIAS, before - 1)
    return float(np.exp(ends[0] + (ends[1] - ends[0]) * (level - before) / (after - before)))


def _outside(wavelength_mm: Floats, recovered: Floats) -> str:
    if not np.isfinite(recovered).all() or np.isfinite(cut_off_mm(wavelength_mm, recovered)):
        return ""
    return f"< {wavelength_mm[0]:g}" if abs(recovered[-1] - 1) <= BIAS else f"> {wavelength_mm[-1]:g}"


def _noise(runs: pd.DataFrame, folder: Path) -> float:
    """Return the standard deviation of the strain over repetitions, rms over the intervals that all of them saw."""
    profiles = [np.load(folder / ERRORS / f"{key}.npz")[PROFILE].astype(float) for key in runs["key"]]
    if len(profiles) < 2:
        return float("nan")
    variance = np.stack(profiles).var(axis=0, ddof=1)
    known = variance[np.isfinite(variance)]
    return float(np.sqrt(known.mean())) if known.size else float("nan")


def resolution_table(found: Sequence[Resolution]) -> pd.DataFrame:
    """Return a row for each method: spatial and measurement resolution, and the indicators made of both."""
    return pd.DataFrame(
        [
            {
                **each.combination,
                "repetitions": each.repetitions,
                "resolution_mm": each.resolution_mm.value,
                "resolution_mm_low": each.resolution_mm.low,
                "resolution_mm_high": each.resolution_mm.high,
                "recoverable_mm": each.recoverable_mm,
                "noise_strain": each.sigma,
                "indicator_um": each.indicator_um,
                "strain_indicator_um_mm": each.strain_indicator_um_mm,
            }
            for each in found
        ]
    )
