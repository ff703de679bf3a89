"""Counts in TIFF files: stacks, written image by image and read where they are; radiographs; refused in one line."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import tifffile
from numpy.typing import NDArray

DESCRIPTION = "experiment.toml"

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it complains of is an ExperimentError here


class ExperimentError(ValueError):
    """A file of an experiment folder is wrong: which, what was expected and what was found."""


class UnfinishedError(ExperimentError):
    """A file is not there, shorter than it says, or cannot be opened, as while it is being written."""


def read_stack(path: Path, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Return a stack of counts (image, row, column), whose images are of a size (rows, columns) in px.

    A memory map where the TIFF is uncompressed. Raises ExperimentError, in one line, for a file that is missing,
    truncated, damaged, or of other counts or another size.
    """
    if not path.is_file():
        raise ExperimentError(f"{path}: expected a TIFF stack, found none")
    try:
        with tifffile.TiffFile(path) as tiff:
            if len(tiff.series) != 1:
                raise ExperimentError(f"{path}: expected one stack of equal images, found {len(tiff.series)} series")
            series = tiff.series[0]
            needed = series.dataoffset + series.nbytes if series.dataoffset is not None else 0
            if path.stat().st_size < needed:
                raise ExperimentError(f"{path}: truncated: expected {needed} bytes, found {path.stat().st_size}")
            declared, found = _declared_images(tiff), len(tiff.pages) * _images_of_a_page(tiff)
            if declared is not None and declared != found and declared != len(series):
                raise ExperimentError(f"{path}: truncated: expected {declared} images, found {found}")
            # before they are read, as a damaged header may promise more than any memory holds
            _check_counts(path, series.dtype)
            shape = (1,) * (3 - len(series.shape)) + tuple(series.shape)
            if len(shape) != 3 or shape[1:] != size or not shape[0]:
                raise ExperimentError(
                    f"{path}: expected (image, {size[0]}, {size[1]}) as in {DESCRIPTION}, found {shape}"
                )
            counts = series.asarray() if series.dataoffset is None else tifffile.memmap(path, mode="r")
            return counts.reshape(shape)
    except (ExperimentError, MemoryError):
        raise
    except OSError as error:
        if error.errno is not None:  # the disk's own failure, not the file's content
            raise
        raise _unreadable(path, error) from None
    except Exception as error:  # a damaged header makes tifffile and what it calls raise errors of every kind
        raise _unreadable(path, error) from None


def read_radiograph(path: Path, size: tuple[int, int], where: str = DESCRIPTION) -> NDArray[np.uint16]:
    """Return the counts (row, column) of a TIFF of one image, of a size (rows, columns) in px, into memory.

    `where` tells, for errors, what has that size. The file may still be written to. Raises UnfinishedError, in one
    line, unless all that it says is there, and ExperimentError for one that is whole, but of several images, of other
    counts or of another size.
    """
    try:
        with tifffile.TiffFile(path) as tiff:
            if not len(tiff.pages):
                raise UnfinishedError(f"{path}: expected one image, found none")
            page = tiff.pages.first
            # first, as what is not written yet may pass for another size
            _check_whole(path, page, tiff.filehandle.size)
            _check_counts(path, page.dtype)
            found = tuple(page.shape) if len(tiff.pages) == 1 else (len(tiff.pages), *page.shape)
            if found != size:
                raise ExperimentError(f"{path}: expected one image {size} as in {where}, found {found}")
            return page.asarray()
    except ExperimentError:
        raise
    except FileNotFoundError:
        raise UnfinishedError(f"{path}: expected a TIFF, found none") from None
    except Exception as error:  # half a header makes tifffile and what it calls raise errors of every kind
        raise UnfinishedError(f"{path}: expected a TIFF, cannot read it: {' '.join(str(error).split())}") from None


def _check_whole(path: Path, page: tifffile.TiffPage, length: int) -> None:
    """Raise UnfinishedError unless a file of so many bytes holds all parts of an image, none of them still empty."""
    parts = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    needed = max((offset + count for offset, count in parts), default=0)
    if length < needed:
        raise UnfinishedError(f"{path}: expected {needed} bytes, found {length}")
    # some programs note where a part lies only once it is written; of a part noted as nowhere, tifffile makes zeros
    written, due = sum(1 for offset, count in parts if offset and count), math.prod(page.chunked)
    if written != due:
        raise UnfinishedError(f"{path}: expected all {due} parts of an image, found {written}")


def _check_counts(path: Path, found: np.dtype[Any] | None) -> None:
    if found is None or found.newbyteorder("=") != np.uint16:  # ImageJ writes big-endian
        raise ExperimentError(f"{path}: expected uint16 counts, found {found}")


def _unreadable(path: Path, error: Exception) -> ExperimentError:
    return ExperimentError(f"{path}: expected a TIFF stack, cannot read it: {' '.join(str(error).split())}")


def _images_of_a_page(tiff: tifffile.TiffFile) -> int:
    """Return how many images each page holds: tifffile takes a stack of three or four for the colours of one."""
    first = tiff.pages.first
    return first.samplesperpixel if first.planarconfig == tifffile.PLANARCONFIG.SEPARATE else 1


def _declared_images(tiff: tifffile.TiffFile) -> int | None:
    """Return how many images the file's own notes promise, as tifffile and ImageJ write them; None without."""
    for notes in tiff.shaped_metadata or ():
        if "shape" in notes:
            return int(np.prod(notes["shape"][:-2]))
    images = (tiff.imagej_metadata or {}).get("images")
    return None if images is None else int(images)


class StackWriter:
    """Write a stack image by image, under a provisional name until it is complete.

    A writer opened again on the same path and shape goes on where the last one stopped: `done` images
    are there already. Use as a context manager; the file gets its name only if all images were written.
    """

    def __init__(self, path: Path, shape: tuple[int, int, int]) -> None:
        self.path = path
        self._partial = path.with_name(path.name + ".partial")
        self._count = path.with_name(path.name + ".count")
        self._shape = shape
        path.parent.mkdir(parents=True, exist_ok=True)
        self.done = self._resume()
        if self.done < 0:
            self.done = 0
            path.unlink(missing_ok=True)
            self._count.write_text("0")
            # the whole file is laid out now, so that a full disk is met before the work, not after it
            with tifffile.TiffWriter(self._partial, bigtiff=_too_large(shape)) as tiff:
                blank = np.zeros(shape[1:], dtype=np.uint16)
                tiff.write((blank for _ in range(shape[0])), shape=shape, dtype=np.uint16, photometric="minisblack")
        self._map: Any = _open_map(self._partial, shape) if self.done < shape[0] else None

    def write(self, index: int, image: NDArray[np.uint16]) -> None:
        """Store the next image, counts (row, column); images come in order."""
        if index != self.done or self._map is None:
            raise ValueError(f"{self.path}: expected image {self.done} next, got {index}")
        self._map[index] = image
        self.done += 1
        if self.done % 16 == 0:
            self._save()

    def _resume(self) -> int:
        if self.path.exists() and not self._partial.exists():
            try:
                complete = read_stack(self.path, self._shape[1:]).shape[0] == self._shape[0]
            except ExperimentError:
                complete = False
            return self._shape[0] if complete else -1
        if not (self._partial.exists() and self._count.exists()):
            return -1
        try:
            found = tifffile.memmap(self._partial, mode="r")
            if found.size != int(np.prod(self._shape)):
                return -1
            return min(int(self._count.read_text()), self._shape[0])
        except (ValueError, OSError, tifffile.TiffFileError):
            return -1

    def _save(self) -> None:
        self._map.flush()
        self._count.write_text(str(self.done))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._map is not None:
            self._save()
            self._map = None
        # a process that was killed between the last image and its name left only the naming to do
        if self.done == self._shape[0]:
            if self._partial.exists():
                self._partial.replace(self.path)
            self._count.unlink(missing_ok=True)


def _open_map(path: Path, shape: tuple[int, int, int]) -> Any:
    pages = tifffile.memmap(path, mode="r+")
    assert isinstance(pages, np.memmap)
    # tifffile drops an axis of length one
    return np.memmap(path, dtype=pages.dtype, mode="r+", offset=pages.offset, shape=shape)


def _too_large(shape: Sequence[int]) -> bool:
    return int(np.prod(shape)) * 2 > 2**32 - 2**25
