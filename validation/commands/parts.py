"""What the commands of the command line have in common: arguments, progress, errors in one line."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pdvc.measurement import Measurement
    from pdvc.options import MeasureOptions
    from validation.console import ProgressBars

ScenarioName = Annotated[
    str, typer.Argument(metavar="SCENARIO", help="A built-in name (see: scenarios), or the path of a TOML file.")
]
ExperimentFolder = Annotated[
    Path, typer.Argument(metavar="DIR", help="An experiment folder: experiment.toml and its TIFF stacks.")
]
MeasurementFile = Annotated[Path, typer.Argument(metavar="FILE", help="A measurement, as written by measure.")]
Options = Annotated[
    str,
    typer.Option(
        "--options",
        metavar="NAME|TOML",
        help="How to measure: a built-in protocol, default or paper, or a TOML file such as 'options' prints.",
    ),
]
SelfCalibrate = Annotated[
    str | None,
    typer.Option(
        "--self-calibrate",
        metavar="none|geometry|motion",
        help="Correct the scanner by the reference scan itself: axis and roll, or these and motion of its views. "
        "Unless given: as --options says, none by default.",
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        "--threads", min=1, metavar="N", help="Processor cores to use; all, unless given. Changes no result."
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", min=1, metavar="N", help="Processes on this machine, one thread each; one for each processor."
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler", metavar="ADDRESS", help="A Dask scheduler to send the work to; its workers see DIR too."
    ),
]


class Debugging:
    """Whether errors are shown with their traceback: --debug."""

    on = False


def judge(measurement: Measurement) -> None:
    """Print a verdict on stderr; end with exit code 3 where the measurement failed."""
    from rich.console import Console

    from validation.console import NOT_BELIEVED, say_verdict

    say_verdict(Console(stderr=True), measurement.verdict)
    if measurement.verdict.word == "failed":
        raise typer.Exit(NOT_BELIEVED)


def read_options(name: str, self_calibrate: str | None = None) -> MeasureOptions:
    """Return a built-in protocol by its name, or the options of a TOML file; self-calibrated otherwise, if given."""
    from pdvc.options import PROTOCOLS, MeasureOptions

    found = PROTOCOLS[name]() if name in PROTOCOLS else MeasureOptions.read(Path(name))
    if self_calibrate is None:
        return found
    asked = MeasureOptions.parse({"self_calibration": self_calibrate}, where="--self-calibrate")
    return found.model_copy(update={"self_calibration": asked.self_calibration})


def tell_scanner(measurement: Measurement) -> None:
    """Print on stderr what was found of the scanner, and left out, where it was asked for."""
    for line in measurement.correction.lines if measurement.correction else ():
        tell(f"self-calibration: {line}")
    beam = measurement.recording.brightness
    if beam is not None:
        tell(
            f"brightness: {beam[:, 0].min():.4f} to {beam[:, 0].max():.4f} of the flats, "
            f"+- {beam[:, 1].max():.4f} at most, told by air"
        )
    elif 'brightness = "air"' in measurement.provenance.options:
        tell("brightness: no air is seen beside the sample, taken to be that of the flats")
    outliers = measurement.fit.outliers
    if outliers is not None:
        of_step = outliers.sum(axis=(1, 2))
        tell(f"outliers: {of_step.sum()} pixels of {(of_step > 0).sum()} radiographs left out")


def use_threads(count: int | None) -> None:
    """Let numba use so many threads; raises ValueError where the machine has fewer."""
    if count is None:
        return
    import numba

    most = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    if count > most:
        raise ValueError(f"--threads: expected 1 to {most} on this machine, given {count}")
    numba.set_num_threads(count)


def check_folder(option: str, folder: Path) -> None:
    """Raise ValueError where what an option names is to be a folder, and is a file."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{option}: expected a folder, or none yet, found {folder}, a file")


@contextmanager
def answering(resume: str = "nothing half-written was left under its final name") -> Iterator[ProgressBars]:
    """Show progress on stderr, and errors there in one line."""
    from rich.console import Console

    from validation.console import ProgressBars, one_line_errors

    console = Console(stderr=True)
    with one_line_errors(console, resume=resume, debug=Debugging.on), ProgressBars(console) as progress:
        yield progress


def tell(text: str) -> None:
    """Print a line on stderr."""
    print(text, file=sys.stderr)
