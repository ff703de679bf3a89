"""The commands that go through a measured test step by step: replay, movie."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from validation.commands.parts import MeasurementFile, answering, tell

if TYPE_CHECKING:
    from validation.report.steps import Steps

ExperimentOf = Annotated[
    Path | None,
    typer.Option("--experiment", metavar="DIR", help="The experiment folder that was measured, for its radiographs."),
]
TruthOf = Annotated[
    Path | None,
    typer.Option("--truth", metavar="DIR", help="The same of a simulated one: the truth is shown, too."),
]


def replay(
    measurement: MeasurementFile,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="HTML", help="The page to write.")],
    experiment: ExperimentOf = None,
    truth: TruthOf = None,
) -> None:
    """Write a self-contained page whose slider moves through the steps: radiograph, residual and profiles together.

    It needs no network and no server: send it, and open it in any browser. Arrow keys go from step to step.

    Example:  `pdvc-bench replay motion.nc --experiment mine -o replay.html`
    """
    with answering() as progress:
        from validation.report.replay import write_replay

        pictures = write_replay(out, _steps(measurement, experiment, truth), progress=progress)
    if pictures.binning > 1:
        tell(f"images: reduced, a pixel is the mean of {pictures.binning} x {pictures.binning}")
    tell(f"page: {out}, {out.stat().st_size / 1e6:.1f} MB")


def movie(
    measurement: MeasurementFile,
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="GIF|MP4", help="The movie to write; .mp4 needs the program ffmpeg.")
    ],
    experiment: ExperimentOf = None,
    truth: TruthOf = None,
    every: Annotated[int, typer.Option("--every", min=1, metavar="N", help="Show every N-th step.")] = 1,
    speed: Annotated[
        float, typer.Option("--speed", min=0.1, max=50, metavar="N", help="Frames shown in a second.")
    ] = 10.0,
) -> None:
    """Write a movie of the test: radiograph, residual, vertical displacement and strain with their 95 % bands.

    Example:  `pdvc-bench movie motion.nc --experiment mine -o movie.gif`
    """
    with answering() as progress:
        from validation.report.movie import movie_writer, write_movie

        # a wrong name, or no ffmpeg, is answered before anything is read
        movie_writer(out, speed)
        write_movie(out, _steps(measurement, experiment, truth), every=every, steps_per_s=speed, progress=progress)
    tell(f"movie: {out}, {out.stat().st_size / 1e6:.1f} MB")


def _steps(measurement: Path, experiment: Path | None, truth: Path | None) -> Steps:
    """Read what is shown."""
    from pdvc.experiment import read_experiment
    from pdvc.measurement_file import read_measurement
    from validation.report.steps import Steps

    folder = experiment or truth
    if folder is None:
        raise ValueError(
            "--experiment: expected the folder that was measured, whose radiographs are shown, or --truth"
        )
    known = None
    if truth is not None:
        from simulator.truth import read_truth

        known = read_truth(truth)
    return Steps(measurement=read_measurement(measurement), experiment=read_experiment(folder), truth=known)
