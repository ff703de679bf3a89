"""Which rows and columns are used, and how much of the sample a scan reconstructs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pdvc.geometry import ConeBeam
from pdvc.reconstruction import seen_half_height_mm
from pdvc.volume import Grid, Hull

Floats = NDArray[np.float64]

USUAL_ROWS, USUAL_COLUMNS = 100 / 954, 60 / 432
"""Shares of the rows and columns that are left out on each side, as in the paper."""


def used_window(geometry: ConeBeam, hull: Hull, rows: int | None, columns: int | None) -> tuple[int, int, int, int]:
    """Return the used rows and columns: row_from, row_to, column_from, column_to.

    `rows` and `columns` are left out on each side. What is left open is the paper's share of the detector, but for two
    things that the sample asks for: rows whose rays would leave the volume through its cut ends are left out, and
    columns that see the sample are not.
    Raises ValueError where no rows would be left.
    """
    if rows is None:
        reached = reached_rows(geometry, scan_grid(geometry, hull), hull)
        rows = max(round(geometry.rows * USUAL_ROWS), reached.start, geometry.rows - reached.stop)
    if 2 * rows >= geometry.rows:
        raise ValueError(f"rows: expected rays of some of {geometry.rows} rows to stay in the volume, found none")
    if columns is None:
        edges = [height_mm(geometry, row - 0.5) for row in (geometry.rows - rows, rows)]
        columns = max(min(round(geometry.columns * USUAL_COLUMNS), int(free_columns(geometry, hull, *edges))), 0)
    return rows, geometry.rows - rows, columns, geometry.columns - columns


def free_columns(geometry: ConeBeam, hull: Hull, low_mm: float, high_mm: float) -> float:
    """Return the columns on either side that never see the sample between two heights, px."""
    bottom = hull.z_mm + hull.slab_mm * np.arange(len(hull.support_mm))
    support = hull.support_mm[(bottom + hull.slab_mm > low_mm) & (bottom < high_mm)]
    # its margin is half a slab: see find_outline
    radius = min(max(float(support.max(initial=0.0)) - hull.slab_mm / 2, 0.0), 0.9 * geometry.source_axis_mm)
    shadow = geometry.source_detector_mm * radius / (geometry.source_axis_mm - radius)
    return geometry.columns / 2 - (shadow + abs(geometry.column_shift_mm)) / geometry.pixel_mm


def height_mm(geometry: ConeBeam, row: float) -> float:
    """Return the height at which the middle of a detector row looks through the axis, mm."""
    down = (row - (geometry.rows - 1) / 2) * geometry.pixel_mm + geometry.row_shift_mm
    return -down / geometry.magnification


def scan_grid(geometry: ConeBeam, hull: Hull) -> Grid:
    """Return the voxels that a scan is reconstructed on: around the hull, as high as every view sees.

    Layers lie halfway between the heights at which rows look through the axis. Where the beam is level they would else
    lie on them, or anywhere: interpolation along z would blur nothing there, and much elsewhere.
    """
    low, high = hull.box_mm()
    reach = seen_half_height_mm(geometry, hull.radius_mm())
    # two voxels of air around the hull keep interpolation, and its gradient, inside the grid
    margin = np.full(3, 2 * geometry.voxel_mm)
    low, high = low - margin, high + margin
    low[2], high[2] = max(low[2], -reach), min(high[2], reach)
    grid = Grid.around(low, high, geometry.voxel_mm)
    x, y, z = grid.origin_mm
    half = height_mm(geometry, 0) + geometry.voxel_mm / 2
    return replace(grid, origin_mm=(x, y, z + (half - z) % geometry.voxel_mm))


def kept_heights_mm(grid: Grid) -> Floats:
    """Return the heights (2,), mm, between which rays are summed: from the first layer but one to the last but one."""
    return np.asarray(grid.origin_mm[2] + grid.voxel_mm * np.array([1, grid.shape[0] - 2]))


def reached_rows(geometry: ConeBeam, grid: Grid, hull: Hull) -> slice:
    """Return the rows whose rays stay within the grid's height where they cross the sample."""
    z = kept_heights_mm(grid)
    down = -z * geometry.source_detector_mm / (geometry.source_axis_mm + hull.radius_mm()) - geometry.row_shift_mm
    rows = down / geometry.pixel_mm + (geometry.rows - 1) / 2
    return slice(max(int(np.ceil(rows[1])) + 1, 0), min(int(np.floor(rows[0])), geometry.rows))
