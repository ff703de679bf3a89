"""The command line, pdvc-bench; what takes long to import is imported by the command that needs it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pdvc.measure import MeasureOptions
    from pdvc.measurement import Measurement
    from simulator.truth import Truth
    from validation.console import ProgressBars

app = typer.Typer(
    name="pdvc-bench",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    help="""Measure the motion of a sample from one radiograph per load step (P-DVC), and know how far to trust it.

    A **scenario** describes an experiment whose truth is known; **simulate** carries it out; **measure**
    recovers the motion from the radiographs alone; **score** compares both; **run** does all in turn. A
    **study** runs many and varies what they have; **compare** lets several methods measure the same.

    Start with:  `pdvc-bench run quick -o out/quick`

    Your own radiographs:  `pdvc-bench measure my-experiment -o motion.nc`
    """,
)

debugging = False

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


@app.callback()
def _common(
    debug: Annotated[bool, typer.Option("--debug", help="Show the whole traceback of an error.")] = False,
) -> None:
    global debugging
    debugging = debug


@app.command()
def scenarios(
    name: Annotated[
        str | None, typer.Argument(metavar="[SCENARIO]", help="Print this one as TOML, to start your own from.")
    ] = None,
) -> None:
    """List the built-in scenarios, or print one as TOML with every key explained.

    Example:  `pdvc-bench scenarios quick > mine.toml`
    """
    with _answering():
        from simulator.scenario import builtin_names, load_scenario

        if name is not None:
            print(load_scenario(name).template(), end="")
            return
        from rich.console import Console

        from validation.console import scenario_table

        Console().print(scenario_table(load_scenario(each) for each in builtin_names()))


@app.command()
def options(
    protocol: Annotated[str, typer.Argument(metavar="NAME", help="default, or paper: the paper's own.")] = "default",
) -> None:
    """Print a protocol of measuring as TOML, with every key explained.

    Example:  `pdvc-bench options > options.toml`, then change it and give it to --options.
    """
    with _answering():
        print(_read_options(protocol).template(), end="")


@app.command()
def simulate(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="The experiment folder to write.")],
    threads: Threads = None,
) -> None:
    """Carry out a scenario: write radiographs as a scanner would, and the truth apart from them.

    Example:  `pdvc-bench simulate quick -o out/quick/experiment`
    """
    with _answering() as progress:
        from simulator.scanner import simulate as carry_out
        from simulator.scenario import load_scenario

        chosen = load_scenario(scenario)
        _use_threads(threads)
        carry_out(chosen, out, progress=progress, workers=threads)
    _tell(f"experiment: {out}")


@app.command()
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
    with _answering() as progress:
        from pdvc.experiment import read_experiment
        from validation.inspection import inspect as look
        from validation.inspection import lines_of
        from validation.inspection_figure import inspection_figure

        chosen, opened = _read_options(options), read_experiment(experiment)
        _use_threads(threads)
        found = look(opened, chosen, progress=progress)
        picture.parent.mkdir(parents=True, exist_ok=True)
        inspection_figure(found, opened).savefig(picture, dpi=120)
    from rich.console import Console

    from validation.console import inspection_table, say_doubts

    console = Console()
    console.print(inspection_table(str(experiment), lines_of(found, opened)))
    say_doubts(console, found.doubts)
    _tell(f"picture: {picture}")


@app.command()
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
    threads: Threads = None,
) -> None:
    """Measure the motion of the sample at every load step, from the radiographs alone.

    The folder may come from simulate or from a laboratory; the truth, if there is one, is not looked at. The last line
    is a verdict: trusted, doubtful or failed, with what speaks against the measurement. Exit code 3 says failed.

    Example:  `pdvc-bench measure out/quick/experiment -o motion.nc`
    """
    with _answering() as progress:
        from pdvc.experiment import read_experiment
        from validation.console import used
        from validation.measuring import measure_into

        chosen = _read_options(options)
        opened = read_experiment(experiment)
        _use_threads(threads)
        found = measure_into(out, opened, chosen, work=work, progress=progress)
    _tell(used(found))
    _tell(f"measurement: {out}")
    _judge(found)


@app.command()
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
    with _answering():
        from pdvc.measurement import read_measurement
        from validation.run import write_text
        from validation.scores import score as compare

        scores = compare(read_measurement(measurement), _read_truth(truth))
        if out is None:
            print(scores.to_json(), end="")
        else:
            write_text(out, scores.to_json())


@app.command()
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
    with _answering():
        from pdvc.experiment import read_experiment
        from pdvc.measurement import read_measurement
        from validation.report import write_report
        from validation.scores import score as compare

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
    _tell(f"report: {page}")


@app.command()
def run(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Where everything goes.")],
    options: Options = "default",
    threads: Threads = None,
) -> None:
    """Simulate, measure, score and report, in one folder; what is finished already is not done again.

    Writes DIR/experiment/, measurement.nc, scores.json, report.html and figures/. Interrupted, it goes on where it
    was when the same command is given again.

    Example:  `pdvc-bench run quick -o out/quick`
    """
    with _answering(resume="give the same command again to go on from here") as progress:
        from simulator.scenario import load_scenario
        from validation.run import Job
        from validation.run import run as do

        job = Job(
            scenario=load_scenario(scenario),
            options=_read_options(options),
            folder=out,
            workers=threads,
        )
        _use_threads(threads)
        outcome = do(job, progress=progress)
    from rich.console import Console

    from validation.console import summary

    for part in outcome.reused:
        _tell(f"{part}: finished before, kept")
    Console().print(summary(outcome.scores))
    _tell(f"report: {outcome.report}")
    _judge(outcome.measurement)


@app.command()
def compare(
    scenarios: Annotated[
        list[str],
        typer.Argument(metavar="SCENARIO...", help="Built-in names (see: scenarios), or paths of TOML files."),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Where everything goes.")],
    methods: Annotated[
        str | None,
        typer.Option(
            "--methods",
            metavar="NAME,...",
            help="Which methods, separated by commas; unless given: all that are installed, but for spam.",
        ),
    ] = None,
    repetitions: Annotated[
        int,
        typer.Option("--repetitions", min=1, metavar="N", help="Noise draws of each scenario; three give intervals."),
    ] = 3,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Let several methods measure the same experiments, and set their errors against what they cost.

    Writes DIR/comparison.html, figures/, and tables as CSV, Parquet, Markdown and LaTeX. Methods that need full scans
    get a few at interruptions of the test. Interrupted, it goes on where it was when the same command is given again.

    Example:  `pdvc-bench compare quick --methods pgd,weighted,each-step -o out/compare`
    """
    with _answering(resume="give the same command again to go on from here") as progress:
        from simulator.scenario import load_scenario
        from validation.compare import Comparison
        from validation.compare import compare as do
        from validation.methods import default_methods, find_method

        names = default_methods() if methods is None else [name.strip() for name in methods.split(",")]
        comparison = Comparison(
            scenarios=tuple(load_scenario(name) for name in scenarios),
            methods=tuple(find_method(name) for name in names),
            repetitions=repetitions,
        )
        comparison.check()
        for name, note in comparison.notes().items():
            _tell(f"{name}: {note[0].lower()}{note[1:]}")
        page = do(comparison, out, scheduler=scheduler, workers=workers, progress=progress)
    print((out / "methods.md").read_text(encoding="utf-8"), end="")
    _tell(f"comparison: {page}")


@app.command()
def studies(
    name: Annotated[
        str | None, typer.Argument(metavar="[STUDY]", help="Print this one as TOML, to start your own from.")
    ] = None,
) -> None:
    """List the built-in studies, or print one as TOML.

    Example:  `pdvc-bench studies noise > mine.toml`
    """
    with _answering():
        from validation.study import Study, builtin_studies, study_file

        if name is not None:
            Study.read(study_file(name))
            print(study_file(name).read_text(encoding="utf-8"), end="")
            return
        from rich.console import Console

        from validation.console import study_table

        Console().print(study_table(Study.read(study_file(each)) for each in builtin_studies()))


@app.command()
def study(
    study: Annotated[
        str, typer.Argument(metavar="STUDY", help="A built-in name (see: studies), or the path of a TOML file.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Where everything goes.")],
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Simulate and measure many experiments that differ in chosen factors, and show how the error depends on these.

    Writes a row for each run as soon as it is finished, and at the end DIR/table.parquet, summary.csv, figures/ and
    study.html. Interrupted or killed, it goes on where it was when the same command is given again.

    Example:  `pdvc-bench study noise -o out/noise`
    """
    with _answering(resume="give the same command again to go on from here") as progress:
        from pdvc.lock import held
        from validation.paired import counted
        from validation.runs import run_trials
        from validation.study import Study, study_file, trials_of
        from validation.study_report import machine, write_study_report

        path = study_file(study)
        chosen = Study.read(path)
        trials = trials_of(chosen, path)
        if scheduler is not None and workers is not None:
            raise ValueError("--workers: expected without --scheduler, which has its own workers")
        with held(out):
            table = run_trials(trials, out, scheduler=scheduler, workers=workers, progress=progress)
            page, summary = write_study_report(
                out, chosen, path.read_text(encoding="utf-8"), table, where=machine(scheduler, workers)
            )
    from rich.console import Console

    from validation.console import study_summary

    Console().print(study_summary(chosen, summary))
    failed = int((table["status"] != "done").sum())
    if failed:
        _tell(f"{failed} of {len(table)} runs failed: see the reasons in {page}, or {out / 'failed'}")
    doubted = int((table["verdict"].dropna() != "trusted").sum())
    if doubted:
        _tell(f"{doubted} of {len(table)} measurements are doubted: {counted(table['doubts'].dropna())}")
    _tell(f"report: {page}")


@app.command()
def plan(
    scenario: ScenarioName,
    options: Options = "default",
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="CSV", help="Write the designs here, too, as a table.")
    ] = None,
    threads: Threads = None,
) -> None:
    """Tell what to expect of a test before it is made, and which motions it would not show.

    From the reference scan's sensitivities alone: the standard deviations of the scenario as it is, and with other
    numbers of radiographs a turn, turns, frames, flats and sections. They hold noise and prior, not model errors.

    Example:  `pdvc-bench plan quick`
    """
    with _answering() as progress:
        from simulator.scenario import load_scenario
        from validation.plan import plan as work_out
        from validation.plan_tables import designs_csv, designs_table, weak_table
        from validation.run import write_text

        chosen, read = load_scenario(scenario), _read_options(options)
        _use_threads(threads)
        found = work_out(chosen, read, progress=progress)
        if out is not None:
            write_text(out, designs_csv(found))
    from rich.console import Console

    console = Console()
    console.print(designs_table(found, chosen))
    console.print(weak_table(found))
    if out is not None:
        _tell(f"table: {out}")


def _judge(measurement: Measurement) -> None:
    """Print a verdict on stderr; end with exit code 3 where the measurement failed."""
    from rich.console import Console

    from validation.console import NOT_BELIEVED, say_verdict

    say_verdict(Console(stderr=True), measurement.verdict)
    if measurement.verdict.word == "failed":
        raise typer.Exit(NOT_BELIEVED)


def _read_truth(folder: Path) -> Truth:
    from simulator.truth import read_truth

    return read_truth(folder)


def _read_options(name: str) -> MeasureOptions:
    from pdvc.options import PROTOCOLS, MeasureOptions

    return PROTOCOLS[name]() if name in PROTOCOLS else MeasureOptions.read(Path(name))


def _use_threads(count: int | None) -> None:
    if count is None:
        return
    import numba

    most = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    if count > most:
        raise ValueError(f"--threads: expected 1 to {most} on this machine, given {count}")
    numba.set_num_threads(count)


@contextmanager
def _answering(resume: str = "nothing half-written was left under its final name") -> Iterator[ProgressBars]:
    """Show progress on stderr, and errors there in one line."""
    from rich.console import Console

    from validation.console import ProgressBars, one_line_errors

    console = Console(stderr=True)
    with one_line_errors(console, resume=resume, debug=debugging), ProgressBars(console) as progress:
        yield progress


def _tell(text: str) -> None:
    print(text, file=sys.stderr)


if __name__ == "__main__":
    app()
