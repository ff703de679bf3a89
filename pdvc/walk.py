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

from pdvc.volume import Hull

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

BAND_ROWS = 16
"""Rows of pixels that one task works on; part of the result's definition, as sums are ordered by it."""
BLOCK_COLUMNS = 16
"""Columns of a block, for which c is summed by itself."""

_f = np.float32
_BIG = 1e30
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
    """S (step, row, column, unknown) where it is asked for, else empty."""


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
    """Walk the rays of one band of rows of step t."""
    volume, shape, place, support, heights, patterns, voxel_mm, phase64 = scene
    phase = _f(phase64)
    box, rays, maps, target = steps.box[t], steps.rays[t], steps.maps[t], steps.target[t]
    weight, low = steps.weight[t % len(steps.weight)], steps.low[t, band]
    matrix, vectors, chi2 = sums.matrices[t, band], sums.vectors[t, band], sums.chi2[t]
    residual, kept = sums.residual[t], sums.kept[t]
    rows, columns = target.shape
    n, motions = patterns.shape[0], patterns.shape[1]
    nx, ny = shape[2], shape[1]
    row_of, layer = np.uint32(nx), np.uint32(nx * ny)
    # strides of the axis across the planes, of the other horizontal axis, and of z; largest place along the last two,
    # just below the last voxel, so that the next one is always there to interpolate with
    to_x, most_x = (np.uint32(1), row_of, layer), (_f(ny - 1.0001), _f(shape[0] - 1.0001))
    to_y, most_y = (row_of, np.uint32(1), layer), (_f(nx - 1.0001), _f(shape[0] - 1.0001))
    # scratch, made once for all rays; s holds the sensitivities of one pixel
    normals, limit16 = _NORMALS32, np.empty(_NORMALS32.shape[1], np.float32)
    s = np.zeros(max(vectors.shape[1], 1))
    base, along, k12 = np.empty(3), np.empty(3), np.empty(12)
    middle = 0.5 * (box[0] + box[1])
    # rows outside, columns inside: neighbours of a row walk through the same two layers of voxels, still in the cache
    for row in range(band * BAND_ROWS, min((band + 1) * BAND_ROWS, rows)):
        for column in range(columns):
            reach = _aim(rays, middle, row, column, base, along)
            # one axis for the whole ray: sums of neighbouring intervals must be over the same planes
            along_x = abs(along[0]) >= abs(along[1])
            value = 0.0
            a, end = _clip_box(box, base, along)
            # a box that reaches the source goes on behind it, where no band's sections were looked for
            a = max(a, -reach)
            k_first, k_last = n, -1
            rising = along[2] >= 0
            # from section to section: between two of them the moved ray is one polynomial
            while a < end:
                # the interval between sections k and k + 1 that the ray enters at a
                z = base[2] + a * along[2]
                k = -1
                while k + 1 < n and (heights[k + 1] < z or (rising and heights[k + 1] == z)):
                    k += 1
                # it leaves it at b
                b = end
                wall = k + 1 if rising else k
                if n > 1 and 0 <= wall < n and abs(along[2]) > 1e-9:
                    b = min(end, (heights[wall] - base[2]) / along[2])
                    if b <= a:  # rounding left the ray on the wall: step over it
                        b = min(end, a + 1e-7)
                # the upper section's share there is s0 + s1 l; beyond the outermost section that one alone counts
                j0, j1, s0, s1 = max(k, 0), min(max(k, 0) + 1, n - 1), 0.0, 0.0
                if 0 <= k < n - 1:
                    s1 = along[2] / (heights[k + 1] - heights[k])
                    s0 = (base[2] - heights[k]) / (heights[k + 1] - heights[k])
                else:
                    j1 = j0
                path = _quadratic(maps[j0], maps[j1], base, along, s0, s1)
                inner_a, inner_b = _clip_hull(place, support, normals, limit16, shape[0], a, b, path)
                if inner_a < inner_b:
                    ax, bx, cx, ay, by, cy, az, bz, cz = path
                    if along_x:
                        turned, strides, limit, count = (ax, bx, cx, ay, by, cy, az, bz, cz), to_x, most_x, nx
                    else:
                        turned, strides, limit, count = (ay, by, cy, ax, bx, cx, az, bz, cz), to_y, most_y, ny
                    first, last = _planes(turned, inner_a, inner_b, count)
                    if last > first:
                        am, bm, cm, ao, bo, co, az, bz, cz = turned
                        path32 = (_f(am), _f(bm), _f(cm), _f(ao), _f(bo), _f(co), _f(az), _f(bz), _f(cz))
                        # length of the ray from plane to plane, mm: F is per mm
                        scale = voxel_mm / abs(bm)
                        if with_sensitivities:
                            sums8 = _sum_all(volume, strides, limit, first, last, path32, phase)
                            value += sums8[0] * scale
                            nine = _nine_sums(sums8, turned, along_x)
                            if k_last < 0:
                                k_first, k_last = j0, j1
                            k_first, k_last = min(k_first, j0), max(k_last, j1)
                            # both sections of the interval, each with its hat: 1 - s and s
                            at = (j0 - low) * motions
                            out = s[at : at + motions]
                            if j0 == j1:
                                _add_section(patterns[j0], 1.0, 0.0, base, along, nine, scale, k12, out)
                            else:
                                _add_section(patterns[j0], 1.0 - s0, -s1, base, along, nine, scale, k12, out)
                                at = (j1 - low) * motions
                                out = s[at : at + motions]
                                _add_section(patterns[j1], s0, s1, base, along, nine, scale, k12, out)
                        else:
                            value += scale * _sum_values(volume, strides, limit, first, last, path32, phase)
                a = b
            rho = value - target[row, column]
            residual[row, column] = rho
            w = weight[row, column]
            if w > 0:
                chi2[band] += w * rho * rho
            if k_last >= 0:
                # only the sections that this ray met: S of a pixel is zero elsewhere, and so are its products
                first, last = (k_first - low) * motions, (k_last + 1 - low) * motions
                if w > 0:
                    _add_outer(matrix, vectors[column // BLOCK_COLUMNS], s, first, last, w, rho)
                if kept.size > 0:
                    for i in range(first, last):
                        kept[row, column, i] = s[i]
                s[first:last] = 0.0


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _aim(rays, middle, row, column, base, along):  # type: ignore[no-untyped-def]
    """Write the ray base + l along to a pixel's centre, along of length 1, and return the distance base - source.

    l = 0 is where the ray passes the middle of the sample: l stays small, so that single precision is enough.
    """
    length, reach = 0.0, 0.0
    for i in range(3):
        along[i] = rays[1, i] + row * rays[2, i] + column * rays[3, i] - rays[0, i]
        length += along[i] * along[i]
    for i in range(3):
        along[i] /= np.sqrt(length)
        reach += along[i] * (middle[i] - rays[0, i])
    for i in range(3):
        base[i] = rays[0, i] + reach * along[i]
    return reach


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True, inline="always")
def _in_phase(f, phase):  # type: ignore[no-untyped-def]
    """Return the share of the next voxel at a place f in [0, 1] after one, and its derivative: `Volume.phase`."""
    away = f * (_f(1) - f)
    return f + phase * away * (_f(1) - _f(2) * f), _f(1) + phase * (_f(1) - _f(6) * away)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True, boundscheck=False)
def _sum_all(volume, strides, limit, first, last, path, phase):  # type: ignore[no-untyped-def]
    """Sum F times 1, l, and d_o F times 1, l, l^2, over the planes first <= k < last that the ray crosses.

    `path` holds the coefficients of x'(l) for the axes m, o, z, and `strides` and `limit` theirs. This loop is where
    the time goes (docs/performance.md): no branches, four gathers, and single precision, so that a vector holds twice
    as many planes.
    """
    am, bm, cm, ao, bo, co, az, bz, cz = path
    stride_m, stride_o, stride_z = strides
    most_o, most_z = limit
    turn = _f(1) / bm
    bend = cm * turn
    v0 = v1 = g0 = g1 = g2 = h0 = h1 = h2 = _f(0)
    for k in range(first, last):
        # l at which x'_m = k, from am + bm l + cm l^2 = k by the series in the small curvature cm / bm
        t = (_f(k) - am) * turn
        t -= bend * t * t * (_f(1) - _f(2) * bend * t)
        # length from plane to plane, here over its value 1 / bm at l = 0
        share = _f(1) - _f(2) * bend * t
        # rounding may take the ray out of the volume, where it would read other memory
        o = min(max(ao + t * (bo + t * co), _f(0)), most_o)
        z = min(max(az + t * (bz + t * cz), _f(0)), most_z)
        io, iz = np.int32(o), np.int32(z)
        fo, slope_o = _in_phase(o - _f(io), phase)
        fz, slope_z = _in_phase(z - _f(iz), phase)
        # unsigned indices: signed ones of 32 bits were slower, and these reach twice as far
        p = np.uint32(iz * stride_z + io * stride_o + np.uint32(k) * stride_m)
        q = p + stride_z
        # the four voxels around the place in this plane, and the bilinear value with its exact derivatives
        a00, a01, a10, a11 = volume[p], volume[p + stride_o], volume[q], volume[q + stride_o]
        d0, d1 = a01 - a00, a11 - a10
        low = a00 + fo * d0
        dz = a10 + fo * d1 - low
        value = share * (low + fz * dz)
        do = share * slope_o * (d0 + fz * (d1 - d0))
        dz *= share * slope_z
        v0 += value
        v1 += t * value
        g0 += do
        h0 += dz
        do *= t
        dz *= t
        g1 += do
        h1 += dz
        g2 += t * do
        h2 += t * dz
    return v0, v1, g0, g1, g2, h0, h1, h2


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True, boundscheck=False)
def _sum_values(volume, strides, limit, first, last, path, phase):  # type: ignore[no-untyped-def]
    """Sum F over the planes first <= k < last that the ray crosses; arguments as of _sum_all."""
    am, bm, cm, ao, bo, co, az, bz, cz = path
    stride_m, stride_o, stride_z = strides
    most_o, most_z = limit
    turn = _f(1) / bm
    bend = cm * turn
    v0 = _f(0)
    for k in range(first, last):
        t = (_f(k) - am) * turn
        t -= bend * t * t * (_f(1) - _f(2) * bend * t)
        o = min(max(ao + t * (bo + t * co), _f(0)), most_o)
        z = min(max(az + t * (bz + t * cz), _f(0)), most_z)
        io, iz = np.int32(o), np.int32(z)
        fo, fz = _in_phase(o - _f(io), phase)[0], _in_phase(z - _f(iz), phase)[0]
        p = np.uint32(iz * stride_z + io * stride_o + np.uint32(k) * stride_m)
        q = p + stride_z
        a00, a01, a10, a11 = volume[p], volume[p + stride_o], volume[q], volume[q + stride_o]
        low = a00 + fo * (a01 - a00)
        v0 += (_f(1) - _f(2) * bend * t) * (low + fz * (a10 + fo * (a11 - a10) - low))
    return v0


@njit(nogil=True, cache=True, error_model="numpy")
def _planes(path, a, b, count):  # type: ignore[no-untyped-def]
    """Return the planes [first, last) that the ray crosses between a and b, each counted in one interval only."""
    # half open, on the side of a: a plane exactly on a wall between two intervals belongs to the later one
    start = path[0] + a * (path[1] + a * path[2])
    end = path[0] + b * (path[1] + b * path[2])
    if end >= start:
        first, last = int(np.ceil(start)), int(np.ceil(end))
    else:
        first, last = int(np.floor(end)) + 1, int(np.floor(start)) + 1
    return max(first, 0), min(last, count)


@njit(nogil=True, cache=True, error_model="numpy")
def _nine_sums(sums, path, along_x):  # type: ignore[no-untyped-def]
    """Complete the sums of d_i F times 1, l, l^2, for i = x, y, z, by parts along the axis across the planes.

    Bilinear interpolation in a plane knows no derivative across it. What integration by parts leaves at the two ends
    of an interval is left out: F is zero at the ends of the ray, and at a section the motions of both intervals agree,
    so that their ends cancel but for the change of slope there. The slope t is taken at l = 0.
    """
    v0, v1 = sums[0], sums[1]
    g0, g1, g2 = np.float64(sums[2]), np.float64(sums[3]), np.float64(sums[4])
    h0, h1, h2 = np.float64(sums[5]), np.float64(sums[6]), np.float64(sums[7])
    turn = 1.0 / path[1]
    o, z = path[4] * turn, path[7] * turn
    m0 = -o * g0 - z * h0
    m1 = -o * g1 - z * h1 - turn * v0
    m2 = -o * g2 - z * h2 - 2 * turn * v1
    if along_x:
        return m0, g0, h0, m1, g1, h1, m2, g2, h2
    return g0, m0, h0, g1, m1, h1, g2, m2, h2


@njit(nogil=True, cache=True, error_model="numpy")
def _clip_box(box, base, along):  # type: ignore[no-untyped-def]
    """Return the part [a, b] of the ray base + l along that lies in a box; empty where a >= b."""
    a, b = -_BIG, _BIG
    for i in range(3):
        # a ray along a face of the box never crosses it: it is between the two faces or it is not
        if abs(along[i]) < 1e-12:
            if base[i] < box[0, i] or base[i] > box[1, i]:
                return 0.0, 0.0
        else:
            near, far = (box[0, i] - base[i]) / along[i], (box[1, i] - base[i]) / along[i]
            a, b = max(a, min(near, far)), min(b, max(near, far))
    return a, b


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True, boundscheck=False)
def _clip_hull(place, support, normals, limit, layers, a, b, path):  # type: ignore[no-untyped-def]
    """Shrink [a, b] to where the moved ray x'(l), taken as straight between a and b, meets the hull.

    It also stays inside the volume's first and last layer but one: where the volume is cut in height, the step from
    the sample to the empty outermost layer is no texture. Written without branches over the half-planes, in single
    precision, so that they are clipped together; `limit` (direction,) is scratch.
    """
    ax, bx, cx, ay, by, cy, az, bz, cz = path
    xa, ya, za = _f(ax + a * (bx + a * cx)), _f(ay + a * (by + a * cy)), az + a * (bz + a * cz)
    xb, yb, zb = _f(ax + b * (bx + b * cx)), _f(ay + b * (by + b * cy)), az + b * (bz + b * cz)
    first = max(int(np.floor((min(za, zb) - place[0]) / place[1])), 0)
    last = min(int(np.floor((max(za, zb) - place[0]) / place[1])), support.shape[0] - 1)
    if first > last:
        return a, a
    # a ray through several slabs is clipped by the hull of them all
    limit[:] = support[first]
    for slab in range(first + 1, last + 1):
        for k in range(len(limit)):
            limit[k] = max(limit[k], support[slab, k])
    low, high = _f(0), _f(1)
    for da, db in ((za - 1, zb - 1), (layers - 2 - za, layers - 2 - zb)):
        if da < 0 and db < 0:
            return a, a
        if da < 0:
            low = max(low, _f(da / (da - db)))
        elif db < 0:
            high = min(high, _f(da / (da - db)))
    for k in range(len(limit)):
        # depths below the half-plane's edge at both ends; it is crossed where the line between them is zero
        da = limit[k] - (normals[0, k] * xa + normals[1, k] * ya)
        db = limit[k] - (normals[0, k] * xb + normals[1, k] * yb)
        t = da / (da - db)
        # outside at both ends: beyond 1, so that nothing is left
        enter = _f(2) if db < 0 else t
        low = max(low, enter if da < 0 else _f(0))
        high = min(high, t if db < 0 else _f(1))
    if low >= high:
        return a, a
    return a + low * (b - a), a + high * (b - a)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _quadratic_row(first, second, i, base, along, s0, s1):  # type: ignore[no-untyped-def]
    """Return coordinate i of x'(l) = x - u(x), with u = (1 - s) u_first + s u_second, s = s0 + s1 l."""
    # u of both sections along the ray: p + q l, and what the second has more, dp + dq l
    p = first[i, 0] * base[0] + first[i, 1] * base[1] + first[i, 2] * base[2] + first[i, 3]
    q = first[i, 0] * along[0] + first[i, 1] * along[1] + first[i, 2] * along[2]
    dp = second[i, 0] * base[0] + second[i, 1] * base[1] + second[i, 2] * base[2] + second[i, 3] - p
    dq = second[i, 0] * along[0] + second[i, 1] * along[1] + second[i, 2] * along[2] - q
    return base[i] - p - s0 * dp, along[i] - q - s0 * dq - s1 * dp, -s1 * dq


@njit(nogil=True, cache=True, error_model="numpy")
def _quadratic(first, second, base, along, s0, s1):  # type: ignore[no-untyped-def]
    """Return the nine coefficients of the moved ray x'(l), coordinate by coordinate."""
    ax, bx, cx = _quadratic_row(first, second, 0, base, along, s0, s1)
    ay, by, cy = _quadratic_row(first, second, 1, base, along, s0, s1)
    az, bz, cz = _quadratic_row(first, second, 2, base, along, s0, s1)
    return ax, bx, cx, ay, by, cy, az, bz, cz


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def _add_section(pattern, w0, w1, base, along, sums, scale, k, out):  # type: ignore[no-untyped-def]
    """Add to `out` (motion,) the integral of (w0 + w1 l) Psi(x(l)) . grad F, from the nine sums; `k` is scratch.

    Psi is affine in x and x is linear in l, so that twelve integrals, of x_j d_i F and d_i F, hold all that the
    section's motions need: a motion more costs twelve products more.
    """
    for i in range(3):
        m0, m1, m2 = sums[i], sums[3 + i], sums[6 + i]
        flat, tilted = (w0 * m0 + w1 * m1) * scale, (w0 * m1 + w1 * m2) * scale
        for j in range(3):
            k[4 * i + j] = flat * base[j] + tilted * along[j]
        k[4 * i + 3] = flat
    for n in range(pattern.shape[0]):
        total = 0.0
        for i in range(12):
            total += pattern[n, i] * k[i]
        out[n] += total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def _add_outer(matrix, vector, s, first, last, weight, rho):  # type: ignore[no-untyped-def]
    """Add w s s^T (lower triangle) and w s rho of one pixel; the upper triangle is filled in once, at the end."""
    for i in range(first, last):
        w = weight * s[i]
        vector[i] += w * rho
        for j in range(first, i + 1):
            matrix[i, j] += w * s[j]
