"""Sums over pixels of sensitivities: what an image or a variance does to the right-hand side of the equations.

A field of sensitivities S(p) is known in the window of a step; what noise meets lies on the whole detector: S itself
in its place, R^T S where a reference view was moved (`pdvc.systematic`), and sums of both over steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdvc.apart import apart
from pdvc.projection import Sensitivities
from pdvc.systematic import first_pixel, keys_weights

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

_BLOCK_ROWS = 16


def product(one: Sensitivities, other: Sensitivities, variance: Image, unknowns: int) -> Floats:
    """Return sum_p one(p)^T v(p) other(p), (unknown, unknown), of two fields with variances v (row, column)."""
    result = np.zeros((unknowns, unknowns))
    offsets = one.first * one.motions, other.first * other.motions
    _add_product(one.values, offsets[0], other.values, offsets[1], variance, result)
    return result


def adjoint(field: Sensitivities, image: Image, unknowns: int) -> Floats:
    """Return sum_p field(p) image(p), (unknown,)."""
    of_rows = np.einsum("rck,rc->rk", field.values, image, dtype=float)
    # the last sections may have room beyond
    found = np.zeros(unknowns + field.values.shape[2])
    for first, row in zip(field.first * field.motions, of_rows, strict=True):
        found[first : first + len(row)] += row
    return found[:unknowns]


class Pile:
    """The sums z = sum_t sigma(t) (x) field(t) in each pixel of the detector: what a noise meets that all share."""

    def __init__(self, shape: tuple[int, ...], time_functions: Floats, motions: int) -> None:
        """Begin with nothing on a detector of `shape`, for time functions (function, step)."""
        self._shape = shape
        self._functions = time_functions.astype(np.float32)
        self._motions = motions
        self._first: dict[int, int] = {}
        self._blocks: dict[int, Image] = {}

    def add(self, step: int, field: Sensitivities, pool: Executor | None = None) -> None:
        """Add a step's field over the detector; with a pool, blocks of rows side by side."""

        def add_block(block: int) -> None:
            rows = slice(block * _BLOCK_ROWS, min((block + 1) * _BLOCK_ROWS, len(field.values)))
            z, first = self._room_for(block, field, rows)
            offset = (field.first[rows] - first) * self._motions
            _pile_up(z, field.values[rows], offset, self._functions[:, step])

        blocks = range((len(field.values) - 1) // _BLOCK_ROWS + 1)
        for _ in (map if pool is None else pool.map)(add_block, blocks):
            pass

    def _room_for(self, block: int, field: Sensitivities, rows: slice) -> tuple[Image, int]:
        """Return a block of pixels (row, column, function, section * motion), wide enough, and its first section."""
        span = field.values.shape[2] // self._motions
        low, high = int(field.first[rows].min()), int(field.first[rows].max()) + span
        if block not in self._blocks:
            shape = (_BLOCK_ROWS, self._shape[1], len(self._functions), (high - low) * self._motions)
            self._blocks[block], self._first[block] = np.zeros(shape, dtype=np.float32), low
        z, first = self._blocks[block], self._first[block]
        below, above = max(first - low, 0), max(high - first - z.shape[3] // self._motions, 0)
        if below or above:
            z = np.pad(z, ((0, 0),) * 3 + ((below * self._motions, above * self._motions),))
            self._blocks[block], self._first[block] = z, first - below
        return self._blocks[block], self._first[block]

    def covariance(self, variance: Image, unknowns: int) -> Floats:
        """Return sum_p v(p) z(p) z(p)^T (function * unknown, function * unknown)."""
        functions = len(self._functions)
        total = np.zeros((functions, unknowns, functions, unknowns))
        # from the top down, whichever a pool began with: the sum is to have the same bits
        for block, z in sorted(self._blocks.items()):
            rows = slice(block * _BLOCK_ROWS, min((block + 1) * _BLOCK_ROWS, self._shape[0]))
            flat = (z[: rows.stop - rows.start] * np.sqrt(variance[rows])[..., None, None]).reshape(-1, z[0, 0].size)
            # pixels in air are left out
            flat = flat[flat.any(axis=1)]
            product = (flat.T @ flat).reshape(functions, z.shape[3], functions, z.shape[3])
            i = self._first[block] * self._motions
            size = min(z.shape[3], unknowns - i)
            total[:, i : i + size, :, i : i + size] += product[:, :size, :, :size]
        return total.reshape(functions * unknowns, functions * unknowns)


def overlaid(
    fields: Sequence[tuple[Sensitivities, Image, tuple[int, int]]],
    shape: tuple[int, ...],
    pool: Executor | None = None,
) -> Sensitivities:
    """Return the sum, over a detector of `shape`, of fields times factors (row, column), from their first pixel on.

    With a pool, halves of each field side by side.
    """
    motions = fields[0][0].motions
    low, high = np.full(shape[0], np.iinfo(np.int64).max), np.zeros(shape[0], dtype=np.int64)
    for field, _, (row, _) in fields:
        rows = slice(row, row + len(field.values))
        low[rows] = np.minimum(low[rows], field.first)
        high[rows] = np.maximum(high[rows], field.first + field.values.shape[2] // motions)
    low, values = _blank(low, high, shape, motions)
    for field, factor, (row, column) in fields:
        offset = (field.first - low[row : row + len(field.values)]) * motions

        add = partial(_add_rows, values, field.values, offset, factor, (row, column))
        for _ in (map if pool is None else pool.map)(add, _halves(len(field.values))):
            pass
    return Sensitivities(values=values, first=low, motions=motions)


def _add_rows(
    out: Image, values: Image, offset: NDArray[np.int64], factor: Image, corner: tuple[int, int], rows: slice
) -> None:
    """Add some rows of a field times a factor to `out`; see `_add_to`."""
    _add_to(out, values[rows], offset[rows], factor[rows], corner[0] + rows.start, corner[1])


def _blank(
    low: NDArray[np.int64], high: NDArray[np.int64], shape: tuple[int, ...], motions: int
) -> tuple[NDArray[np.int64], Image]:
    """Return the first section of each row, and zeros for the sections from `low` to `high` (row,), 0 for none.

    A row without any begins where its neighbours do: one from far below would make room for all in between.
    """
    filled = np.flatnonzero(high > 0)
    if len(filled) == 0:
        return np.zeros_like(low), np.zeros((*shape, motions), dtype=np.float32)
    low = low[filled[np.abs(np.arange(len(low))[:, None] - filled).argmin(axis=1)]]
    return low, np.zeros((*shape, max(int((high - low).max()), 1) * motions), dtype=np.float32)


def spread(
    field: Sensitivities, places: Floats, shape: tuple[int, ...], pool: Executor | None = None
) -> Sensitivities:
    """Return R^T of a field over the window: what each pixel of the detector takes part in.

    With a pool, halves of the window side by side, to other last digits where they meet.
    """
    row = np.clip(np.floor(places[..., 0]).astype(np.int64), 0, shape[0] - 2)
    top, bottom = np.maximum(row.min(axis=1) - 1, 0), np.minimum(row.max(axis=1) + 2, shape[0] - 1)
    span = field.values.shape[2] // field.motions
    low, high = np.full(shape[0], np.iinfo(np.int64).max), np.zeros(shape[0], dtype=np.int64)
    for first, start, end in zip(field.first, top, bottom, strict=True):
        low[start : end + 1] = np.minimum(low[start : end + 1], first)
        high[start : end + 1] = np.maximum(high[start : end + 1], first + span)
    low, values = _blank(low, high, shape, field.motions)
    offset = (field.first[:, None] - low) * field.motions
    if pool is None:
        _scatter(field.values, offset, places, values)
    else:
        upper, lower = _halves(len(field.values))
        # neighbours add to the same pixels
        apart = np.zeros_like(values)
        for _ in pool.map(
            lambda part: _scatter(field.values[part[0]], offset[part[0]], places[part[0]], part[1]),
            ((upper, values), (lower, apart)),
        ):
            pass
        first = int(top[lower].min(initial=len(values)))
        values[first:] += apart[first:]
    return Sensitivities(values=values, first=low, motions=field.motions)


def _halves(rows: int) -> tuple[slice, slice]:
    return slice(0, rows // 2), slice(rows // 2, rows)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _filled(values):  # type: ignore[no-untyped-def]
    """Return the range of a pixel's values that are not zero: of the sections that its ray meets, few of its row's."""
    low, high = 0, len(values)
    while low < high and values[low] == 0:
        low += 1
    while high > low and values[high - 1] == 0:
        high -= 1
    return low, high


@apart(fastmath=True, boundscheck=False)
def _add_product(one, first, other, second, variance, out):  # type: ignore[no-untyped-def]
    """Add v one^T other of each pixel to `out`; `first` and `second` (row,) are where a row's values belong there.

    A row may have room for sections beyond the last: these are left out.
    """
    for row in range(one.shape[0]):
        # the pixels of a row share their sections: they are added up in a small matrix of their own, in double
        # precision, which is added to its place in the large one when the row is done
        i0, j0 = first[row], second[row]
        height, width = min(one.shape[2], out.shape[0] - i0), min(other.shape[2], out.shape[1] - j0)
        part = np.zeros((height, width))
        for column in range(one.shape[1]):
            for i in range(height):
                w = variance[row, column] * one[row, column, i]
                # most are zero: air, and sections of the row that this ray does not meet
                if w != 0:
                    for j in range(width):
                        part[i, j] += w * other[row, column, j]
        for i in range(height):
            for j in range(width):
                out[i0 + i, j0 + j] += part[i, j]


@apart()
def _scatter(values, offset, places, out):  # type: ignore[no-untyped-def]
    """Add each pixel's values to the 4 x 4 pixels that it was interpolated from; the adjoint of `systematic._cubic`.

    One thread: neighbours add to the same pixels, and always in this order.
    """
    rows, columns = out.shape[0], out.shape[1]
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            low, high = _filled(values[row, column])
            r, c, longer = places[row, column]
            i, j = first_pixel(r, rows), first_pixel(c, columns)
            if low >= high or i < 0 or j < 0:
                continue
            down, right = keys_weights(r - i), keys_weights(c - j)
            for m in range(4):
                to_row = min(max(i - 1 + m, 0), rows - 1)
                # where the sections of this row of the window begin in that row of the detector
                start = offset[row, to_row]
                for n in range(4):
                    share = np.float32(longer * down[m] * right[n])
                    if share != 0:
                        to = out[to_row, min(max(j - 1 + n, 0), columns - 1)]
                        for k in range(low, high):
                            to[start + k] += share * values[row, column, k]


@apart()
def _add_to(out, values, offset, factor, row0, column0):  # type: ignore[no-untyped-def]
    """Add factor(p) values(p, k) to out, which starts row0 and column0 earlier, `offset` (row,) entries on."""
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            scale = factor[row, column]
            low, high = _filled(values[row, column])
            to = out[row0 + row, column0 + column]
            for k in range(low, high):
                to[offset[row] + k] += scale * values[row, column, k]


@apart(fastmath=True, boundscheck=False)
def _pile_up(z, values, offset, sigma):  # type: ignore[no-untyped-def]
    """Add sigma_f values(p, k) to z (row, column, f, k)."""
    for row in range(values.shape[0]):
        # unsigned: numba need not ask whether an index counts from the end
        start = np.uint32(offset[row])
        for column in range(values.shape[1]):
            low, high = _filled(values[row, column])
            for f in range(len(sigma)):
                out = z[row, column, f]
                for k in range(low, high):
                    out[start + np.uint32(k)] += sigma[f] * values[row, column, k]
