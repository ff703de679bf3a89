"""X-rays: spectrum, attenuation, and the transmission of matrix and graphite as the detector sees it.

The detector weighs each energy by what its scintillator makes of it, w(E) = E (1 - exp(-mu_s(E) t_s)) if it
integrates energy (without the factor E if it counts photons), so that with the fluence phi(E) of the tube

    T(L_m, L_g) = sum_E phi w exp(-mu_m(E) L_m - mu_g(E) L_g) / sum_E phi w.

Attenuation coefficients are those of xraylib's `CS_Total`, cm2/g (about 1 % between published tables); the
`..._Kissel` totals of the same library are wrong for carbon. The scintillator keeps all the energy of each
photon that interacts: fluorescence that escapes is neglected, and so is scatter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated

import numba
import numpy as np
import xraylib
from numpy.typing import NDArray
from pydantic import Field

from pdvc.settings import Settings

Positive = Annotated[float, Field(gt=0)]

_IRON, _SILICON, _CARBON, _CAESIUM, _IODINE = 26, 14, 6, 55, 53
_CSI_DENSITY_G_CM3 = 4.51


class XraySource(Settings):
    """The beam, the materials in it and the scintillator behind them."""

    spectrum: str = "w180_cu0.5"
    """name of a shipped spectrum, or path of a CSV file with the columns energy_keV, fluence"""
    energy_integrating: bool = True
    """whether the detector adds up the photons' energy; otherwise it counts photons"""
    scintillator_mm: Positive = 0.6
    """thickness of the caesium iodide scintillator, mm"""
    matrix_density_g_cm3: Positive = 7.7
    """density of the ferrite: iron has 7.87 g/cm3, with 2.5 % silicon some 7.7 g/cm3"""
    silicon_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.025
    """mass fraction of silicon in the ferrite, the rest is iron"""
    graphite_density_g_cm3: Positive = 2.2
    """density of the graphite, g/cm3"""


@dataclass(frozen=True, kw_only=True)
class Spectrum:
    """The fluence of a tube behind its filters, in bins of energy."""

    energy_keV: NDArray[np.float64]
    """Bin centres (e,), keV."""
    fluence: NDArray[np.float64]
    """Photons per bin (e,), scaled to the sum 1."""

    def __post_init__(self) -> None:
        if self.energy_keV.ndim != 1 or self.energy_keV.shape != self.fluence.shape or not len(self.fluence):
            raise ValueError(
                "spectrum: expected as many energies as fluences, "
                f"got shapes {self.energy_keV.shape} and {self.fluence.shape}"
            )
        if not (np.all(self.energy_keV > 0) and np.all(self.fluence >= 0) and self.fluence.sum() > 0):
            raise ValueError("spectrum: expected energies above 0 keV and fluences of at least 0, not all 0")


def shipped_spectra() -> tuple[str, ...]:
    """Return the names of the spectra that come with the package."""
    return tuple(sorted(f.name.removesuffix(".csv") for f in _folder().iterdir() if f.name.endswith(".csv")))


def read_spectrum(name: str) -> Spectrum:
    """Read a shipped spectrum by name, or any CSV file by its path (ending in .csv)."""
    if name.endswith(".csv"):
        path = Path(name)
        if not path.is_file():
            raise ValueError(f"spectrum: expected a CSV file, found none at {path}")
        lines = path.read_text(encoding="utf-8").splitlines()
    elif name in shipped_spectra():
        lines = (_folder() / f"{name}.csv").read_text(encoding="utf-8").splitlines()
    else:
        raise ValueError(
            f"spectrum: expected a path ending in .csv or one of {', '.join(shipped_spectra())}, got {name!r}"
        )
    rows = [line for line in lines if line and not line.startswith(("#", "energy_keV"))]
    try:
        energy, fluence = np.array([[float(x) for x in row.split(",")] for row in rows]).T
    except ValueError as error:
        raise ValueError(f"spectrum {name}: expected rows of energy_keV, fluence: {error}") from None
    return Spectrum(energy_keV=energy, fluence=fluence / fluence.sum())


def make_spectrum(kilovolt: float, filters_mm: Mapping[str, float], *, anode_deg: float = 12.0) -> Spectrum:
    """Compute the spectrum of a tungsten reflection target behind filters {element: thickness}, 1 keV bins.

    Model: spekpy's default (`casim`: electron transport by Monte Carlo, inherent self-filtration).
    Needs the extra `spectra`.
    """
    try:
        import spekpy
    except ImportError:
        raise ImportError("spectra are made with spekpy: install it with `pip install pdvc-bench[spectra]`") from None
    tube = spekpy.Spek(kvp=kilovolt, th=anode_deg, dk=1.0)
    for element, thickness in filters_mm.items():
        tube.filter(element, thickness)
    energy, fluence = (np.asarray(values, dtype=np.float64) for values in tube.get_spectrum())
    # what is left of the lowest energies cannot be seen, and its numbers fill the file
    used = fluence > 1e-9 * fluence.max()
    return Spectrum(energy_keV=energy[used], fluence=fluence[used] / fluence[used].sum())


def write_spectrum(path: Path, spectrum: Spectrum, comment: str) -> None:
    """Write a spectrum as CSV, below the lines of a comment that says how it was made."""
    lines = [*(f"# {line}" for line in comment.splitlines()), "energy_keV,fluence"]
    lines += [f"{e:.6g},{p:.9e}" for e, p in zip(spectrum.energy_keV, spectrum.fluence, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclass(frozen=True, kw_only=True)
class Beam:
    """What the detector sees of each energy, and what the materials take from it."""

    energy_keV: NDArray[np.float64]
    """Bin centres (e,), keV."""
    weight: NDArray[np.float64]
    """Share of each energy in the open-beam signal (e,), summing to 1."""
    matrix_per_mm: NDArray[np.float64]
    """Linear attenuation of the matrix (e,), 1/mm."""
    graphite_per_mm: NDArray[np.float64]
    """Linear attenuation of graphite (e,), 1/mm."""


def beam(source: XraySource) -> Beam:
    """Combine spectrum, scintillator and materials into the terms of the transmission."""
    spectrum = read_spectrum(source.spectrum)
    energy = spectrum.energy_keV
    caesium, iodine = xraylib.AtomicWeight(_CAESIUM), xraylib.AtomicWeight(_IODINE)
    csi = _mixture(energy, {_CAESIUM: caesium, _IODINE: iodine}) / (caesium + iodine)
    kept = -np.expm1(-csi * _CSI_DENSITY_G_CM3 * source.scintillator_mm / 10)
    weight = spectrum.fluence * kept * (energy if source.energy_integrating else 1.0)
    ferrite = {_IRON: 1 - source.silicon_fraction, _SILICON: source.silicon_fraction}
    return Beam(
        energy_keV=energy,
        weight=weight / weight.sum(),
        matrix_per_mm=_mixture(energy, ferrite) * source.matrix_density_g_cm3 / 10,
        graphite_per_mm=_mixture(energy, {_CARBON: 1.0}) * source.graphite_density_g_cm3 / 10,
    )


def direct_transmission(
    rays: Beam, matrix_mm: NDArray[np.float64], graphite_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sum the transmission over all energies; the lengths broadcast, mm."""
    matrix, graphite = np.asarray(matrix_mm)[..., None], np.asarray(graphite_mm)[..., None]
    return np.exp(-matrix * rays.matrix_per_mm - graphite * rays.graphite_per_mm) @ rays.weight


@dataclass(frozen=True, kw_only=True)
class TransmissionTable:
    """-log T on a grid of matrix and graphite lengths that starts at 0, between which it is bilinear.

    The second derivative of -log T along a length is minus the variance of mu over the transmitted spectrum,
    so that the relative error of T is at most step^2 / 8 times the largest variance.
    """

    log_attenuation: NDArray[np.float64]
    """-log T (matrix, graphite)."""
    step_mm: tuple[float, float]
    """Grid steps of matrix and graphite, mm."""

    @property
    def longest_mm(self) -> tuple[float, float]:
        """Return the largest matrix and graphite lengths in the table, mm."""
        shape = self.log_attenuation.shape
        return self.step_mm[0] * (shape[0] - 1), self.step_mm[1] * (shape[1] - 1)

    @classmethod
    def of(
        cls,
        source: XraySource,
        longest_mm: tuple[float, float],
        *,
        step_mm: tuple[float, float] = (0.004, 0.02),
    ) -> TransmissionTable:
        """Tabulate a source's transmission up to the longest lengths in matrix and graphite, mm."""
        rays = beam(source)
        matrix, graphite = (
            np.arange(int(np.ceil(longest / step)) + 2) * step
            for longest, step in zip(longest_mm, step_mm, strict=True)
        )
        through_matrix = np.exp(-np.outer(matrix, rays.matrix_per_mm)) * rays.weight
        through_graphite = np.exp(-np.outer(graphite, rays.graphite_per_mm))
        return cls(log_attenuation=-np.log(through_matrix @ through_graphite.T), step_mm=step_mm)

    def transmission(self, matrix_mm: NDArray[np.float32], graphite_mm: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return T of each ray; lengths (rows, columns), mm.

        Raises ValueError where a length is longer than the table or below zero by more than rounding.
        """
        for name, lengths, longest in zip(
            ("matrix", "graphite"), (matrix_mm, graphite_mm), self.longest_mm, strict=True
        ):
            low, high = (float(lengths.min()), float(lengths.max())) if lengths.size else (0.0, 0.0)
            if not (low > -1e-4 and high <= longest):
                raise ValueError(f"{name} length: expected 0 to {longest:.6g} mm, got {low:.6g} to {high:.6g} mm")
        per_mm = 1 / self.step_mm[0], 1 / self.step_mm[1]
        return np.asarray(_interpolate(self.log_attenuation, *per_mm, matrix_mm, graphite_mm))


@numba.njit(cache=True, nogil=True)
def _interpolate(table, per_matrix, per_graphite, matrix, graphite):  # type: ignore[no-untyped-def]
    result = np.empty(matrix.shape, dtype=np.float32)
    last_a, last_b = table.shape[0] - 2, table.shape[1] - 2
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            if matrix[i, j] == 0.0 and graphite[i, j] == 0.0:
                result[i, j] = 1.0
                continue
            x, y = matrix[i, j] * per_matrix, graphite[i, j] * per_graphite
            a, b = min(max(int(x), 0), last_a), min(max(int(y), 0), last_b)
            x, y = x - a, y - b
            low = table[a, b] + y * (table[a, b + 1] - table[a, b])
            high = table[a + 1, b] + y * (table[a + 1, b + 1] - table[a + 1, b])
            result[i, j] = np.exp(-(low + x * (high - low)))
    return result


def _mixture(energy_keV: NDArray[np.float64], parts: Mapping[int, float]) -> NDArray[np.float64]:
    """Return sum of part x total cross section over the elements, cm2/g."""
    return np.array([sum(part * xraylib.CS_Total(z, e) for z, part in parts.items()) for e in energy_keV.tolist()])


def _folder() -> Traversable:
    return files("simulator") / "spectra"
