"""Exact path lengths through the deformed object: depths of surface triangles and chords of ellipsoids.

No voxel grid and no marching. The object is turned into the *lab* frame, X = R(theta) x with R a turn by
+theta about z, where the scanner stands still (see `pdvc.geometry`): source S = (-source_axis, 0, 0),
detector in the plane x = source_detector - source_axis, columns along -y and rows along -z. A ray is
S + t d with

    d = (1, -U / L, -V / L),    (U, V) = (column_shift, row_shift) + roll . (a, b),    L = source_detector,

where (a, b) are the coordinates of a sub-pixel centre on the detector; t is the depth X - S_x in mm, and a
length in depth becomes a length along the ray by the factor |d|.

*Surface*: the matrix of a closed surface is the sum of its crossings' depths, + on leaving and - on entering.
1/t is affine on the image of a plane triangle, so that the depth needs no ray-plane intersection.

*Nodule* {c + A s : |s| <= 1}: with f = d x (c - S), a ray meets it if |adj(A) d|^2 > |A' f|^2, over the chord

    2 |d| |det A| sqrt(|adj(A) d|^2 - |A' f|^2) / |adj(A) d|^2.

Both sides are quadratic in the pixel coordinates, so that the nodule's silhouette is known row by row.

*Crack*: the same ellipsoid, of air, and so flat that it may lie between two rows of sub-pixel centres. Each sub-pixel
therefore takes the mean of the chord over its area. With D(x, y) = |adj(A) d|^2 - |A' f|^2 = a (h^2 - (y - m)^2) along
a column, in which a, h and m depend on the column, the substitution y = m + h sin(phi) leaves

    integral of chord dy = 2 |d| |det A| sqrt(a) integral of h^2 cos^2(phi) / |adj(A) d|^2 dphi,

whose integrand is smooth between the edges of a sub-pixel: Gauss and Legendre's rule, and likewise across the columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numba
import numpy as np
from numpy.typing import NDArray

from pdvc.geometry import ConeBeam
from simulator.rounding import fused

_NODE, _WEIGHT = (np.polynomial.legendre.leggauss(8) + np.array([[1.0], [0.0]])) / 2
"""Nodes between 0 and 1, and weights, of Gauss and Legendre's rule."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """The deformed object in the sample frame, as the stage sees it at angle 0."""

    vertices_mm: NDArray[np.float64]
    """Vertices (v, 3) of the closed surface of the matrix, mm."""
    faces: NDArray[np.int64]
    """Triangles (f, 3): vertex numbers, counter-clockwise from outside."""
    centres_mm: NDArray[np.float64]
    """Centres (n, 3) of the nodules, mm."""
    shapes_mm: NDArray[np.float64]
    """Shapes (n, 3, 3), mm: the nodule is {centre + A s, |s| <= 1}; A = deformation gradient x radius."""
    crack_centres_mm: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """Centres (m, 3) of cracks in the matrix, mm."""
    crack_shapes_mm: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """Shapes (m, 3, 3), mm: as those of nodules, but of air."""

    def __post_init__(self) -> None:
        v, f, n, m = (len(part) for part in (self.vertices_mm, self.faces, self.centres_mm, self.crack_centres_mm))
        for name, shape in (
            ("vertices_mm", (v, 3)),
            ("faces", (f, 3)),
            ("centres_mm", (n, 3)),
            ("shapes_mm", (n, 3, 3)),
            ("crack_centres_mm", (m, 3)),
            ("crack_shapes_mm", (m, 3, 3)),
        ):
            found = np.shape(getattr(self, name))
            if found != shape:
                raise ValueError(f"body.{name}: expected shape {shape}, got {found}")
        if f and not (self.faces.min() >= 0 and self.faces.max() < v):
            raise ValueError(f"body.faces: expected vertex numbers from 0 to {v - 1}")


def path_lengths(
    body: Body, geometry: ConeBeam, angle_rad: float, subpixels: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the lengths of every ray in matrix and in graphite, at the sub-pixel centres.

    Shapes (rows * subpixels, columns * subpixels), mm; matrix = chord of the surface - chords of the nodules - mean
    chords of the cracks, over each sub-pixel. Cracks are expected inside the surface, and clear of nodules.
    One call uses one thread and releases the interpreter: run radiographs side by side in threads.
    Raises ValueError where the object reaches the source or the detector.
    """
    if subpixels < 1:
        raise ValueError(f"subpixels: expected at least 1, got {subpixels}")
    fine = _Screen.of(geometry, subpixels)
    turn = math.cos(angle_rad), math.sin(angle_rad)
    vertices = _from_source(body.vertices_mm, turn, geometry.source_axis_mm)
    centres = _from_source(body.centres_mm, turn, geometry.source_axis_mm)
    cracks = _from_source(body.crack_centres_mm, turn, geometry.source_axis_mm)
    for points in (vertices, centres, cracks):
        _check_depth(points[:, 0], geometry, angle_rad)
    # depths of some 30 mm that cancel to a length of 1 mm: in double precision
    surface = np.zeros((fine.rows, fine.columns))
    _add_surface(
        surface, *fine.image_of(vertices), 1 / vertices[:, 0], np.ascontiguousarray(body.faces, dtype=np.int64)
    )
    if len(cracks):
        _take_cracks(surface, cracks, body.crack_shapes_mm, turn, *fine.image_of(cracks), *fine.rays()[1:])
    graphite = np.zeros((fine.rows, fine.columns), dtype=np.float32)
    _add_nodules(graphite, centres, body.shapes_mm, turn, *fine.image_of(centres), *fine.rays())
    return _lengths(surface, graphite, *fine.rays()), graphite


def _check_depth(depth_mm: NDArray[np.float64], geometry: ConeBeam, angle_rad: float) -> None:
    if len(depth_mm) and not (depth_mm.min() > 0 and depth_mm.max() < geometry.source_detector_mm):
        raise ValueError(
            "body: expected between source and detector, "
            f"0 to {geometry.source_detector_mm} mm from the source, "
            f"found {depth_mm.min():.6g} to {depth_mm.max():.6g} mm at {angle_rad:.6g} rad"
        )


@dataclass(frozen=True)
class _Screen:
    """The sub-pixel grid: number q of a centre <-> place (a, b) on the detector <-> ray."""

    rows: int
    columns: int
    pitch: float
    distance: float
    shift: tuple[float, float]
    roll: tuple[float, float]

    @classmethod
    def of(cls, geometry: ConeBeam, subpixels: int) -> _Screen:
        return cls(
            rows=geometry.rows * subpixels,
            columns=geometry.columns * subpixels,
            pitch=geometry.pixel_mm / subpixels,
            distance=geometry.source_detector_mm,
            shift=(geometry.column_shift_mm, geometry.row_shift_mm),
            roll=(math.cos(geometry.roll_rad), math.sin(geometry.roll_rad)),
        )

    def image_of(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project points (n, 3), x counted from the source: fractional column and row numbers (n,)."""
        middle = (self.columns - 1) / 2, (self.rows - 1) / 2
        column, row = _image_of(points, self.distance, self.shift, self.roll, self.pitch, middle)
        return column, row

    def rays(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return d at sub-pixel (0, 0), and its steps to the next column and to the next row; (3,) each."""
        c, s = self.roll
        step = -self.pitch / self.distance
        by_column = np.array([0.0, c * step, s * step])
        by_row = np.array([0.0, -s * step, c * step])
        centre = np.array([1.0, -self.shift[0] / self.distance, -self.shift[1] / self.distance])
        return centre - by_column * (self.columns - 1) / 2 - by_row * (self.rows - 1) / 2, by_column, by_row


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _from_source(points, turn, source_axis):  # type: ignore[no-untyped-def]
    """Turn points (n, 3) by +angle about z, given its cosine and sine, and count x from the source."""
    c, s = turn
    lab = np.empty(points.shape)
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        lab[n] = fused(-s, y, c * x) + source_axis, fused(c, y, s * x), points[n, 2]
    return lab


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _image_of(points, distance, shift, roll, pitch, middle):  # type: ignore[no-untyped-def]
    """Return fractional column and row numbers (n,) of points, see `_Screen.image_of`."""
    c, s = roll
    column, row = np.empty(len(points)), np.empty(len(points))
    for n in range(len(points)):
        depth = points[n, 0]
        u, v = -points[n, 1] * distance / depth - shift[0], -points[n, 2] * distance / depth - shift[1]
        column[n] = (c * u + s * v) / pitch + middle[0]
        row[n] = (c * v - s * u) / pitch + middle[1]
    return column, row


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_surface(total, column, row, nearness, faces):  # type: ignore[no-untyped-def]
    """Add the signed crossing depths of each triangle at the sub-pixel centres it covers.

    `nearness` is 1 / depth at each vertex. Watertight by construction: a vertex lies above a row of centres
    or not, and an edge that changes sides crosses it at one column, always computed from the lower vertex
    number to the higher. A triangle that is crossed has exactly two such edges, and covers the centres
    between them, + if the edge that goes down is on the right (a face seen from behind: the ray leaves) and
    - if it is on the left. Neighbours compute the same crossing of their common edge, so that the signs of
    every ray of a closed surface sum to zero, whatever the rounding.
    """
    rows, columns = total.shape
    at = np.empty(2)
    for f in range(len(faces)):
        top = min(row[faces[f, 0]], row[faces[f, 1]], row[faces[f, 2]])
        bottom = max(row[faces[f, 0]], row[faces[f, 1]], row[faces[f, 2]])
        # centres are at whole numbers: the rows with top <= i < bottom
        first, last = max(math.ceil(top), 0), min(math.ceil(bottom), rows)
        if first >= last:
            continue
        # 1 / depth = w + gc (column - c0) + gr (row - r0), never outside the range of the three vertices
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        c0, r0, w = column[a], row[a], nearness[a]
        c1, r1, w1 = column[b] - c0, row[b] - r0, nearness[b] - w
        c2, r2, w2 = column[c] - c0, row[c] - r0, nearness[c] - w
        area = c1 * r2 - c2 * r1
        gc = gr = 0.0
        if area != 0.0:
            gc, gr = (w1 * r2 - w2 * r1) / area, (c1 * w2 - c2 * w1) / area
        low, high = min(w, w + w1, w + w2), max(w, w + w1, w + w2)
        for i in range(first, last):
            # the two columns at which this row crosses the triangle: at[0] on an edge that goes down, at[1] up
            for k in range(3):
                p, q = faces[f, k], faces[f, (k + 1) % 3]
                above_p, above_q = row[p] <= i, row[q] <= i
                if above_p == above_q:
                    continue
                m, n = min(p, q), max(p, q)
                across = column[m] + (i - row[m]) * ((column[n] - column[m]) / (row[n] - row[m]))
                at[0 if above_p else 1] = across
            sign = 1.0 if at[0] > at[1] else -1.0
            start, stop = max(math.ceil(min(at[0], at[1])), 0), min(math.ceil(max(at[0], at[1])), columns)
            base = w + gr * (i - r0) - gc * c0
            line = total[i, start : max(start, stop)]
            # limited, as a triangle seen edge on has hardly an area to divide by
            for k in range(len(line)):
                line[k] += sign / min(max(base + gc * (start + k), low), high)


@numba.njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True, nogil=True)
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, nogil=True)
def _times(a, x, y, z):  # type: ignore[no-untyped-def]
    """Return (x . a, y . a, z . a)."""
    return _dot(x, a), _dot(y, a), _dot(z, a)


@numba.njit(cache=True, nogil=True)
def _column(matrix, k, turn):  # type: ignore[no-untyped-def]
    """Return column k of a matrix (3, 3), turned about z by the angle whose cosine and sine are given."""
    c, s = turn
    x, y = matrix[0, k], matrix[1, k]
    return x * c - y * s, x * s + y * c, matrix[2, k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reach(c, shape):  # type: ignore[no-untyped-def]
    """Return how far from the image of its centre c a nodule may be seen, over the detector's distance.

    A s is no longer than |A|, the root of the sum of squares. The image of c + w is (x w - w_x c) / (x (x + w_x)) from
    that of c, with x = c_x: at most |c| |w| / (x (x - |w|)).
    """
    square = 0.0
    for k in range(3):
        square += _dot(shape[k], shape[k])
    size = math.sqrt(square)
    return math.sqrt(_dot(c, c)) * size / (c[0] * max(c[0] - size, 0.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_nodules(total, centres, shapes, turn, column, row, d0, by_column, by_row):  # type: ignore[no-untyped-def]
    """Add each nodule's chord, in depth, at the sub-pixel centres of its silhouette.

    `centres` are in the lab and count x from the source; `shapes` are in the sample frame, and turned here. Around the
    sub-pixel that is nearest to the centre's image, with (x, y) columns and rows from there, e = adj(A) d and g = A' f
    are affine, e = e0 + x ex + y ey, so that |e|^2 - |g|^2 = k0 + kx x + ky y + kxx x^2 + kxy x y + kyy y^2, positive
    inside an ellipse.
    """
    rows, columns = total.shape
    dx, dy = (by_column[0], by_column[1], by_column[2]), (by_row[0], by_row[1], by_row[2])
    pitch = math.sqrt(_dot(dx, dx))
    chord = np.empty(columns + 3)
    for n in range(len(centres)):
        # columns and rows count from here: they stay small, and the quadratics keep their digits
        jc, ic = round(column[n]), round(row[n])
        c = (centres[n, 0], centres[n, 1], centres[n, 2])
        # half of the sample is above or below the image
        reach = 1 + _reach(c, shapes[n]) / pitch
        if not (-reach < ic < rows + reach and -reach < jc < columns + reach):
            continue
        a1, a2, a3 = _column(shapes[n], 0, turn), _column(shapes[n], 1, turn), _column(shapes[n], 2, turn)
        # adj(A) by rows: the cross products of the columns of A
        r1, r2, r3 = _cross(a2, a3), _cross(a3, a1), _cross(a1, a2)
        d = (
            d0[0] + jc * dx[0] + ic * dy[0],
            d0[1] + jc * dx[1] + ic * dy[1],
            d0[2] + jc * dx[2] + ic * dy[2],
        )
        e0, ex, ey = _times(d, r1, r2, r3), _times(dx, r1, r2, r3), _times(dy, r1, r2, r3)
        g0 = _times(_cross(d, c), a1, a2, a3)
        gx, gy = _times(_cross(dx, c), a1, a2, a3), _times(_cross(dy, c), a1, a2, a3)
        k0, kx, ky = (
            _dot(e0, e0) - _dot(g0, g0),
            2 * (_dot(e0, ex) - _dot(g0, gx)),
            2 * (_dot(e0, ey) - _dot(g0, gy)),
        )
        kxx, kxy, kyy = (
            _dot(ex, ex) - _dot(gx, gx),
            2 * (_dot(ex, ey) - _dot(gx, gy)),
            _dot(ey, ey) - _dot(gy, gy),
        )
        # rows where the quadratic in x has real roots: another quadratic, in y, and likewise the columns
        m0, m1, m2 = kx * kx - 4 * kxx * k0, kx * kxy - 2 * kxx * ky, kxy * kxy - 4 * kxx * kyy
        n0, n1 = ky * ky - 4 * kyy * k0, ky * kxy - 2 * kyy * kx
        high, wide = m1 * m1 - m0 * m2, n1 * n1 - n0 * m2
        if high <= 0.0 or wide <= 0.0 or m2 >= 0.0:
            continue
        high, wide = math.sqrt(high) / -m2, math.sqrt(wide) / -m2
        first, last = max(math.ceil(-m1 / m2 - high), -ic), min(math.floor(-m1 / m2 + high), rows - 1 - ic)
        start, stop = max(math.ceil(-n1 / m2 - wide), -jc), min(math.floor(-n1 / m2 + wide), columns - 1 - jc)
        if start > stop:
            continue
        twice_det, txx = 2 * abs(_dot(a1, r1)), _dot(ex, ex)
        for y in range(first, last + 1):
            # in this row: |e|^2 - |g|^2 = s0 + 2 sx x + kxx x^2, and |e|^2 = t0 + tx x + txx x^2
            s0, sx = k0 + y * (ky + y * kyy), (kx + y * kxy) / 2
            e = (e0[0] + y * ey[0], e0[1] + y * ey[1], e0[2] + y * ey[2])
            t0, tx = _dot(e, e), 2 * _dot(e, ex)
            line = total[ic + y, jc + start : jc + stop + 1]
            # four at a time; outside the ellipse there is less than nothing, and the chord is 0
            for k in range((len(line) + 3) // 4 * 4):
                x = start + k
                square = max(s0 + x * (2 * sx + x * kxx), 0.0)
                chord[k] = twice_det * math.sqrt(square) / (t0 + x * (tx + x * txx))
            for k in range(len(line)):
                line[k] += chord[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _take_cracks(total, centres, shapes, turn, column, row, by_column, by_row):  # type: ignore[no-untyped-def]
    """Take each crack's chord, in depth, from the sub-pixels that it covers: the mean over the area of each.

    As in `_add_nodules`, but (x, y) count columns and rows from the very image of the centre: there f = 0, and nothing
    cancels however flat the crack is. A sub-pixel that lies in part beside the crack is integrated over the rest.
    """
    rows, columns = total.shape
    dx, dy = (by_column[0], by_column[1], by_column[2]), (by_row[0], by_row[1], by_row[2])
    for n in range(len(centres)):
        c = (centres[n, 0], centres[n, 1], centres[n, 2])
        d = (1.0, c[1] / c[0], c[2] / c[0])
        a1, a2, a3 = _column(shapes[n], 0, turn), _column(shapes[n], 1, turn), _column(shapes[n], 2, turn)
        r1, r2, r3 = _cross(a2, a3), _cross(a3, a1), _cross(a1, a2)
        e0, ex, ey = _times(d, r1, r2, r3), _times(dx, r1, r2, r3), _times(dy, r1, r2, r3)
        gx, gy = _times(_cross(dx, c), a1, a2, a3), _times(_cross(dy, c), a1, a2, a3)
        k0, kx, ky = _dot(e0, e0), 2 * _dot(e0, ex), 2 * _dot(e0, ey)
        kxx, kxy, kyy = (
            _dot(ex, ex) - _dot(gx, gx),
            2 * (_dot(ex, ey) - _dot(gx, gy)),
            _dot(ey, ey) - _dot(gy, gy),
        )
        n0, n1, m2 = ky * ky - 4 * kyy * k0, ky * kxy - 2 * kyy * kx, kxy * kxy - 4 * kxx * kyy
        wide = n1 * n1 - n0 * m2
        if wide <= 0.0 or m2 >= 0.0:
            continue
        middle, half = -n1 / m2, math.sqrt(wide) / -m2
        chord = 2 * abs(_dot(a1, r1)) * math.sqrt(-kyy)
        left = column[n] + middle
        for j in range(max(math.ceil(left - half - 0.5), 0), min(math.floor(left + half + 0.5), columns - 1) + 1):
            start, stop = _between(j, left, half)
            for p in range(len(_NODE)):
                psi = start + _NODE[p] * (stop - start)
                x, wx = middle + half * math.sin(psi), half * math.cos(psi) * _WEIGHT[p] * (stop - start)
                # in this column: k0 + kx x + kxx x^2 + (ky + kxy x) y + kyy y^2 = -kyy (high^2 - (y - level)^2)
                level = (ky + x * kxy) / (-2 * kyy)
                high = math.sqrt(max(level * level - (k0 + x * (kx + x * kxx)) / kyy, 0.0))
                top = row[n] + level
                for i in range(max(math.ceil(top - high - 0.5), 0), min(math.floor(top + high + 0.5), rows - 1) + 1):
                    first, last = _between(i, top, high)
                    mean = 0.0
                    for q in range(len(_NODE)):
                        phi = first + _NODE[q] * (last - first)
                        y, across = level + high * math.sin(phi), high * math.cos(phi)
                        e = (
                            e0[0] + x * ex[0] + y * ey[0],
                            e0[1] + x * ex[1] + y * ey[1],
                            e0[2] + x * ex[2] + y * ey[2],
                        )
                        mean += _WEIGHT[q] * across * across / _dot(e, e)
                    total[i, j] -= wx * chord * (last - first) * mean


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _between(place, middle, half):  # type: ignore[no-untyped-def]
    """Return the angles, -pi/2 to pi/2, at which middle + half sin(angle) enters and leaves a sub-pixel at a place."""
    if half == 0.0:
        return 0.0, 0.0
    low, high = (place - 0.5 - middle) / half, (place + 0.5 - middle) / half
    return math.asin(min(max(low, -1.0), 1.0)), math.asin(min(max(high, -1.0), 1.0))


@numba.njit(cache=True, nogil=True)
def _lengths(surface, graphite, d0, by_column, by_row):  # type: ignore[no-untyped-def]
    """Turn depths into lengths, by the factor |d|: graphite in place, matrix as the returned array."""
    matrix = np.empty(surface.shape, dtype=np.float32)
    for i in range(surface.shape[0]):
        for j in range(surface.shape[1]):
            y, z = d0[1] + j * by_column[1] + i * by_row[1], d0[2] + j * by_column[2] + i * by_row[2]
            length = math.sqrt(1.0 + y * y + z * z)
            matrix[i, j] = length * (surface[i, j] - graphite[i, j])
            graphite[i, j] = length * graphite[i, j]
    return matrix
