"""Kernels give the same bits in the process that compiles them and in later ones, which load them."""

from __future__ import annotations

import importlib
import pkgutil

import pytest
from numba.core.dispatcher import Dispatcher

import pdvc
import simulator
from pdvc.apart import IN_ORDER

KERNELS = {
    f"{kernel.__module__}.{kernel.__name__}": kernel
    for package in (pdvc, simulator)
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    if not module.ispkg
    for kernel in vars(importlib.import_module(module.name)).values()
    if isinstance(kernel, Dispatcher)
}


def test_kernels_are_found() -> None:
    """The walk along the rays is among them, and what it calls."""
    assert {"pdvc.walk.walk_bands", "pdvc.walk._sum_all", "pdvc.sensitivity_sums._dot"} <= set(KERNELS)


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_sums_are_worked_out_as_they_are_written(name: str) -> None:
    """Reordered, fused or approximated arithmetic may differ from copy to copy of a function: there is one copy then.

    `python -m benchmarks.first_use` compares a whole measurement.
    """
    options = KERNELS[name].targetoptions
    fast = options.get("fastmath", False)
    assert fast in (False, IN_ORDER) or (fast is not True and options.get("forceinline", False))
