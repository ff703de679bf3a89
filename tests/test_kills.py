"""Commands killed at random moments, twice in a row, and given again: the scores of an undisturbed one.

Once with all their processes, once alone. `make faults` kills them thirty times each.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from benchmarks.faults import SCENARIO, TIMES, disturb, jobs, kill, outlived, rows_of, scores_of

RUN, STUDY, COMPARISON = jobs(str(SCENARIO))
ONE_DRAW = replace(COMPARISON, arguments=(*COMPARISON.arguments[:4], "--repetitions", "1", "--workers", "1"))
"""A comparison goes on as a study does, by the same engine: it is killed once, with its worker."""


# most of what these take is to start: the kernels are loaded by every process anew
@pytest.mark.parametrize(("job", "moments"), [(RUN, 2), (STUDY, 2), (ONE_DRAW, 1)], ids=["run", "study", "compare"])
def test_what_is_killed_and_given_again_finds_the_same_to_the_last_digit(tmp_path, job, moments):
    tally = disturb(job, tmp_path, moments, np.random.default_rng(len(job.name)))
    assert tally.wrong == []
    assert tally.same == tally.folders
    assert tally.killed >= moments


def test_workers_end_with_the_command_that_is_killed(tmp_path):
    leader = kill(STUDY, tmp_path / "out", 0.2, alone=True)
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
