"""A study from Python: how the error depends on the photons, over noise draws that share one sample.

    python examples/my_study.py out/my-study

The same as `pdvc-bench study STUDY.toml -o out/my-study`, which docs/studies.md explains. Killed, it goes on where it
was when it is started again.
"""

import sys
import tomllib
from pathlib import Path

from validation.batch.engine import run_trials
from validation.study.description import Study, trials_of
from validation.study.page import write_study_report
from validation.testing.small_cases import small_options, small_scenario

STUDY = """
name = "photons"
title = "How the error falls with photons"
scenario = "scenario.toml"
options = "options.toml"
repetitions = 2

[[factor]]
key = "scenario.detector.photons_per_pixel"
values = [500.0, 8000.0]
log = true
label = "photons per pixel"
"""


def main(folder: Path) -> None:
    """Run the study, and print the mean error of each combination."""
    folder.mkdir(parents=True, exist_ok=True)
    scenario = small_scenario()
    (folder / "scenario.toml").write_text(scenario.template())
    (folder / "options.toml").write_text(small_options(scenario).template())
    (folder / "study.toml").write_text(STUDY)

    study = Study.parse(tomllib.loads(STUDY), where="STUDY")
    table = run_trials(trials_of(study, folder / "study.toml"), folder, workers=1)
    page, _ = write_study_report(folder, study, STUDY, table, where="this machine")
    error = table.groupby("photons_per_pixel")["error_voxel_across_beam"].mean()
    print(error.to_string())
    print("page:", page)
    assert error[500.0] > error[8000.0]


if __name__ == "__main__":  # workers are processes, which import this file
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/my-study"))
