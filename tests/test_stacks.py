"""Stacks in TIFF files: of few images, cut short, damaged, and begun by a writer that was killed."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from pdvc.stacks import ExperimentError, StackWriter, read_stack

ROWS, COLUMNS = 6, 7


def images_of(count):
    """Return a stack (image, row, column) of random counts."""
    return np.random.default_rng(count).integers(0, 65536, (count, ROWS, COLUMNS), dtype=np.uint16)


def write_stack(path, images):
    with StackWriter(path, images.shape) as writer:
        for i in range(writer.done, len(images)):
            writer.write(i, images[i])


@pytest.mark.filterwarnings("ignore:.*stored as RGB:DeprecationWarning")
@pytest.mark.parametrize("how", [{}, {"compression": "zlib"}, {"imagej": True}])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_a_stack_of_few_images_written_in_the_plainest_way_is_read(tmp_path, count, how):
    """Of three or four images tifffile makes the colours of one."""
    images = images_of(count)
    tifffile.imwrite(tmp_path / "test.tif", images, **how)
    np.testing.assert_array_equal(read_stack(tmp_path / "test.tif", (ROWS, COLUMNS)), images)


@pytest.mark.filterwarnings("ignore:.*stored as RGB:DeprecationWarning")
@pytest.mark.parametrize("share", [0.2, 0.9])
def test_three_images_in_one_page_are_missed_when_cut_off(tmp_path, share):
    images = images_of(3)
    tifffile.imwrite(tmp_path / "test.tif", images)
    path = tmp_path / "test.tif"
    with tifffile.TiffFile(path) as tiff:
        start, size = tiff.series[0].dataoffset, tiff.series[0].nbytes
    path.write_bytes(path.read_bytes()[: start + int(share * size)])
    with pytest.raises(ExperimentError, match=r"test\.tif: truncated: expected \d+ bytes"):
        read_stack(tmp_path / "test.tif", (ROWS, COLUMNS))


def test_a_header_that_promises_more_than_any_memory_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "flats.tif"
    tifffile.imwrite(path, images_of(2), photometric="minisblack", compression="zlib")
    with tifffile.TiffFile(path, mode="r+b") as tiff:
        for page in tiff.pages:
            page.tags["ImageLength"].overwrite(2_000_000_000)
            page.tags["ImageWidth"].overwrite(2_000_000_000)
    with pytest.raises(ExperimentError, match=r"flats\.tif: "):
        read_stack(path, (ROWS, COLUMNS))


def test_a_note_of_progress_that_a_kill_left_beside_a_whole_stack_goes(tmp_path):
    images = images_of(3)
    write_stack(tmp_path / "a.tif", images)
    (tmp_path / "a.tif.count").write_text("3")
    write_stack(tmp_path / "a.tif", images)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


@pytest.mark.parametrize("left", [0, 5, 300])
def test_a_whole_stack_that_was_damaged_since_is_begun_anew(tmp_path, left):
    images = images_of(7)
    write_stack(tmp_path / "a.tif", images)
    (tmp_path / "a.tif").write_bytes((tmp_path / "a.tif").read_bytes()[:left])
    with StackWriter(tmp_path / "a.tif", images.shape) as writer:
        assert writer.done == 0
        for i, image in enumerate(images):
            writer.write(i, image)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), images)
