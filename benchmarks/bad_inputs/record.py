"""What a bad input is: a sentence, a change of a good experiment folder or of the options, and the answer that is due.

A change works on the files, as a user's mistake would: TIFF stacks and `experiment.toml`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tifffile
import tomlkit
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.experiment import DARKS, DESCRIPTION, FLATS, REFERENCE, TEST

Counts = NDArray[np.uint16]
Floats = NDArray[np.float64]
ALL = (REFERENCE, TEST, FLATS, DARKS)
"""The stacks of an experiment folder."""
BEAM = (REFERENCE, TEST, FLATS)
"""The stacks that are made with X-rays."""
FULL = 65535

Due = Literal["error", "warning", "good", "unknowable", "told"]
"""What is due: an error in one line; a result whose verdict is not `trusted`, or an error; a trusted result; nothing,
because the folder is that of another experiment, without a fault; or a line that tells what was lost, and no end for
that."""


@dataclass(frozen=True, kw_only=True)
class Folder:
    """An experiment folder that may be changed, and the way to other ones, which may not."""

    path: Path
    simulated: Callable[[str], Path]
    """Gives the folder of a good experiment, by its name in `experiments.EXPERIMENTS`."""

    @property
    def beside(self) -> Path:
        """Return the folder in which commands are given: it holds the experiment."""
        return self.path.parent

    def counts(self, name: str) -> Counts:
        """Return a stack (image, row, column), counts."""
        found = tifffile.imread(self.path / name)
        return found if found.ndim == 3 else found[None]

    def write(self, name: str, counts: NDArray[Any]) -> None:
        """Write a stack (image, row, column) as an uncompressed TIFF, a page for each image."""
        tifffile.imwrite(self.path / name, counts, photometric="minisblack")

    def description(self) -> dict[str, Any]:
        """Return what `experiment.toml` says, as plain values."""
        return tomllib.loads((self.path / DESCRIPTION).read_text(encoding="utf-8"))

    def describe(self, values: dict[str, Any]) -> None:
        """Write `experiment.toml` from plain values."""
        (self.path / DESCRIPTION).write_text(tomlkit.dumps(values), encoding="utf-8")


Change = Callable[[Folder], None]


def unchanged(folder: Folder) -> None:
    """Leave the folder as it is: the mistake is elsewhere."""


@dataclass(frozen=True, kw_only=True)
class BadInput:
    """An input that a user got wrong, or a good one that must not be called wrong."""

    name: str
    """Slug, unique in the catalogue."""
    wrong: str
    """What the user did, in a sentence."""
    due: Due = "warning"
    experiment: str = "small"
    """The good experiment that is changed, by its name in `experiments.EXPERIMENTS`."""
    change: Change = unchanged
    options: str = ""
    """Content of the file given to --options; empty: none is given."""
    arguments: tuple[str, ...] = ()
    """Further arguments of `pdvc-bench measure`; of another command all arguments."""
    command: str = "measure"
    """Command of `pdvc-bench`; all but `measure` are given in the folder that holds `experiment`, and `ready`, as
    prepare leaves it, where their arguments name it."""
    meanwhile: Callable[[Path], AbstractContextManager[object]] = nullcontext
    """What else goes on in that folder as long as the command runs."""
    code: int = 2
    """Exit code that is due with an error."""


def stacks(edit: Callable[[Counts], NDArray[Any]], *names: str) -> Change:
    """Return the change that puts other counts in the place of some stacks; `edit` may change its argument."""

    def change(folder: Folder) -> None:
        for name in names:
            folder.write(name, edit(folder.counts(name)))

    return change


def described(edit: Callable[[dict[str, Any]], object]) -> Change:
    """Return the change that `edit` makes, in place, to the values of `experiment.toml`."""

    def change(folder: Folder) -> None:
        values = folder.description()
        edit(values)
        folder.describe(values)

    return change


def recorded(part: str, key: str, edit: Callable[[Floats], Floats]) -> Change:
    """Return the change of the numbers of a list, as `angle_deg` of `test`."""
    return described(lambda values: values[part].update({key: edit(np.array(values[part][key])).tolist()}))


def settled(part: str, **entries: object) -> Change:
    """Return the change that sets entries of a table of `experiment.toml`."""
    return described(lambda values: values[part].update(entries))


def scaled(part: str, key: str, factor: float) -> Change:
    """Return the change that multiplies an entry of `experiment.toml`."""
    return described(lambda values: values[part].update({key: values[part][key] * factor}))


def text(edit: Callable[[bytes], bytes]) -> Change:
    """Return the change of the bytes of `experiment.toml`."""
    return raw(DESCRIPTION, edit)


def raw(name: str, edit: Callable[[bytes], bytes]) -> Change:
    """Return the change of the bytes of a file."""

    def change(folder: Folder) -> None:
        path = folder.path / name
        path.write_bytes(edit(path.read_bytes()))

    return change


def removed(name: str) -> Change:
    """Return the change that deletes a file."""
    return lambda folder: (folder.path / name).unlink()


def in_turn(*changes: Change) -> Change:
    """Return the change that makes several, one after the other."""

    def change(folder: Folder) -> None:
        for each in changes:
            each(folder)

    return change


def picked(part: str, name: str, which: Callable[[int], NDArray[np.int64]]) -> Change:
    """Return the change that keeps some images of a stack, in an order, with all that was recorded with them."""

    def change(folder: Folder) -> None:
        counts = folder.counts(name)
        chosen = which(len(counts))
        folder.write(name, counts[chosen])
        values = folder.description()
        for key in ("angle_deg", "time_s", "force_N"):
            values[part][key] = np.array(values[part][key])[chosen].tolist()
        folder.describe(values)

    return change


def shifted(counts: Counts, rows: float, columns: float) -> Counts:
    """Return images moved down and to the right by whole pixels; what comes in repeats the edge."""
    return np.asarray(ndimage.shift(counts, (0, rows, columns), order=0, mode="nearest"))


def rounded(values: NDArray[Any]) -> Counts:
    """Return counts as a detector stores them: rounded, and clipped to 16 bits."""
    return np.clip(np.rint(values), 0, FULL).astype(np.uint16)
