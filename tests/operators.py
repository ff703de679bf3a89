"""The test that every linear operator and its adjoint must pass."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Map = Callable[[Floats], NDArray[np.floating]]


def dottest(
    forward: Map, adjoint: Map, domain: tuple[int, ...], image: tuple[int, ...], *, rtol: float = 1e-5, seed: int = 0
) -> None:
    """Assert <A u, v> = <u, A^T v> for random u of shape `domain` and v of shape `image`.

    v is half noise and half A u, so that neither side is small by chance. What differs is allowed to be `rtol` of
    |A u| |v|. Five pairs are drawn, of different sizes: an error of one kind may be nearly across a single pair.
    """
    rng = np.random.default_rng(seed)
    for size in (1.0, 0.3, 2.0, 0.5, 4.0):
        u, noise = size * rng.normal(size=domain), rng.normal(size=image)
        moved = np.asarray(forward(u), dtype=np.float64)
        assert moved.shape == image
        norm = np.linalg.norm(moved)
        assert norm > 0
        v = moved / norm + noise / np.linalg.norm(noise)
        back = np.asarray(adjoint(v), dtype=np.float64)
        assert back.shape == domain
        left, right = float((moved * v).sum()), float((u * back).sum())
        assert abs(left - right) <= rtol * norm * np.linalg.norm(v), f"<A u, v> = {left}, <u, A^T v> = {right}"
