"""The reference volume by filtered back-projection of cone-beam views (Feldkamp, Davis and Kress, 1984).

For a full turn of views at angles theta_i, in the frame of pdvc.geometry, with R the source-axis distance and
detector coordinates (u, v) scaled to the axis plane (u along e_c, v downwards, mm):

    p'(u, v)  = p(u, v) R / sqrt(R^2 + u^2 + v^2)                     cosine weight
    q         = p' * h along u,   h the band-limited ramp             1 / mm
    F(x)      = 1/2 sum_i dtheta_i (R / U)^2 q_i(u(x), v(x)),         U = R + x . e_b(theta_i)
    u(x)      = R (x . e_c) / U,   v(x) = -R z / U

Only voxels inside a hull are reconstructed; views are read, filtered and used in batches, never all at once.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numba
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy import fft, ndimage

from pdvc.apart import IN_ORDER, apart
from pdvc.geometry import ConeBeam, gaps_rad
from pdvc.progress import Progress, silent
from pdvc.rays import directions
from pdvc.volume import Grid, Hull, framed

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

BATCH = 12
"""Views that are back-projected together."""
LARGEST_GAP_RAD = np.deg2rad(20.0)


def fdk(
    view: Callable[[int], Image],
    geometry: ConeBeam,
    angle_rad: Floats,
    grid: Grid,
    hull: Hull,
    *,
    progress: Progress = silent,
    task: str = "reconstruct",
) -> NDArray[np.float32]:
    """Reconstruct F on a grid (z, y, x), grey levels per mm, zero outside the hull and in the outermost layer.

    `view(i)` returns radiograph i (row, column) in grey levels; several threads ask for theirs at once. Raises
    ValueError where the angles do not go all around.
    """
    share = angular_share(angle_rad).astype(np.float32)
    level = replace(geometry, roll_rad=0.0)
    inside, first = _columns_inside(grid, hull)
    result = np.zeros((grid.shape[1], grid.shape[2], grid.shape[0]), dtype=np.float32)
    weight, ramp = _cosine_weight(level), _ramp(level)
    beam, across = directions(angle_rad)

    def filtered(i: int) -> Image:
        return _filtered(_unrolled(view(i), geometry) * (weight * share[i]), ramp)

    # a view is read and filtered by one thread
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        for start in range(0, len(angle_rad), BATCH):
            batch = range(start, min(start + BATCH, len(angle_rad)))
            _back_project(
                result,
                np.ascontiguousarray(np.stack(list(pool.map(filtered, batch)))[:, ::-1].transpose(0, 2, 1)),
                beam[batch.start : batch.stop],
                across[batch.start : batch.stop],
                np.array(grid.origin_mm),
                grid.voxel_mm,
                np.array([level.source_axis_mm, level.source_detector_mm, level.pixel_mm]),
                np.array([level.column_shift_mm, level.row_shift_mm]),
                inside,
                first,
            )
            progress(task, batch.stop, len(angle_rad))
    return framed(np.ascontiguousarray(result.transpose(2, 0, 1)))


def angular_share(angle_rad: Floats) -> Floats:
    """Return dtheta_i / 2: half the turn that each view stands for, from the gaps to its neighbours.

    Views at the same angle share its part. Raises ValueError where a gap exceeds 20 degrees.
    """
    turned = np.mod(angle_rad, 2 * np.pi)
    unique, inverse, count = np.unique(np.round(turned, 9), return_inverse=True, return_counts=True)
    gaps = gaps_rad(np.asarray(unique, dtype=np.float64))
    if len(unique) < 3 or gaps.max() > LARGEST_GAP_RAD:
        raise ValueError(
            "angles of a full scan: expected a full turn without gaps above "
            f"{np.rad2deg(LARGEST_GAP_RAD):.0f} degrees, found one of {np.rad2deg(gaps.max()):.1f} degrees"
        )
    part = (gaps + np.roll(gaps, 1)) / 2 / count
    return np.asarray(part[inverse] / 2)


def one_of(angle_rad: Floats, most: int) -> NDArray[np.int64]:
    """Return one of every `most` views, evenly spread over the turn; of fewer where these would leave a gap.

    Views are told by their places in `angle_rad`, in rising order.
    """
    order = np.argsort(np.mod(angle_rad, 2 * np.pi), kind="stable")
    for stride in range(most, 1, -1):
        chosen = np.sort(order[::stride])
        if gaps_rad(np.sort(np.mod(angle_rad[chosen], 2 * np.pi))).max() < LARGEST_GAP_RAD / 2:
            return chosen
    return np.arange(len(angle_rad))


def seen_half_height_mm(geometry: ConeBeam, radius_mm: float) -> float:
    """Return the height up to which every view sees all of a cylinder of this radius, mm."""
    half = (geometry.rows / 2 - 0.5) * geometry.pixel_mm - abs(geometry.row_shift_mm)
    return half * (geometry.source_axis_mm - radius_mm) / geometry.source_detector_mm


def _cosine_weight(geometry: ConeBeam) -> Image:
    row = (np.arange(geometry.rows) - (geometry.rows - 1) / 2) * geometry.pixel_mm + geometry.row_shift_mm
    column = (np.arange(geometry.columns) - (geometry.columns - 1) / 2) * geometry.pixel_mm
    column += geometry.column_shift_mm
    distance = geometry.source_detector_mm
    weight = distance / np.sqrt(distance**2 + row[:, None] ** 2 + column[None] ** 2)
    return np.asarray(weight, dtype=np.float32)


def _ramp(geometry: ConeBeam) -> NDArray[np.complex64]:
    """Return the transform of the band-limited ramp, sampled in space (Kak and Slaney, 1988, Eq. 3.61)."""
    length = fft.next_fast_len(2 * geometry.columns, real=True)
    n = np.minimum(np.arange(length), length - np.arange(length))
    kernel = np.zeros(length)
    kernel[0] = 0.25
    odd = n % 2 == 1
    kernel[odd] = -1 / (np.pi * n[odd]) ** 2
    return np.asarray(fft.rfft(kernel / geometry.voxel_mm), dtype=np.complex64)


def _filtered(image: Image, ramp: NDArray[np.complex64]) -> Image:
    columns = image.shape[1]
    length = 2 * (len(ramp) - 1) if len(ramp) * 2 - 2 >= 2 * columns else 2 * len(ramp) - 1
    spectrum = fft.rfft(image, n=length, axis=1) * ramp
    return np.asarray(fft.irfft(spectrum, n=length, axis=1)[:, :columns], dtype=np.float32)


def _unrolled(image: Image, geometry: ConeBeam) -> Image:
    """Turn a radiograph about the detector's centre, as a detector without roll would have seen it."""
    if geometry.roll_rad == 0:
        return image
    c, s = np.cos(geometry.roll_rad), np.sin(geometry.roll_rad)
    turn = np.array([[c, -s], [s, c]])  # (row, column) on the rolled detector of a level one's offset
    centre = (np.array(image.shape) - 1) / 2
    return np.asarray(
        ndimage.affine_transform(image, turn, centre - turn @ centre, order=1, mode="nearest"),
        dtype=np.float32,
    )


def _columns_inside(grid: Grid, hull: Hull) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which slabs (y, x, slab) hold a column of voxels, and each slab's first voxel (slab + 1,)."""
    x = grid.origin_mm[0] + grid.voxel_mm * np.arange(grid.shape[2])
    y = grid.origin_mm[1] + grid.voxel_mm * np.arange(grid.shape[1])
    edges = hull.z_mm + hull.slab_mm * np.arange(len(hull.support_mm) + 1)
    first = np.clip(np.ceil((edges - grid.origin_mm[2]) / grid.voxel_mm), 0, grid.shape[0]).astype(np.int64)
    inside = np.ones((len(y), len(x), len(hull.support_mm)), dtype=bool)
    for k, (nx, ny) in enumerate(Hull.normals()):
        inside &= (nx * x[None, :] + ny * y[:, None])[..., None] <= hull.support_mm[:, k]
    return inside, first


@apart(fastmath=IN_ORDER, boundscheck=False)
def _blend(one, two, f, first, last, out):  # type: ignore[no-untyped-def]
    """Interpolate between two detector columns, over the rows first <= r < last."""
    for r in range(first, last):
        out[r] = one[r] + f * (two[r] - one[r])


@apart(fastmath=IN_ORDER, boundscheck=False)
def _add_piece(out, line, first, last, place, step, weight):  # type: ignore[no-untyped-def]
    """Add what the voxels first <= k < last of a column see, all of it on the detector: `line` at place + k step.

    With a step of about one pixel, many voxels in turn lie between pixels k + c and k + c + 1 of the same c: what they
    read lies in memory as what they write does.
    """
    k = first
    while k < last:
        r = place + k * step
        i = int(r)
        # the part between the two pixels grows by step - 1 from voxel to voxel, until it leaves [0, 1]
        part, growth = r - i, step - 1.0
        length = float(last - k)
        if growth * length > 1.0 - part:
            length = (1.0 - part) / growth
        elif growth * length < -part:
            length = -part / growth
        end = min(k + int(length) + 1, last)
        f, df = np.float32(part), np.float32(growth)
        # unsigned: numba need not ask whether an index counts from the end
        to, seen = np.uint64(k), np.uint64(i)
        for n in range(np.uint64(end - k)):
            low = line[seen + n]
            out[to + n] += weight * (low + (f + np.float32(n) * df) * (line[seen + n + np.uint64(1)] - low))
        k = end


@apart(fastmath=IN_ORDER, boundscheck=False)
def _add_beside(out, line, first, last, place, step, weight):  # type: ignore[no-untyped-def]
    """The same where some of it is beside the detector, whose edge goes on there."""
    top = np.float32(len(line) - 2.001)
    for k in range(first, last):
        r = min(max(np.float32(place + k * step), np.float32(0)), top)
        # unsigned: numba need not ask whether an index counts from the end
        i = np.uint32(r)
        low = line[i]
        out[k] += weight * (low + (r - np.float32(i)) * (line[i + np.uint32(1)] - low))


@njit(nogil=True, cache=True, error_model="numpy", parallel=True)
def _back_project(out, views, beam, across, origin, voxel, distances, shift, inside, first):  # type: ignore[no-untyped-def]
    """Add a batch of filtered views (view, column, row from the lowest up) to the volume (y, x, z).

    A column of voxels along z has one depth U and one detector column u in each view, as the detector is level: its
    two neighbouring detector columns are blended once, and the rows follow in equal steps. So z comes last in the
    volume and rows last in the views, and both are walked through memory in order. A task adds all views of the batch,
    in order, to its own y: no two write to the same voxel, and the result does not depend on the threads.
    """
    ny, nx = out.shape[:2]
    columns, rows = views.shape[1], views.shape[2]
    source, detector, pixel = distances
    for j in prange(ny):
        # one more than there are rows: by rounding, the last voxel may look beyond with a share of nearly zero
        line = np.zeros(rows + 1, np.float32)
        for i in range(nx):
            # voxels low <= k < high hold all of the hull in this column
            low, high = -1, -1
            for slab in range(inside.shape[2]):
                if inside[j, i, slab] and first[slab + 1] > first[slab]:
                    if low < 0:
                        low = first[slab]
                    high = first[slab + 1]
            if low < 0:
                continue
            x, y = origin[0] + voxel * i, origin[1] + voxel * j
            for n in range(views.shape[0]):
                depth = source + x * beam[n, 0] + y * beam[n, 1]
                scale = detector / (depth * pixel)
                # places on the detector are counted in pixels from the centre of its first one
                u = (x * across[n, 0] + y * across[n, 1]) * scale - shift[0] / pixel + 0.5 * (columns - 1)
                if u < 0 or u >= columns - 1:
                    continue
                c = int(u)
                # rows are counted from the lowest one up, as voxels are
                place = 0.5 * (rows - 1) + shift[1] / pixel + origin[2] * scale
                step = voxel * scale
                bottom, top = place + step * low, place + step * (high - 1)
                beside = bottom < 0 or top >= rows - 1
                # only rows that some voxel looks at are blended
                r_from, r_to = (0, rows) if beside else (int(bottom), min(int(top) + 3, rows))
                _blend(views[n, c], views[n, c + 1], np.float32(u - c), r_from, r_to, line)
                weight = np.float32((source / depth) ** 2)
                slab = 0
                while slab < inside.shape[2]:
                    # slabs that follow each other are one piece of the column
                    start = slab
                    while slab < inside.shape[2] and inside[j, i, slab]:
                        slab += 1
                    if beside:
                        _add_beside(out[j, i], line, first[start], first[slab], place, step, weight)
                    else:
                        _add_piece(out[j, i], line, first[start], first[slab], place, step, weight)
                    slab += 1
