"""The walk along the rays: each is summed once through the moved volume, and its equations are added at once.

The integrals of `pdvc.projection` are sums over the voxel planes that the moved ray x'(l) = x(l) - u(x(l)) crosses
(Joseph, 1982): along x or y, whichever the ray follows more, with bilinear interpolation of F, and its exact gradient,
in each plane. Between two sections u is a quadratic polynomial of the ray's arc length l, and so is everything that
multiplies grad F. With m the axis across the planes, o the two others and t = dx'/dl, the missing derivative follows
by parts,

    int l^n d_m F dl = -sum_o (t_o / t_m) int l^n d_o F dl - (n / t_m) int l^(n-1) F dl,

as F vanishes at both ends of the ray: eight sums, of F, l F and d_o F times 1, l, l^2, give the sensitivities of
all motions, however many a section has.

All lengths here are in voxels of the volume, l too, and all places are its indices: voxel (k, j, i) has its centre at
x = i, y = j, z = k. Pixels are told by their centres, so that `rays` needs no half pixel.

Neighbouring rays of a row are walked side by side, `LANES` of them, each in a lane of the processor's vectors: every
kernel here does one thing for all of them, and its arrays hold one component after the other, each of all rays. A
ray that is not concerned, of another axis or past its end, takes part with a share of zero.

Sums run in single precision along a ray, in double precision over rays. Bands of rows are worked on in
parallel and added in order, so that the result does not depend on the number of threads.

A kernel and all that it calls are in this one file: numba looks for changes in the file of the kernel that is called,
and would otherwise take an old one from its cache.
The names of the records that kernels take are kept in that cache: one that is renamed or leaves makes old caches
unreadable, with an AttributeError, and has to take the file's name with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from pdvc.apart import IN_ORDER, apart
from pdvc.volume import Hull

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

BAND_ROWS = 16
"""Rows of pixels that one task works on; part of the result's definition, as sums are ordered by it."""
BLOCK_COLUMNS = 16
"""Columns of a block, for which c is summed by itself."""

LANES = BLOCK_COLUMNS
"""Neighbouring rays of a row that are walked side by side, each in a lane of the processor's vectors."""

_f = np.float32
_BIG = 1e30
_LEAST_SLOPE = 1e-12
_X, _Y, _Z = 0, LANES, 2 * LANES
_NORMALS32 = np.ascontiguousarray(Hull.normals().T, dtype=np.float32)


class Scene(NamedTuple):
    """What all steps share: the volume, its hull and the sections."""

    volume: Image
    """F (voxel,), z slowest and x fastest, grey levels per mm."""
    shape: NDArray[np.int64]
    """Voxels of the volume along z, y, x (3,)."""
    place: Floats
    """Bottom of the hull's lowest slab, and height of a slab (2,)."""
    support: Image
    """Supports of the hull (slab, direction); far outside where a slab is empty."""
    heights: Floats
    """Heights of the sections (section,)."""
    patterns: Floats
    """What each motion does at unit amplitude, an affine map of the place (section, motion, 12)."""
    voxel_mm: float
    """Voxel of the volume, mm: F is given per mm."""
    phase: float
    """`pdvc.volume.Volume.phase`."""


class Steps(NamedTuple):
    """What differs from step to step."""

    box: Floats
    """A box that holds the moved sample: lowest and highest corner (step, 2, 3)."""
    rays: Floats
    """Source, centre of pixel (0, 0), and the ways to the next row and column (step, 4, 3)."""
    maps: Floats
    """Displacement of each section, an affine map of the place (step, section, 3, 4)."""
    target: Image
    """g (step, row, column), grey levels."""
    weight: Image
    """w (step, row, column), or (1, row, column) for all steps."""
    low: NDArray[np.int64]
    """The lowest section that any ray of a band meets (step, band)."""


class Sums(NamedTuple):
    """What the walk leaves; each task writes to its own band, and to its own rows of the images."""

    matrices: Floats
    """B of each band, lower triangle (step, band, unknown, unknown); unknowns count from the band's lowest section."""
    vectors: Floats
    """c of each block of a band (step, band, block, unknown)."""
    chi2: Floats
    """(step, band)"""
    residual: Image
    """rho (step, row, column)."""
    kept: Image
    """S (step, row, unknown, column) where it is asked for, else empty."""


@njit(nogil=True, cache=True, error_model="numpy", parallel=True)
def walk_bands(scene, steps, sums, with_sensitivities):  # type: ignore[no-untyped-def]
    """Walk all rays of all steps, a band of rows at a time."""
    bands = steps.low.shape[1]
    # one task for each band of each step: no two write to the same place, and each adds its rays in the same order,
    # so that neither locks nor the number of threads come into it
    for task in prange(steps.low.size):
        _walk_band(scene, steps, sums, with_sensitivities, task // bands, task % bands)


@njit(nogil=True, cache=True, error_model="numpy")
def _walk_band(scene, steps, sums, with_sensitivities, t, band):  # type: ignore[no-untyped-def]
    """Walk the rays of one band of rows of step t, a block of neighbouring columns at a time."""
    volume, shape, place, support, heights, patterns, voxel_mm, phase64 = scene
    phase = _f(phase64)
    box, rays, maps, target = steps.box[t], steps.rays[t], steps.maps[t], steps.target[t]
    weight, low = steps.weight[t % len(steps.weight)], steps.low[t, band]
    matrix, vectors, chi2 = sums.matrices[t, band], sums.vectors[t, band], sums.chi2[t]
    residual, kept = sums.residual[t], sums.kept[t]
    rows, columns = target.shape
    n, motions = patterns.shape[0], patterns.shape[1]
    nx, ny, layers = shape[2], shape[1], shape[0]
    row_of, layer = np.uint32(nx), np.uint32(nx * ny)
    # strides of the axis across the planes, of the other horizontal axis, and of z
    strides_x, strides_y = (np.uint32(1), row_of, layer), (row_of, np.uint32(1), layer)
    # scratch, made once for all rays: what is told of each ray of a block, component by component
    base, along, reach = np.empty(3 * LANES), np.empty(3 * LANES), np.empty(LANES)
    enter, leave = np.empty(LANES), np.empty(LANES)
    a, b, inner_a, inner_b = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    s0, s1, path = np.empty(LANES), np.empty(LANES), np.empty(9 * LANES)
    limit = np.empty(_NORMALS32.shape[1], np.float32)
    ends, left_from, left_to = np.empty(6 * LANES), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    planes, path32 = np.empty(2 * LANES, np.float32), np.empty(9 * LANES, np.float32)
    turn = np.empty(LANES)
    sums8 = np.empty(8 * LANES, np.float32)
    value, nine, twelve = np.empty(LANES), np.empty(9 * LANES), np.empty(12 * LANES)
    s, of_i = np.zeros(vectors.shape[1] * LANES), np.empty(LANES)
    used, weighted = np.empty(LANES), np.empty(LANES)
    middle = 0.5 * (box[0] + box[1])
    # rows outside, columns inside: neighbours of a row walk through the same two layers of voxels, still in the cache
    for row in range(band * BAND_ROWS, min((band + 1) * BAND_ROWS, rows)):
        for block in range(vectors.shape[0]):
            column0 = block * LANES
            count = min(LANES, columns - column0)
            _aim(rays, middle, row, column0, base, along, reach)
            _clip_box(box, base, along, reach, count, enter, leave)
            value[:] = 0.0
            first_section, last_section = n, -1
            lowest, highest = _heights_met(base, along, enter, leave)
            # from section to section: between two of them a moved ray is one polynomial
            k = -1 if n > 1 else 0
            while k + 1 < n and heights[k + 1] < lowest:
                k += 1
            while lowest <= highest and k < n and (k < 0 or n == 1 or heights[k] <= highest):
                # between sections k and k + 1; beyond the outermost section that one alone counts
                j0, j1 = max(k, 0), min(k + 1, n - 1)
                bottom = heights[k] if n > 1 and k >= 0 else -_BIG
                top = heights[k + 1] if k + 1 < n else _BIG
                k += 1
                _between(bottom, top, base, along, enter, leave, a, b)
                _share(bottom, 1.0 / (top - bottom) if j0 != j1 else 0.0, base, along, s0, s1)
                _path(maps[j0], maps[j1], s0, s1, base, along, path)
                _ends(path, a, b, ends)
                if not _limits(place, support, a, b, ends, limit):
                    continue
                _clip_hull(_NORMALS32, limit, layers, ends, a, b, left_from, left_to, inner_a, inner_b)
                # one axis for the whole ray: sums of neighbouring intervals must be over the same planes
                for along_x in (True, False):
                    m, o = (_X, _Y) if along_x else (_Y, _X)
                    _planes(path, m, o, along, inner_a, inner_b, nx if along_x else ny, planes, turn, path32)
                    first, last = _range_of(planes)
                    if first >= last:
                        continue
                    strides = strides_x if along_x else strides_y
                    # largest places, just below the last voxel, so that the next one is always there
                    most = _f((ny if along_x else nx) - 1.0001), _f(layers - 1.0001)
                    if not with_sensitivities:
                        _sum_values(volume, strides, most, first, last, phase, path32, planes, sums8)
                        _add_value(sums8, turn, voxel_mm, value)
                        continue
                    _sum_all(volume, strides, most, first, last, phase, path32, planes, sums8)
                    _add_value(sums8, turn, voxel_mm, value)
                    _nine_sums(sums8, turn, path, m, o, voxel_mm, nine)
                    first_section, last_section = min(first_section, j0), max(last_section, j1)
                    # both sections of the interval, each with its hat: 1 - s and s
                    _twelve(nine, 1.0, -1.0 if j0 != j1 else 0.0, s0, s1, base, along, twelve)
                    _add_section(patterns[j0], twelve, s, (j0 - low) * motions)
                    if j0 != j1:
                        _twelve(nine, 0.0, 1.0, s0, s1, base, along, twelve)
                        _add_section(patterns[j1], twelve, s, (j1 - low) * motions)
            for ray in range(LANES):
                w, rho = _f(0), _f(0)
                if ray < count:
                    column = column0 + ray
                    rho = _f(value[ray] - target[row, column])
                    residual[row, column] = rho
                    w = weight[row, column]
                # a pixel of no weight counts for nothing, even if it holds no number
                used[ray] = w if w > 0 else 0.0
                weighted[ray] = w * np.float64(rho) if w > 0 else 0.0
                chi2[band] += weighted[ray] * rho if w > 0 else 0.0
            # only the sections that these rays met: S is zero elsewhere, and so are its products
            if last_section >= 0:
                first, last = (first_section - low) * motions, (last_section + 1 - low) * motions
                _add_products(s, first, last, used, weighted, of_i, matrix, vectors[block])
                if kept.size > 0:
                    for i in range(first, last):
                        for ray in range(count):
                            kept[row, i, column0 + ray] = s[i * LANES + ray]
                s[first * LANES : last * LANES] = 0.0


@apart()
def _aim(rays, middle, row, column0, base, along, reach):  # type: ignore[no-untyped-def]
    """Write the rays base + l along to pixels' centres, along of length 1, and the distances base - source.

    l = 0 is where a ray passes the middle of the sample: l stays small, so that single precision is enough.
    """
    for ray in range(LANES):
        column = column0 + ray
        x = rays[1, 0] + row * rays[2, 0] + column * rays[3, 0] - rays[0, 0]
        y = rays[1, 1] + row * rays[2, 1] + column * rays[3, 1] - rays[0, 1]
        z = rays[1, 2] + row * rays[2, 2] + column * rays[3, 2] - rays[0, 2]
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        away = x * (middle[0] - rays[0, 0]) + y * (middle[1] - rays[0, 1]) + z * (middle[2] - rays[0, 2])
        along[_X + ray], along[_Y + ray], along[_Z + ray] = x, y, z
        base[_X + ray] = rays[0, 0] + away * x
        base[_Y + ray] = rays[0, 1] + away * y
        base[_Z + ray] = rays[0, 2] + away * z
        reach[ray] = away


@apart()
def _clip_box(box, base, along, reach, count, enter, leave):  # type: ignore[no-untyped-def]
    """Write the parts [enter, leave] of the rays that lie in a box; empty where enter >= leave, as beyond `count`."""
    for ray in range(LANES):
        # a ray along a face of the box is taken as nearly along it: inside it goes on for ever, outside it is never in
        x, y, z = _steep(along[_X + ray]), _steep(along[_Y + ray]), _steep(along[_Z + ray])
        x0, x1 = (box[0, 0] - base[_X + ray]) / x, (box[1, 0] - base[_X + ray]) / x
        y0, y1 = (box[0, 1] - base[_Y + ray]) / y, (box[1, 1] - base[_Y + ray]) / y
        z0, z1 = (box[0, 2] - base[_Z + ray]) / z, (box[1, 2] - base[_Z + ray]) / z
        start = max(max(min(x0, x1), min(y0, y1)), min(z0, z1))
        end = min(min(max(x0, x1), max(y0, y1)), max(z0, z1))
        # a box that reaches the source goes on behind it, where no band's sections were looked for
        start = max(start, -reach[ray])
        met = (start < end) & (ray < count)
        enter[ray] = start if met else 0.0
        leave[ray] = end if met else 0.0


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _steep(slope):  # type: ignore[no-untyped-def]
    """Return a slope, or one that may be divided by where it is nearly zero."""
    return slope if abs(slope) > _LEAST_SLOPE else _LEAST_SLOPE


@njit(nogil=True, cache=True, error_model="numpy")
def _heights_met(base, along, enter, leave):  # type: ignore[no-untyped-def]
    """Return the lowest and the highest z that the rays meet, with room for rounding; the first is higher if none."""
    low, high = _BIG, -_BIG
    for ray in range(LANES):
        if enter[ray] < leave[ray]:
            z0 = base[_Z + ray] + enter[ray] * along[_Z + ray]
            z1 = base[_Z + ray] + leave[ray] * along[_Z + ray]
            low, high = min(low, min(z0, z1)), max(high, max(z0, z1))
    return low - 1e-6, high + 1e-6


@apart()
def _between(bottom, top, base, along, enter, leave, a, b):  # type: ignore[no-untyped-def]
    """Write the parts [a, b] of the rays between two heights; both zero where there is none.

    Both intervals beside a wall find it at the same place, so that no plane is lost or counted twice.
    """
    for ray in range(LANES):
        z = _steep(along[_Z + ray])
        one, two = (bottom - base[_Z + ray]) / z, (top - base[_Z + ray]) / z
        start, end = max(enter[ray], min(one, two)), min(leave[ray], max(one, two))
        a[ray] = start if start < end else 0.0
        b[ray] = end if start < end else 0.0


@apart()
def _share(bottom, per_gap, base, along, s0, s1):  # type: ignore[no-untyped-def]
    """Write the upper section's share along the rays, s0 + s1 l; `per_gap` is 1 / (top - bottom), 0 for one alone."""
    for ray in range(LANES):
        s0[ray] = (base[_Z + ray] - bottom) * per_gap
        s1[ray] = along[_Z + ray] * per_gap


@apart()
def _path(first, second, s0, s1, base, along, path):  # type: ignore[no-untyped-def]
    """Write the coefficients of the moved rays x'(l) = x - u(x), u = (1 - s) u_first + s u_second.

    For each of x, y, z those of 1, l and l^2: (coordinate, power, ray).
    """
    for i in range(3):
        for ray in range(LANES):
            x, y, z = base[_X + ray], base[_Y + ray], base[_Z + ray]
            dx, dy, dz = along[_X + ray], along[_Y + ray], along[_Z + ray]
            # u of both sections along the ray: p + q l, and what the second has more, dp + dq l
            p = first[i, 0] * x + first[i, 1] * y + first[i, 2] * z + first[i, 3]
            q = first[i, 0] * dx + first[i, 1] * dy + first[i, 2] * dz
            dp = second[i, 0] * x + second[i, 1] * y + second[i, 2] * z + second[i, 3] - p
            dq = second[i, 0] * dx + second[i, 1] * dy + second[i, 2] * dz - q
            path[3 * LANES * i + ray] = base[LANES * i + ray] - p - s0[ray] * dp
            path[3 * LANES * i + LANES + ray] = along[LANES * i + ray] - q - s0[ray] * dq - s1[ray] * dp
            path[3 * LANES * i + 2 * LANES + ray] = -s1[ray] * dq


@apart()
def _ends(path, a, b, ends):  # type: ignore[no-untyped-def]
    """Write x', y', z' at a, then at b (end, coordinate, ray)."""
    for i in range(3):
        for ray in range(LANES):
            one, slope = path[3 * LANES * i + ray], path[3 * LANES * i + LANES + ray]
            bend = path[3 * LANES * i + 2 * LANES + ray]
            ends[LANES * i + ray] = one + a[ray] * (slope + a[ray] * bend)
            ends[3 * LANES + LANES * i + ray] = one + b[ray] * (slope + b[ray] * bend)


@njit(nogil=True, cache=True, error_model="numpy")
def _limits(place, support, a, b, ends, limit):  # type: ignore[no-untyped-def]
    """Write the supports (direction,) of the hull of all slabs that the moved rays go through; False if there is none.

    Moved rays are taken as straight between a and b.
    """
    low, high = _BIG, -_BIG
    for ray in range(LANES):
        if a[ray] < b[ray]:
            za, zb = ends[_Z + ray], ends[3 * LANES + _Z + ray]
            low, high = min(low, min(za, zb)), max(high, max(za, zb))
    if low > high:
        return False
    first = max(int(np.floor((low - place[0]) / place[1])), 0)
    last = min(int(np.floor((high - place[0]) / place[1])), support.shape[0] - 1)
    if first > last:
        return False
    limit[:] = support[first]
    for slab in range(first + 1, last + 1):
        for k in range(len(limit)):
            limit[k] = max(limit[k], support[slab, k])
    return True


@apart(fastmath=IN_ORDER, boundscheck=False)
def _clip_hull(normals, limit, layers, ends, a, b, low, high, inner_a, inner_b):  # type: ignore[no-untyped-def]
    """Shrink [a, b] to where the moved rays, taken as straight between a and b, meet a hull; to nothing elsewhere.

    They also stay inside the volume's first and last layer but one: where the volume is cut in height, the step from
    the sample to the empty outermost layer is no texture. Shares `low` to `high` of [a, b] are left, in single
    precision.
    """
    for ray in range(LANES):
        za, zb = ends[_Z + ray], ends[3 * LANES + _Z + ray]
        one = _left_above(_f(za - 1), _f(zb - 1))
        two = _left_above(_f(layers - 2 - za), _f(layers - 2 - zb))
        low[ray], high[ray] = max(one[0], two[0]), min(one[1], two[1])
    for k in range(len(limit)):
        for ray in range(LANES):
            # depths below the half-plane's edge at both ends
            da = limit[k] - (normals[0, k] * _f(ends[_X + ray]) + normals[1, k] * _f(ends[_Y + ray]))
            db = limit[k] - (
                normals[0, k] * _f(ends[3 * LANES + _X + ray]) + normals[1, k] * _f(ends[3 * LANES + _Y + ray])
            )
            left = _left_above(da, db)
            low[ray], high[ray] = max(low[ray], left[0]), min(high[ray], left[1])
    for ray in range(LANES):
        met = (low[ray] < high[ray]) & (a[ray] < b[ray])
        inner_a[ray] = a[ray] + low[ray] * (b[ray] - a[ray]) if met else 0.0
        # to the wall itself, where nothing is cut: the next interval begins there
        end = b[ray] if high[ray] >= _f(1) else a[ray] + high[ray] * (b[ray] - a[ray])
        inner_b[ray] = end if met else 0.0


@njit(nogil=True, cache=True, error_model="numpy", fastmath=IN_ORDER, inline="always")
def _left_above(da, db):  # type: ignore[no-untyped-def]
    """Return the part of [0, 1] where what is da at 0 and db at 1 is positive; from 2 on if nowhere."""
    # crossed where the line between them is zero
    t = da / (da - db)
    enter = _f(2) if db < 0 else t
    return enter if da < 0 else _f(0), t if db < 0 else _f(1)


@apart()
def _planes(path, m, o, along, a, b, count, planes, turn, path32):  # type: ignore[no-untyped-def]
    """Write the planes [first, last) across the axis m that the rays cross between a and b: (end, ray).

    Rays that follow the other axis more cross none, as do those without an interval. `turn` is 1 / x'_m at l = 0, zero
    for rays that cross none; `path32` holds the coefficients of x' for the axes m, o, z in single precision, but
    c_m / b_m for c_m and 1 / b_m for b_m.
    """
    for ray in range(LANES):
        one, slope, bend = path[3 * m + ray], path[3 * m + LANES + ray], path[3 * m + 2 * LANES + ray]
        # half open, on the side of a: a plane exactly on a wall between two intervals belongs to the later one
        start, end = one + a[ray] * (slope + a[ray] * bend), one + b[ray] * (slope + b[ray] * bend)
        up = end >= start
        first = np.ceil(start) if up else np.floor(end) + 1
        last = np.ceil(end) if up else np.floor(start) + 1
        x, y = abs(along[_X + ray]), abs(along[_Y + ray])
        ours = (x >= y) if m == _X else (x < y)
        first, last = max(first, 0.0), min(last, float(count))
        met = ours & (a[ray] < b[ray]) & (first < last)
        planes[ray] = _f(first if met else _BIG)
        planes[LANES + ray] = _f(last if met else -_BIG)
        inverse = 1.0 / slope if met else 0.0
        turn[ray] = inverse
        path32[ray], path32[LANES + ray], path32[2 * LANES + ray] = _f(one), _f(inverse), _f(bend * inverse)
    for power in range(3):
        for ray in range(LANES):
            path32[(3 + power) * LANES + ray] = _f(path[3 * o + power * LANES + ray])
            path32[(6 + power) * LANES + ray] = _f(path[3 * _Z + power * LANES + ray])


@njit(nogil=True, cache=True, error_model="numpy")
def _range_of(planes):  # type: ignore[no-untyped-def]
    """Return the first plane that any ray crosses, and one past the last; no range if there is none."""
    first, last = planes[0], planes[LANES]
    for ray in range(1, LANES):
        first, last = min(first, planes[ray]), max(last, planes[LANES + ray])
    return (int(first), int(last)) if first < last else (0, 0)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=IN_ORDER, inline="always")
def _in_phase(f, phase):  # type: ignore[no-untyped-def]
    """Return the share of the next voxel at a place f in [0, 1] after one, and its derivative: `Volume.phase`."""
    away = f * (_f(1) - f)
    return f + phase * away * (_f(1) - _f(2) * f), _f(1) + phase * (_f(1) - _f(6) * away)


@apart(fastmath=IN_ORDER, boundscheck=False)
def _sum_all(volume, strides, most, first, last, phase, path, planes, sums):  # type: ignore[no-untyped-def]
    """Sum F times 1, l, and d_o F times 1, l, l^2, over the planes that each ray crosses: (sum, ray).

    `strides` of the axes m, o, z; `most` the largest places along o and z. This loop is where the time goes
    (docs/performance.md): neighbouring rays side by side, without branches, four gathers, in single precision, so that
    a vector holds as many rays as can be.
    """
    stride_m, stride_o, stride_z = strides
    most_o, most_z = most
    sums[:] = _f(0)
    for k in range(first, last):
        plane, at = _f(k), np.uint32(k) * stride_m
        for ray in range(LANES):
            am, turn, bend = path[ray], path[LANES + ray], path[2 * LANES + ray]
            ao, bo, co = path[3 * LANES + ray], path[4 * LANES + ray], path[5 * LANES + ray]
            az, bz, cz = path[6 * LANES + ray], path[7 * LANES + ray], path[8 * LANES + ray]
            # l at which x'_m = k, from am + bm l + cm l^2 = k by the series in the small curvature cm / bm
            t = (plane - am) * turn
            t -= bend * t * t * (_f(1) - _f(2) * bend * t)
            # length from plane to plane, here over its value 1 / bm at l = 0
            crossed = (plane >= planes[ray]) & (plane < planes[LANES + ray])
            share = _f(1) - _f(2) * bend * t if crossed else _f(0)
            # a ray may be out of the volume in planes that only its neighbours cross, or by rounding
            o = min(max(ao + t * (bo + t * co), _f(0)), most_o)
            z = min(max(az + t * (bz + t * cz), _f(0)), most_z)
            io, iz = np.int32(o), np.int32(z)
            fo, slope_o = _in_phase(o - _f(io), phase)
            fz, slope_z = _in_phase(z - _f(iz), phase)
            # unsigned indices: signed ones of 32 bits were slower, and these reach twice as far
            p = np.uint32(iz * stride_z + io * stride_o + at)
            q = np.uint32(p + stride_z)
            # the four voxels around the place in this plane, and the bilinear value with its exact derivatives
            a00, a01 = volume[p], volume[np.uint32(p + stride_o)]
            a10, a11 = volume[q], volume[np.uint32(q + stride_o)]
            d0, d1 = a01 - a00, a11 - a10
            low = a00 + fo * d0
            dz = a10 + fo * d1 - low
            value = share * (low + fz * dz)
            do = share * slope_o * (d0 + fz * (d1 - d0))
            dz *= share * slope_z
            sums[ray] += value
            sums[LANES + ray] += t * value
            sums[2 * LANES + ray] += do
            sums[5 * LANES + ray] += dz
            do *= t
            dz *= t
            sums[3 * LANES + ray] += do
            sums[6 * LANES + ray] += dz
            sums[4 * LANES + ray] += t * do
            sums[7 * LANES + ray] += t * dz


@apart(fastmath=IN_ORDER, boundscheck=False)
def _sum_values(volume, strides, most, first, last, phase, path, planes, sums):  # type: ignore[no-untyped-def]
    """Sum F alone over the planes that each ray crosses (ray,); arguments as of _sum_all.

    Written out: with the sample in a function that both loops call, the process that compiled them ran three times
    slower than later ones, with the same bits.
    """
    stride_m, stride_o, stride_z = strides
    most_o, most_z = most
    sums[:] = _f(0)
    for k in range(first, last):
        plane, at = _f(k), np.uint32(k) * stride_m
        for ray in range(LANES):
            am, turn, bend = path[ray], path[LANES + ray], path[2 * LANES + ray]
            ao, bo, co = path[3 * LANES + ray], path[4 * LANES + ray], path[5 * LANES + ray]
            az, bz, cz = path[6 * LANES + ray], path[7 * LANES + ray], path[8 * LANES + ray]
            t = (plane - am) * turn
            t -= bend * t * t * (_f(1) - _f(2) * bend * t)
            crossed = (plane >= planes[ray]) & (plane < planes[LANES + ray])
            share = _f(1) - _f(2) * bend * t if crossed else _f(0)
            o = min(max(ao + t * (bo + t * co), _f(0)), most_o)
            z = min(max(az + t * (bz + t * cz), _f(0)), most_z)
            io, iz = np.int32(o), np.int32(z)
            fo, fz = _in_phase(o - _f(io), phase)[0], _in_phase(z - _f(iz), phase)[0]
            p = np.uint32(iz * stride_z + io * stride_o + at)
            q = np.uint32(p + stride_z)
            a00, a01 = volume[p], volume[np.uint32(p + stride_o)]
            a10, a11 = volume[q], volume[np.uint32(q + stride_o)]
            low = a00 + fo * (a01 - a00)
            sums[ray] += share * (low + fz * (a10 + fo * (a11 - a10) - low))


@apart()
def _add_value(sums, turn, voxel_mm, value):  # type: ignore[no-untyped-def]
    """Add the integrals of F, grey levels: from plane to plane a ray is |1 / x'_m| voxels long, and F is per mm."""
    for ray in range(LANES):
        value[ray] += sums[ray] * (voxel_mm * abs(turn[ray]))


@apart()
def _nine_sums(sums, turn, path, m, o, voxel_mm, nine):  # type: ignore[no-untyped-def]
    """Write the integrals of d_i F times 1, l, l^2 (power, i, ray), by parts along the axis across the planes.

    Bilinear interpolation in a plane knows no derivative across it. What integration by parts leaves at the two ends
    of an interval is left out: F is zero at the ends of the ray, and at a section the motions of both intervals agree,
    so that their ends cancel but for the change of slope there. The slope is taken at l = 0.
    """
    for ray in range(LANES):
        inverse = turn[ray]
        scale = voxel_mm * abs(inverse)
        v0, v1 = sums[ray], sums[LANES + ray]
        g0, g1, g2 = sums[2 * LANES + ray], sums[3 * LANES + ray], sums[4 * LANES + ray]
        h0, h1, h2 = sums[5 * LANES + ray], sums[6 * LANES + ray], sums[7 * LANES + ray]
        across, rise = path[3 * o + LANES + ray] * inverse, path[3 * _Z + LANES + ray] * inverse
        nine[m + ray] = (-across * g0 - rise * h0) * scale
        nine[3 * LANES + m + ray] = (-across * g1 - rise * h1 - inverse * v0) * scale
        nine[6 * LANES + m + ray] = (-across * g2 - rise * h2 - 2 * inverse * v1) * scale
        nine[o + ray] = g0 * scale
        nine[3 * LANES + o + ray] = g1 * scale
        nine[6 * LANES + o + ray] = g2 * scale
        nine[_Z + ray] = h0 * scale
        nine[3 * LANES + _Z + ray] = h1 * scale
        nine[6 * LANES + _Z + ray] = h2 * scale


@apart()
def _twelve(nine, whole, sign, s0, s1, base, along, twelve):  # type: ignore[no-untyped-def]
    """Write the integrals of w x_j d_i F and w d_i F (i, j, ray), with w = whole + sign s the share of a section."""
    for i in range(3):
        for ray in range(LANES):
            m0, m1, m2 = nine[i * LANES + ray], nine[(3 + i) * LANES + ray], nine[(6 + i) * LANES + ray]
            w0, w1 = whole + sign * s0[ray], sign * s1[ray]
            flat, tilted = w0 * m0 + w1 * m1, w0 * m1 + w1 * m2
            twelve[4 * LANES * i + ray] = flat * base[_X + ray] + tilted * along[_X + ray]
            twelve[4 * LANES * i + LANES + ray] = flat * base[_Y + ray] + tilted * along[_Y + ray]
            twelve[4 * LANES * i + 2 * LANES + ray] = flat * base[_Z + ray] + tilted * along[_Z + ray]
            twelve[4 * LANES * i + 3 * LANES + ray] = flat


@apart()
def _add_section(pattern, twelve, s, at):  # type: ignore[no-untyped-def]
    """Add to s (unknown, ray) the integrals of w Psi(x(l)) . grad F, for the motions of a section from `at` on.

    Psi is affine in x and x is linear in l, so that the twelve integrals hold all that the section's motions need: a
    motion more costs a few products more.
    """
    for motion in range(pattern.shape[0]):
        for i in range(12):
            # most are zero
            if pattern[motion, i] == 0:
                continue
            for ray in range(LANES):
                s[(at + motion) * LANES + ray] += pattern[motion, i] * twelve[i * LANES + ray]


@apart()
def _add_products(s, first, last, weight, weighted_rho, of_i, matrix, vector):  # type: ignore[no-untyped-def]
    """Add w s s^T (lower triangle) and w s rho of all rays, of the unknowns first <= i < last.

    `s` (unknown, ray), `weight` and `weighted_rho` (ray,); `of_i` (ray,) is scratch. The upper triangle is filled in
    once, at the end.
    """
    for i in range(first, last):
        vector[i] += _over_rays(weighted_rho, s, i * LANES)
        for ray in range(LANES):
            of_i[ray] = weight[ray] * s[i * LANES + ray]
        for j in range(first, i + 1):
            matrix[i, j] += _over_rays(of_i, s, j * LANES)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _over_rays(one, other, at):  # type: ignore[no-untyped-def]
    """Return the sum of products of two components, the other's from `at` on.

    Four partial sums, side by side in a vector, in an order that no compiler may change: bits are to be the same.
    """
    p, q, u, v = 0.0, 0.0, 0.0, 0.0
    for ray in range(0, LANES, 4):
        p += one[ray] * other[at + ray]
        q += one[ray + 1] * other[at + ray + 1]
        u += one[ray + 2] * other[at + ray + 2]
        v += one[ray + 3] * other[at + ray + 3]
    return (p + q) + (u + v)
