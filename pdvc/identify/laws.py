"""Elastoplastic laws of a material point in tension: flow stress against plastic strain, plastic strain of a stress.

A law tells the flow stress s_f(p) at the accumulated plastic strain p, growing with p. At a stress s that grows the
point yields where |s| > s_f(0), and its plastic strain is the root of s_f(p) = |s|; the consistent tangent is
1/E + 1/s_f'(p). On unloading p stays and the tangent is 1/E: isotropic hardening.

Its parameters are the fields of the record: all positive, in natural units, each with a value to start from. A law of
one's own is a subclass with a `kind`, its fields, and `flow_MPa`; TOML and the command line find it then.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from pdvc.settings import Choice, SettingsError, load_plugins

Floats = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0)]

LEAST_PLASTIC, MOST_PLASTIC = 1e-12, 1.0
"""Plastic strains between which a root is sought; a stress that asks for more is beyond what the law carries."""
_NEARBY = 1e-5
"""Share of p over which slopes are taken."""
_STARTS_AT, _STARTS_WITH = 0.1, 1.1
"""A law to start from carries a tenth more than the largest stress at a plastic strain of 0.1: one that cannot carry a
test has no slope that leads to one that can."""
_LEAST_SLOPE_MPA = 1e-30
_ROUNDS = 60
_TABLE = 512
"""Plastic strains at which a law is looked up to bracket a root."""
_CLOSE = 1e-13


class Law(Choice):
    """A law: flow stress against plastic strain, and Young's modulus."""

    young_MPa: Positive = 200e3
    """Young's modulus E, MPa"""

    def flow_MPa(self, plastic: Floats) -> Floats:
        """Return the flow stress s_f at accumulated plastic strains p (any shape, not negative), MPa."""
        raise NotImplementedError

    def slope_MPa(self, plastic: Floats) -> Floats:
        """Return the hardening modulus s_f' (the shape of `plastic`, positive), MPa, by central differences."""
        p = np.maximum(plastic, LEAST_PLASTIC)
        far, near = p * (1 + _NEARBY), p * (1 - _NEARBY)
        return np.asarray((self.flow_MPa(far) - self.flow_MPa(near)) / (far - near))

    def partial_MPa(self, name: str, plastic: Floats) -> Floats:
        """Return d s_f / d log of a parameter (the shape of `plastic`), MPa, by central differences."""
        value = float(getattr(self, name))
        more, less = (self.with_values({name: value * (1 + sign * _NEARBY)}) for sign in (1, -1))
        return np.asarray((more.flow_MPa(plastic) - less.flow_MPa(plastic)) / (2 * _NEARBY))

    def values(self) -> dict[str, float]:
        """Return the parameters by their names, Young's modulus first."""
        return {name: float(getattr(self, name)) for name in type(self).model_fields if name != "kind"}

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Return the law with other values of some parameters."""
        return self.model_copy(update={name: float(value) for name, value in values.items()})

    def started_for(self, stress_MPa: float) -> Self:
        """Return the law to start from for a test up to a stress: all its stresses scaled, to carry a little more."""
        carried = float(self.flow_MPa(np.array([_STARTS_AT]))[0])
        share = _STARTS_WITH * stress_MPa / carried
        stresses = {name: value for name, value in self.values().items() if name.endswith("_MPa")}
        return self.with_values({name: share * value for name, value in stresses.items() if name != "young_MPa"})


class Ludwik(Law):
    """s_y + K p^n."""

    kind: Literal["ludwik"] = "ludwik"
    """yield stress and a power of the plastic strain"""
    yield_MPa: Positive = 300.0
    """yield stress s_y, MPa"""
    hardening_MPa: Positive = 500.0
    """K, MPa"""
    exponent: Positive = 0.3
    """n, without unit"""

    def flow_MPa(self, plastic: Floats) -> Floats:
        """Return s_y + K p^n."""
        return np.asarray(self.yield_MPa + self.hardening_MPa * plastic**self.exponent)


class Voce(Law):
    """s_y + Q (1 - exp(-b p)): hardening that saturates."""

    kind: Literal["voce"] = "voce"
    """yield stress and hardening that saturates"""
    yield_MPa: Positive = 300.0
    """yield stress s_y, MPa"""
    saturation_MPa: Positive = 300.0
    """Q, MPa"""
    rate: Positive = 20.0
    """b, without unit"""

    def flow_MPa(self, plastic: Floats) -> Floats:
        """Return s_y + Q (1 - exp(-b p))."""
        return np.asarray(self.yield_MPa - self.saturation_MPa * np.expm1(-self.rate * plastic))


class RambergOsgood(Law):
    """s_02 (p / 0.002)^n: plastic from the first, with the stress s_02 at a plastic strain of 0.2 %."""

    kind: Literal["ramberg-osgood"] = "ramberg-osgood"
    """plastic from the first, a power of the stress"""
    proof_MPa: Positive = 350.0
    """proof stress s_02 at a plastic strain of 0.2 %, MPa"""
    exponent: Positive = 0.15
    """n, without unit: one over Ramberg and Osgood's"""

    def flow_MPa(self, plastic: Floats) -> Floats:
        """Return s_02 (p / 0.002)^n."""
        return np.asarray(self.proof_MPa * (plastic / 0.002) ** self.exponent)


class Swift(Law):
    """K (p_0 + p)^n."""

    kind: Literal["swift"] = "swift"
    """a power of the plastic strain and of one before the test"""
    hardening_MPa: Positive = 900.0
    """K, MPa"""
    prestrain: Positive = 0.005
    """p_0, without unit"""
    exponent: Positive = 0.2
    """n, without unit"""

    def flow_MPa(self, plastic: Floats) -> Floats:
        """Return K (p_0 + p)^n."""
        return np.asarray(self.hardening_MPa * (self.prestrain + plastic) ** self.exponent)


class Linear(Law):
    """s_y + H p."""

    kind: Literal["linear"] = "linear"
    """yield stress and a constant hardening modulus"""
    yield_MPa: Positive = 350.0
    """yield stress s_y, MPa"""
    modulus_MPa: Positive = 4000.0
    """hardening modulus H, MPa"""

    def flow_MPa(self, plastic: Floats) -> Floats:
        """Return s_y + H p."""
        return np.asarray(self.yield_MPa + self.modulus_MPa * plastic)


class MultiVoce(Law):
    """s_y + sum_k Q_k (1 - exp(-p / p_k)), p_k = 0.001, 0.004, 0.016, 0.064: nearly any shape."""

    kind: Literal["multi-voce"] = "multi-voce"
    """yield stress and four terms that saturate at plastic strains of 0.1, 0.4, 1.6 and 6.4 %: nearly any shape"""
    yield_MPa: Positive = 250.0
    """yield stress s_y, MPa"""
    first_MPa: Positive = 60.0
    """Q_1, MPa"""
    second_MPa: Positive = 60.0
    """Q_2, MPa"""
    third_MPa: Positive = 60.0
    """Q_3, MPa"""
    fourth_MPa: Positive = 100.0
    """Q_4, MPa"""

    def flow_MPa(self, plastic: Floats) -> Floats:
        """Return s_y + sum_k Q_k (1 - exp(-p / p_k))."""
        terms = (self.first_MPa, self.second_MPa, self.third_MPa, self.fourth_MPa)
        saturating = (-q * np.expm1(-plastic / p) for q, p in zip(terms, (0.001, 0.004, 0.016, 0.064), strict=True))
        return np.asarray(self.yield_MPa + sum(saturating))


def law_named(kind: str) -> Law:
    """Return the law of a kind, with the values to start from; raises SettingsError where there is none."""
    for _ in range(2):
        for each in Law.kinds():
            if each.model_fields["kind"].default == kind:
                return each.model_validate({})
        load_plugins()
    known = ", ".join(str(each.model_fields["kind"].default) for each in Law.kinds())
    raise SettingsError(f"law: expected one of {known}, or what an installed plug-in offers, got {kind!r}")


def plastic_at(law: Law, stress_MPa: ArrayLike) -> Floats:
    """Return the plastic strain (of the shape of the stress) that a stress growing up to s >= 0 leaves.

    The root of s_f(p) = s in log p, by Newton's method kept within a bracket. At most `MOST_PLASTIC`.
    """
    stress = np.asarray(stress_MPa, dtype=float)
    found = np.zeros(stress.shape)
    yields = stress > law.flow_MPa(np.full(1, LEAST_PLASTIC))[0]
    wanted = stress[yields]
    table = np.linspace(np.log(LEAST_PLASTIC), np.log(MOST_PLASTIC), _TABLE)
    place = np.searchsorted(law.flow_MPa(np.exp(table)), wanted).clip(1, _TABLE - 1)
    low, high = table[place - 1], table[place]
    x = (low + high) / 2
    for _ in range(_ROUNDS):
        p = np.exp(x)
        left = law.flow_MPa(p) - wanted
        low, high = np.where(left < 0, x, low), np.where(left < 0, high, x)
        newton = x - left / np.maximum(law.slope_MPa(p) * p, _LEAST_SLOPE_MPA)
        # at its end Newton stays where it is, which is a bound by then
        inside = (newton >= low) & (newton <= high)
        moved = np.where(inside, newton, (low + high) / 2)
        done = np.max(np.abs(moved - x), initial=0.0) < _CLOSE
        x = moved
        if done:
            break
    found[yields] = np.exp(x)
    return found
