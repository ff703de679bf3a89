"""Intermediate results kept in a work folder, so that an interrupted measurement goes on where it was."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.experiment import Experiment, Series


class Store:
    """Keep named arrays on disk, under names that tell experiments and purposes apart; without a folder, keep none."""

    def __init__(self, folder: Path | None, experiment: Experiment) -> None:
        self._folder = folder
        self._reference = _fingerprint(experiment, (experiment.reference,)) if folder else ""
        tested = (experiment.test, *(scan.series for scan in experiment.interrupted))
        self._whole = _fingerprint(experiment, (experiment.reference, *tested)) if folder else ""

    def arrays(
        self, name: str, make: Callable[[], Mapping[str, NDArray[Any]]], *, reference_alone: bool = False
    ) -> Mapping[str, NDArray[Any]]:
        """Return the arrays of that name, made and kept if they are not there; the name holds all they depend on.

        What depends on the reference scan alone is found again by every experiment that has the same one.
        """
        if self._folder is None:
            return make()
        key = self._reference if reference_alone else self._whole
        digest = hashlib.sha256(f"{key} {name}".encode()).hexdigest()[:12]
        path = self._folder / f"{name.split()[0]}-{digest}.npz"
        if path.exists():
            with np.load(path) as kept:
                return dict(kept)
        values = make()
        self._folder.mkdir(parents=True, exist_ok=True)
        # another process may keep the same at the same time: each writes its own file
        partial = path.with_suffix(f".{uuid.uuid4().hex}.partial")
        with partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **values)
        partial.replace(path)
        return values


def _fingerprint(experiment: Experiment, stacks: tuple[Series, ...]) -> str:
    """Return a digest of geometry, flats and darks, and of the stacks: angles, forces, and a sample of the counts."""
    digest = hashlib.sha256(repr(experiment.geometry).encode())
    for series in stacks:
        every = max(1, len(series) // 8)
        for part in (series.angle_rad, series.force_N, series.counts[::every]):
            digest.update(np.ascontiguousarray(part).tobytes())
    for images in (experiment.flats, experiment.darks):
        digest.update(np.ascontiguousarray(images).tobytes())
    return digest.hexdigest()
