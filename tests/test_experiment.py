"""The experiment folder: written and read back, resumed, and refused in one line that names file and fault."""

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from pdvc.experiment import (
    AcquisitionEntry,
    Description,
    ExperimentError,
    GeometryEntry,
    InterruptedEntry,
    SettingsError,
    StackEntry,
    StackWriter,
    interrupted_stack,
    read_experiment,
    write_description,
)
from tests.laws import law

ROWS, COLUMNS = 6, 4


def entry(count):
    return StackEntry(
        angle_deg=tuple(360 * i / count for i in range(count)),
        time_s=tuple(2.0 * i for i in range(count)),
        force_N=tuple(250.0 + i for i in range(count)),
    )


DESCRIPTION = Description(
    title="dog-bone",
    material="cast iron",
    geometry=GeometryEntry(
        source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=ROWS, columns=COLUMNS, roll_deg=1.0
    ),
    acquisition=AcquisitionEntry(frames=5, photons_per_count=2.5, readout_noise_counts=9.0),
    reference=entry(7),
    test=entry(3),
)
SIZES = {"reference/radiographs.tif": 7, "test/radiographs.tif": 3, "flats.tif": 2, "darks.tif": 1}


def counts(name):
    """Return the stack (image, row, column) of a file, different for every file."""
    rng = np.random.default_rng(len(name))
    return rng.integers(0, 65536, (SIZES[name], ROWS, COLUMNS), dtype=np.uint16)


def write_stack(path, images):
    with StackWriter(path, images.shape) as writer:
        for i in range(writer.done, len(images)):
            writer.write(i, images[i])


@pytest.fixture
def folder(tmp_path):
    for name in SIZES:
        write_stack(tmp_path / name, counts(name))
    write_description(tmp_path, DESCRIPTION)
    return tmp_path


def refused(folder, kind=ExperimentError):
    with pytest.raises(kind) as caught:
        read_experiment(folder)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_a_folder_reads_back_as_it_was_written(folder):
    experiment = read_experiment(folder)
    stacks = (experiment.reference.counts, experiment.test.counts, experiment.flats, experiment.darks)
    for name, stack in zip(SIZES, stacks, strict=True):
        np.testing.assert_array_equal(stack, counts(name), err_msg=name)
    assert (experiment.title, experiment.material) == ("dog-bone", "cast iron")
    assert (experiment.frames, experiment.photons_per_count, experiment.readout_noise_counts) == (5, 2.5, 9.0)
    assert experiment.geometry == DESCRIPTION.geometry.cone_beam()
    assert experiment.geometry.roll_rad == pytest.approx(np.pi / 180)
    np.testing.assert_allclose(experiment.test.angle_rad, [0, 2 * np.pi / 3, 4 * np.pi / 3])
    np.testing.assert_array_equal(experiment.test.time_s, [0, 2, 4])
    np.testing.assert_array_equal(experiment.test.force_N, [250, 251, 252])


def with_scans(folder, *steps, views=4):
    """Add interrupted scans of `views` radiographs to a folder, and return their counts."""
    stacks = [np.random.default_rng(step).integers(0, 65536, (views, ROWS, COLUMNS), np.uint16) for step in steps]
    entries = tuple(InterruptedEntry(step=step, **entry(views).model_dump()) for step in steps)
    for n, stack in enumerate(stacks):
        write_stack(folder / interrupted_stack(n), stack)
    write_description(folder, DESCRIPTION.model_copy(update={"interrupted": entries}))
    return stacks


def test_interrupted_scans_read_back_as_they_were_written_and_stay_on_disk(folder):
    stacks = with_scans(folder, 0, 2)
    found = read_experiment(folder).interrupted
    assert [scan.step for scan in found] == [0, 2]
    for scan, stack in zip(found, stacks, strict=True):
        assert isinstance(scan.series.counts, np.memmap)
        np.testing.assert_array_equal(scan.series.counts, stack)
        np.testing.assert_allclose(scan.series.angle_rad, [0, np.pi / 2, np.pi, 3 * np.pi / 2])
        np.testing.assert_array_equal(scan.series.force_N, [250, 251, 252, 253])
    assert (folder / "interrupted/01/radiographs.tif").is_file()


def test_a_description_that_knows_no_interrupted_scans_reads_as_before(folder):
    path = folder / "experiment.toml"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("interrupted")]
    assert len(lines) == len(path.read_text().splitlines()) - 1
    path.write_text("\n".join(lines))
    assert read_experiment(folder).interrupted == ()


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ((0, 3), r"[[interrupted]] step below 3, the number of steps of the test, got 3"),
        ((2, 1), r"[[interrupted]] step: increasing step numbers, got 2, 1"),
        ((1, 1), r"[[interrupted]] step: increasing step numbers, got 1, 1"),
    ],
)
def test_scans_at_steps_that_the_test_has_not_are_refused(folder, steps, message):
    with_scans(folder, *steps)
    assert message in refused(folder, SettingsError)


def test_a_missing_or_short_interrupted_scan_is_named(folder):
    with_scans(folder, 0, 2)
    (folder / interrupted_stack(0)).unlink()
    assert "interrupted/00/radiographs.tif: expected a TIFF stack, found none" in refused(folder)
    write_stack(folder / interrupted_stack(0), np.zeros((3, ROWS, COLUMNS), np.uint16))
    text = refused(folder)
    assert "interrupted/00/radiographs.tif: expected 4 radiographs, one for each interrupted.0.angle_deg" in text
    assert "found 3" in text


def test_stacks_stay_on_disk(folder):
    assert isinstance(read_experiment(folder).reference.counts, np.memmap)


def test_a_single_image_is_a_stack_of_one(folder):
    tifffile.imwrite(folder / "darks.tif", counts("darks.tif")[0])
    np.testing.assert_array_equal(read_experiment(folder).darks, counts("darks.tif"))


@pytest.mark.parametrize(
    "how",
    [
        {"imagej": True},
        {"compression": "zlib", "photometric": "minisblack"},
        {"byteorder": ">", "photometric": "minisblack"},
    ],
    ids=["ImageJ", "zlib", "big-endian"],
)
def test_ordinary_tiffs_of_other_programs_are_read(folder, how):
    images = counts("test/radiographs.tif")
    tifffile.imwrite(folder / "test/radiographs.tif", images, **how)
    np.testing.assert_array_equal(read_experiment(folder).test.counts, images)


def test_pages_written_one_by_one_without_metadata_are_one_stack(folder):
    images = counts("test/radiographs.tif")
    with tifffile.TiffWriter(folder / "test/radiographs.tif") as tiff:
        for image in images:
            tiff.write(image, metadata=None, photometric="minisblack", contiguous=False)
    np.testing.assert_array_equal(read_experiment(folder).test.counts, images)


def test_a_folder_without_description_is_unfinished(folder):
    (folder / "experiment.toml").unlink()
    assert "experiment.toml: expected a TOML file, found none" in refused(folder, SettingsError)


def test_no_folder_at_all(tmp_path):
    assert "nowhere: expected an experiment folder, found none" in refused(tmp_path / "nowhere")


@pytest.mark.parametrize("name", SIZES)
def test_a_missing_stack_is_named(folder, name):
    (folder / name).unlink()
    assert f"{folder / name}: expected a TIFF stack, found none" in refused(folder)


@pytest.mark.parametrize("name", SIZES)
def test_a_stack_that_is_no_tiff_is_named(folder, name):
    (folder / name).write_text("frankly not a TIFF")
    assert f"{folder / name}: expected a TIFF stack, cannot read it" in refused(folder)


def cut(path, share):
    """Cut a TIFF within its counts, and return how many bytes are needed and how many are left."""
    with tifffile.TiffFile(path) as tiff:
        start, size = tiff.series[0].dataoffset, tiff.series[0].nbytes
    left = start + int(share * size)
    path.write_bytes(path.read_bytes()[:left])
    return start + size, left


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_truncated_stack_is_named_with_what_is_missing(folder, share):
    path = folder / "reference/radiographs.tif"
    needed, left = cut(path, share)
    assert f"{path}: truncated: expected {needed} bytes, found {left}" in refused(folder)


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_a_truncated_stack_of_imagej_is_named(folder, share):
    path = folder / "reference/radiographs.tif"
    tifffile.imwrite(path, counts("reference/radiographs.tif"), imagej=True)
    cut(path, share)
    assert f"{path}: truncated: expected 7 images" in refused(folder)


def compressed(path, name):
    """Write a stack compressed, image by image, and return the file's bytes."""
    tifffile.imwrite(path, counts(name), compression="zlib", photometric="minisblack")
    return path.read_bytes()


@pytest.mark.parametrize("left", [0.95, 0.5, 0.2])
def test_a_truncated_compressed_stack_is_named(folder, left):
    path = folder / "test/radiographs.tif"
    whole = compressed(path, "test/radiographs.tif")
    path.write_bytes(whole[: int(left * len(whole))])
    assert str(path) in refused(folder)


def test_a_stack_cut_within_its_header_is_named(folder):
    path = folder / "test/radiographs.tif"
    path.write_bytes(compressed(path, "test/radiographs.tif")[:5])
    assert str(path) in refused(folder)


def test_a_flat_lost_by_truncation_is_missed(folder):
    """The first flat is whole, and nothing but the file's own notes tells that there was a second."""
    path = folder / "flats.tif"
    whole = compressed(path, "flats.tif")
    with tifffile.TiffFile(path) as tiff:
        first = tiff.pages[0]
        end = first.dataoffsets[0] + first.databytecounts[0]
    path.write_bytes(whole[:end])
    assert str(path) in refused(folder)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "float32"])
def test_counts_of_another_type_are_refused_with_what_was_found(folder, dtype):
    tifffile.imwrite(folder / "flats.tif", np.ones((2, ROWS, COLUMNS), dtype=dtype), photometric="minisblack")
    assert f"{folder / 'flats.tif'}: expected uint16 counts, found {dtype}" in refused(folder)


def test_images_of_another_shape_are_refused_with_what_was_found(folder):
    tifffile.imwrite(
        folder / "darks.tif", np.zeros((2, COLUMNS, ROWS), dtype=np.uint16), photometric="minisblack", metadata=None
    )
    text = refused(folder)
    assert f"{folder / 'darks.tif'}: expected (image, 6, 4)" in text
    assert "found (2, 4, 6)" in text


def test_as_many_angles_as_radiographs_are_expected(folder):
    write_description(folder, DESCRIPTION.model_copy(update={"test": entry(4)}))
    text = refused(folder)
    assert "test/radiographs.tif: expected 4 radiographs, one for each test.angle_deg" in text
    assert "found 3" in text


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("force_N = [250.0, 251.0, 252.0]", "force_N = [250.0, nan, 252.0]", "test.force_N.1: expected a finite"),
        ("pixel_mm = 0.5", "pixel_mm = -0.5", "geometry.pixel_mm: expected greater than 0, given -0.5"),
        ("source_axis_mm", "source_axes_mm", "geometry.source_axes_mm: unknown key"),
        ("frames = 5", "frames = 'five'", "acquisition.frames: expected a valid integer"),
        ("[geometry]", "[geometry", "not valid TOML"),
        ("force_N = [250.0, 251.0, 252.0]", "force_N = [250.0, 1e300, 252.0]", "force_N.1: expected a number of size"),
        (
            "force_N = [250.0, 251.0, 252.0]",
            "force_N = [250.0, -1e10, 252.0]",
            "test.force_N.1: expected greater than",
        ),
        ("roll_deg = 1.0", "roll_deg = inf", "geometry.roll_deg: expected a finite number, given inf"),
        ("roll_deg = 1.0", "roll_deg = 1e6", "geometry.roll_deg: expected less than or equal to 360"),
        ("column_shift_mm = 0.0", "column_shift_mm = nan", "geometry.column_shift_mm: expected a finite number"),
        ("readout_noise_counts = 9.0", "readout_noise_counts = -9.0", "readout_noise_counts: expected greater than"),
        ("photons_per_count = 2.5", "photons_per_count = 0.0", "acquisition.photons_per_count: expected greater"),
        ("rows = 6", "rows = 1000000000", "geometry.rows: expected less than or equal to 100000"),
        ("pixel_mm = 0.5", "pixel_mm = 1e-15", "geometry: expected pixel_mm and source_axis_mm of at least 3e-07 mm"),
    ],
)
def test_a_wrong_entry_is_named_by_its_key(folder, old, new, message):
    path = folder / "experiment.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    found = refused(folder, SettingsError)
    assert str(path) in found
    assert message in found


@law(25)
@given(st.integers(1, 40), st.lists(st.integers(0, 40), max_size=4))
def test_a_stack_goes_on_where_the_last_writer_stopped(tmp_path_factory, size, stops):
    path = tmp_path_factory.mktemp("stack") / "stack.tif"
    images = np.random.default_rng(size).integers(0, 65536, (size, 3, 5), dtype=np.uint16)
    written = 0
    for stop in (*sorted(min(stop, size) for stop in stops), size):
        with StackWriter(path, images.shape) as writer:
            assert writer.done == written
            for i in range(writer.done, stop):
                writer.write(i, images[i])
        written = stop
        assert path.exists() == (written == size)
    np.testing.assert_array_equal(tifffile.imread(path).reshape(images.shape), images)
    assert [other.name for other in path.parent.iterdir()] == ["stack.tif"]


def test_a_writer_that_fails_keeps_what_it_has_written(tmp_path):
    images = counts("reference/radiographs.tif")

    def fail_after_two():
        with StackWriter(tmp_path / "a.tif", images.shape) as writer:
            for i in (0, 1, 5):
                writer.write(i, images[i])

    with pytest.raises(ValueError, match="expected image 2 next, got 5"):
        fail_after_two()
    with StackWriter(tmp_path / "a.tif", images.shape) as writer:
        assert writer.done == 2
        for i in range(2, 7):
            writer.write(i, images[i])
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), images)


def test_a_stack_whose_writer_was_killed_after_the_last_image_is_finished_by_the_next(tmp_path):
    images = np.random.default_rng(0).integers(0, 65536, (16, 3, 5), dtype=np.uint16)
    killed = StackWriter(tmp_path / "a.tif", images.shape)
    for i, image in enumerate(images):
        killed.write(i, image)
    del killed
    with StackWriter(tmp_path / "a.tif", images.shape) as writer:
        assert writer.done == 16
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), images)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


def test_a_stack_of_another_shape_is_begun_anew(tmp_path):
    write_stack(tmp_path / "a.tif", np.ones((4, 3, 5), dtype=np.uint16))
    with StackWriter(tmp_path / "a.tif", (6, 3, 5)) as writer:
        assert writer.done == 0


def test_images_out_of_order_are_refused(tmp_path):
    with (
        StackWriter(tmp_path / "a.tif", (3, 2, 2)) as writer,
        pytest.raises(ValueError, match=r"a\.tif: expected image 0 next, got 1"),
    ):
        writer.write(1, np.zeros((2, 2), dtype=np.uint16))
