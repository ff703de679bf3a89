"""The commands about one experiment: scenarios, options, simulate, inspect, measure, score, report, run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from validation.commands.parts import (
    ExperimentFolder,
    MeasurementFile,
    Options,
    ScenarioName,
    SelfCalibrate,
    Threads,
    answering,
    judge,
    read_options,
    tell,
    tell_scanner,
    use_threads,
)

if TYPE_CHECKING:
    from simulator.truth import Truth


def scenarios(
    name: Annotated[
        str | None, typer.Argument(metavar="[SCENARIO]", help="Print this one as TOML, to start your own from.")
    ] = None,
) -> None:
    """List the built-in scenarios, or print one as TOML with every key explained.

    Example:  `pdvc-bench scenarios quick > mine.toml`
    """
    with answering():
        from simulator.scenario import builtin_names, load_scenario

        if name is not None:
            print(load_scenario(name).template(), end="")
            return
        from rich.console import Console

        from validation.console import scenario_table

        Console().print(scenario_table(load_scenario(each) for each in builtin_names()))


def options(
    protocol: Annotated[str, typer.Argument(metavar="NAME", help="default, or paper: the paper's own.")] = "default",
) -> None:
    """Print a protocol of measuring as TOML, with every key explained.

    Example:  `pdvc-bench options > options.toml`, then change it and give it to --options.
    """
    with answering():
        print(read_options(protocol).template(), end="")


def simulate(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="The experiment folder to write.")],
    threads: Threads = None,
) -> None:
    """Carry out a scenario: write radiographs as a scanner would, and the truth apart from them.

    Example:  `pdvc-bench simulate quick -o out/quick/experiment`
    """
    with answering() as progress:
        from simulator.scanner import simulate as carry_out
        from simulator.scenario import load_scenario

        chosen = load_scenario(scenario)
        use_threads(threads)
        carry_out(chosen, out, progress=progress, workers=threads)
    tell(f"experiment: {out}")


def inspect(
    experiment: ExperimentFolder,
    options: Options = "default",
    picture: Annotated[Path, typer.Option("-o", "--out", metavar="PNG", help="Where the picture goes.")] = Path(
        "inspection.png"
    ),
    threads: Threads = None,
) -> None:
    """Look at a folder before it is measured: counts, air, angles, onset of loading, what to change.

    Example:  `pdvc-bench inspect out/quick/experiment`
    """
    with answering() as progress:
        from pdvc.experiment import read_experiment
        from pdvc.inspection import inspect as look
        from validation.report.inspection import inspection_figure, lines_of

        chosen, opened = read_options(options), read_experiment(experiment)
        use_threads(threads)
        found = look(opened, chosen, progress=progress)
        picture.parent.mkdir(parents=True, exist_ok=True)
        inspection_figure(found, opened).savefig(picture, dpi=120)
    from rich.console import Console

    from validation.console import inspection_table, say_doubts

    console = Console()
    console.print(inspection_table(str(experiment), lines_of(found, opened)))
    say_doubts(console, found.doubts)
    tell(f"picture: {picture}")


def measure(
    experiment: ExperimentFolder,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="The measurement to write (NetCDF).")],
    options: Options = "default",
    work: Annotated[
        Path | None,
        typer.Option(
            "--work",
            metavar="DIR",
            help="Keep intermediate results here. Unless given: beside FILE, and removed at the end.",
        ),
    ] = None,
    self_calibrate: SelfCalibrate = None,
    threads: Threads = None,
) -> None:
    """Measure the motion of the sample at every load step, from the radiographs alone.

    The folder may come from simulate or from a laboratory; the truth, if there is one, is not looked at. The last line
    is a verdict: trusted, doubtful or failed, with what speaks against the measurement. Exit code 3 says failed.

    Example:  `pdvc-bench measure out/quick/experiment -o motion.nc`
    """
    with answering() as progress:
        from pdvc.experiment import read_experiment
        from pdvc.resumable import measure_into
        from validation.console import used

        chosen = read_options(options, self_calibrate)
        opened = read_experiment(experiment)
        use_threads(threads)
        found = measure_into(out, opened, chosen, work=work, progress=progress)
    tell(used(found))
    tell_scanner(found)
    tell(f"measurement: {out}")
    judge(found)


def score(
    measurement: MeasurementFile,
    truth: Annotated[
        Path, typer.Option("--truth", metavar="DIR", help="The simulated experiment folder that was measured.")
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="JSON", help="Write the scores here, not to the terminal.")
    ] = None,
) -> None:
    """Compare a measurement with the truth: errors, bias, scatter and strain, as JSON.

    Example:  `pdvc-bench score motion.nc --truth out/quick/experiment`
    """
    with answering():
        from pdvc.measurement_file import read_measurement
        from validation.job import write_text
        from validation.scoring.scores import score as compare

        scores = compare(read_measurement(measurement), _read_truth(truth))
        if out is None:
            print(scores.to_json(), end="")
        else:
            write_text(out, scores.to_json())


def report(
    measurement: MeasurementFile,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Where report.html and figures/ go.")],
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="DIR", help="The simulated experiment folder that was measured."),
    ] = None,
    experiment: Annotated[
        Path | None,
        typer.Option(
            "--experiment", metavar="DIR", help="The experiment folder, to show radiographs, where no truth is."
        ),
    ] = None,
) -> None:
    """Write a self-contained page about a measurement, and its figures as files.

    Example:  `pdvc-bench report motion.nc --truth out/quick/experiment -o out/report`
    """
    with answering():
        from pdvc.experiment import read_experiment
        from pdvc.measurement_file import read_measurement
        from validation.report.page import write_report
        from validation.scoring.scores import score as compare

        opened = read_measurement(measurement)
        known = None if truth is None else _read_truth(truth)
        folder = experiment or truth
        page = write_report(
            out,
            opened,
            experiment=None if folder is None else read_experiment(folder),
            truth=known,
            scores=None if known is None else compare(opened, known),
        )
    tell(f"report: {page}")


def run(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Where everything goes.")],
    options: Options = "default",
    self_calibrate: SelfCalibrate = None,
    threads: Threads = None,
) -> None:
    """Simulate, measure, score and report, in one folder; what is finished already is not done again.

    Writes DIR/experiment/, measurement.nc, scores.json, report.html and figures/. Interrupted, it goes on where it
    was when the same command is given again.

    Example:  `pdvc-bench run quick -o out/quick`
    """
    with answering(resume="give the same command again to go on from here") as progress:
        from simulator.scenario import load_scenario
        from validation.job import Job
        from validation.job import run as do

        job = Job(
            scenario=load_scenario(scenario),
            options=read_options(options, self_calibrate),
            folder=out,
            workers=threads,
        )
        use_threads(threads)
        outcome = do(job, progress=progress)
    from rich.console import Console

    from validation.console import summary

    for part in outcome.reused:
        tell(f"{part}: finished before, kept")
    Console().print(summary(outcome.scores))
    tell_scanner(outcome.measurement)
    tell(f"report: {outcome.report}")
    judge(outcome.measurement)


def _read_truth(folder: Path) -> Truth:
    from simulator.truth import read_truth

    return read_truth(folder)
