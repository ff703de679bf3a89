"""The commands about a test while it runs: prepare, live, play."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from validation.commands.parts import (
    ExperimentFolder,
    Options,
    SelfCalibrate,
    Threads,
    answering,
    check_folder,
    judge,
    read_options,
    tell,
    tell_scanner,
    use_threads,
)
from validation.commands.watching import PageBeside


def prepare(
    experiment: ExperimentFolder,
    work: Annotated[Path, typer.Option("--work", metavar="DIR", help="Where what is prepared is kept.")],
    options: Options = "default",
    self_calibrate: SelfCalibrate = None,
    threads: Threads = None,
) -> None:
    """Prepare a test that is to be followed while it runs, as soon as its reference scan is done.

    The folder needs no radiographs of the test yet, only what is planned of them in experiment.toml. Interrupted, it
    goes on where it was when the same command is given again.

    Example:  `pdvc-bench prepare out/quick/experiment --work out/ready`
    """
    with answering(resume="give the same command again to go on from here") as progress:
        from pdvc.experiment import read_experiment
        from pdvc.live import make_ready

        chosen = read_options(options, self_calibrate)
        use_threads(threads)
        check_folder("--work", work)
        make_ready(read_experiment(experiment, planned=True), chosen, work=work, progress=progress)
    tell(f"ready: {work}")


def live(
    experiment: ExperimentFolder,
    radiographs: Annotated[
        Path, typer.Option("--radiographs", metavar="FOLDER", help="Where the radiographs of the test arrive.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="The measurement to write (NetCDF).")],
    options: Options = "default",
    work: Annotated[
        Path | None,
        typer.Option("--work", metavar="DIR", help="What prepare has kept. Unless given: beside FILE, made first."),
    ] = None,
    idle: Annotated[
        float | None,
        typer.Option("--idle", min=0.0, metavar="S", help="The test is over when no more came for so many seconds."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the lines of the record on stdout, for another program.")
    ] = False,
    page: Annotated[
        bool, typer.Option("--page", help="Show the test on a page, as the command page does, until it is over.")
    ] = False,
    self_calibrate: SelfCalibrate = None,
    threads: Threads = None,
) -> None:
    """Follow a test while it runs: the motion of each radiograph, with its interval, as soon as it has come.

    Adds a line to FILE.record.jsonl for each radiograph in FOLDER (see play), and measures the whole test into FILE
    when all that are planned in experiment.toml are in. Killed, it goes on where it was when the same command is given
    again. page and watch show the test meanwhile.

    Example:  `pdvc-bench live out/quick/experiment --radiographs out/arriving --work out/ready -o out/motion.nc`
    """
    # as long as bars are drawn, what is printed goes to the terminal, above them
    stdout = sys.stdout
    with answering(resume="give the same command again to go on from here") as progress:
        from pdvc.experiment import read_experiment
        from pdvc.incoming import check_arriving
        from pdvc.live import follow
        from pdvc.record import Line, record_of
        from validation.view.pictures import Pictures
        from validation.view.places import Places

        places = Places(file=out)
        pictures = Pictures(places.pictures, radiographs, tell)

        def show(line: Line) -> None:
            if page:
                shown.start()
            if as_json:
                print(line.text(), file=stdout, flush=True)
            else:
                print(line.words(), flush=True)
            pictures.tell(line)

        chosen, planned = read_options(options, self_calibrate), read_experiment(experiment, planned=True)
        use_threads(threads)
        # what would be told in the end, hours later, or once all is prepared
        if out.is_dir():
            raise ValueError(f"{out}: expected a file to write, found a folder")
        if work is not None:
            check_folder("--work", work)
        check_arriving(radiographs)
        idle_s = float("inf") if idle is None else idle
        with PageBeside(out) as shown:
            # before there is a plan there is nothing to show
            if page and places.record.is_file() and places.record.stat().st_size:
                shown.start()
            found = follow(
                *(planned, radiographs, out, chosen),
                work=work,
                progress=progress,
                tell=show,
                see=pictures.see,
                idle_s=idle_s,
            )
    tell_scanner(found)
    tell(f"record: {record_of(out)}")
    tell(f"measurement: {out}")
    judge(found)


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
