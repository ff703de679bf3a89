"""One pass over all radiographs of one scale: the small systems B(t), c(t) that every solver starts from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import psutil
from numpy.typing import NDArray

from pdvc.progress import Progress, silent
from pdvc.projection import BlockVectors, normal_equations, project
from pdvc.sections import SectionBasis
from pdvc.systematic import Systematic
from pdvc.volume import Volume

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

STEPS_AT_ONCE = 8
MEMORY_SHARE = 0.5
"""Of the free memory, what the unknowns may need: images and other work need some, too."""
COPIES = 10
"""Matrices of all unknowns that are held at a time: Hessian, inverse, parts of the noise, their products."""


@dataclass(frozen=True, kw_only=True)
class Images:
    """The radiographs of one scale, and the volume that is to be matched with them."""

    rays: Floats
    """RayVectors.stacked() of the used window (step, 4, 3), mm."""
    grey: Image
    """Radiographs g (step, row, column), grey levels, of the used window."""
    weight: Image
    """Weights (step, row, column), or (1, row, column) where all steps share them; zero: unused; mean about 1."""
    volume: Volume
    systematic: Systematic | None
    """What the volume's re-projection leaves, to be registered and subtracted; None: nothing is."""
    voxel_mm: float
    """Voxel in which amplitudes are counted, mm: that of scale 1, whatever this scale."""

    @property
    def used_pixels(self) -> int:
        """Return the number of pixels, over all steps, whose weight is not zero."""
        return int(np.count_nonzero(self.weight)) * (len(self.grey) // len(self.weight))


@dataclass(frozen=True, kw_only=True)
class Equations:
    """B(t), c(t) and the residual at one trial motion."""

    matrix: Floats
    """B (step, section * motion, section * motion)."""
    vector: Floats
    """c (step, section * motion)."""
    chi2: Floats
    """Weighted sum of squared residuals of each step (step,)."""
    residual: Image
    """rho (step, row, column), grey levels; of volumes (step, z, y, x), grey levels per mm."""
    pixels: int
    """Number of used pixels, or voxels, over all steps."""
    blocks: tuple[BlockVectors, ...] = ()
    """c of each step, block by block; of volumes none."""

    @property
    def rms(self) -> float:
        """Return the weighted rms residual, in the unit of the residual."""
        return float(np.sqrt(self.chi2.sum() / self.pixels))


Linearise = Callable[[Floats], Equations]
"""From trial amplitudes (step, section, motion) to the equations there."""


def memory_bytes(time_functions: Floats, basis: SectionBasis) -> int:
    """Return what the equations of all steps and the covariance of all unknowns need, about, bytes."""
    functions, steps = time_functions.shape
    size = basis.shape[0] * basis.shape[1]
    joined = functions * size if np.count_nonzero(time_functions, axis=0).max() > 1 else size
    return int(8 * (2 * steps * size**2 + COPIES * joined**2))


def check_size(time_functions: Floats, basis: SectionBasis) -> None:
    """Raise ValueError where the equations and the covariance of all unknowns need more than half of the memory."""
    functions, needed = len(time_functions), memory_bytes(time_functions, basis)
    free = psutil.virtual_memory().available
    if needed > MEMORY_SHARE * free:
        raise ValueError(
            f"sections, time: expected unknowns that fit into memory, got {functions} time functions of "
            f"{basis.shape[0]} sections with {basis.shape[1]} motions, which need {needed / 2**30:.1f} GiB where "
            f"{free / 2**30:.1f} are free"
        )


def linearise(
    images: Images, basis: SectionBasis, amplitude: Floats, *, progress: Progress = silent, task: str = "pass"
) -> Equations:
    """Walk all radiographs once at trial amplitudes (step, section, motion), in voxels."""
    steps, size = len(images.grey), basis.shape[0] * basis.shape[1]
    matrix, vector, chi2 = np.empty((steps, size, size)), np.empty((steps, size)), np.empty(steps)
    residual = np.empty_like(images.grey)
    blocks: list[BlockVectors] = []
    for part in _parts(steps):
        result = normal_equations(
            images.volume,
            images.rays[part],
            basis,
            amplitude[part],
            _target(images, basis, amplitude, part),
            images.weight if len(images.weight) == 1 else images.weight[part],
            voxel_mm=images.voxel_mm,
        )
        matrix[part], vector[part], chi2[part] = result.matrix, result.vector, result.chi2
        residual[part] = result.residual
        blocks += result.blocks
        progress(task, part.stop, steps)
    return Equations(
        matrix=matrix,
        vector=vector,
        chi2=chi2,
        residual=residual,
        pixels=images.used_pixels,
        blocks=tuple(blocks),
    )


def joined(blocks: Floats, time_functions: Floats, others: Floats | None = None) -> Floats:
    """Return sum_n sigma(n) sigma'(n)^T (x) block(n): of B(t), the Hessian of all unknowns.

    `blocks` (n, unknown, unknown), with unknown = section * motion; `time_functions` (function, n), and `others` the
    same, or those of the other one of two steps that a block joins. Returns (function * unknown, function * unknown).
    """
    functions, count = time_functions.shape
    size = blocks.shape[1]
    second = time_functions if others is None else others
    pairs = np.einsum("ft,gt->fgt", time_functions, second).reshape(-1, count)
    found = (pairs @ blocks.reshape(count, -1)).reshape(functions, functions, size, size)
    return np.ascontiguousarray(found.transpose(0, 2, 1, 3)).reshape(functions * size, functions * size)


def residuals(
    images: Images, basis: SectionBasis, amplitude: Floats, *, progress: Progress = silent, task: str = "residual"
) -> Image:
    """Return the residual fields (step, row, column) alone, at half the cost of a full pass."""
    result = np.empty_like(images.grey)
    shape = (images.grey.shape[1], images.grey.shape[2])
    for part in _parts(len(images.grey)):
        model = project(images.volume, images.rays[part], shape, basis, amplitude[part], voxel_mm=images.voxel_mm)
        result[part] = model - _target(images, basis, amplitude, part)
        progress(task, part.stop, len(images.grey))
    return result


def _parts(steps: int) -> list[slice]:
    """Return the ranges of steps that are worked on together: enough of them to keep all threads busy."""
    return [slice(start, min(start + STEPS_AT_ONCE, steps)) for start in range(0, steps, STEPS_AT_ONCE)]


def _target(images: Images, basis: SectionBasis, amplitude: Floats, part: slice) -> Image:
    """Return what the bare projections should equal: the radiographs plus the registered systematic residual."""
    if images.systematic is None:
        return images.grey[part]
    left = images.systematic.registered(part, images.rays[part], basis, amplitude[part], images.voxel_mm)
    left += images.grey[part]
    return left
