"""Intermediate results kept in a work folder, so that an interrupted measurement goes on where it was."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.experiment import Experiment


class Store:
    """Keep named arrays on disk, under names that tell experiments and purposes apart; without a folder, keep none."""

    def __init__(self, folder: Path | None, experiment: Experiment) -> None:
        self._folder = folder
        self._key = _fingerprint(experiment) if folder else ""

    def arrays(self, name: str, make: Callable[[], Mapping[str, NDArray[Any]]]) -> Mapping[str, NDArray[Any]]:
        """Return the arrays of that name, made and kept if they are not there; the name holds all they depend on."""
        if self._folder is None:
            return make()
        digest = hashlib.sha256(f"{self._key} {name}".encode()).hexdigest()[:12]
        path = self._folder / f"{name.split()[0]}-{digest}.npz"
        if path.exists():
            with np.load(path) as kept:
                return dict(kept)
        values = make()
        self._folder.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        with partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **values)
        partial.replace(path)
        return values


def _fingerprint(experiment: Experiment) -> str:
    """Return a digest of the geometry, the angles and forces, and a sample of the counts."""
    digest = hashlib.sha256(repr(experiment.geometry).encode())
    held = (scan.series for scan in experiment.interrupted)
    for series in (experiment.reference, experiment.test, *held):
        every = max(1, len(series) // 8)
        for part in (series.angle_rad, series.force_N, series.counts[::every]):
            digest.update(np.ascontiguousarray(part).tobytes())
    for images in (experiment.flats, experiment.darks):
        digest.update(np.ascontiguousarray(images).tobytes())
    return digest.hexdigest()
