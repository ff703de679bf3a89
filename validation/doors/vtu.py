"""VTK's files for ParaView: unstructured grids of quadrilaterals (.vtu), and series of them (.pvd)."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from pdvc.whole import write_whole

QUAD = 9
"""VTK's number of a quadrilateral."""
_TYPES = {"float32": "Float32", "float64": "Float64", "int64": "Int64", "uint8": "UInt8"}
_FILE = '<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" header_type="UInt64">'


def write_vtu(
    path: Path,
    points: NDArray[np.float64],
    quads: NDArray[np.int64],
    point_data: Mapping[str, NDArray[np.generic]],
    cell_data: Mapping[str, NDArray[np.generic]],
) -> None:
    """Write points (point, 3), quadrilaterals (cell, 4) between them, and fields of both, (n,) or (n, component)."""
    offsets = 4 * np.arange(1, len(quads) + 1)
    lines = [
        '<?xml version="1.0"?>',
        _FILE.format(kind="UnstructuredGrid"),
        "<UnstructuredGrid>",
        f'<Piece NumberOfPoints="{len(points)}" NumberOfCells="{len(quads)}">',
        "<Points>",
        _array("points", points),
        "</Points>",
        "<Cells>",
        _array("connectivity", quads.reshape(-1)),
        _array("offsets", offsets),
        _array("types", np.full(len(quads), QUAD, dtype=np.uint8)),
        "</Cells>",
        *_fields("PointData", point_data),
        *_fields("CellData", cell_data),
        "</Piece>",
        "</UnstructuredGrid>",
        "</VTKFile>",
        "",
    ]
    write_whole(path, "\n".join(lines).encode())


def write_pvd(path: Path, files: Sequence[tuple[float, str]]) -> None:
    """Write a series: the time of each file, and its name relative to the series."""
    sets = [f'<DataSet timestep="{time!r}" part="0" file={quoteattr(name)}/>' for time, name in files]
    lines = ['<?xml version="1.0"?>', _FILE.format(kind="Collection"), "<Collection>", *sets, "</Collection>"]
    write_whole(path, "\n".join([*lines, "</VTKFile>", ""]).encode())


def _fields(kind: str, fields: Mapping[str, NDArray[np.generic]]) -> list[str]:
    return [f"<{kind}>", *(_array(name, values) for name, values in fields.items()), f"</{kind}>"]


def _array(name: str, values: NDArray[np.generic]) -> str:
    """Return an array as VTK's XML: its length in bytes, then itself, both little-endian, in base 64."""
    little = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    content = np.array([little.nbytes], dtype="<u8").tobytes() + little.tobytes()
    components = values.shape[1] if values.ndim == 2 else 1
    return (
        f'<DataArray type="{_TYPES[values.dtype.name]}" Name={quoteattr(name)} NumberOfComponents="{components}" '
        f'format="binary">{base64.b64encode(content).decode()}</DataArray>'
    )
