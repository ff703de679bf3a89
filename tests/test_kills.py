"""Commands killed at random moments, three times in a row, and given again: the scores of an undisturbed one."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from benchmarks.faults import SCENARIO, TIMES, disturb, jobs, kill, outlived, rows_of, scores_of

MOMENTS = 3


@pytest.mark.parametrize("job", jobs(str(SCENARIO)), ids=lambda job: job.arguments[0])
def test_what_is_killed_and_given_again_finds_the_same_to_the_last_digit(tmp_path, job):
    tally = disturb(job, tmp_path, MOMENTS, np.random.default_rng(len(job.name)))
    assert tally.wrong == []
    assert tally.same == tally.folders
    assert tally.killed >= MOMENTS


def test_workers_end_with_the_command_that_is_killed(tmp_path):
    study = jobs()[1]
    leader = kill(study, tmp_path / "out", 0.2, alone=True)
    assert leader is not None
    # a worker that was just being started looks for its command before it does anything
    assert outlived(leader, 20.0) < 20.0


@pytest.mark.parametrize(
    ("change", "differs"), [(lambda text: text.replace("0.", "0.1", 1), True), (lambda text: text, False)]
)
def test_scores_are_compared_to_the_last_digit_and_without_times(tmp_path, change, differs):
    one, other = tmp_path / "one", tmp_path / "other"
    for folder in (one, other):
        folder.mkdir()
    text = (
        '{"strain_rms": 0.0123456789012345, "chi2_reduced": NaN, "seconds": {"simulate": %s}, "peak_memory_gib": %s}'
    )
    (one / "scores.json").write_text(text % (1.5, 0.5))
    (other / "scores.json").write_text(change(text) % (2.5, 0.75))
    assert (scores_of(one) != scores_of(other)) == differs
    assert not set(scores_of(one)) & set(TIMES)


def test_a_run_that_is_in_a_table_twice_is_found(tmp_path):
    (tmp_path / "runs").mkdir()
    row = pd.DataFrame({"key": ["a"], "status": ["done"], "reason": [""]})
    row.to_parquet(tmp_path / "runs" / "a.parquet")
    pd.concat([row, row]).to_parquet(tmp_path / "table.parquet")
    with pytest.raises(ValueError, match="expected every run once"):
        rows_of(tmp_path)
