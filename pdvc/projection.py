"""Warped projection, residual and projected sensitivities of radiographs, reduced as they are found.

For each step, with F the reference volume, u the trial motion and a ray x(s) from the source to pixel r,

    P[F~](r)  = int F(x - u(x)) ds                              grey levels
    rho(r)    = P[F~](r) - g(r)                                 Eq. 2
    S_i(r)    = int Phi_i(x) . grad F(x - u(x)) ds              Eq. 10, grey levels per voxel
    B_ij      = sum_r w(r) S_i(r) S_j(r)                        Eq. 11
    c_i       = sum_r w(r) S_i(r) rho(r)

so that chi2 = sum_r w rho^2 is lowered by the solution of B da = c. Neither S nor the warped volume is stored:
each ray is walked once, and its sensitivities are added into B and c and forgotten.

The integrals are sums over the voxel planes that the moved ray x'(l) = x(l) - u(x(l)) crosses (Joseph, 1982): along
x or y, whichever the ray follows more, with bilinear interpolation of F, and its exact gradient, in each plane.
Between two sections u is a quadratic polynomial of the ray's arc length l, and so is everything that multiplies
grad F. With m the axis across the planes, o the two others and t = dx'/dl, the missing derivative follows by parts,

    int l^n d_m F dl = -sum_o (t_o / t_m) int l^n d_o F dl - (n / t_m) int l^(n-1) F dl,

as F vanishes at both ends of the ray: eight sums, of F, l F and d_o F times 1, l, l^2, give the sensitivities of
all motions, however many a section has.

Sums run in single precision along a ray, in double precision over rays. Bands of rows are worked on in
parallel and added in order, so that the result does not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from pdvc.sections import SectionBasis
from pdvc.volume import Hull, Volume

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

BAND_ROWS = 16
"""Rows of pixels that one task works on; part of the result's definition, as sums are ordered by it."""

_f = np.float32
_BIG = 1e30
_NORMALS = Hull.normals()
_NORMALS32 = np.ascontiguousarray(_NORMALS.T, dtype=np.float32)
_NOWHERE = np.float32(-1e6)
_FARTHEST = 2.0
"""Distances from the axis to the source within which a moved sample is followed."""


@dataclass(frozen=True, kw_only=True)
class StepEquations:
    """Hold what radiographs say about the section amplitudes of their steps."""

    matrix: Floats
    """B (step, section * motion, section * motion), (grey level / voxel)^2."""
    vector: Floats
    """c (step, section * motion), grey level^2 / voxel."""
    chi2: Floats
    """Weighted sum of squared residuals (step,), grey level^2."""
    residual: Image
    """rho (step, row, column), grey levels, in every pixel of the window, whatever its weight."""


def normal_equations(
    volume: Volume,
    rays: Floats,
    basis: SectionBasis,
    amplitude: Floats,
    target: Image,
    weight: Image,
    *,
    voxel_mm: float,
) -> StepEquations:
    """Compare radiographs with the moved volume, and return their normal equations.

    `rays` (step, 4, 3) in mm as of RayVectors.stacked, for the window that `target` (step, row, column) covers;
    `amplitude` (step, section, motion) in voxels of `voxel_mm`; `weight` (step, row, column), or (1, row, column)
    for all steps, zero for unused pixels. A step that takes the sample out of the scanner has an infinite chi2, so
    that no solver goes there. Raises ValueError for amplitudes that are not finite or of another shape.
    """
    return _walk(volume, rays, basis, amplitude, target, weight, voxel_mm, True, tried=True)


@dataclass(frozen=True, kw_only=True)
class Sensitivities:
    """Hold S_i of every pixel of one step, for the sections that its row may touch: the others' are zero."""

    values: Image
    """S (row, column, section of the row * motion), grey levels per voxel."""
    first: NDArray[np.int64]
    """(row,) the section that `values` starts with; sections beyond the last are zero."""
    motions: int
    """Motions of a section."""


def sensitivities(
    volume: Volume,
    rays: Floats,
    shape: tuple[int, int],
    basis: SectionBasis,
    amplitude: Floats,
    *,
    voxel_mm: float,
) -> list[Sensitivities]:
    """Return S of each step: what `normal_equations` forgets, and what noise is propagated with.

    Arguments as of `project`. A step at the paper's size takes 20 MB.
    """
    blank = np.zeros((len(rays), *shape), dtype=np.float32)
    fields: list[Sensitivities] = []
    _walk(volume, rays, basis, amplitude, blank, blank[:1], voxel_mm, True, fields)
    return fields


def project(
    volume: Volume,
    rays: Floats,
    shape: tuple[int, int],
    basis: SectionBasis,
    amplitude: Floats,
    *,
    voxel_mm: float,
) -> Image:
    """Return the radiographs P[F~] (step, row, column), grey levels, of the moved volume; arguments as above."""
    blank = np.zeros((len(rays), *shape), dtype=np.float32)
    return _walk(volume, rays, basis, amplitude, blank, blank[:1], voxel_mm, False).residual


def project_at_rest(volume: Volume, rays: Floats, shape: tuple[int, int]) -> Image:
    """Return the radiographs P[F] (step, row, column), grey levels, of the volume where it is."""
    still = SectionBasis(height_mm=np.zeros(1), radius_mm=1.0)
    nothing = np.zeros((len(rays), *still.shape))
    return project(volume, rays, shape, still, nothing, voxel_mm=volume.grid.voxel_mm)


def _walk(
    volume: Volume,
    rays: Floats,
    basis: SectionBasis,
    amplitude: Floats,
    target: Image,
    weight: Image,
    voxel_mm: float,
    with_sensitivities: bool,
    fields: list[Sensitivities] | None = None,
    tried: bool = False,
) -> StepEquations:
    """Prepare the steps in index coordinates of the volume, walk their rays, and add the bands in order.

    Where `fields` is a list, the sensitivities of each step are appended to it. Where motions are only `tried`, one
    that leaves the scanner is as bad as can be; else it is refused.
    """
    grid, steps = volume.grid, len(rays)
    if amplitude.shape != (steps, *basis.shape) or not np.isfinite(amplitude).all():
        raise ValueError(f"amplitude: expected finite {(steps, *basis.shape)}, got {amplitude.shape}")
    origin = np.array(grid.origin_mm)
    index_rays = rays / grid.voxel_mm
    index_rays[:, :2] -= origin / grid.voxel_mm
    heights = (basis.height_mm - origin[2]) / grid.voxel_mm
    ratio = voxel_mm / grid.voxel_mm
    maps = _indexed(basis.affine(amplitude), origin, grid.voxel_mm) * ratio
    patterns = _indexed(basis.patterns(), origin, grid.voxel_mm) * ratio
    place, support = _hull_in_index(volume)
    boxes = np.stack([_moved_box(volume, heights, each) for each in maps])
    astray = _astray(boxes, index_rays)
    if astray.any():
        if not tried:
            raise ValueError(f"amplitude: expected the sample in the beam, got it outside in {astray.sum()} steps")
        at_rest = np.where(astray[:, None, None], 0, amplitude)
        found = _walk(volume, rays, basis, at_rest, target, weight, voxel_mm, with_sensitivities, tried=True)
        return replace(found, chi2=np.where(astray, np.inf, found.chi2))
    bands = [_band_sections(index_rays[t], target.shape[1:], heights, boxes[t]) for t in range(steps)]
    low = np.stack([lowest for lowest, _ in bands])
    size = max(span for _, span in bands) * basis.shape[1] if with_sensitivities else 0
    matrices, vectors = np.zeros((*low.shape, size, size)), np.zeros((*low.shape, size))
    chi2 = np.zeros(low.shape)
    residual = np.empty(target.shape, dtype=np.float32)
    kept = np.zeros((*target.shape, size) if fields is not None else (steps, 0, 0, 0), dtype=np.float32)
    _walk_bands(
        volume.values.reshape(-1),
        np.array(grid.shape, dtype=np.int64),
        place,
        support,
        boxes,
        index_rays,
        heights,
        maps,
        np.ascontiguousarray(patterns.reshape(*basis.shape, 12)),
        target,
        weight,
        grid.voxel_mm,
        with_sensitivities,
        low,
        matrices,
        vectors,
        chi2,
        residual,
        kept,
    )
    if fields is not None:
        of_row = np.arange(target.shape[1]) // BAND_ROWS
        fields.extend(
            Sensitivities(values=kept[t], first=low[t, of_row], motions=basis.shape[1]) for t in range(steps)
        )
    total = basis.shape[0] * basis.shape[1] if with_sensitivities else 0
    matrix, vector = np.zeros((steps, total, total)), np.zeros((steps, total))
    for t, band in np.ndindex(low.shape if with_sensitivities else (0, 0)):
        first = int(low[t, band]) * basis.shape[1]
        count = min(size, total - first)
        here = slice(first, first + count)
        matrix[t, here, here] += matrices[t, band, :count, :count]
        vector[t, here] += vectors[t, band, :count]
    matrix += np.tril(matrix, -1).transpose(0, 2, 1)
    return StepEquations(matrix=matrix, vector=vector, chi2=chi2.sum(axis=1), residual=residual)


def _indexed(affine: Floats, origin_mm: Floats, voxel_mm: float) -> Floats:
    """Turn affine maps (..., 3, 4) of x in mm into the same maps of voxel indices."""
    result = affine.copy()
    result[..., 3] += affine[..., :3] @ origin_mm
    result[..., :3] *= voxel_mm
    return result


def _hull_in_index(volume: Volume) -> tuple[Floats, Image]:
    """Return (bottom, height) of the hull's slabs and its supports, in voxel indices; empty slabs far outside."""
    grid, hull = volume.grid, volume.hull
    origin = np.array(grid.origin_mm)
    place = np.array([(hull.z_mm - origin[2]) / grid.voxel_mm, hull.slab_mm / grid.voxel_mm])
    support = (hull.support_mm - _NORMALS @ origin[:2]) / grid.voxel_mm
    return place, np.where(np.isfinite(support), support, _NOWHERE).astype(np.float32)


def _moved_box(volume: Volume, heights: Floats, maps: Floats) -> Floats:
    """Return a box (2, 3), in voxel indices, that holds the hull wherever u takes it.

    x = X + u(x): bounding u over the hull's box, enlarged once by that bound, bounds the moved hull.
    """
    low, high = volume.hull.box_mm()
    origin = np.array(volume.grid.origin_mm)
    start = np.array([low - origin, high - origin]) / volume.grid.voxel_mm
    box = start
    for _ in range(2):
        x, y = np.repeat(box[:, 0], 2), np.tile(box[:, 1], 2)
        z = np.concatenate([heights, box[:, 2]])
        corners = np.stack(np.broadcast_arrays(x[:, None], y[:, None], z), axis=-1).reshape(-1, 3)
        moved = np.tensordot(maps[..., :3], corners, axes=(2, 1)) + maps[..., 3, None]
        box = np.array(
            [
                start[0] + np.minimum(moved.min(axis=(0, 2)), 0) - 1,
                start[1] + np.maximum(moved.max(axis=(0, 2)), 0) + 1,
            ]
        )
    return box


def _astray(boxes: Floats, rays: Floats) -> NDArray[np.bool_]:
    """Return which steps (step,) are taken so far that sums in single precision mean nothing."""
    most = _FARTHEST * float(np.linalg.norm(rays[:, 0], axis=1).max())
    return np.asarray(~(np.abs(boxes).max(axis=(1, 2)) <= most))


def _band_sections(
    rays: Floats, shape: tuple[int, ...], heights: Floats, box: Floats
) -> tuple[NDArray[np.int64], int]:
    """Return each band's lowest section, and the largest number of sections that any band touches."""
    rows, columns = shape
    bands = -(-rows // BAND_ROWS)
    first = np.arange(bands) * BAND_ROWS
    row = np.stack([first, np.minimum(first + BAND_ROWS, rows) - 1])[..., None]
    column = np.arange(columns)
    slope = [rays[1, i] + row * rays[2, i] + column * rays[3, i] - rays[0, i] for i in range(3)]
    rise = slope[2] / np.hypot(slope[0], slope[1])
    near = np.hypot(*(box.mean(axis=0)[:2] - rays[0, :2]))
    reach = np.linalg.norm(box[1, :2] - box[0, :2]) / 2 + 1
    # every point of the box is, seen from above, between these two distances from the source
    z = rays[0, 2] + np.stack([rise * max(near - reach, 0.0), rise * (near + reach)])
    low = np.searchsorted(heights, z.min(axis=(0, 1, 3)) - 1, side="right") - 1
    high = np.searchsorted(heights, z.max(axis=(0, 1, 3)) + 1, side="left")
    low = np.clip(low, 0, len(heights) - 1)
    high = np.clip(high, low, len(heights) - 1)
    return low, int((high - low).max()) + 1


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True, boundscheck=False)
def _sum_all(volume, strides, limit, first, last, path):  # type: ignore[no-untyped-def]
    """Sum F times 1, l, and d_o F times 1, l, l^2, over the planes first <= k < last that the ray crosses.

    `path` holds the coefficients of x'(l) for the axes m, o, z, and `strides` and `limit` theirs.
    """
    am, bm, cm, ao, bo, co, az, bz, cz = path
    stride_m, stride_o, stride_z = strides
    most_o, most_z = limit
    turn = _f(1) / bm
    bend = cm * turn
    v0 = v1 = g0 = g1 = g2 = h0 = h1 = h2 = _f(0)
    for k in range(first, last):
        t = (_f(k) - am) * turn
        t -= bend * t * t * (_f(1) - _f(2) * bend * t)
        share = _f(1) - _f(2) * bend * t
        o = min(max(ao + t * (bo + t * co), _f(0)), most_o)
        z = min(max(az + t * (bz + t * cz), _f(0)), most_z)
        io, iz = np.int32(o), np.int32(z)
        fo, fz = o - _f(io), z - _f(iz)
        p = np.uint32(iz * stride_z + io * stride_o + np.uint32(k) * stride_m)
        q = p + stride_z
        a00, a01, a10, a11 = volume[p], volume[p + stride_o], volume[q], volume[q + stride_o]
        d0, d1 = a01 - a00, a11 - a10
        low = a00 + fo * d0
        dz = a10 + fo * d1 - low
        value = share * (low + fz * dz)
        do = share * (d0 + fz * (d1 - d0))
        dz *= share
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
def _sum_values(volume, strides, limit, first, last, path):  # type: ignore[no-untyped-def]
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
        fo, fz = o - _f(io), z - _f(iz)
        p = np.uint32(iz * stride_z + io * stride_o + np.uint32(k) * stride_m)
        q = p + stride_z
        a00, a01, a10, a11 = volume[p], volume[p + stride_o], volume[q], volume[q + stride_o]
        low = a00 + fo * (a01 - a00)
        v0 += (_f(1) - _f(2) * bend * t) * (low + fz * (a10 + fo * (a11 - a10) - low))
    return v0


@njit(nogil=True, cache=True, error_model="numpy")
def _planes(path, a, b, count):  # type: ignore[no-untyped-def]
    """Return the planes [first, last) that the ray crosses between a and b, each counted in one interval only."""
    start = path[0] + a * (path[1] + a * path[2])
    end = path[0] + b * (path[1] + b * path[2])
    if end >= start:
        first, last = int(np.ceil(start)), int(np.ceil(end))
    else:
        first, last = int(np.floor(end)) + 1, int(np.floor(start)) + 1
    return max(first, 0), min(last, count)


@njit(nogil=True, cache=True, error_model="numpy")
def _nine_sums(sums, path, along_x):  # type: ignore[no-untyped-def]
    """Complete the sums of d_i F times 1, l, l^2, for i = x, y, z, by parts along the axis across the planes."""
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
        da = limit[k] - (normals[0, k] * xa + normals[1, k] * ya)
        db = limit[k] - (normals[0, k] * xb + normals[1, k] * yb)
        t = da / (da - db)
        enter = _f(2) if db < 0 else t
        low = max(low, enter if da < 0 else _f(0))
        high = min(high, t if db < 0 else _f(1))
    if low >= high:
        return a, a
    return a + low * (b - a), a + high * (b - a)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _quadratic_row(first, second, i, base, along, s0, s1):  # type: ignore[no-untyped-def]
    """Return coordinate i of x'(l) = x - u(x), with u = (1 - s) u_first + s u_second, s = s0 + s1 l."""
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
    """Add to `out` (motion,) the integral of (w0 + w1 l) Psi(x(l)) . grad F, from the nine sums; `k` is scratch."""
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
    """Add w s s^T (lower triangle) and w s rho of one pixel."""
    for i in range(first, last):
        w = weight * s[i]
        vector[i] += w * rho
        for j in range(first, i + 1):
            matrix[i, j] += w * s[j]


@njit(nogil=True, cache=True, error_model="numpy", parallel=True)
def _walk_bands(  # type: ignore[no-untyped-def]
    volume,
    shape,
    place,
    support,
    box,
    rays,
    heights,
    maps,
    patterns,
    target,
    weight,
    voxel_mm,
    with_sensitivities,
    low,
    matrices,
    vectors,
    chi2,
    residual,
    kept,
):
    """Walk all rays of all steps, a band of rows at a time."""
    bands = low.shape[1]
    for task in prange(low.size):
        t, band = task // bands, task % bands
        _walk_band(
            volume,
            shape,
            place,
            support,
            box[t],
            rays[t],
            heights,
            maps[t],
            patterns,
            target[t],
            weight[t % len(weight)],
            voxel_mm,
            with_sensitivities,
            low[t, band],
            band,
            matrices[t, band],
            vectors[t, band],
            chi2[t],
            residual[t],
            kept[t],
        )


@njit(nogil=True, cache=True, error_model="numpy")
def _walk_band(  # type: ignore[no-untyped-def]
    volume,
    shape,
    place,
    support,
    box,
    rays,
    heights,
    maps,
    patterns,
    target,
    weight,
    voxel_mm,
    with_sensitivities,
    low,
    band,
    matrix,
    vector,
    chi2,
    residual,
    kept,
):
    """Walk the rays of one band of rows."""
    rows, columns = target.shape
    n, motions = patterns.shape[0], patterns.shape[1]
    nx, ny = shape[2], shape[1]
    row_of, layer = np.uint32(nx), np.uint32(nx * ny)
    # strides of the axis across the planes, of the other horizontal axis, and of z; largest index of the last two
    to_x, most_x = (np.uint32(1), row_of, layer), (_f(ny - 1.0001), _f(shape[0] - 1.0001))
    to_y, most_y = (row_of, np.uint32(1), layer), (_f(nx - 1.0001), _f(shape[0] - 1.0001))
    normals, limit16 = _NORMALS32, np.empty(_NORMALS32.shape[1], np.float32)
    s = np.zeros(max(vector.shape[0], 1))
    base, along, k12 = np.empty(3), np.empty(3), np.empty(12)
    middle = 0.5 * (box[0] + box[1])
    for row in range(band * BAND_ROWS, min((band + 1) * BAND_ROWS, rows)):
        for column in range(columns):
            length, reach = 0.0, 0.0
            for i in range(3):
                along[i] = rays[1, i] + row * rays[2, i] + column * rays[3, i] - rays[0, i]
                length += along[i] * along[i]
            for i in range(3):
                along[i] /= np.sqrt(length)
                reach += along[i] * (middle[i] - rays[0, i])
            for i in range(3):
                # l = 0 where the ray passes the middle of the sample, so that single precision is enough
                base[i] = rays[0, i] + reach * along[i]
            # one axis for the whole ray: sums of neighbouring intervals must be over the same planes
            along_x = abs(along[0]) >= abs(along[1])
            value = 0.0
            a, end = _clip_box(box, base, along)
            # a box that reaches the source goes on behind it, where no band's sections were looked for
            a = max(a, -reach)
            k_first, k_last = n, -1
            rising = along[2] >= 0
            while a < end:
                # the interval between sections k and k + 1 that the ray enters at a
                z = base[2] + a * along[2]
                k = -1
                while k + 1 < n and (heights[k + 1] < z or (rising and heights[k + 1] == z)):
                    k += 1
                b = end
                wall = k + 1 if rising else k
                if n > 1 and 0 <= wall < n and abs(along[2]) > 1e-9:
                    b = min(end, (heights[wall] - base[2]) / along[2])
                    if b <= a:  # rounding left the ray on the wall: step over it
                        b = min(end, a + 1e-7)
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
                        scale = voxel_mm / abs(bm)
                        if with_sensitivities:
                            sums = _sum_all(volume, strides, limit, first, last, path32)
                            value += sums[0] * scale
                            nine = _nine_sums(sums, turned, along_x)
                            if k_last < 0:
                                k_first, k_last = j0, j1
                            k_first, k_last = min(k_first, j0), max(k_last, j1)
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
                            value += scale * _sum_values(volume, strides, limit, first, last, path32)
                a = b
            rho = value - target[row, column]
            residual[row, column] = rho
            w = weight[row, column]
            if w > 0:
                chi2[band] += w * rho * rho
            if k_last >= 0:
                first, last = (k_first - low) * motions, (k_last + 1 - low) * motions
                if w > 0:
                    _add_outer(matrix, vector, s, first, last, w, rho)
                if kept.size > 0:
                    for i in range(first, last):
                        kept[row, column, i] = s[i]
                s[first:last] = 0.0
