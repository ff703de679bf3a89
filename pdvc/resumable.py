"""Measure an experiment into a file; intermediate results are kept beside it while they are of use."""

from __future__ import annotations

import shutil
from pathlib import Path

from pdvc.experiment import Experiment
from pdvc.lock import held
from pdvc.measurement import Measurement
from pdvc.measurement_file import write_measurement
from pdvc.options import DEFAULT, MeasureOptions
from pdvc.progress import Progress, silent
from pdvc.protocol import measure


def measure_into(
    file: Path | str,
    experiment: Experiment,
    options: MeasureOptions = DEFAULT,
    *,
    work: Path | None = None,
    progress: Progress = silent,
) -> Measurement:
    """Measure and write the measurement; intermediate results go to `work`, by default to FILE.work beside the file.

    FILE.work is removed at the end, and where the input cannot be used. It stays where an interruption, or a failure
    of the machine, leaves something to go on from; the error's note says so.
    Raises ValueError for data that cannot be used, or whose result is not finite, InUseError where another process is
    at the same file.
    """
    file = Path(file)
    folder = work or file.with_name(file.name + ".work")
    new = not folder.exists()
    with held(folder):
        try:
            measurement = measure(experiment, options, progress=progress, work=folder)
            write_measurement(measurement, file)
        except ValueError:
            if work is None and new:
                shutil.rmtree(folder, ignore_errors=True)
            raise
        except BaseException as error:
            if any(path.suffix != ".partial" and not path.name.startswith(".") for path in folder.iterdir()):
                error.add_note(f"what was found so far is kept in {folder}, and the same command goes on from there")
            elif work is None:
                shutil.rmtree(folder, ignore_errors=True)
            raise
        if work is None:
            shutil.rmtree(folder, ignore_errors=True)
    return measurement
