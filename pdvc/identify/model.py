"""What a law says that the sections do, as a function of its parameters: amplitudes and their sensitivities.

Unknown are the logarithms of the law's parameters, and of few numbers that the test knows only so well: the share by
which all areas are larger than the reconstructed volume tells, and Poisson's ratios, elastic and plastic. Each has a
Gaussian prior: broad for the law's, as narrow as stated for the others. The transverse stretch of a section is

    s = 1 - nu_e e_elastic - nu_p e_plastic

Towards the end a neck may form, which no law of stress and strain tells. Its strain is a Gaussian about the smallest
section, with a width of half that section's, which grows by three ramps over the last quarter of the loaded steps, all
free: what the ligament then says of the law is given up for not being misled by a neck.

Strains count from the reference scan, which was made at a force F_0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdvc.identify.beam import Profile, Strains, strains
from pdvc.identify.carried import Carrier
from pdvc.identify.laws import Law

Floats = NDArray[np.float64]

BROAD = 1.0
"""Prior standard deviation of the logarithm of a law's parameter: a factor of e either way."""
POISSON = {"poisson_elastic": (0.3, 0.03), "poisson_plastic": (0.5, 0.01)}
"""Mean and standard deviation of Poisson's ratios."""
AREA = "area_share"
NECK = ("neck_1", "neck_2", "neck_3")
"""What three ramps of the neck reach at the last step, strains."""
NECK_DEVIATION = 0.02
NECK_SHARE = 0.25
"""Share of the loaded steps, the last ones, in which a neck may form."""
NECK_WIDTH = 0.25
"""Standard deviation of the neck's strain along z, over the square root of the smallest area."""
LEAST_STRETCH = 0.1
"""What a section shrinks to, at most: a trial law may ask for anything."""


@dataclass(frozen=True, kw_only=True)
class Unknowns:
    """Names and priors of what is identified, in the order in which vectors hold them."""

    names: tuple[str, ...]
    mean: Floats
    """Prior means: logarithms of the law's starting values first."""
    deviation: Floats
    """Prior standard deviations."""
    of_law: int
    """How many are logarithms of a law's parameters: the first ones."""

    @classmethod
    def of(cls, law: Law, area_deviation: float, necks: int) -> Unknowns:
        """Return the unknowns of a law, for a relative standard deviation of all areas, and some ramps of a neck."""
        values = law.values()
        poisson = np.array(list(POISSON.values()))
        return cls(
            names=(*values, AREA, *POISSON, *NECK[:necks]),
            mean=np.concatenate([np.log(list(values.values())), [0.0], poisson[:, 0], np.zeros(necks)]),
            deviation=np.concatenate(
                [np.full(len(values), BROAD), [area_deviation], poisson[:, 1], np.full(necks, NECK_DEVIATION)]
            ),
            of_law=len(values),
        )

    def law(self, law: Law, vector: Floats) -> Law:
        """Return the law with the parameters of a vector."""
        names = self.names[: self.of_law]
        return law.with_values(dict(zip(names, np.exp(vector[: self.of_law]), strict=True)))

    def natural(self, vector: Floats) -> Floats:
        """Return a vector (..., unknown) with the law's parameters in their own units."""
        result = np.array(vector, dtype=float)
        result[..., : self.of_law] = np.exp(result[..., : self.of_law])
        return result


@dataclass(frozen=True, kw_only=True)
class Model:
    """A beam of a law, loaded by forces, as the sections of a measurement see it."""

    law: Law
    """Its values are those to start from, and the medians of the prior."""
    profile: Profile
    area_deviation: float
    """Relative standard deviation of all areas together."""
    reference_N: float
    """F_0, N."""
    force_noise_N: float
    """Standard deviation of a recorded force, N."""
    carrier: Carrier
    neck: Floats
    """How far each ramp of a neck has grown (ramp, step), from 0 to 1; no ramp where there is no neck."""
    bridgman: bool = False
    """Whether the stress of a neck is corrected by Bridgman's factor."""

    @cached_property
    def unknowns(self) -> Unknowns:
        """Return what is identified."""
        return Unknowns.of(self.law, self.area_deviation, len(self.neck))

    def moved_along(self, carrier: Carrier) -> Model:
        """Return the model as seen by sections that have moved otherwise."""
        return replace(self, carrier=carrier)

    def of_steps(self, steps: slice) -> Model:
        """Return the model of some steps."""
        carrier = replace(self.carrier, shift_mm=self.carrier.shift_mm[steps])
        return replace(self, carrier=carrier, neck=self.neck[:, steps])

    def strains(self, vector: Floats, force_N: Floats) -> tuple[Floats, Floats]:
        """Return elastic and plastic strains from the reference scan on, both (step, height).

        For unknowns (unknown,) and forces (step,), N.
        """
        found, rest = self._loaded(vector, force_N)
        return found.elastic - rest.elastic, found.plastic - rest.plastic + self._necking(vector)

    def amplitude(self, vector: Floats, force_N: Floats) -> Floats:
        """Return amplitudes (step, section * motion), voxels."""
        elastic, plastic = self.strains(vector, force_N)
        found = self.carrier.amplitude(elastic + plastic, self._stretch(vector, elastic, plastic))
        return found.reshape(len(force_N), -1)

    def linear(self, vector: Floats, force_N: Floats) -> Linear:
        """Return amplitudes and their sensitivities, by the chain rule."""
        unknowns, share = self.unknowns, self.profile.stress_share(self.bridgman) / (1 + self._area(vector))
        law = unknowns.law(self.law, vector)
        found, rest = self._loaded(vector, force_N)
        elastic, plastic = found.elastic - rest.elastic, found.plastic - rest.plastic + self._necking(vector)
        stretch = self._stretch(vector, elastic, plastic)
        tangent = self.carrier.tangent(elastic + plastic, stretch)
        ratio_elastic, ratio_plastic = self._poisson(vector)

        def carried(of_elastic: Floats, of_plastic: Floats) -> Floats:
            change = tangent(of_elastic + of_plastic, -ratio_elastic * of_elastic - ratio_plastic * of_plastic)
            return change.reshape(len(force_N), -1)

        nothing = np.zeros_like(elastic)
        columns = [carried(-elastic, nothing)]
        for name in unknowns.names[1 : unknowns.of_law]:
            of_plastic = [-each.plastic_per_MPa * law.partial_MPa(name, each.plastic) for each in (found, rest)]
            columns.append(carried(nothing, of_plastic[0] - of_plastic[1]))
        of_area = [-each.plastic_per_MPa * each.most_MPa / (1 + self._area(vector)) for each in (found, rest)]
        columns.append(carried(-elastic / (1 + self._area(vector)), of_area[0] - of_area[1]))
        columns += [tangent(nothing, -part).reshape(len(force_N), -1) for part in (elastic, plastic)]
        columns += [carried(nothing, ramp[:, None] * self._bump) for ramp in self.neck]
        by_force = carried(nothing + share / law.young_MPa, np.where(found.flows, found.plastic_per_MPa * share, 0.0))
        return Linear(
            amplitude=self.carrier.amplitude(elastic + plastic, stretch).reshape(len(force_N), -1),
            slopes=np.stack(columns, axis=2),
            by_force=by_force,
        )

    def _loaded(self, vector: Floats, force_N: Floats) -> tuple[Strains, Strains]:
        """Return the strains at forces, and those of the reference scan (1, height)."""
        law, profile = self.unknowns.law(self.law, vector), self.profile.scaled(self._area(vector))
        found = strains(law, profile, force_N, noise_N=self.force_noise_N, bridgman=self.bridgman)
        return found, strains(law, profile, np.array([self.reference_N]), bridgman=self.bridgman)

    @cached_property
    def _bump(self) -> Floats:
        """Return the neck's strain along z, one at the smallest section (height,)."""
        smallest = int(self.profile.area_mm2.argmin())
        width = NECK_WIDTH * np.sqrt(self.profile.area_mm2[smallest])
        away = (self.profile.height_mm - self.profile.height_mm[smallest]) / width
        return np.asarray(np.exp(-0.5 * away**2))

    def _necking(self, vector: Floats) -> Floats:
        """Return the neck's strain (step, height)."""
        return np.outer(vector[self.unknowns.of_law + 3 :] @ self.neck, self._bump)

    def _poisson(self, vector: Floats) -> tuple[float, float]:
        """Return the elastic and the plastic ratio."""
        first = self.unknowns.of_law + 1
        return float(vector[first]), float(vector[first + 1])

    def _area(self, vector: Floats) -> float:
        return float(vector[self.unknowns.of_law])

    def _stretch(self, vector: Floats, elastic: Floats, plastic: Floats) -> Floats:
        ratio_elastic, ratio_plastic = self._poisson(vector)
        return np.maximum(1 - ratio_elastic * elastic - ratio_plastic * plastic, LEAST_STRETCH)


@dataclass(frozen=True, kw_only=True)
class Linear:
    """What a law makes of the sections near some unknowns and forces."""

    amplitude: Floats
    """(step, section * motion), voxels."""
    slopes: Floats
    """d amplitude / d unknown (step, section * motion, unknown)."""
    by_force: Floats
    """d amplitude / d force (step, section * motion), voxels per N: each step's, by its own force."""


def neck_ramps(steps: int, loaded: int) -> Floats:
    """Return how far each ramp of a neck has grown (ramp, step): 0 until it begins, 1 at the last step.

    `loaded` is the first loaded step.
    """
    last = steps - 1
    begin = last - NECK_SHARE * (last - loaded) * np.array([1.0, 2 / 3, 1 / 3])
    return np.asarray(np.clip((np.arange(steps) - begin[:, None]) / np.maximum(last - begin[:, None], 1e-9), 0.0, 1.0))
