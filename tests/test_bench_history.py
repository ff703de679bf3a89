"""The history of `make bench`: what was kept is read again, and a loss is told from a time that only wavers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from benchmarks.history import LAST, Entry, add, losses, read
from tests.laws import law

ONE = Entry(
    day="2026-11-28",
    commit="0123abc",
    machine="a processor, 2 cores",
    stage="FDK",
    size="60 views, 886 x 261 x 285 voxels",
    threads=2,
    seconds=3.25,
    compared="RTK FDK",
    ratio=0.5,
)


def test_what_is_kept_is_read_again_in_order(tmp_path: Path) -> None:
    path = tmp_path / "results" / "history.csv"
    assert read(path) == []
    entries = [
        ONE,
        replace(ONE, threads=1, ratio=0.75),
        replace(ONE, stage='noise, "all"', compared="yardstick"),
    ]
    add(entries[:1], path)
    add(entries[1:], path)
    assert read(path) == entries


@law()
@given(before=st.lists(st.floats(0.9, 1.1), min_size=1, max_size=9), now=st.floats(0.5, 2.0))
def test_a_loss_is_a_tenth_more_than_the_median_of_the_last_ones(before: list[float], now: float) -> None:
    last = sorted(before[-LAST:])
    middle = (last[(len(last) - 1) // 2] + last[len(last) // 2]) / 2
    found = losses([replace(ONE, ratio=now)], [replace(ONE, ratio=each) for each in before])
    assert len(found) == (now > 1.1 * middle)


def test_only_the_same_stage_of_the_same_size_is_compared() -> None:
    slower = replace(ONE, ratio=2.0)
    for other in (replace(ONE, size="600 views"), replace(ONE, threads=1), replace(ONE, compared="yardstick")):
        assert losses([slower], [other]) == []
    (line,) = losses([slower], [ONE])
    assert line.startswith("slower by 300% than the median of 1 before: FDK")
    assert losses([slower], []) == []
