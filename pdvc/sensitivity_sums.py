"""Sums over pixels of sensitivities: what an image or a variance does to the right-hand side of the equations.

Noise meets the sensitivities W S(p) of a step in the window of its radiograph, and, where a reference view was moved
with the sample (`pdvc.systematic`), Y = R^T W S on the whole detector. An error of the mean flat meets both, s_f Y in
the view and -s_t W S in the radiograph.

Fields are (row, section * motion, column): every kernel here does one thing for neighbouring columns, which become
the processor's vectors. Y of a whole detector would be moved to and from memory for each sum: it is made band by
band of rows instead, for all sums, while it lies in the cache.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pdvc.apart import apart
from pdvc.projection import Sensitivities
from pdvc.systematic import first_pixel, keys_weights

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

BAND_ROWS = 16
"""Rows of the detector that are worked on at once."""


def product(one: Sensitivities, other: Sensitivities, variance: Image, unknowns: int) -> Floats:
    """Return sum_p one(p)^T v(p) other(p), (unknown, unknown), of two fields with variances v (row, column)."""
    result = np.zeros((unknowns, unknowns))
    offsets = one.first * one.motions, other.first * other.motions
    _add_product(one.values, offsets[0], other.values, offsets[1], variance, one is other, result)
    return _whole(result) if one is other else result


def adjoint(field: Sensitivities, image: Image, unknowns: int) -> Floats:
    """Return sum_p field(p) image(p), (unknown,)."""
    of_rows = np.einsum("rkc,rc->rk", field.values, image, dtype=float)
    # the last sections may have room beyond
    found = np.zeros(unknowns + field.values.shape[1])
    for first, row in zip(field.first * field.motions, of_rows, strict=True):
        found[first : first + len(row)] += row
    return found[:unknowns]


@dataclass(frozen=True, kw_only=True)
class Rows:
    """A field in a band of rows of the detector."""

    values: Image
    """(row, entry, column)"""
    first: int
    """The unknown of the first entry; entries beyond the last unknown are zero."""

    def add_product(self, other: Rows, variance: Image, out: Floats) -> None:
        """Add sum_p self(p)^T v(p) other(p) to `out` (unknown, unknown): with itself, its lower triangle."""
        starts, others = (np.full(len(self.values), each.first) for each in (self, other))
        _add_product(self.values, starts, other.values, others, variance, self is other, out)


@dataclass(frozen=True, kw_only=True)
class Spread:
    """W S of a step, and Y = R^T W S, over a detector of `shape`."""

    weighted: Sensitivities
    """W S (row, section * motion, column), in the window."""
    places: Floats
    """Where e is taken for each pixel of the window, and a factor (row, column, 3): `Systematic.places`."""
    corner: tuple[int, int]
    """The window's first pixel."""
    shape: tuple[int, int]
    """Rows and columns of the detector."""

    @property
    def bands(self) -> range:
        """Return the bands of rows of the detector."""
        return range((self.shape[0] - 1) // BAND_ROWS + 1)

    def rows(self, band: int) -> slice:
        """Return the rows of a band."""
        return slice(band * BAND_ROWS, min((band + 1) * BAND_ROWS, self.shape[0]))

    def moved(self, band: int, room: str = "moved") -> Rows:
        """Return Y in a band of rows: what each pixel of the detector takes part in.

        It lasts until the thread asks for another one in the same room.
        """
        rows = self.rows(band)
        from_rows = (self._reach[:, 0] < rows.stop) & (self._reach[:, 1] >= rows.start)
        out = self._blank(room, np.flatnonzero(from_rows), rows)
        offset = self._first - out.first
        _scatter(
            self.weighted.values, offset, self._filled, self.places, from_rows, rows.start, self.shape[0], out.values
        )
        return out

    def shared(self, band: int, moved: Rows, view_slope: Image, image_slope: Image) -> Rows:
        """Return s_f Y - s_t W S in a band of rows: what an error of the flats meets.

        Of the slopes s_f is given over the detector, s_t over the window. It lasts until the thread asks for another
        one.
        """
        rows, (row, column) = self.rows(band), self.corner
        own = np.arange(max(rows.start - row, 0), min(max(rows.stop - row, 0), len(self._first)))
        out = self._blank("shared", own, rows, moved)
        at = moved.first - out.first
        np.multiply(moved.values, view_slope[rows, None], out=out.values[:, at : at + moved.values.shape[1]])
        offset = self._first - out.first
        _subtract(self.weighted.values, offset, self._filled, image_slope, own, row - rows.start, column, out.values)
        return out

    def _blank(self, room: str, own: NDArray[np.int64], rows: slice, beside: Rows | None = None) -> Rows:
        """Return zeros in a band of rows, for the unknowns that some rows of the window see, and another field."""
        own = own[self._filled[own, 1] > 0]
        low, high = self._first[own] + self._filled[own, 0], self._first[own] + self._filled[own, 1]
        if beside is not None:
            low, high = np.append(low, beside.first), np.append(high, beside.first + beside.values.shape[1])
        first, end = (int(low.min()), int(high.max())) if len(low) else (0, 0)
        return Rows(values=_zeros(room, (rows.stop - rows.start, end - first, self.shape[1])), first=first)

    @cached_property
    def _first(self) -> NDArray[np.int64]:
        """The first unknown of each row of the window (row,)."""
        return self.weighted.first * self.weighted.motions

    @cached_property
    def _filled(self) -> NDArray[np.int64]:
        """First and last entry, and column, of a row of the window that is not zero (row, 4); the last is left out."""
        filled = np.zeros((len(self._first), 4), dtype=np.int64)
        _find_filled(self.weighted.values, filled)
        return filled

    @cached_property
    def _reach(self) -> NDArray[np.int64]:
        """First and last row of the detector that a row of the window was interpolated from (row, 2)."""
        rows = np.clip(np.floor(self.places[..., 0]).astype(np.int64), 0, self.shape[0] - 2)
        first, last = np.maximum(rows.min(axis=1) - 1, 0), np.minimum(rows.max(axis=1) + 2, self.shape[0] - 1)
        return np.stack([first, last], axis=1)


class _Rooms(threading.local):
    """Memory of each thread in which fields are made again and again: to get it anew would take longer."""

    def __init__(self) -> None:
        self.of: dict[str, Image] = {}


_rooms = _Rooms()


def _zeros(room: str, shape: tuple[int, int, int]) -> Image:
    """Return zeros, in the place of those that were made in this room before."""
    size, memory = int(np.prod(shape)), _rooms.of.get(room)
    if memory is None or memory.size < size:
        memory = _rooms.of[room] = np.empty(size, dtype=np.float32)
    found = memory[:size].reshape(shape)
    found[:] = 0
    return found


def summed(
    bands: range, unknowns: int, add: Callable[[int, Floats], None], count: int = 1, pool: Executor | None = None
) -> Floats:
    """Return what `add` adds, band by band, to the lower triangles of `count` matrices (count, unknown, unknown).

    With a pool, halves of the bands side by side, to other last digits.
    """

    def some(part: range) -> Floats:
        found = np.zeros((count, unknowns, unknowns))
        for band in part:
            add(band, found)
        return found

    half = len(bands) // 2
    found = some(bands) if pool is None else np.sum(list(pool.map(some, (bands[:half], bands[half:]))), axis=0)
    return np.stack([_whole(each) for each in found])


def _whole(lower: Floats) -> Floats:
    """Return a symmetric matrix by its lower triangle."""
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


class Pile:
    """The sums z = sum_t sigma(t) (x) field(t) in each pixel of the detector: what a noise meets that all share."""

    def __init__(self, time_functions: Floats) -> None:
        """Begin with nothing, for time functions (function, step)."""
        self._functions = time_functions.astype(np.float32)
        self._bands: dict[int, Rows] = {}
        """Of each band (row, function, entry, column)."""

    def add(self, step: int, bands: range, field: Callable[[int], Rows], pool: Executor | None = None) -> None:
        """Add the field of a step, band by band of the detector; with a pool, bands side by side."""

        def add_band(band: int) -> None:
            part = field(band)
            z = self._room_for(band, part)
            _pile_up(z.values, part.values, part.first - z.first, self._functions[:, step])

        for _ in (map if pool is None else pool.map)(add_band, bands):
            pass

    def _room_for(self, band: int, part: Rows) -> Rows:
        """Return the sums of a band (row, function, entry, column), wide enough for another field."""
        rows, room, columns = part.values.shape
        z = self._bands.get(band)
        if z is None:
            z = Rows(values=np.zeros((rows, len(self._functions), room, columns), np.float32), first=part.first)
        elif room:
            below = max(z.first - part.first, 0)
            above = max(part.first + room - z.first - z.values.shape[2], 0)
            if below or above:
                values = np.pad(z.values, ((0, 0), (0, 0), (below, above), (0, 0)))
                z = Rows(values=values, first=z.first - below)
        self._bands[band] = z
        return z

    def covariance(self, variance: Image, unknowns: int) -> Floats:
        """Return sum_p v(p) z(p) z(p)^T (function * unknown, function * unknown)."""
        functions = len(self._functions)
        total = np.zeros((functions, unknowns, functions, unknowns))
        # from the top down, whichever a pool began with: the sum is to have the same bits
        for band, z in sorted(self._bands.items()):
            size = min(z.values.shape[2], unknowns - z.first)
            if size <= 0:
                continue
            root = np.sqrt(variance[band * BAND_ROWS : band * BAND_ROWS + len(z.values)])
            flat = (z.values[:, :, :size] * root[:, None, None]).transpose(1, 2, 0, 3).reshape(functions * size, -1)
            # pixels in air are left out
            flat = flat[:, flat.any(axis=0)]
            here = slice(z.first, z.first + size)
            total[:, here, :, here] += (flat @ flat.T).reshape(functions, size, functions, size)
        return total.reshape(functions * unknowns, functions * unknowns)


@apart(boundscheck=False)
def _find_filled(values, filled):  # type: ignore[no-untyped-def]
    """Write the ranges of each row's entries and columns outside which all is zero (row, 4): no ray meets more."""
    for row in range(values.shape[0]):
        low, high = 0, values.shape[1]
        while low < high and not values[row, low].any():
            low += 1
        while high > low and not values[row, high - 1].any():
            high -= 1
        if low == high:
            continue
        left, right = values.shape[2], 0
        for k in range(low, high):
            column = 0
            while column < left and values[row, k, column] == 0:
                column += 1
            left, column = column, values.shape[2]
            while column > right and values[row, k, column - 1] == 0:
                column -= 1
            right = column
        filled[row] = low, high, left, right


@apart(fastmath={"reassoc", "contract"}, boundscheck=False, forceinline=True)
def _dot(one, other):  # type: ignore[no-untyped-def]
    """Return the sum of products over the columns of a row.

    In any order, as in none would the row become vectors; always within its caller, so that there is one order only
    (`pdvc.apart.IN_ORDER`).
    """
    total = np.float32(0)
    for column in range(one.shape[0]):
        total += one[column] * other[column]
    return total


@apart(boundscheck=False)
def _add_times(to, factor, values):  # type: ignore[no-untyped-def]
    """Add to each column of a row its factor times its value."""
    for column in range(to.shape[0]):
        to[column] += factor[column] * values[column]


@apart(boundscheck=False)
def _add_product(one, first, other, second, variance, alike, out):  # type: ignore[no-untyped-def]
    """Add v one^T other of each pixel to `out`; `first` and `second` (row,) are where a row's values belong there.

    A row may have room for sections beyond the last: these are left out. Where both are `alike`, the lower triangle is
    enough.
    """
    weighted = np.empty(variance.shape[1], np.float32)
    for row in range(one.shape[0]):
        height, width = min(one.shape[1], out.shape[0] - first[row]), min(other.shape[1], out.shape[1] - second[row])
        for i in range(height):
            filled = False
            for column in range(len(weighted)):
                weighted[column] = variance[row, column] * one[row, i, column]
                filled |= weighted[column] != 0
            if filled:
                for j in range(i + 1 if alike else width):
                    out[first[row] + i, second[row] + j] += _dot(weighted, other[row, j])


@apart()
def _scatter(values, offset, filled, places, chosen, row0, rows, out):  # type: ignore[no-untyped-def]
    """Add each pixel's values to those of the 4 x 4 pixels it was interpolated from that lie in a band of rows.

    The adjoint of `systematic._cubic`. `out` begins at `row0` of the detector's `rows`; `chosen` (row,) of the window
    reach it. Along a row neighbours were mostly interpolated from neighbours, and are added side by side as far as
    they were.
    """
    columns, count = out.shape[2], values.shape[2]
    i, j = np.empty(count, np.int64), np.empty(count, np.int64)
    down, right = np.empty((4, count), np.float32), np.empty((4, count), np.float32)
    share = np.empty(4 * count, np.float32)
    into, what = out.reshape(-1), values.reshape(-1)
    for row in range(values.shape[0]):
        low, high, left, right_end = filled[row]
        if low >= high or not chosen[row]:
            continue
        for column in range(left, right_end):
            r, c, longer = places[row, column]
            i[column], j[column] = first_pixel(r, rows), first_pixel(c, columns)
            of_rows, of_columns = keys_weights(r - i[column]), keys_weights(c - j[column])
            for m in range(4):
                down[m, column], right[m, column] = longer * of_rows[m], of_columns[m]
        start = left
        while start < right_end:
            at, to = i[start], j[start]
            end = start + 1
            # pixels of the edge stand for those beyond it, and are taken one by one
            side_by_side = 1 <= to <= columns - 3
            if side_by_side:
                while end < right_end and i[end] == at and j[end] - to == end - start and j[end] <= columns - 3:
                    end += 1
            for m in range(4 if at >= 0 and to >= 0 else 0):
                to_row = min(max(at - 1 + m, 0), rows - 1) - row0
                if to_row < 0 or to_row >= out.shape[0]:
                    continue
                for n in range(4):
                    for x in range(start, end):
                        share[n * count + x] = down[m, x] * right[n, x]
                for k in range(low, high):
                    line = (to_row * out.shape[1] + offset[row] + k) * columns
                    source = (row * values.shape[1] + k) * count
                    if side_by_side:
                        _add_taps(into, line + to - 1, share, count, start, what, source + start, end - start)
                        continue
                    for n in range(4):
                        column = min(max(to - 1 + n, 0), columns - 1)
                        into[line + column] += share[n * count + start] * what[source + start]
            start = end


@apart(boundscheck=False)
def _add_taps(to, at, share, width, start, values, source, count):  # type: ignore[no-untyped-def]
    """Add to pixels in a line from `at` on what the four taps of `count` neighbours make of their values.

    The shares of tap n are `width` after those before it. Numbers without a sign, as numba asks whether others count
    from the end.
    """
    # the first three and the last three pixels are not reached by all taps
    for e in range(min(count, 3) + 3):
        d = e if e < 3 else max(count, 3) + e - 3
        for n in range(max(d - count + 1, 0), min(d, 3) + 1):
            to[at + d] += share[n * width + start + d - n] * values[source + d - n]
    pixel, one = np.uint64(at), np.uint64(1)
    of, value, step = np.uint64(start), np.uint64(source), np.uint64(width)
    for d in range(np.uint64(3), np.uint64(max(count, 3))):
        x = of + d
        v = value + d
        to[pixel + d] += (
            share[x] * values[v]
            + share[x + step - one] * values[v - one]
            + share[x + step + step - one - one] * values[v - one - one]
            + share[x + step + step + step - one - one - one] * values[v - one - one - one]
        )


@apart()
def _subtract(values, offset, filled, factor, chosen, down, right, out):  # type: ignore[no-untyped-def]
    """Subtract factor(p) values(p, k) of some rows from `out`, so many rows down and columns right."""
    share = np.empty(values.shape[2], np.float32)
    for row in chosen:
        for column in range(len(share)):
            share[column] = -factor[row, column]
        for k in range(filled[row, 0], filled[row, 1]):
            into = out[row + down, offset[row] + k, right : right + len(share)]
            _add_times(into, share, values[row, k])


@apart(boundscheck=False)
def _pile_up(z, values, offset, sigma):  # type: ignore[no-untyped-def]
    """Add sigma_f values(p, k) to z (row, f, k, column)."""
    factor = np.empty(values.shape[2], np.float32)
    for row in range(values.shape[0]):
        for f in range(len(sigma)):
            factor[:] = sigma[f]
            for k in range(values.shape[1]):
                _add_times(z[row, f, offset + k], factor, values[row, k])
