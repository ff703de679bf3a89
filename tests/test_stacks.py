"""TIFF files: stacks of few images, cut short, damaged, begun by a writer that was killed; half a radiograph."""

from __future__ import annotations

from contextlib import nullcontext, suppress

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from pdvc.stacks import ExperimentError, StackWriter, UnfinishedError, read_radiograph, read_stack
from tests.laws import law
from tests.radiograph_files import LAYOUTS, by_tifffile, header_last, random_counts

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


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_radiograph_of_any_layout_is_read_into_memory(tmp_path, layout):
    counts = random_counts(1, (5, 4))
    (tmp_path / "a.tif").write_bytes(LAYOUTS[layout](counts))
    found = read_radiograph(tmp_path / "a.tif", (5, 4))
    (tmp_path / "a.tif").write_bytes(b"")
    np.testing.assert_array_equal(found, counts)
    assert found.dtype == np.uint16  # of this machine's byte order


def check_prefix(path, content, length, counts):
    """Check that the first bytes of a radiograph are told to be unfinished, unless all its counts are there."""
    path.write_bytes(content[:length])
    # the last four bytes may be the note that no further image follows, which is not needed
    if length < len(content) - 4:
        with pytest.raises(UnfinishedError, match=r"\.tif: expected ") as caught:
            read_radiograph(path, counts.shape)
        assert "\n" not in str(caught.value)
        return
    with nullcontext() if length == len(content) else suppress(UnfinishedError):
        np.testing.assert_array_equal(read_radiograph(path, counts.shape), counts)


def test_a_radiograph_cut_anywhere_is_unfinished_whose_tags_come_last(tmp_path):
    counts = random_counts(2, (3, 2))
    content = header_last(counts)
    for length in range(len(content) + 1):
        check_prefix(tmp_path / "a.tif", content, length, counts)


@law(150)
@given(st.sampled_from(sorted(LAYOUTS)), st.data())
def test_a_radiograph_cut_anywhere_is_unfinished(tmp_path_factory, layout, data):
    counts = random_counts(3, (5, 4))
    content = LAYOUTS[layout](counts)
    length = data.draw(st.integers(0, len(content)))
    check_prefix(tmp_path_factory.getbasetemp() / "cut.tif", content, length, counts)


def test_a_part_that_is_noted_as_empty_is_not_written_yet(tmp_path):
    """Libtiff notes where a strip lies when it is written; tifffile makes zeros of those that are nowhere."""
    path = tmp_path / "a.tif"
    path.write_bytes(LAYOUTS["strips"](random_counts(4, (5, 4))))
    for tag in ("StripOffsets", "StripByteCounts"):
        whole = path.read_bytes()
        with tifffile.TiffFile(path, mode="r+b") as tiff:
            values = tiff.pages.first.tags[tag].value
            tiff.pages.first.tags[tag].overwrite([*values[:-1], 0])
        with pytest.raises(UnfinishedError, match="expected all 3 parts of an image, found 2"):
            read_radiograph(path, (5, 4))
        path.write_bytes(whole)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (by_tifffile(random_counts(5, (4, 5))), r"one image \(5, 4\) as in experiment.toml, found \(4, 5\)$"),
        (by_tifffile(random_counts(5, (2, 5, 4))), r"one image \(5, 4\) as in experiment.toml, found \(2, 5, 4\)$"),
        (by_tifffile(random_counts(5, (5, 4)).astype(np.uint8)), "uint16 counts, found uint8$"),
        (by_tifffile(random_counts(5, (5, 4)).astype(np.int16)), "uint16 counts, found int16$"),
        (by_tifffile(random_counts(5, (5, 4)).astype(np.float32)), "uint16 counts, found float32$"),
    ],
)
def test_a_radiograph_of_another_size_or_type_is_refused_for_good(tmp_path, content, said):
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(ExperimentError, match=rf"a\.tif: expected {said}") as caught:
        read_radiograph(tmp_path / "a.tif", (5, 4))
    assert not isinstance(caught.value, UnfinishedError)


def test_a_radiograph_of_another_type_is_unfinished_first(tmp_path):
    """As long as it is not whole it may be anything."""
    content = by_tifffile(random_counts(6, (5, 4)).astype(np.int32))
    (tmp_path / "a.tif").write_bytes(content[:-1])
    with pytest.raises(UnfinishedError, match=f"expected {len(content)} bytes, found {len(content) - 1}"):
        read_radiograph(tmp_path / "a.tif", (5, 4))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "a TIFF, cannot read it: not a TIFF"),
        (b"II*\0\0\0\0\0", "one image, found none$"),
        (b"not a TIFF at all", "a TIFF, cannot read it: not a TIFF"),
        (b"\0" * 400, "a TIFF, cannot read it: not a TIFF"),
    ],
)
def test_what_is_no_tiff_may_become_one(tmp_path, content, said):
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(UnfinishedError, match=rf"a\.tif: expected {said}"):
        read_radiograph(tmp_path / "a.tif", (5, 4))


def test_a_radiograph_that_is_not_there_or_a_folder_is_unfinished(tmp_path):
    with pytest.raises(UnfinishedError, match=r"a\.tif: expected a TIFF, found none$"):
        read_radiograph(tmp_path / "a.tif", (5, 4))
    (tmp_path / "a.tif").mkdir()
    with pytest.raises(UnfinishedError, match=r"a\.tif: expected a TIFF, cannot read it: "):
        read_radiograph(tmp_path / "a.tif", (5, 4))
