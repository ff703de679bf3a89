"""Bad files: missing, cut off, of another kind; and unusual ones that are to be read."""

from __future__ import annotations

import numpy as np
import tifffile

from benchmarks.bad_inputs.record import (
    ALL,
    BadInput,
    Change,
    Folder,
    described,
    in_turn,
    picked,
    raw,
    removed,
    settled,
    stacks,
    text,
)
from pdvc.experiment import DARKS, DESCRIPTION, FLATS, REFERENCE, TEST


def in_planes(name: str) -> Change:
    """Return the change that stores three or four images as one page with as many planes of colour.

    That is what `tifffile.imwrite(path, counts)` did, up to now, unless it was told what the images are.
    """

    def change(folder: Folder) -> None:
        tifffile.imwrite(folder.path / name, folder.counts(name), photometric="rgb", planarconfig="separate")

    return change


def compressed(folder: Folder) -> None:
    """Write all stacks compressed."""
    for name in ALL:
        tifffile.imwrite(folder.path / name, folder.counts(name), photometric="minisblack", compression="zlib")


def of_imagej(folder: Folder) -> None:
    """Write all stacks as ImageJ does: big-endian."""
    for name in ALL:
        tifffile.imwrite(folder.path / name, folder.counts(name), imagej=True)


def image_by_image(folder: Folder) -> None:
    """Write the test as many single images in a folder of the stack's name."""
    counts = folder.counts(TEST)
    (folder.path / TEST).unlink()
    (folder.path / TEST).mkdir()
    for t, image in enumerate(counts):
        tifffile.imwrite(folder.path / TEST / f"{t:04d}.tif", image)


CASES = (
    BadInput(name="no-flats", due="error", change=removed(FLATS), wrong="There are no flats."),
    BadInput(name="no-darks", due="error", change=removed(DARKS), wrong="There are no darks."),
    BadInput(name="no-test", due="error", change=removed(TEST), wrong="There is no test stack."),
    BadInput(name="no-reference", due="error", change=removed(REFERENCE), wrong="There is no reference stack."),
    BadInput(name="no-description", due="error", change=removed(DESCRIPTION), wrong="There is no `experiment.toml`."),
    BadInput(
        name="test-truncated",
        due="error",
        change=raw(TEST, lambda data: data[: len(data) * 2 // 3]),
        wrong="The copy of the test stack broke off after two thirds.",
    ),
    BadInput(name="test-empty-file", due="error", change=raw(TEST, lambda data: b""), wrong="The test is of 0 bytes."),
    BadInput(
        name="test-no-tiff",
        due="error",
        change=raw(TEST, lambda data: b"\x89PNG\r\n\x1a\n" + data),
        wrong="The test stack is another kind of file, renamed to .tif.",
    ),
    BadInput(
        name="test-single-files",
        due="error",
        change=image_by_image,
        wrong="The test is a folder of single images, not a stack.",
    ),
    BadInput(
        name="counts-float",
        due="error",
        change=stacks(lambda counts: counts.astype(np.float32), TEST),
        wrong="The test stack is of 32-bit floats.",
    ),
    BadInput(
        name="counts-8-bit",
        due="error",
        change=stacks(lambda counts: (counts >> 8).astype(np.uint8), *ALL),
        wrong="All stacks are of 8 bits.",
    ),
    BadInput(
        name="counts-signed",
        due="error",
        change=stacks(lambda counts: counts.astype(np.int16), TEST),
        wrong="The test stack is of signed 16-bit numbers: bright counts are negative.",
    ),
    BadInput(
        name="test-transposed",
        due="error",
        change=stacks(lambda counts: counts.transpose(0, 2, 1), TEST),
        wrong="Rows and columns of the test are interchanged.",
    ),
    BadInput(
        name="test-axes-rolled",
        due="error",
        change=stacks(lambda counts: counts.transpose(1, 2, 0), TEST),
        wrong="The test is stored as (row, column, step).",
    ),
    BadInput(
        name="test-binned",
        due="error",
        change=stacks(lambda counts: counts[:, ::2, ::2], TEST),
        wrong="The test was binned by two, the rest was not.",
    ),
    BadInput(
        name="test-one-image-less",
        due="error",
        change=stacks(lambda counts: counts[:-1], TEST),
        wrong="The last radiograph of the test is missing.",
    ),
    BadInput(
        name="flats-cropped",
        due="error",
        change=stacks(lambda counts: counts[:, 5:-5], FLATS),
        wrong="The flats were cropped to fewer rows.",
    ),
    BadInput(
        name="description-latin",
        due="error",
        change=text(lambda data: b'title = "Zugversuch gro\xdf"\n' + data.partition(b"\n")[2]),
        wrong="`experiment.toml` was saved in Latin-1.",
    ),
    BadInput(
        name="description-utf-16",
        due="error",
        change=text(lambda data: data.decode().encode("utf-16")),
        wrong="`experiment.toml` was saved as UTF-16.",
    ),
    BadInput(
        name="description-empty", due="error", change=text(lambda data: b""), wrong="`experiment.toml` is empty."
    ),
    BadInput(
        name="description-decimal-comma",
        due="error",
        change=text(lambda data: data.replace(b"pixel_mm = 2.3968", b"pixel_mm = 2,3968")),
        wrong="A number is written with a decimal comma.",
    ),
    BadInput(
        name="interrupted-without-stack",
        due="error",
        change=described(lambda values: values.update(interrupted=[values["reference"] | {"step": 40}])),
        wrong="An interrupted scan is listed, but has no stack.",
    ),
)
"""Files that cannot be read as what they should be."""

CONTROLS = (
    BadInput(
        name="good-byte-order-mark",
        due="good",
        change=text(lambda data: b"\xef\xbb\xbf" + data),
        wrong="Nothing: an editor put a byte-order mark before `experiment.toml`.",
    ),
    BadInput(
        name="good-line-ends",
        due="good",
        change=text(lambda data: data.replace(b"\n", b"\r\n")),
        wrong="Nothing: `experiment.toml` was written on Windows.",
    ),
    BadInput(
        name="good-three-planes",
        due="good",
        experiment="small, three flats",
        change=in_planes(FLATS),
        wrong="Nothing: three flats, by `tifffile.imwrite(path, flats)`: one page of three planes.",
    ),
    BadInput(
        name="good-four-planes",
        due="good",
        experiment="small, four flats",
        change=in_planes(FLATS),
        wrong="Nothing: four flats, by `tifffile.imwrite(path, flats)`: one page of four planes.",
    ),
    BadInput(name="good-compressed", due="good", change=compressed, wrong="Nothing: all stacks are compressed."),
    BadInput(name="good-imagej", due="good", change=of_imagej, wrong="Nothing: all stacks were saved by ImageJ."),
    BadInput(
        name="good-views-in-any-order",
        due="good",
        change=picked("reference", REFERENCE, lambda n: np.random.default_rng(0).permutation(n)),
        wrong="Nothing: the reference scan was made in another order of angles, which are recorded.",
    ),
    BadInput(
        name="good-angles-beyond-a-turn",
        due="good",
        change=described(
            lambda values: values["test"].update(angle_deg=[angle + 720.0 for angle in values["test"]["angle_deg"]])
        ),
        wrong="Nothing: the stage went on counting, two turns further.",
    ),
    BadInput(
        name="no-force",
        due="warning",
        change=in_turn(settled("reference", force_N=[0.0] * 75), settled("test", force_N=[0.0] * 127)),
        wrong="No force was recorded, zeros stand for it, and the options do not say where loading starts.",
    ),
    BadInput(
        name="good-noise-unknown",
        due="good",
        change=described(
            lambda values: [values["acquisition"].pop(key) for key in ("photons_per_count", "readout_noise_counts")]
        ),
        wrong="Nothing: the noise of the detector is not known, and left out.",
    ),
)
"""Folders that look unusual, without a fault."""
