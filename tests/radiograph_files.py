"""Radiographs as TIFF files of the layouts that scanners and programs write, as bytes."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

Image = NDArray[np.uint16]


def random_counts(seed: int, shape: tuple[int, ...]) -> Image:
    """Return counts without zeros, so that no pixel that was not read passes for one that was."""
    return np.random.default_rng(seed).integers(1, 65536, shape, dtype=np.uint16)


def by_tifffile(counts: NDArray[Any], **how: Any) -> bytes:
    """Return the file that tifffile writes: header, then pixels."""
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, counts, **{"photometric": "minisblack", **how})
    return buffer.getvalue()


def header_last(counts: Image) -> bytes:
    """Return a file as libtiff lays it out, made by the TIFF 6.0 standard: pixels, a strip for each row, then tags."""
    rows, columns = counts.shape
    pixels = counts.astype("<u2").tobytes()
    offsets = [8 + 2 * columns * row for row in range(rows)]
    lists = 8 + len(pixels)
    tags = 4 * rows * 2 + lists
    # tag, type (3: uint16, 4: uint32), how many, value or where the values are
    entries = [
        (256, 4, 1, columns),
        (257, 4, 1, rows),
        (258, 3, 1, 16),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (273, 4, rows, lists),
        (277, 3, 1, 1),
        (278, 4, 1, 1),
        (279, 4, rows, lists + 4 * rows),
        (339, 3, 1, 1),
    ]
    return b"".join(
        [
            struct.pack("<2sHI", b"II", 42, tags),
            pixels,
            struct.pack(f"<{2 * rows}I", *offsets, *[2 * columns] * rows),
            struct.pack("<H", len(entries)),
            *(struct.pack("<HHII", *entry) for entry in entries),
            struct.pack("<I", 0),
        ]
    )


LAYOUTS: dict[str, Callable[[Image], bytes]] = {
    "plain": by_tifffile,
    "imagej": lambda counts: by_tifffile(counts, imagej=True),
    "big-endian": lambda counts: by_tifffile(counts, byteorder=">", metadata=None),
    "bigtiff": lambda counts: by_tifffile(counts, bigtiff=True),
    "strips": lambda counts: by_tifffile(counts, rowsperstrip=2, metadata=None),
    "compressed": lambda counts: by_tifffile(counts, compression="zlib", rowsperstrip=2),
    "header-last": header_last,
}
