"""One trial: what identifies it, what it shares, and that sharing changes nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from tests.tiny_scenarios import trial
from validation.batch import trial as room
from validation.batch.trial import BOUND_COLUMNS, RECOVERY_COLUMNS, Volumes, clean_parts, score_columns


def without_times(scores):
    return {name: value for name, value in scores.items() if not name.startswith("seconds")}


def stamps(folder):
    """Return when each stack, outline, volume and stage of a shared folder was written."""
    return {path.name: path.stat().st_mtime_ns for path in folder.rglob("*") if path.suffix in (".npy", ".kept")}


def test_sharing_changes_nothing(tmp_path):
    other = trial({"sections": 4}, acquisition={"steps_per_turn": 11})
    for part in (*clean_parts(other.scenario), Volumes(other.scenario, other.options)):
        part.make(tmp_path / "shared")
    one = trial({"sections": 5})
    kept = stamps(tmp_path / "shared")
    shared, alone = one.carry_out(tmp_path / "shared"), one.carry_out(tmp_path / "alone")
    assert without_times(shared.scores) == without_times(alone.scores)
    for name in ("points", "strain"):
        np.testing.assert_array_equal(shared.arrays[name], alone.arrays[name])
    now = stamps(tmp_path / "shared")
    # reference stack, outline and volumes were found; only the test's radiographs and its modes are new
    assert {name: now[name] for name in kept} == kept
    assert {name.split("-")[0] for name in now.keys() - kept.keys()} == {"test", "stage", "pattern"}
    assert not list((tmp_path / "shared").glob("experiment-*"))
    self_consistent(shared)


def self_consistent(result):
    columns = {**score_columns(), **dict.fromkeys((*BOUND_COLUMNS.values(), *RECOVERY_COLUMNS), float)}
    assert set(result.scores) == set(columns)
    for name, kind in columns.items():
        assert isinstance(result.scores[name], kind), name
    rms = np.sqrt(np.nanmean(result.arrays["points"].astype(float) ** 2, axis=(0, 1)))
    for value, name in zip(rms, ("across_beam", "vertical", "along_beam"), strict=True):
        # the scores take all heights, the arrays those about a section apart
        assert value == pytest.approx(result.scores[f"error_voxel_{name}"], rel=0.2)
    strain = np.sqrt(np.nanmean(result.arrays["strain"].astype(float) ** 2))
    assert strain == pytest.approx(result.scores["strain_rms"], rel=1e-5)


@pytest.mark.parametrize(
    ("other", "same_key", "same_volumes"),
    [
        (trial(name="other", title="other"), True, True),
        (trial({"sections": 5}), False, True),
        (trial(motion={"ingredients": []}), False, True),
        (trial(repetition=1), False, False),
        (trial(detector={"frames": 2}), False, False),
        (trial(acquisition={"reference_views": 61}), False, False),
        (trial({"beam_hardening": "none"}), False, False),
    ],
)
def test_keys_and_shared_volumes(other, same_key, same_volumes):
    assert (trial().key == other.key) == same_key
    volumes = [Volumes(each.scenario, each.options).name for each in (trial(), other)]
    assert (volumes[0] == volumes[1]) == same_volumes


def test_the_factors_are_no_part_of_the_key():
    assert replace(trial(), factors={"noise": 1.0}).key == trial().key


def test_a_score_that_fits_no_column_is_named(monkeypatch):
    @dataclass
    class Odd:
        spread: tuple

    monkeypatch.setattr(room, "Scores", Odd)
    with pytest.raises(TypeError, match=r"Scores\.spread: expected a number"):
        score_columns()
