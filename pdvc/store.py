"""Intermediate results kept in a work folder, so that an interrupted measurement goes on where it was.

What is kept is found by the digest of all that it depends on: the software, every count and every number of the
experiment but its title and material, and what the caller names besides. So a file that a work folder holds can be
old, but never wrong.
"""

from __future__ import annotations

import hashlib
import io
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.digest import digest, software
from pdvc.experiment import Experiment
from pdvc.whole import write_whole

Arrays = Mapping[str, NDArray[Any]]
Keep = Callable[[Callable[[], Arrays]], Arrays]
"""`Store.arrays` with all but `make` given: makes arrays, or finds them kept."""

_SEAL = hashlib.sha256().digest_size
"""Bytes at the head of a kept file: the digest of the rest, an .npz archive."""


class Store:
    """Keep arrays on disk, under the digest of all that they depend on; without a folder, keep none."""

    def __init__(self, folder: Path | None, experiment: Experiment) -> None:
        self._folder = folder
        self._reference = reference_digest(experiment) if folder else ""
        self._whole = _whole(self._reference, experiment) if folder else ""

    def arrays(self, name: str, depends: tuple[Any, ...], make: Callable[[], Arrays]) -> Arrays:
        """Return what `make` makes of the experiment and of what else it `depends` on; read where it was kept."""
        return self._kept(name, (self._whole, *depends), make)

    def of_reference(self, name: str, depends: tuple[Any, ...], make: Callable[[], Arrays]) -> Arrays:
        """Return what `make` makes of the reference scan alone: every experiment with the same one finds it."""
        return self._kept(name, (self._reference, *depends), make)

    def _kept(self, name: str, depends: tuple[Any, ...], make: Callable[[], Arrays]) -> Arrays:
        if self._folder is None:
            return make()
        path = self._folder / f"{name}-{digest(name, *depends)}.kept"
        found = read_arrays(path)
        if found is not None:
            return found
        values = make()
        write_arrays(path, values)
        return values


def write_arrays(path: Path, values: Arrays) -> None:
    """Write arrays to a sealed file, whole or not at all."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **values)
    sealed = hashlib.sha256(content.getbuffer()).digest() + content.getvalue()
    # another process may keep the same at the same time: each writes its own file
    write_whole(path, sealed, partial=path.with_suffix(f".{uuid.uuid4().hex}.partial"))


def read_arrays(path: Path) -> Arrays | None:
    """Return the arrays of a file; None where it is not there, cut short or damaged: then they are made again."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    seal, rest = content[:_SEAL], memoryview(content)[_SEAL:]
    if hashlib.sha256(rest).digest() != seal:
        return None
    with np.load(io.BytesIO(rest)) as kept:
        return dict(kept)


def reference_digest(experiment: Experiment) -> str:
    """Return a digest of the software and of all that a reconstruction of the reference scan may depend on."""
    return digest(
        software("pdvc"),
        experiment.geometry,
        experiment.frames,
        experiment.photons_per_count,
        experiment.readout_noise_counts,
        experiment.flats,
        experiment.darks,
        experiment.reference,
    )


def experiment_digest(experiment: Experiment) -> str:
    """Return a digest of the software and of all of an experiment but its title and material."""
    return _whole(reference_digest(experiment), experiment)


def _whole(reference: str, experiment: Experiment) -> str:
    return digest(reference, experiment.test, experiment.interrupted)
