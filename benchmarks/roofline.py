"""What bounds the projection kernel: planes crossed, counted exactly, against measured gathers and bytes a second.

Each plane that a ray crosses is a sample: four values are gathered, weighted bilinearly, and summed. The planes are
counted through the public projector: of a volume of ones at rest, a pixel's projection is its number of planes times
voxel / largest horizontal direction cosine. Times are processor times of one thread.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.case import Case, case
from benchmarks.growth import one_pass
from benchmarks.timing import in_turns, machine, with_threads

GATHERS = 4
FLOPS_VALUE = 31
"""Of a sample of the projection: plane to arc length 9, position 8, clamps 4, bilinear value 8, sum 2."""
FLOPS_ALL = 49
"""Of a sample with sensitivities: as above, and gradients 6, and the sums of seven more moments 12."""

Floats = NDArray[np.float64]


def main() -> None:
    """Run from the command line."""
    print(machine())
    rate, bandwidth = _gather_rate(), _bandwidth()
    print(
        f"micro-kernels, one thread: {1e-9 * rate:.2f} G gathers/s from 16 KiB, {1e-9 * bandwidth:.1f} GB/s streamed"
    )
    for name, rows in (("full size", 954), ("a quarter of it", 238)):
        on = case("jailin2018", rows=rows)
        samples, rays = planes(on)
        plain, full = (
            taken.cpu
            for taken in in_turns(
                [with_threads(1, lambda on=on: on.project(on.window, 0.4)), with_threads(1, one_pass(on))], 7
            )
        )
        volume = _touched_bytes(on)
        bound = {
            "gathers": GATHERS * samples / rate,
            "bytes": volume / bandwidth,
        }
        print(
            f"{name}: {samples:.3g} samples on {rays} rays, {samples / rays:.0f} each; "
            f"{1e-6 * volume:.0f} MB of volume\n"
            f"  bounds: {', '.join(f'{key} {1e3 * value:.0f} ms' for key, value in bound.items())}\n"
            f"  projection {1e3 * plain:.0f} ms, {1e9 * plain / samples:.1f} ns a sample, "
            f"{FLOPS_VALUE * samples / plain * 1e-9:.1f} Gflop/s, {plain / max(bound.values()):.1f} times the bound\n"
            f"  equations {1e3 * full:.0f} ms, {1e9 * full / samples:.1f} ns a sample, "
            f"{FLOPS_ALL * samples / full * 1e-9:.1f} Gflop/s, {full / max(bound.values()):.1f} times the bound"
        )
    print(machine())


def planes(on: Case) -> tuple[float, int]:
    """Return the number of planes crossed by the rays of the used window, and the number of rays that cross any."""
    window = on.window
    rays = on.rays(window, 0.4)[0]
    image = replace(on, volume=replace(on.volume, values=np.ones_like(on.volume.values))).project(window, 0.4)
    row, column = np.arange(window.rows)[:, None, None], np.arange(window.columns)[:, None]
    along = rays[1] + row * rays[2] + column * rays[3] - rays[0]
    cosine = np.abs(along[..., :2]).max(axis=-1) / np.linalg.norm(along, axis=-1)
    count = np.rint(image * cosine / on.volume.grid.voxel_mm)
    return float(count.sum()), int((count > 0).sum())


def _touched_bytes(on: Case) -> float:
    """Return the bytes of the volume within the hull and the used height."""
    inside = np.isfinite(on.volume.hull.support_mm).all(axis=1)
    support = on.volume.hull.support_mm[inside]
    normals = on.volume.hull.normals()
    # area of a polygon given by its supports: half the sum of support times side
    step = 2 * np.pi / len(normals)
    side = (np.roll(support, 1, 1) + np.roll(support, -1, 1) - 2 * support * np.cos(step)) / np.sin(step)
    area = 0.5 * (support * side).sum(axis=1)
    height = on.window.rows * on.geometry.voxel_mm
    return float(area.mean() * height / on.volume.grid.voxel_mm**3 * 4)


@njit(nogil=True, error_model="numpy", fastmath=True, boundscheck=False)
def _gather(table, count):  # type: ignore[no-untyped-def]
    mask = np.uint32(len(table) - 1)
    total = np.float32(0)
    for k in range(count):
        total += table[np.uint32(np.uint32(k) * np.uint32(37)) & mask]
    return total


def _gather_rate() -> float:
    table, count = np.ones(4096, np.float32), 20_000_000
    return count / in_turns([lambda: _gather(table, count)], 7)[0].cpu


@njit(nogil=True, error_model="numpy", fastmath=True, boundscheck=False)
def _stream(values):  # type: ignore[no-untyped-def]
    total = np.float32(0)
    for k in range(len(values)):
        total += values[k]
    return total


def _bandwidth() -> float:
    values = np.ones(60_000_000, np.float32)
    return values.nbytes / in_turns([lambda: _stream(values)], 5)[0].cpu


if __name__ == "__main__":
    main()
