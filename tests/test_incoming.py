"""A folder into which radiographs come one by one: each handed out once and whole, what cannot be used told once."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from pdvc import incoming
from pdvc.incoming import Incoming, IncomingWriter
from pdvc.stacks import ExperimentError
from tests.laws import law
from tests.radiograph_files import LAYOUTS, by_tifffile, random_counts

HEADER = "step,file,angle_deg,time_s,force_N\n"
SIZE = (5, 4)
PATIENCE_S = 10.0


class Clock:
    """A clock that stands unless it is set."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


class Folder:
    """A folder that is written to, and looked at, by hand."""

    def __init__(self, path, steps=6, **how):
        self.path = path
        self.clock = Clock()
        self.incoming = Incoming(path, SIZE, steps, patience_s=PATIENCE_S, clock=self.clock, **how)

    def append(self, text, name="radiographs.csv"):
        with (self.path / name).open("ab") as file:
            file.write(text if isinstance(text, bytes) else text.encode())

    def tiff(self, step, content=None):
        (self.path / f"{step}.tif").write_bytes(by_tifffile(random_counts(step, SIZE)) if content is None else content)

    def look(self):
        """Return the steps that arrived, and what was given up."""
        arrived, given_up = self.incoming.look()
        assert all("\n" not in each.reason for each in given_up)
        return [each.step for each in arrived], given_up

    def refused(self):
        with pytest.raises(ExperimentError) as caught:
            self.incoming.look()
        assert "\n" not in str(caught.value)
        return str(caught.value)


@pytest.fixture
def folder(tmp_path):
    found = Folder(tmp_path)
    found.append(HEADER)
    return found


NOTHING: tuple[list[int], list[str]] = ([], [])


@st.composite
def pieces(draw, content):
    """Return a content cut at some places."""
    cuts = sorted(draw(st.sets(st.integers(1, len(content) - 1), max_size=4)))
    return [content[start:end] for start, end in zip([0, *cuts], [*cuts, len(content)], strict=True)]


@st.composite
def arriving_tests(draw):
    """Return the number of steps, and what is appended to which file, in turn."""
    steps = draw(st.integers(1, 4))
    end = draw(st.sampled_from(["\n", "\r\n"]))
    order = draw(st.permutations(range(steps)))
    lines = [f"{step},{step}.tif,{step * 7.5},{step + 0.25},{250 - step}{end}" for step in order]
    files = {"radiographs.csv": "".join([HEADER.replace("\n", end), *lines]).encode()}
    for step in range(steps):
        files[f"{step}.tif"] = LAYOUTS[draw(st.sampled_from(sorted(LAYOUTS)))](random_counts(step, SIZE))
    cut = {name: draw(pieces(content)) for name, content in files.items()}
    turns = draw(st.permutations([name for name, parts in cut.items() for _ in parts]))
    return steps, files, [(name, cut[name].pop(0)) for name in turns]


@law(60)
@given(arriving_tests())
def test_each_radiograph_is_handed_out_once_and_whole_in_whatever_pieces_it_comes(drawn):
    steps, files, turns = drawn
    handed: list[int] = []
    with tempfile.TemporaryDirectory() as path:
        folder = Folder(Path(path), steps)
        for name, piece in turns:
            folder.append(piece, name)
            arrived, given_up = folder.incoming.look()
            assert given_up == []
            written = {each.name: each.read_bytes() for each in Path(path).iterdir()}
            whole_lines = written.get("radiographs.csv", b"").rpartition(b"\n")[0].decode().splitlines()
            in_table = {int(line.split(",")[0]) for line in whole_lines[1:]}
            for each in arrived:
                assert each.step in in_table
                np.testing.assert_array_equal(each.counts, random_counts(each.step, SIZE))
                assert each.angle_rad == pytest.approx(np.deg2rad(each.step * 7.5))
                assert (each.file, each.time_s, each.force_N) == (
                    f"{each.step}.tif",
                    each.step + 0.25,
                    250 - each.step,
                )
            handed += [each.step for each in arrived]
            assert {step for step in in_table if written.get(f"{step}.tif") == files[f"{step}.tif"]} <= set(handed)
    assert sorted(handed) == list(range(steps))


@law(60)
@given(
    st.lists(
        st.tuples(*[st.floats(-1e6, 1e6, allow_subnormal=False), *[st.floats(-1e9, 1e9)] * 2]), min_size=1, max_size=4
    ),
    st.data(),
)
def test_what_is_written_is_read_back_to_the_last_digit(recorded, data):
    order = data.draw(st.permutations(range(len(recorded))))
    with tempfile.TemporaryDirectory() as path:
        writer = IncomingWriter(Path(path) / "arriving")
        for step in order:
            writer.write(step, random_counts(step, SIZE), *recorded[step])
        arrived, given_up = Incoming(Path(path) / "arriving", SIZE, len(recorded)).look()
    assert given_up == []
    assert [each.step for each in arrived] == list(range(len(recorded)))
    for each, (angle_rad, time_s, force_N) in zip(arrived, recorded, strict=True):
        assert each.angle_rad == pytest.approx(angle_rad, rel=1e-15, abs=0)
        assert (each.time_s, each.force_N) == (time_s, force_N)
        np.testing.assert_array_equal(each.counts, random_counts(each.step, SIZE))


class TestTable:
    def test_before_there_is_a_table_nothing_has_arrived(self, tmp_path):
        folder = Folder(tmp_path)
        folder.tiff(0)
        assert folder.look() == NOTHING
        folder.append(HEADER + "0,0.tif,0,0,0\n")
        assert folder.look() == ([0], [])

    def test_without_a_folder_this_is_told(self, tmp_path):
        missing = Folder(tmp_path / "none")
        assert missing.refused() == f"{tmp_path / 'none'}: expected a folder of radiographs, found none"
        (tmp_path / "file").touch()
        assert (
            Folder(tmp_path / "file").refused()
            == f"{tmp_path / 'file'}: expected a folder of radiographs, found a file"
        )

    @pytest.mark.parametrize(
        "first", ["step;file;angle_deg;time_s;force_N\n", "0,0.tif,0,0,0\n", "\n", "x" * 300 + "\n"]
    )
    def test_a_table_that_begins_otherwise_is_refused_each_time(self, tmp_path, first):
        folder = Folder(tmp_path)
        folder.append(first)
        for _ in range(2):
            told = folder.refused()
            assert "radiographs.csv: expected the first line step,file,angle_deg,time_s,force_N, found '" in told
            assert len(told) < 300

    def test_the_first_line_may_be_half_written_and_begin_with_a_mark(self, tmp_path):
        folder = Folder(tmp_path)
        folder.append(b"\xef\xbb\xbfstep,fi")
        assert folder.look() == NOTHING
        folder.append("le,angle_deg,time_s,force_N\n0,0.tif,0,0,0\n")
        folder.tiff(0)
        assert folder.look() == ([0], [])

    def test_a_table_that_became_shorter_is_refused(self, folder):
        folder.append("0,0.tif,0,0,0\n1,1.t")
        folder.look()
        table = folder.path / "radiographs.csv"
        table.write_bytes(table.read_bytes()[:-1])
        assert "radiographs.csv: expected a table that only grows, found 54, then 53 bytes" in folder.refused()
        table.unlink()
        assert "only grows" in folder.refused()

    def test_only_what_was_appended_is_read(self, folder, monkeypatch):
        folder.append("0,0.tif,0,0,0\n1,1.t")
        folder.tiff(0)
        folder.look()
        with (folder.path / "radiographs.csv").open("r+b") as table:
            table.write(b"?" * (len(HEADER) + len("0,0.tif,0,0,0")))
        folder.append("if,0,0,0\n")
        folder.tiff(1)
        assert folder.look() == ([1], [])
        monkeypatch.setattr(Path, "open", None)
        assert folder.look() == NOTHING

    def test_radiographs_that_came_together_are_in_the_order_of_steps(self, folder):
        for step in (3, 0, 5, 1):
            folder.append(f"{step},{step}.tif,0,0,0\n")
            folder.tiff(step)
        assert folder.look() == ([0, 1, 3, 5], [])

    def test_names_may_be_quoted_and_fields_have_spaces_around_them(self, folder):
        folder.append('0 , "a, b.tif" , 90 , 1e-3 , -250.5\n\n\r\n')
        (folder.path / "a, b.tif").write_bytes(by_tifffile(random_counts(0, SIZE)))
        ((arrival,), given_up) = folder.incoming.look()
        assert given_up == []
        assert (arrival.angle_rad, arrival.time_s, arrival.force_N) == (pytest.approx(np.pi / 2), 0.001, -250.5)

    def test_a_radiograph_may_lie_in_a_folder_within(self, folder):
        (folder.path / "within").mkdir()
        (folder.path / "within/0.tif").write_bytes(by_tifffile(random_counts(0, SIZE)))
        folder.append("0,within/0.tif,0,0,0\n")
        assert folder.look() == ([0], [])


WRONG = {
    "0,0.tif,0,0": (-1, "expected step,file,angle_deg,time_s,force_N, found 4 fields, '0,0.tif,0,0'"),
    "0,0.tif,0,0,0,0": (-1, "found 6 fields"),
    "0,0.tif,0,5,0,2,1": (-1, "found 7 fields"),
    "0,0.tif,0,0,\xff": (-1, "in UTF-8, found "),
    "x,0.tif,0,0,0": (-1, "step: expected a whole number, 0 to 5, found 'x'"),
    "1.0,0.tif,0,0,0": (-1, "step: expected a whole number, 0 to 5, found '1.0'"),
    "-1,0.tif,0,0,0": (-1, "step: expected a whole number, 0 to 5, found '-1'"),
    "6,0.tif,0,0,0": (-1, "step: expected a whole number, 0 to 5, found '6'"),
    "0,0.tif,north,0,0": (0, "angle_deg: expected a number of size up to 1e+09, found 'north'"),
    "0,0.tif,0,nan,0": (0, "time_s: expected a number of size up to 1e+09, found 'nan'"),
    "0,0.tif,0,0,-2e9": (0, "force_N: expected a number of size up to 1e+09, found '-2e9'"),
    "0,,0,0,0": (0, "file: expected a name within the folder, found ''"),
    "0,.,0,0,0": (0, "file: expected a name within the folder, found '.'"),
    "0,../0.tif,0,0,0": (0, "file: expected a name within the folder, found '../0.tif'"),
    "0,a/../../0.tif,0,0,0": (0, "file: expected a name within the folder"),
    "0,..\\0.tif,0,0,0": (0, "file: expected a name within the folder"),
    "0,/0.tif,0,0,0": (0, "file: expected a name within the folder, found '/0.tif'"),
    "0,C:\\0.tif,0,0,0": (0, "file: expected a name within the folder"),
    "0,0\0.tif,0,0,0": (0, "file: expected a name within the folder"),
}
"""Lines, the step they tell, and what is said of them."""


class TestWrongLines:
    @pytest.mark.parametrize("line", WRONG)
    def test_a_wrong_line_is_told_once_and_skipped(self, folder, line):
        step, said = WRONG[line]
        folder.append(line.encode("latin-1") + b"\n")
        folder.append("0,0.tif,0,0,0\n")
        folder.tiff(0)
        arrived, (wrong,) = folder.look()
        assert arrived == [0]  # the same step, in a line that is right
        assert (wrong.step, wrong.file) == (step, "radiographs.csv")
        assert wrong.reason.startswith(f"{folder.path / 'radiographs.csv'}: line 2: ")
        assert said in wrong.reason
        assert folder.look() == NOTHING

    def test_a_long_line_is_told_in_short(self, folder):
        folder.append("0,0.tif,0,0," + "9" * 200_000 + "\n" + "," * 200_000 + "\n")
        arrived, wrong = folder.look()
        assert arrived == []
        assert all(len(each.reason) < 300 for each in wrong)
        assert [each.reason.split(": ")[1] for each in wrong] == ["line 2", "line 3"]

    def test_a_step_that_came_before_is_told_and_not_handed_out_again(self, folder):
        folder.append("2,2.tif,0,0,0\n2,3.tif,0,0,0\n")
        folder.tiff(2)
        folder.tiff(3)
        arrived, (again,) = folder.look()
        assert arrived == [2]
        assert (again.step, again.file) == (2, "radiographs.csv")
        assert again.reason.endswith("line 3: step: expected a line for each step, found 2 again")
        folder.append("2,3.tif,0,0,0\n")
        arrived, (again,) = folder.look()
        assert arrived == []
        assert "line 4: " in again.reason


class TestRadiographsThatDoNotCome:
    @pytest.mark.parametrize("content", [None, b"", b"not a TIFF at all", by_tifffile(random_counts(1, SIZE))[:-1]])
    def test_one_that_is_missing_or_stays_half_is_given_up_once_when_patience_ends(self, folder, content):
        folder.append("1,1.tif,0,0,0\n")
        if content is not None:
            folder.tiff(1, content)
        assert folder.look() == NOTHING
        folder.clock.now_s += PATIENCE_S - 0.001
        assert folder.look() == NOTHING
        folder.clock.now_s += 0.001
        arrived, (lost,) = folder.look()
        assert arrived == []
        assert (lost.step, lost.file) == (1, "1.tif")
        assert lost.reason.startswith(f"{folder.path / '1.tif'}: expected ")
        assert lost.reason.endswith("; given up after 10 s without a change")
        folder.tiff(1)
        assert folder.look() == NOTHING

    def test_one_that_comes_late_is_handed_out(self, folder):
        folder.append("1,1.tif,0,0,0\n")
        folder.look()
        folder.clock.now_s += 3 * PATIENCE_S
        folder.tiff(1)
        assert folder.look() == ([1], [])

    def test_one_that_grows_slowly_is_awaited(self, folder):
        content = by_tifffile(random_counts(1, SIZE))
        folder.append("1,1.tif,0,0,0\n")
        for length in range(0, len(content), 50):
            folder.tiff(1, content[:length])
            assert folder.look() == NOTHING
            folder.clock.now_s += PATIENCE_S - 1
        assert folder.look() == NOTHING
        folder.clock.now_s += 1
        arrived, (lost,) = folder.look()
        assert arrived == []
        assert lost.step == 1

    @pytest.mark.parametrize(
        ("counts", "said"),
        [
            (random_counts(1, (4, 5)), "expected one image (5, 4) as in experiment.toml, found (4, 5)"),
            (random_counts(1, SIZE).astype(np.float32), "expected uint16 counts, found float32"),
        ],
    )
    def test_one_of_another_size_or_type_is_told_at_once(self, folder, counts, said):
        folder.append("1,1.tif,0,0,0\n0,0.tif,0,0,0\n")
        folder.tiff(0)
        folder.tiff(1, by_tifffile(counts))
        arrived, (lost,) = folder.look()
        assert arrived == [0]
        assert (lost.step, lost.file, lost.reason) == (1, "1.tif", f"{folder.path / '1.tif'}: {said}")
        assert folder.look() == NOTHING


def test_steps_of_an_earlier_run_are_passed_over(tmp_path):
    folder = Folder(tmp_path, done=[0, 2])
    folder.append(HEADER + "0,gone.tif,0,0,0\n1,1.tif,0,0,0\n2,2.tif,0,0,0\n")
    folder.tiff(1)
    folder.tiff(2)
    assert folder.look() == ([1], [])
    folder.clock.now_s += PATIENCE_S
    assert folder.look() == NOTHING
    folder.append("2,2.tif,0,0,0\n")
    arrived, (again,) = folder.look()
    assert arrived == []
    assert "found 2 again" in again.reason


class TestWriter:
    def test_the_folder_is_readable_without_this_software(self, tmp_path):
        writer = IncomingWriter(tmp_path / "new/arriving")
        counts = random_counts(0, (7, 3))  # as wide as a colour image is deep
        writer.write(12, counts.astype(">u2"), np.pi / 2, 1.5, 250)
        table = tmp_path / "new/arriving/radiographs.csv"
        assert table.read_text() == HEADER + "12,00012.tif,90.0,1.5,250.0\n"
        np.testing.assert_array_equal(tifffile.imread(table.with_name("00012.tif")), counts)
        assert sorted(each.name for each in table.parent.iterdir()) == ["00012.tif", "radiographs.csv"]

    def test_a_folder_with_a_table_is_left_as_it_is(self, tmp_path):
        (tmp_path / "radiographs.csv").write_text("mine")
        with pytest.raises(ExperimentError, match=r"radiographs\.csv: expected a folder without a table, found one"):
            IncomingWriter(tmp_path)
        assert (tmp_path / "radiographs.csv").read_text() == "mine"

    def test_a_line_comes_after_its_radiograph(self, tmp_path, monkeypatch):
        writer = IncomingWriter(tmp_path)
        monkeypatch.setattr(incoming, "write_whole", no_room)
        with pytest.raises(OSError, match="no room"):
            writer.write(0, random_counts(0, SIZE), 0, 0, 0)
        assert (tmp_path / "radiographs.csv").read_text() == HEADER

    @pytest.mark.parametrize("counts", [np.ones((5, 4)), np.ones((1, 5, 4), dtype=np.uint16)])
    def test_other_counts_are_refused(self, tmp_path, counts):
        with pytest.raises(ValueError, match=r"expected uint16 counts \(row, column\), given "):
            IncomingWriter(tmp_path).write(0, counts, 0, 0, 0)


def no_room(*_):
    raise OSError("no room")
