"""Direct Gauss-Newton solve of all unknowns over the same equations that PGD uses.

With u_ij the amplitudes, sigma the time functions, and B(t), c(t) of one pass,

    H = sum_t sigma(t) sigma(t)^T (x) B(t),       h = sum_t sigma(t) (x) c(t),       H du = h

(x) being Kronecker's product: 7 x 90 = 630 unknowns at the paper's size. A prior adds to H and h.

Time functions that share no step leave H in blocks. Each block is then solved, shortened and stopped by itself, its
prior weighed against its own residual, as if there were no other steps: with one function for each step, 127 systems
of 105 unknowns instead of one of 13335, and no step holds another back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from pdvc.equations import Equations, Linearise, joined
from pdvc.prior import Prior, solved
from pdvc.solution import SHORTER, Problem, Solution, Solver, evaluated, lowers
from pdvc.verdict import Stop

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, kw_only=True)
class Block:
    """Time functions that share steps with each other and with no others."""

    functions: Indices
    steps: Indices
    """Steps at which any of them is not zero."""


def blocks_of(time_functions: Floats) -> tuple[Block, ...]:
    """Return the blocks into which time functions (function, step) fall; one block where all are linked."""
    used = time_functions != 0
    count, label = connected_components(csr_array(used @ used.T), directed=False)
    members = [np.flatnonzero(label == k) for k in range(count)]
    return tuple(Block(functions=own, steps=np.flatnonzero(used[own].any(axis=0))) for own in members)


class GaussNewton(Solver):
    """All unknowns at once, by Gauss-Newton steps."""

    kind: Literal["gauss-newton"] = "gauss-newton"
    """all unknowns at once"""
    most_passes: Annotated[int, Field(ge=1)] = 4
    """largest number of steps, each a pass over all radiographs"""
    least_change_voxel: Annotated[float, Field(gt=0)] = 2e-3
    """converged: the displacement changes by less than this, voxel rms"""

    def solve(self, problem: Problem) -> Solution:
        """Repeat the direct solve until it converges, or as often as allowed; the noise is not asked for."""
        return solve(
            problem.linearise,
            problem.time_functions,
            problem.start,
            problem.prior,
            most_passes=self.most_passes,
            least_change_voxel=self.least_change_voxel,
        )

    @property
    def passes(self) -> float:
        """Return about how many passes over all radiographs it may take."""
        return self.most_passes * 0.6 + 1


def solve(
    linearise: Linearise,
    time_functions: Floats,
    start: Floats,
    prior: Prior,
    *,
    most_passes: int,
    least_change_voxel: float,
) -> Solution:
    """Repeat the direct solve until the rms change of displacement falls under `least_change_voxel` in every block.

    Shapes and units as in pgd.solve.
    """
    shape = start.shape
    coefficients = start.reshape(len(start), -1).copy()
    at = evaluated(linearise, time_functions, shape)
    blocks = blocks_of(time_functions)

    equations = at(coefficients)
    rms = [equations.rms]
    moving, stuck, last = list(blocks), 0, 0.0
    for _ in range(most_passes):
        change = np.zeros_like(coefficients)
        for block in moving:
            change[block.functions] = _change(equations, time_functions, coefficients, prior, block)
        share, coefficients, equations = _carefully(at, equations, coefficients, change, prior, moving)
        sizes = [_size(step * change, time_functions, shape, block) for step, block in zip(share, moving, strict=True)]
        if any(share):
            rms.append(equations.rms)
            last = max(sizes)
        stuck += share.count(0.0)
        moving = [block for block, size in zip(moving, sizes, strict=True) if size >= least_change_voxel]
        if not moving:
            break
    return Solution(
        coefficients=coefficients.reshape(shape),
        equations=equations,
        temporal=np.empty((0, time_functions.shape[1])),
        spatial=np.empty((0, *shape[1:])),
        rms=np.array(rms),
        last_change_voxel=last,
        stop=Stop.UNFINISHED if moving else Stop.NO_GAIN if stuck == len(blocks) else Stop.CONVERGED,
        stop_reason=_reason(len(blocks), len(moving), stuck, last, least_change_voxel, most_passes),
    )


def _change(equations: Equations, time_functions: Floats, coefficients: Floats, prior: Prior, block: Block) -> Floats:
    """Return what one direct solve adds to a block's coefficients (function, section * motion)."""
    own, part = time_functions[np.ix_(block.functions, block.steps)], _of(equations, block)
    now = coefficients[block.functions]
    ridge = np.tile(prior.ridge(part.rms), len(own))
    matrix = joined(part.matrix, own)
    matrix[np.diag_indices_from(matrix)] += ridge
    vector = (own @ part.vector).ravel() - ridge * now.ravel()
    return solved(matrix, vector).reshape(now.shape)


def _of(equations: Equations, block: Block) -> Equations:
    """Return the equations of a block's steps, as if there were no others."""
    steps, total = block.steps, len(equations.chi2)
    if len(steps) == total:
        return equations
    return replace(
        equations,
        matrix=equations.matrix[steps],
        vector=equations.vector[steps],
        chi2=equations.chi2[steps],
        residual=equations.residual[steps],
        pixels=equations.pixels * len(steps) // total,
    )


def _carefully(
    at: Callable[[Floats], Equations],
    now: Equations,
    coefficients: Floats,
    change: Floats,
    prior: Prior,
    blocks: list[Block],
) -> tuple[list[float], Floats, Equations]:
    """Let each block go its whole change, half of it or a quarter: the most that lowers what it minimises, or nothing.

    Returns the share that each block went, and the coefficients and equations there.
    """
    share = np.zeros(len(blocks))
    reached, equations = coefficients, now
    for step in SHORTER:
        moved, left = reached.copy(), np.flatnonzero(share == 0)
        for k in left:
            moved[blocks[k].functions] += step * change[blocks[k].functions]
        trial = at(moved)
        for k in left:
            own = blocks[k].functions
            if lowers(_of(now, blocks[k]), coefficients[own], _of(trial, blocks[k]), moved[own], prior):
                share[k] = step
            else:
                moved[own] = coefficients[own]
        if share[left].any():
            reached = moved
            equations = _patched(trial, now, [blocks[k].steps for k in left if share[k] == 0])
        if share.all():
            break
    return share.tolist(), reached, equations


def _patched(equations: Equations, others: Equations, places: list[Indices]) -> Equations:
    """Return the equations with those of some steps taken from others."""
    if not places:
        return equations
    steps = np.concatenate(places)
    fields = {name: getattr(equations, name).copy() for name in ("matrix", "vector", "chi2", "residual")}
    for name, values in fields.items():
        values[steps] = getattr(others, name)[steps]
    return replace(equations, **fields)


def _size(change: Floats, time_functions: Floats, shape: tuple[int, ...], block: Block) -> float:
    """Return the rms displacement that a block's change makes over its steps, voxels."""
    # the functions are orthonormal over all steps, of which the block has some
    all_steps = time_functions.shape[1]
    total = float((change[block.functions] ** 2).sum()) * all_steps / len(block.steps)
    return float(np.sqrt(total / np.prod(shape[1:])))


def _reason(blocks: int, moving: int, stuck: int, last: float, least_change_voxel: float, most_passes: int) -> str:
    """Say why the passes ended."""
    if moving:
        still = "the solution still moves" if blocks == 1 else f"{moving} of {blocks} parts still move"
        return f"{most_passes} passes done, the most allowed: allow more, {still}, by {last:.2g} voxel rms"
    if stuck == blocks:
        return "no step lowers the residual further: converged, within the precision of the sums"
    reason = f"converged: the last change was {last:.2g} voxel rms, under {least_change_voxel:.2g}"
    return f"{reason}; in {stuck} of {blocks} parts no step lowered the residual further" if stuck else reason
