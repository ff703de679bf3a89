"""What an identification found, and its file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pdvc.whole import read_netcdf, write_netcdf

Floats = NDArray[np.float64]

FORMAT = 1
"""Raised whenever a file of an older version can no longer be read."""
INTEGRATED, WEIGHTED, UNWEIGHTED, CROSSHEAD = "integrated", "two-step", "two-step-unweighted", "crosshead"
"""Methods."""
CONFIDENT = 1.959964
"""Standard deviations on either side of a 95 % interval."""
SEEN = 0.5
"""Share of its prior deviation above which a parameter is not seen."""
STRONG = 3.0
"""Difference of log evidence from which on one law is said to explain a test better than another."""


class IdentificationError(ValueError):
    """An identification cannot be read."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """What one method made of the unknowns."""

    vector: Floats
    """(unknown,): logarithms of the law's parameters first."""
    covariance: Floats
    """(unknown, unknown)"""
    misfit: float
    """rms of what is left, in standard deviations where they are known, else in voxels."""
    seconds: float

    @property
    def deviation(self) -> Floats:
        """Return standard deviations (unknown,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


@dataclass(frozen=True, kw_only=True)
class Identification:
    """A law's parameters, as found by several methods, with what speaks for and against the law."""

    title: str
    law: str
    """Kind of the law."""
    names: tuple[str, ...]
    """Of the unknowns: the law's parameters first, then nuisances."""
    of_law: int
    """How many are the law's, and logarithms in the vectors."""
    prior_mean: Floats
    prior_deviation: Floats
    methods: dict[str, Found]
    """By name: `integrated`, `two-step`, `two-step-unweighted`, and `crosshead` where a stroke is told."""
    by_source: dict[str, Floats]
    """What each source makes of the variance of the integrated unknowns (unknown,)."""
    log_evidence: dict[str, float]
    """Of laws by their kinds, up to a constant; empty where they were not compared."""
    compliance_mm_per_N: tuple[float, float]
    """Of the machine, with its standard deviation; NaN where no stroke is told."""
    height_mm: Floats
    """(height,)"""
    area_mm2: Floats
    """Areas of the sections from the reconstructed volume (height,), mm2."""
    time_s: Floats
    """(step,)"""
    force_N: Floats
    """As recorded (step,), N."""
    force_found_N: Floats
    """As force gauge and radiographs tell together (step,), N."""
    force_noise_N: float
    section_mm: Floats
    """Heights between neighbouring sections (interval,), mm."""
    strain_measured: Floats
    """Axial strain of the free measurement (step, interval), NaN where it was not observed."""
    strain_deviation: Floats
    """Its standard deviation."""
    strain_law: Floats
    """What the law makes of it (step, interval)."""
    curve: Floats
    """Plastic strain, flow stress, and the limits of its 95 % band, MPa (4, point)."""
    seconds: dict[str, float]
    versions: str

    @property
    def best(self) -> Found:
        """Return what the integrated identification found."""
        return self.methods[INTEGRATED]

    def values(self, method: str = INTEGRATED) -> dict[str, tuple[float, float, float]]:
        """Return each unknown's value and the limits of its 95 % interval, the law's in their own units."""
        found = self.methods[method]
        low, high = (found.vector + sign * CONFIDENT * found.deviation for sign in (-1, 1))
        rows = np.stack([found.vector, low, high])[:, : len(self.names)]
        rows[:, : self.of_law] = np.exp(rows[:, : self.of_law])
        return {name: (float(a), float(b), float(c)) for name, (a, b, c) in zip(self.names, rows.T, strict=True)}

    def seen(self) -> dict[str, float]:
        """Return of each of the law's parameters the deviation left, as a share of its prior deviation."""
        share = self.best.deviation[: self.of_law] / self.prior_deviation[: self.of_law]
        return dict(zip(self.names, share.tolist(), strict=False))

    def combinations(self) -> list[tuple[float, dict[str, float]]]:
        """Return the principal directions of what stays uncertain of the law's logarithms, the weakest first.

        Of each its relative standard deviation, and the weights of the parameters.
        """
        values, vectors = np.linalg.eigh(self.best.covariance[: self.of_law, : self.of_law])
        names = self.names[: self.of_law]
        return [
            (float(np.sqrt(max(value, 0.0))), dict(zip(names, vector.tolist(), strict=True)))
            for value, vector in zip(values[::-1], vectors.T[::-1], strict=True)
        ]

    def better(self) -> tuple[str, float] | None:
        """Return the law that explains the test better by a strong difference of log evidence, and this; else None."""
        if not self.log_evidence:
            return None
        best = max(self.log_evidence, key=lambda kind: self.log_evidence[kind])
        more = self.log_evidence[best] - self.log_evidence[self.law]
        return (best, more) if more > STRONG else None

    def doubts(self) -> tuple[str, ...]:
        """Return what speaks against the law, and what it was not seen of."""
        said, better = [], self.better()
        if better is not None:
            best, more = better
            said.append(f"the law {best} explains the test better than {self.law}, by {more:.1f} in log evidence")
        for name, share in self.seen().items():
            if share > SEEN:
                said.append(f"{name} is not seen: {share:.0%} of its prior deviation are left")
        return tuple(said)


_ARRAYS = {
    "prior_mean": ("unknown",),
    "prior_deviation": ("unknown",),
    "height_mm": ("height",),
    "area_mm2": ("height",),
    "time_s": ("step",),
    "force_N": ("step",),
    "force_found_N": ("step",),
    "section_mm": ("interval",),
    "strain_measured": ("step", "interval"),
    "strain_deviation": ("step", "interval"),
    "strain_law": ("step", "interval"),
    "curve": ("row_of_curve", "point"),
}
_NUMBERS = ("title", "law", "of_law", "force_noise_N", "versions")


def write_identification(found: Identification, path: Path) -> None:
    """Write an identification as NetCDF, whole or not at all."""
    data = xr.Dataset(
        {name: (axes, getattr(found, name)) for name, axes in _ARRAYS.items()},
        coords={"unknown": list(found.names)},
        attrs={
            "format": FORMAT,
            **{name: getattr(found, name) for name in _NUMBERS},
            "compliance_mm_per_N": np.array(found.compliance_mm_per_N),
            "log_evidence": json.dumps(found.log_evidence),
            "seconds": json.dumps(found.seconds),
            "methods": json.dumps({name: [each.misfit, each.seconds] for name, each in found.methods.items()}),
            "sources": json.dumps(list(found.by_source)),
            "doubts": json.dumps(found.doubts()),
        },
    )
    for name, each in found.methods.items():
        # the crosshead has unknowns of its own after the others
        axis = f"unknown_{name}"
        data[f"vector_{name}"] = ((axis,), each.vector)
        data[f"covariance_{name}"] = ((axis, f"{axis}_"), each.covariance)
    for name, variance in found.by_source.items():
        data[f"variance_{name}"] = (("unknown",), variance)
    write_netcdf(path, data)


def read_identification(path: Path | str) -> Identification:
    """Read an identification's file; raises IdentificationError where it is none."""
    path = Path(path)
    if not path.is_file():
        raise IdentificationError(f"{path}: expected an identification, found none")
    try:
        data = read_netcdf(path)
        attrs = data.attrs
        if attrs.get("format") != FORMAT:
            raise ValueError(f"found format {attrs.get('format')}")
        value, deviation = (float(each) for each in attrs["compliance_mm_per_N"])
        return Identification(
            **{name: data[name].to_numpy() for name in _ARRAYS},
            title=str(attrs["title"]),
            law=str(attrs["law"]),
            of_law=int(attrs["of_law"]),
            force_noise_N=float(attrs["force_noise_N"]),
            versions=str(attrs["versions"]),
            names=tuple(str(name) for name in data["unknown"].values),
            methods={
                name: Found(
                    vector=data[f"vector_{name}"].to_numpy(),
                    covariance=data[f"covariance_{name}"].to_numpy(),
                    misfit=float(misfit),
                    seconds=float(seconds),
                )
                for name, (misfit, seconds) in json.loads(attrs["methods"]).items()
            },
            by_source={name: data[f"variance_{name}"].to_numpy() for name in json.loads(attrs["sources"])},
            log_evidence=json.loads(attrs["log_evidence"]),
            seconds=json.loads(attrs["seconds"]),
            compliance_mm_per_N=(value, deviation),
        )
    except (KeyError, ValueError, TypeError) as error:
        raise IdentificationError(f"{path}: expected an identification of format {FORMAT}: {error}") from None
