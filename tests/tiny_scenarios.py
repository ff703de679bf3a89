"""Scenarios small enough for a test, as text, as records and as trials."""

from __future__ import annotations

import tomllib
from typing import Any

from pdvc.options import MeasureOptions, StageOptions
from pdvc.pgd import Pgd
from simulator.scenario import Scenario
from validation.batch.trial import Trial

TINY = """
name = "tiny"
title = "Small enough for a test"
discarded_rows = 12

[graphite]
mean_diameter_mm = 0.25
smallest_diameter_mm = 0.1
largest_diameter_mm = 0.5
gap_mm = 0.016

[geometry]
pixel_mm = 2.3968
rows = 119
columns = 54

[acquisition]
reference_views = 60
test_steps = 25
steps_per_turn = 10
subpixels = 2

[loading]
plateau_steps = 10
stroke_mm_per_s = 0.01
"""
"""An experiment of 119 x 54 px that is simulated and measured in a few seconds."""

SHORT = """
name = "tiny"
title = "Smaller still, and with fewer steps"
discarded_rows = 8

[graphite]
mean_diameter_mm = 0.4
smallest_diameter_mm = 0.3
largest_diameter_mm = 0.6
gap_mm = 0.016

[geometry]
pixel_mm = 4.8
rows = 60
columns = 28

[acquisition]
reference_views = 36
test_steps = 14
steps_per_turn = 10
subpixels = 2

[loading]
plateau_steps = 10
stroke_mm_per_s = 0.01
"""
"""An experiment of 60 x 28 px, for commands of which only their course counts."""

FAST = {
    "rigid": (StageOptions(scale="coarse", solver=Pgd(most_modes=2)),),
    "deformation": (StageOptions(scale=1, solver=Pgd(most_modes=2)),),
}


def trial(options: dict[str, Any] | None = None, **changes: Any) -> Trial:
    """Return a trial of `TINY`, measured in a few passes, with changed options and values of the scenario."""
    values = tomllib.loads(TINY)
    for key, value in changes.items():
        values[key] = {**values[key], **value} if isinstance(values.get(key), dict) else value
    scenario = Scenario.parse(values, where="trial")
    return Trial(scenario=scenario, options=MeasureOptions(**FAST, **(options or {})), factors={})


def tinier(**changes: Any) -> Scenario:
    """Return an experiment of 40 x 24 px that takes a fraction of a second."""
    values = {
        "name": "tiny",
        "discarded_rows": 4,
        "specimen": {"facet_mm": 0.12, "thinned": "both"},
        "graphite": {"mean_diameter_mm": 0.2, "smallest_diameter_mm": 0.1, "largest_diameter_mm": 0.4},
        "geometry": {"rows": 40, "columns": 24, "pixel_mm": 7.1},
        "acquisition": {"reference_views": 20, "test_steps": 20, "steps_per_turn": 10, "subpixels": 2},
        "loading": {"plateau_steps": 8, "stroke_mm_per_s": 0.01, "necking_strain": 0.0},
    }
    for key, value in changes.items():
        values[key] = {**values[key], **value} if isinstance(values.get(key), dict) else value
    return Scenario.parse(values, where="tiny")
