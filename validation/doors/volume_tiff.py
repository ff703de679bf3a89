"""A volume as a TIFF stack that ImageJ opens with its voxel size."""

from __future__ import annotations

import io
from pathlib import Path

import tifffile

from pdvc.volume import Volume
from pdvc.whole import write_whole


def write_volume(path: Path, volume: Volume) -> None:
    """Write a volume, grey levels per mm as 32-bit floats (z, y, x), with its voxel in mm by ImageJ's convention.

    Slices go up, rows along y, columns along x. The place of the first voxel, and that of the axes, stand in ImageJ's
    ``Info`` (Image > Show Info).
    """
    grid = volume.grid
    x, y, z = grid.origin_mm
    info = (
        f"centre of the first voxel: x = {x!r} mm, y = {y!r} mm, z = {z!r} mm\n"
        "slices along z (up), rows along y, columns along x, in the frame of the sample\n"
        "grey levels per mm"
    )
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        volume.values,
        imagej=True,
        resolution=(1 / grid.voxel_mm, 1 / grid.voxel_mm),
        metadata={"axes": "ZYX", "spacing": grid.voxel_mm, "unit": "mm", "Info": info},
    )
    write_whole(path, buffer.getbuffer())
