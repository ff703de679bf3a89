"""All bad inputs, and the good ones that must not be called wrong."""

from __future__ import annotations

from benchmarks.bad_inputs import counts, description, experiments, files, followed, options, order
from benchmarks.bad_inputs.record import BadInput

CATALOGUE: tuple[BadInput, ...] = (
    *counts.CASES,
    *order.CASES,
    *files.CASES,
    *description.CASES,
    *options.CASES,
    *experiments.CASES,
    *files.CONTROLS,
    *experiments.CONTROLS,
)
"""In the order of the table: bad ones by what is wrong with them, then good ones."""

FOLLOWED: tuple[BadInput, ...] = followed.CASES
"""Those of the commands about a test while it runs."""
