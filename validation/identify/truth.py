"""The true law of a simulated experiment."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from simulator.loading import Loading


def truth_of(loading: Loading) -> dict[str, float]:
    """Return the true parameters of a scenario's law, by the names of `pdvc.identify.laws.Ludwik`."""
    return {
        "young_MPa": loading.young_MPa,
        "yield_MPa": loading.yield_MPa,
        "hardening_MPa": loading.hardening_MPa,
        "exponent": loading.hardening_exponent,
    }
