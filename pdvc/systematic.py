"""What the volume's re-projection leaves of the reference views: registered to a step, then subtracted.

Reconstructing from few, noisy, cone-beam views and projecting again misses part of each radiograph,

    e(r, theta) = P_theta[F](r) - f(r, theta)        with f the reference view,

the same part for a test radiograph g that looks through the sample in the same direction. So it is moved with the
sample and subtracted from the residual (section 4.1). Two things move:

- the direction. The source S(theta) of a step, moved back with the sample, is at S - u(S): a sample that moved across
  the beam by u, or turned, is seen as at rest from the stage angle theta + delta, with delta about u / |S|, a view's
  spacing for a dozen voxels. Where a face lies along the beam, e changes within the angle by which a face as long
  as the section is turned by half a pixel. It is a mean over the views around theta + delta that is not wider
  (`views_around`), which leaves the less of the views' noise the closer they are;
- the place. A pixel's e is taken where the point of its ray that is nearest to the axis was before it moved,
  projected at that angle. It grows as the path through the material there does.

e has edges of a pixel or two, ten times above its noise, so that it is interpolated by Keys' cubic convolution on
4 x 4 pixels (R. G. Keys, IEEE Trans. ASSP 29 (1981) 1153-1160).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pdvc.apart import apart
from pdvc.geometry import gaps_rad, within_half_turn
from pdvc.sections import SectionBasis

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

REACH = 3.0
"""Standard deviations from which on a view takes no part in a mean over views."""
KNOT = 16
"""Pixels of a row from one place that is worked out to the next: in between a moved row hardly bends."""
BENT_PX = 5e-4
"""Pixels by which it may."""


@dataclass(frozen=True, kw_only=True)
class Sight:
    """The directions in which steps look through the sample as it was at rest, and the views that show it so."""

    delta_rad: Floats
    """delta (step,): what is added to the stage angle."""
    views: NDArray[np.int64]
    """The reference views around each direction (step, neighbour)."""
    share: Floats
    """Share of each (step, neighbour); of a step they add up to one, and may be zero."""

    def of_step(self, step: int) -> dict[int, float]:
        """Return the views that take part in a step, each with its share."""
        found: dict[int, float] = {}
        for view, share in zip(self.views[step].tolist(), self.share[step].tolist(), strict=True):
            if share > 0:
                found[view] = found.get(view, 0.0) + share
        return found


def views_around(view_rad: Floats, direction_rad: Floats, width_rad: float) -> tuple[NDArray[np.int64], Floats]:
    """Return the views around each direction and their shares, (direction, neighbour) both.

    The shares are a Gaussian of the angle between, of standard deviation `width_rad`, or half the views' spacing
    where that is more; each view counts by the part of the turn that it stands for.
    """
    order = np.argsort(np.mod(view_rad, 2 * np.pi), kind="stable")
    ring = np.mod(view_rad, 2 * np.pi)[order]
    gaps = gaps_rad(ring)
    width = max(width_rad, float(np.median(gaps)) / 2)
    count = min(2 * int(np.ceil(REACH * width / float(np.median(gaps)))) + 2, len(ring))
    at = np.mod(direction_rad, 2 * np.pi)
    # the views from half of them before to half of them after
    places = (np.searchsorted(ring, at)[:, None] + np.arange(count) - count // 2) % len(ring)
    away = within_half_turn(ring[places] - at[:, None])
    # where views are far apart the nearest counts, however far it is
    nearest = np.abs(away).min(axis=1, keepdims=True)
    part = (gaps + np.roll(gaps, 1))[places]
    share = part * np.exp((nearest**2 - away**2) / (2 * width**2))
    share[np.abs(away) > np.maximum(REACH * width, nearest)] = 0
    return order[places], share / share.sum(axis=1, keepdims=True)


def nothing_ready(views: Sequence[int]) -> None:
    """Make nothing ready."""


@dataclass(frozen=True, kw_only=True)
class Systematic:
    """e of the reference views, and what it takes to move it with the sample."""

    left: Callable[[int], Image]
    """e (row, column), grey levels, of a reference view, over the whole detector; zero where the volume does not
    reach. Asked for again and again, and only of the views that steps look along."""
    ready: Callable[[Sequence[int]], None] = nothing_ready
    """Told which views will be asked for next, so that they can be made side by side."""
    view_rad: Floats
    """Stage angle of each reference view (view,)."""
    step_rad: Floats
    """Stage angle of each step (step,)."""
    corner: tuple[int, int]
    """First row and column of the used window on the whole detector."""
    shape: tuple[int, int]
    """Rows and columns of the used window."""
    detector: tuple[int, int]
    """Rows and columns of the whole detector."""
    width_rad: float
    """Standard deviation of the mean over views, rad."""

    @property
    def window(self) -> tuple[slice, slice]:
        """Return the used rows and columns of the whole detector."""
        (row, column), (rows, columns) = self.corner, self.shape
        return slice(row, row + rows), slice(column, column + columns)

    def looked_along(
        self, steps: slice, rays: Floats, basis: SectionBasis, amplitude: Floats, voxel_mm: float
    ) -> Sight:
        """Return the directions in which a range of steps looks through the sample as it was at rest.

        `rays` (step, 4, 3), mm, and `amplitude` (step, section, motion) in voxels of `voxel_mm`, of the range.
        """
        delta = turned_rad(rays, basis, amplitude, voxel_mm)
        views, share = views_around(self.view_rad, self.step_rad[steps] + delta, self.width_rad)
        return Sight(delta_rad=delta, views=views, share=share)

    def registered(self, steps: slice, rays: Floats, basis: SectionBasis, amplitude: Floats, voxel_mm: float) -> Image:
        """Return e (step, row, column) over the window, for a range of steps, moved with the sample.

        `rays` (step, 4, 3) of the window, mm; `amplitude` (step, section, motion) in voxels of `voxel_mm`, both
        for the steps of the range.
        """
        result = np.empty((len(rays), *self.shape), dtype=np.float32)
        maps = basis.affine(amplitude) * voxel_mm
        corner = np.array(self.corner, dtype=np.int64)
        sight = self.looked_along(steps, rays, basis, amplitude, voxel_mm)
        self.ready(np.unique(sight.views[sight.share > 0]).tolist())

        def register(t: int) -> None:
            field = np.zeros(self.detector, dtype=np.float32)
            for view, share in sight.of_step(t).items():
                field += np.float32(share) * self.left(view)
            _register(field, rays[t], float(sight.delta_rad[t]), basis.height_mm, maps[t], corner, result[t])

        with ThreadPoolExecutor(numba.get_num_threads()) as pool:
            for _ in pool.map(register, range(len(rays))):
                pass
        return result

    def places(self, step: int, rays: Floats, basis: SectionBasis, amplitude: Floats, voxel_mm: float) -> Floats:
        """Return where e is taken for each pixel of one step, row and column on the detector, and a factor.

        Together (row, column, 3); the factor is how many times as long the path through the material is as before.

        `rays` (4, 3) of the window, mm; `amplitude` (section, motion) in voxels of `voxel_mm`.
        """
        result = np.empty((*self.shape, 3))
        _find_places(
            rays,
            float(turned_rad(rays[None], basis, amplitude[None], voxel_mm)[0]),
            basis.height_mm,
            basis.affine(amplitude) * voxel_mm,
            np.array(self.corner, dtype=np.int64),
            result,
        )
        return result


def turned_rad(rays: Floats, basis: SectionBasis, amplitude: Floats, voxel_mm: float) -> Floats:
    """Return delta (step,), rad: the stage angle from which each step sees the sample as at rest, less its own.

    `rays` (step, 4, 3), mm; `amplitude` (step, section, motion) in voxels of `voxel_mm`. The motion at mid height,
    z = 0, counts, affine as far as the source: with S' = S - u(S), tan(delta) = -(S x S') / (S . S'), as the beam
    turns against the stage in the frame of the sample.
    """
    source = rays[:, 0]
    weight = basis.weights(0.0)
    maps = np.einsum("j,tjab->tab", weight, basis.affine(amplitude)) * voxel_mm
    before = source - np.einsum("tab,tb->ta", maps[..., :3], source) - maps[..., 3]
    cross = source[:, 0] * before[:, 1] - source[:, 1] * before[:, 0]
    along = source[:, 0] * before[:, 0] + source[:, 1] * before[:, 1]
    return np.asarray(-np.arctan2(cross, along))


@njit(nogil=True, cache=True, error_model="numpy")
def keys_weights(x):  # type: ignore[no-untyped-def]
    """Return the weights of the pixels before, at, after and two after a place, x in [0, 1] beyond `at`."""
    return (
        ((-0.5 * x + 1.0) * x - 0.5) * x,
        (1.5 * x - 2.5) * x * x + 1.0,
        ((-1.5 * x + 2.0) * x + 0.5) * x,
        (0.5 * x - 0.5) * x * x,
    )


def taps(place: Floats, first: NDArray[np.int64]) -> Floats:
    """Return the weights (4, ...) of the four pixels about places (...,), from the pixel before `first` on."""
    return np.stack(keys_weights.py_func(place - first))  # type: ignore[no-untyped-call]


@njit(nogil=True, cache=True, error_model="numpy")
def first_pixel(place, count):  # type: ignore[no-untyped-def]
    """Return the pixel at or before a place along an axis of `count` pixels; -1 where the place is off it."""
    if place < -0.01 or place > count - 0.99:
        return -1
    return min(max(int(place), 0), count - 2)


@njit(nogil=True, cache=True, error_model="numpy")
def _cubic(field, r, c):  # type: ignore[no-untyped-def]
    """Interpolate between pixels, those of the edge repeated beyond it; zero off the detector."""
    rows, columns = field.shape
    i, j = first_pixel(r, rows), first_pixel(c, columns)
    if i < 0 or j < 0:
        return 0.0
    down, right = keys_weights(r - i), keys_weights(c - j)
    total = 0.0
    for m in range(4):
        row = min(max(i - 1 + m, 0), rows - 1)
        line = 0.0
        for n in range(4):
            line += right[n] * field[row, min(max(j - 1 + n, 0), columns - 1)]
        total += down[m] * line
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def _turned(m, i, x, y, z):  # type: ignore[no-untyped-def]
    """Return component i of a vector under the linear part of an affine map."""
    return m[i, 0] * x + m[i, 1] * y + m[i, 2] * z


@njit(nogil=True, cache=True, error_model="numpy")
def _moved(m, i, x, y, z):  # type: ignore[no-untyped-def]
    """Return coordinate i of an affine map."""
    return _turned(m, i, x, y, z) + m[i, 3]


@njit(nogil=True, cache=True, error_model="numpy")
def _place(rays, turn, normal, depth, per_pitch2, heights, maps, corner, row, column, k):  # type: ignore[no-untyped-def]
    """Return the row and the column, on the whole detector, where a pixel's material was seen before it moved.

    And how many times as long a piece of it is along the ray as before, by which the path through it grew; and the
    section below, looked for from section k on.
    """
    n = len(heights)
    sx, sy, sz = rays[0]
    ox, oy, oz = rays[1]
    dx, dy, dz = rays[2]
    rx, ry, rz = rays[3]
    x, y, z = ox + row * dx + column * rx, oy + row * dy + column * ry, oz + row * dz + column * rz
    x, y, z = x - sx, y - sy, z - sz
    # the point of the ray that is nearest to the axis
    at = -(sx * x + sy * y) / (x * x + y * y)
    share = 1 / np.sqrt(x * x + y * y + z * z)
    bx, by, bz = share * x, share * y, share * z
    x, y, z = sx + at * x, sy + at * y, sz + at * z
    while k > 0 and heights[k] >= z:
        k -= 1
    while k + 2 < n and heights[k + 1] < z:
        k += 1
    ux, uy, uz = _moved(maps[k], 0, x, y, z), _moved(maps[k], 1, x, y, z), _moved(maps[k], 2, x, y, z)
    gx, gy, gz = _turned(maps[k], 0, bx, by, bz), _turned(maps[k], 1, bx, by, bz), _turned(maps[k], 2, bx, by, bz)
    if n > 1:
        s = min(max((z - heights[k]) / (heights[k + 1] - heights[k]), 0.0), 1.0)
        m = maps[k + 1]
        ux += s * (_moved(m, 0, x, y, z) - ux)
        uy += s * (_moved(m, 1, x, y, z) - uy)
        uz += s * (_moved(m, 2, x, y, z) - uz)
        gx += s * (_turned(m, 0, bx, by, bz) - gx)
        gy += s * (_turned(m, 1, bx, by, bz) - gy)
        gz += s * (_turned(m, 2, bx, by, bz) - gz)
    longer = 1 / np.sqrt((bx - gx) ** 2 + (by - gy) ** 2 + (bz - gz) ** 2)
    # seen from stage angle theta + delta: turned by delta, it is seen alike from theta
    x, y, z = x - ux, y - uy, z - uz
    cos, sin = turn
    x, y, z = cos * x - sin * y - sx, sin * x + cos * y - sy, z - sz
    scale = depth / (x * normal[0] + y * normal[1] + z * normal[2])
    x, y, z = sx + scale * x - ox, sy + scale * y - oy, sz + scale * z - oz
    row, column = (x * dx + y * dy + z * dz) * per_pitch2, (x * rx + y * ry + z * rz) * per_pitch2
    row, column = row + corner[0], column + corner[1]
    return row, column, longer, k


@njit(nogil=True, cache=True, error_model="numpy")
def _panel(rays):  # type: ignore[no-untyped-def]
    """Return the detector's normal, its distance from the source along it, and one over the square of the pitch."""
    dx, dy, dz = rays[2]
    rx, ry, rz = rays[3]
    nx, ny, nz = dy * rz - dz * ry, dz * rx - dx * rz, dx * ry - dy * rx
    depth = (rays[1, 0] - rays[0, 0]) * nx + (rays[1, 1] - rays[0, 1]) * ny + (rays[1, 2] - rays[0, 2]) * nz
    return (nx, ny, nz), depth, 1 / (dx * dx + dy * dy + dz * dz)


@njit(nogil=True, cache=True, error_model="numpy")
def _along_row(rays, turn, panel, heights, maps, corner, row, place):  # type: ignore[no-untyped-def]
    """Write the places of the pixels of a row, `place` (row, column and factor; column).

    Worked out at every `KNOT`-th pixel, and linear in between, but where that is not right by `BENT_PX`: where another
    section begins, it is twice as far off at most.
    """
    normal, depth, per_pitch2 = panel
    last = place.shape[1] - 1
    r, c, longer, k = _place(rays, turn, normal, depth, per_pitch2, heights, maps, corner, row, 0, 0)
    place[0, 0], place[1, 0], place[2, 0] = r, c, longer
    for start in range(0, last, KNOT):
        end = min(start + KNOT, last)
        middle = (start + end) // 2
        rm, cm, _, k = _place(rays, turn, normal, depth, per_pitch2, heights, maps, corner, row, middle, k)
        r1, c1, longer1, k = _place(rays, turn, normal, depth, per_pitch2, heights, maps, corner, row, end, k)
        per_pixel = 1 / (end - start)
        share = (middle - start) * per_pixel
        bent = max(abs(rm - r - share * (r1 - r)), abs(cm - c - share * (c1 - c))) > BENT_PX
        for n in range(1, end - start + 1):
            share = n * per_pixel
            place[0, start + n] = r + share * (r1 - r)
            place[1, start + n] = c + share * (c1 - c)
            place[2, start + n] = longer + share * (longer1 - longer)
        r, c, longer = r1, c1, longer1
        for column in range(start + 1, end if bent else start):
            rm, cm, lm, k = _place(rays, turn, normal, depth, per_pitch2, heights, maps, corner, row, column, k)
            place[0, column], place[1, column], place[2, column] = rm, cm, lm


@apart(boundscheck=False)
def _cubic_inside(field, columns, place, out):  # type: ignore[no-untyped-def]
    """Write the factor times the field, flat, at the places of a row, all of them a pixel and more from its edges."""
    width = np.uint32(columns)
    for column in range(out.shape[0]):
        i, j = np.uint32(place[0, column]), np.uint32(place[1, column])
        down = keys_weights(np.float32(place[0, column] - i))
        right = keys_weights(np.float32(place[1, column] - j))
        at = (i - np.uint32(1)) * width + j - np.uint32(1)
        total = np.float32(0)
        for m in range(4):
            line = np.float32(0)
            for n in range(4):
                line += right[n] * field[at + np.uint32(n)]
            total += down[m] * line
            at += width
        out[column] = np.float32(place[2, column]) * total


@njit(nogil=True, cache=True, error_model="numpy")
def _register(field, rays, delta, heights, maps, corner, out):  # type: ignore[no-untyped-def]
    """Sample a step's field where each pixel's material was before it moved."""
    panel, turn = _panel(rays), (np.cos(delta), np.sin(delta))
    flat, (rows, columns) = field.reshape(-1), field.shape
    place = np.empty((3, out.shape[1]))
    for row in range(out.shape[0]):
        _along_row(rays, turn, panel, heights, maps, corner, row, place)
        r, c = place[0], place[1]
        if r.min() >= 1 and r.max() < rows - 2 and c.min() >= 1 and c.max() < columns - 2:
            _cubic_inside(flat, columns, place, out[row])
        else:
            for column in range(out.shape[1]):
                out[row, column] = place[2, column] * _cubic(field, r[column], c[column])


@njit(nogil=True, cache=True, error_model="numpy")
def _find_places(rays, delta, heights, maps, corner, out):  # type: ignore[no-untyped-def]
    """Write the places of all pixels of one step."""
    panel, turn = _panel(rays), (np.cos(delta), np.sin(delta))
    place = np.empty((3, out.shape[1]))
    for row in range(out.shape[0]):
        _along_row(rays, turn, panel, heights, maps, corner, row, place)
        out[row] = place.T
