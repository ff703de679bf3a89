"""Files written whole or not at all, under another name first, so that no reader meets half of one."""

from __future__ import annotations

import io
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr


def write_whole(path: Path, content: bytes | memoryview, *, partial: Path | None = None) -> None:
    """Write a file, and its folder where there is none; raises OSError and leaves what was there where that fails.

    `partial` is its name meanwhile, by default NAME.partial; where several processes may write it at once, each needs
    another.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial or path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        # a write that fails does not say of which file
        raise OSError(error.errno, error.strerror, str(path)) from None


def write_netcdf(path: Path, data: xr.Dataset, encoding: Mapping[Hashable, dict[str, object]] | None = None) -> None:
    """Write a dataset as NetCDF, as `write_whole` does.

    It is packed in memory first: HDF5 cannot recover from a disk that is full.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        # not by to_netcdf, which in a worker asks the cluster for a lock on the buffer
        data.dump_to_store(H5NetCDFStore(file), encoding=encoding)
    write_whole(path, buffer.getbuffer())


def read_netcdf(path: Path) -> xr.Dataset:
    """Read a NetCDF file into memory; raises ValueError where it is none, or damaged, and OSError of the machine."""
    import h5py
    import xarray as xr

    try:
        # where HDF5 cannot open a file, h5netcdf leaves the traceback of its own failure on the console
        h5py.File(path, "r").close()
        with xr.open_dataset(path, engine="h5netcdf") as data:
            return data.load()
    except OSError as error:
        if error.errno is not None:
            raise
        raise ValueError(" ".join(str(error).split())) from None
    except Exception as error:  # damage inside the file makes HDF5, h5netcdf and xarray raise errors of every kind
        raise ValueError(" ".join(str(error).split())) from None
