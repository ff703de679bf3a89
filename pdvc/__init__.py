"""Projection-based digital volume correlation: the motion of a sample from one radiograph for each load step.

The names below are the public interface, which changes only with a note in the changelog; all of them are loaded when
they are first asked for. What else the package holds can be used, and may change.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pdvc.experiment import Experiment, read_experiment
    from pdvc.inspection import inspect
    from pdvc.measurement import Measurement
    from pdvc.measurement_file import dataset_of, read_measurement
    from pdvc.options import MeasureOptions, paper_options
    from pdvc.plotting import plot
    from pdvc.points import displacement, strain
    from pdvc.protocol import measure
    from pdvc.resumable import measure_into

__all__ = [
    "Experiment",
    "MeasureOptions",
    "Measurement",
    "dataset_of",
    "displacement",
    "inspect",
    "measure",
    "measure_into",
    "paper_options",
    "plot",
    "read_experiment",
    "read_measurement",
    "strain",
]

_ROOMS = {
    "Experiment": "experiment",
    "MeasureOptions": "options",
    "Measurement": "measurement",
    "dataset_of": "measurement_file",
    "displacement": "points",
    "inspect": "inspection",
    "measure": "protocol",
    "measure_into": "resumable",
    "paper_options": "options",
    "plot": "plotting",
    "read_experiment": "experiment",
    "read_measurement": "measurement_file",
    "strain": "points",
}


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module 'pdvc' has no attribute {name!r}")
    return getattr(import_module(f"pdvc.{_ROOMS[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
