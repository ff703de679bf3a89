"""Handing out runs: what dies is tried again, what fails is a row, what is done is not repeated."""

from __future__ import annotations

import errno
import logging
from collections import Counter

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from distributed import LocalCluster

from tests.made_up_runs import Sum
from validation.batch import engine as runs
from validation.batch.engine import is_done, run_trials


def diary(folder):
    return Counter((folder / "diary").read_text().splitlines())


def expected(trials):
    totals = [ord(trial.group) + trial.number for trial in trials]
    return pd.DataFrame({"number": [trial.number for trial in trials], "total": totals})


@pytest.fixture(scope="module")
def address():
    """Return the address of a scheduler with one worker, in this process."""
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0", silence_logs=logging.CRITICAL
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def eventful(tmp_path_factory):
    """Return the runs and the table of a job in which much goes wrong."""
    folder = tmp_path_factory.mktemp("eventful")
    fates = {("a", 1): "kills once", ("a", 3): "raises", ("b", 0): "kills"}
    trials = [Sum(group, n, folder, fates.get((group, n), "")) for n in range(4) for group in "ab"]
    told = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "DEATHS_ALLOWED", 1)
        table = run_trials(trials, folder / "out", workers=2, progress=lambda *event: told.append(event))
    return folder, trials, table, told


class TestAnEventfulJob:
    def test_every_run_is_a_row_in_order(self, eventful):
        _, trials, table, _ = eventful
        assert list(table["key"]) == [trial.key for trial in trials]
        assert list(table.columns[:4]) == ["group", "number", "status", "reason"]
        assert list(table["status"]) == ["done", "failed", "done", "done", "done", "done", "failed", "done"]

    def test_rows_hold_what_the_runs_found_also_after_the_death_of_a_worker(self, eventful):
        folder, trials, table, _ = eventful
        done = table["status"] == "done"
        pd.testing.assert_frame_equal(
            table.loc[done, ["number", "total"]].astype(int), expected(trials)[done], check_dtype=False
        )
        assert diary(folder)["began a1"] == 2
        for trial, total in zip(trials, table["total"], strict=True):
            path = folder / "out" / "errors" / f"{trial.key}.npz"
            assert path.exists() == bool(np.isfinite(total))
            if path.exists():
                assert np.load(path)["total"] == total

    def test_a_run_that_raises_is_a_row_with_its_reason_and_a_log(self, eventful):
        folder, _, table, _ = eventful
        row = table.set_index("key").loc["a3"]
        assert row["reason"] == "ValueError: expected another number, got this one"
        assert "Traceback" in (folder / "out" / "failed" / "a3.log").read_text()

    def test_a_run_that_kills_every_worker_is_given_up_alone(self, eventful):
        folder, _, table, _ = eventful
        assert "KilledWorker" in table.set_index("key").loc["b0", "reason"]
        # one or two deaths among the others, as it also answers for deaths of those in line with it; two by itself
        assert 3 <= diary(folder)["began b0"] <= 4

    def test_parts_are_made_once_and_nothing_is_left_of_them(self, eventful):
        folder, *_ = eventful
        assert diary(folder)["made a"] == diary(folder)["made b"] == 1
        assert not (folder / "out" / "work").exists()

    def test_progress_counts_runs_and_failures(self, eventful):
        *_, told = eventful
        assert told[0] == ("runs", 0, 8)
        assert [done for _, done, _ in told] == list(range(9))
        assert told[-1] == ("runs, 2 failed", 8, 8)

    def test_the_folder_of_rows_reads_as_one_table(self, eventful):
        folder, _, table, _ = eventful
        found = pd.read_parquet(folder / "out" / "runs").set_index("key").loc[list(table["key"])]
        pd.testing.assert_frame_equal(found.reset_index()[list(table.columns)], table)
        pd.testing.assert_frame_equal(pd.read_parquet(folder / "out" / "table.parquet"), table)

    def test_asked_again_only_failed_runs_are_repeated(self, eventful, address):
        folder, trials, *_ = eventful
        before = diary(folder)
        mended = [Sum(trial.group, trial.number, folder) for trial in trials]
        again = run_trials(mended, folder / "out", scheduler=address)
        assert diary(folder) - before == Counter({"began a3": 1, "began b0": 1, "made a": 1, "made b": 1})
        assert set(again["status"]) == {"done"}
        pd.testing.assert_frame_equal(again[["number", "total"]], expected(trials), check_dtype=False)
        assert not list((folder / "out" / "failed").iterdir())
        # with nothing left to do there is no cluster either
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(runs, "connected", None)
            pd.testing.assert_frame_equal(run_trials(mended, folder / "out"), again)


def test_runs_that_share_a_part_follow_each_other(tmp_path, address):
    trials = [Sum(group, n, tmp_path) for n in range(3) for group in "fgh"]
    table = run_trials(trials, tmp_path / "out", scheduler=address)
    began = [line[6] for line in (tmp_path / "diary").read_text().splitlines() if line.startswith("began")]
    # those of the next group may begin while the last of this one wait, those of the one after not
    assert sorted(began) == list("fffggghhh")
    assert "h" not in began[: 1 + max(place for place, group in enumerate(began) if group == "f")]
    assert list(table["group"]) == list("fgh" * 3)


def test_an_interrupted_job_goes_on_and_repeats_nothing(tmp_path, address):
    trials = [Sum("c", n, tmp_path) for n in range(30)]

    def press_ctrl_c(_, done, __):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_trials(trials, tmp_path / "out", scheduler=address, progress=press_ctrl_c)
    done = [trial.key for trial in trials if is_done(tmp_path / "out", trial)]
    assert 3 <= len(done) < 30
    assert not (tmp_path / "out" / "table.parquet").exists()
    told = []
    table = run_trials(trials, tmp_path / "out", scheduler=address, progress=lambda *event: told.append(event))
    # the worker may have finished another one meanwhile
    assert told[0] in (("runs", len(done), 30), ("runs", len(done) + 1, 30))
    assert all(diary(tmp_path)[f"began {key}"] == 1 for key in done)
    pd.testing.assert_frame_equal(table[["number", "total"]], expected(trials), check_dtype=False)


@pytest.mark.parametrize("damaged", ["runs/g1.parquet", "errors/g1.npz"])
@pytest.mark.parametrize("left", [None, 0, 0.5, 0.99])
def test_a_row_or_arrays_that_were_damaged_are_made_again_alone(tmp_path, address, damaged, left):
    trials = [Sum("g", n, tmp_path) for n in range(3)]
    table = run_trials(trials, tmp_path / "out", scheduler=address)
    path = tmp_path / "out" / damaged
    content = path.read_bytes()
    path.unlink()
    if left is not None:
        path.write_bytes(content[: int(left * len(content))])
    before = diary(tmp_path)
    again = run_trials(trials, tmp_path / "out", scheduler=address)
    assert diary(tmp_path) - before == Counter({"began g1": 1, "made g": 1})
    pd.testing.assert_frame_equal(again.drop(columns="seconds"), table.drop(columns="seconds"))
    assert np.load(tmp_path / "out" / "errors" / "g1.npz")["total"] == table["total"][1]


def test_arrays_of_which_a_byte_is_wrong_are_made_again(tmp_path, address):
    trials = [Sum("h", 1, tmp_path)]
    run_trials(trials, tmp_path / "out", scheduler=address)
    path = tmp_path / "out" / "errors" / "h1.npz"
    content = bytearray(path.read_bytes())
    # the array's one number is the last thing before the archive's list of contents
    content[content.index(b"PK\x01\x02") - 1] ^= 255
    path.write_bytes(content)
    assert not is_done(tmp_path / "out", trials[0])
    run_trials(trials, tmp_path / "out", scheduler=address)
    assert is_done(tmp_path / "out", trials[0])


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO])
def test_a_failure_of_the_machine_ends_the_job_and_gives_no_run_a_row(tmp_path, address, number):
    trials = [Sum("i", n, tmp_path, f"errno {number}" if n == 1 else "") for n in range(3)]
    with pytest.raises(OSError, match="/data/full") as caught:
        run_trials(trials, tmp_path / "out", scheduler=address)
    assert caught.value.errno == number
    assert not (tmp_path / "out" / "runs" / "i1.parquet").exists()
    assert not (tmp_path / "out" / "table.parquet").exists()
    mended = [Sum("i", n, tmp_path) for n in range(3)]
    pd.testing.assert_frame_equal(
        run_trials(mended, tmp_path / "out", scheduler=address)[["number", "total"]],
        expected(mended),
        check_dtype=False,
    )


def test_what_killed_workers_had_half_written_is_removed(tmp_path):
    trials = [Sum("j", 1, tmp_path)]
    left = tmp_path / "out" / "runs" / ".j1.parquet.123.partial"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"PAR1")
    run_trials(trials, tmp_path / "out", workers=1)
    assert not left.exists()


def test_a_row_takes_its_first_columns_from_the_study_that_asks(tmp_path, address):
    run_trials([Sum("d", 1, tmp_path)], tmp_path / "out", scheduler=address)

    class Renamed(Sum):
        @property
        def columns(self):
            return {"letter": "d"}

    table = runs.collected([Renamed("d", 1, tmp_path)], tmp_path / "out")
    assert table.column_names[0] == "letter"
    assert "group" not in table.column_names
    assert table["total"].type == pa.int64()


def test_a_scheduler_that_does_not_answer_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "ANSWER_S", 0.5)
    with pytest.raises(ValueError, match=r"--scheduler tcp://127\.0\.0\.1:1: expected the address"):
        run_trials([Sum("e", 1, tmp_path)], tmp_path / "out", scheduler="tcp://127.0.0.1:1")
