"""The commands about a test while it runs: play."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from validation.commands.parts import ExperimentFolder, answering, tell


def play(
    experiment: ExperimentFolder,
    to: Annotated[
        Path, typer.Option("--to", metavar="FOLDER", help="Where the radiographs arrive; made where there is none.")
    ],
    pace: Annotated[
        float,
        typer.Option("--pace", min=0.0, max=86400.0, metavar="S", help="Seconds between radiographs; 0: none."),
    ] = 2.0,
    first: Annotated[
        int, typer.Option("--from", min=0, metavar="STEP", help="Begin at this step, counted from 0.")
    ] = 0,
) -> None:
    """Play the test of an experiment folder into another one, radiograph by radiograph, as a scanner writes it.

    Each radiograph becomes a TIFF of its own, and then a line of FOLDER/radiographs.csv. One that is late delays none
    of those after it.

    Example:  `pdvc-bench play out/quick/experiment --to out/arriving`
    """
    with answering(resume="what was written stays; go on in another folder, with --from") as progress:
        from pdvc.experiment import read_experiment
        from pdvc.incoming import IncomingWriter

        test = read_experiment(experiment).test
        if first >= len(test):
            raise ValueError(f"--from: expected a step of the test, 0 to {len(test) - 1}, given {first}")
        writer = IncomingWriter(to)
        count = len(test) - first
        for n in paced(count, pace):
            step = first + n
            writer.write(step, test.counts[step], test.angle_rad[step], test.time_s[step], test.force_N[step])
            progress("radiographs", n + 1, count)
    tell(f"radiographs: {count}, in {to}")


def paced(
    count: int,
    pace_s: float,
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[int]:
    """Yield 0, 1, ... count - 1, each so many times `pace_s` after the start, or at once where that is past."""
    start_s = clock()
    for n in range(count):
        wait_s = start_s + n * pace_s - clock()
        if wait_s > 0:
            sleep(wait_s)
        yield n
