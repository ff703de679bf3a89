"""Random numbers: one stream for each random thing of a scenario, so that none depends on how many were drawn before.

A stream is seeded by the scenario's seed, by what it is for, and by the numbers of the image that it is drawn for. A
repetition draws the noise anew and leaves the sample and the detector.
"""

from __future__ import annotations

import numpy as np

from simulator.scenario import Scenario

_STREAMS = (
    *("reference", "test", "flats", "darks", "nodules", "maps", "force", "interrupted", "interrupted force"),
    *("stage", "panel"),
)
"""What random numbers are drawn for, one stream for each; the order is part of every result."""
_NOISE = ("reference", "test", "flats", "darks", "force", "interrupted", "interrupted force")
"""Streams that a repetition draws anew."""


def stream(scenario: Scenario, name: str, *index: int) -> np.random.Generator:
    """Return the generator of one image, or of one other random thing; of the first one without an index."""
    key = (_STREAMS.index(name), *(index or (0,)))
    if scenario.repetition and name in _NOISE:
        key = (*key, scenario.repetition)
    return np.random.default_rng(np.random.SeedSequence(scenario.seed, spawn_key=key))
