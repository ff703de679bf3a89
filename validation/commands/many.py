"""The commands about many experiments at once: compare, studies, study, plan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from validation.commands.identifying import study_of_laws, tell_planned_law
from validation.commands.parts import (
    Options,
    Scheduler,
    Threads,
    Workers,
    answering,
    read_options,
    tell,
    use_threads,
)


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
    with answering(resume="give the same command again to go on from here") as progress:
        from simulator.scenario import load_scenario
        from validation.compare.comparison import Comparison
        from validation.compare.comparison import compare as do
        from validation.methods.registry import default_methods, find_method

        names = default_methods() if methods is None else [name.strip() for name in methods.split(",")]
        comparison = Comparison(
            scenarios=tuple(load_scenario(name) for name in scenarios),
            methods=tuple(find_method(name) for name in names),
            repetitions=repetitions,
        )
        comparison.check()
        for name, note in comparison.notes().items():
            tell(f"{name}: {note[0].lower()}{note[1:]}")
        page = do(comparison, out, scheduler=scheduler, workers=workers, progress=progress)
    print((out / "methods.md").read_text(encoding="utf-8"), end="")
    tell(f"comparison: {page}")


def studies(
    name: Annotated[
        str | None, typer.Argument(metavar="[STUDY]", help="Print this one as TOML, to start your own from.")
    ] = None,
) -> None:
    """List the built-in studies, or print one as TOML.

    Example:  `pdvc-bench studies noise > mine.toml`
    """
    with answering():
        from validation.study.description import Study, builtin_studies, study_file

        if name is not None:
            Study.read(study_file(name))
            print(study_file(name).read_text(encoding="utf-8"), end="")
            return
        from rich.console import Console

        from validation.console import study_table

        Console().print(study_table(Study.read(study_file(each)) for each in builtin_studies()))


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
    study.html; of a study of laws table.csv, recovery.csv and laws.csv. Interrupted or killed, it goes on where it was
    when the same command is given again.

    Example:  `pdvc-bench study noise -o out/noise`
    """
    with answering(resume="give the same command again to go on from here") as progress:
        from pdvc.lock import held
        from validation.batch.doubts import doubted
        from validation.batch.engine import run_trials
        from validation.batch.machine import machine
        from validation.study.description import Study, study_file, trials_of
        from validation.study.page import write_study_report

        path = study_file(study)
        chosen = Study.read(path)
        trials = trials_of(chosen, path)
        if scheduler is not None and workers is not None:
            raise ValueError("--workers: expected without --scheduler, which has its own workers")
        if chosen.laws:
            study_of_laws(chosen, trials, out, scheduler, workers, progress)
            return
        with held(out):
            table = run_trials(trials, out, scheduler=scheduler, workers=workers, progress=progress)
            page, summary = write_study_report(
                out, chosen, path.read_text(encoding="utf-8"), table, where=machine(scheduler, workers)
            )
    from rich.console import Console

    from validation.console import honesty_table, influence_tables, resolved_table, study_summary
    from validation.study.coverage import honesty
    from validation.study.page import influence_heads, influence_rows
    from validation.study.resolution import resolutions
    from validation.study.sensitivity import influences
    from validation.study.summary import mean_scores

    resolved = resolutions(chosen, table, out)
    mattering = influences(chosen, summary, mean_scores(chosen, table))
    if resolved:
        Console().print(resolved_table(chosen, resolved))
    elif mattering:
        for each in influence_tables(chosen, influence_heads(chosen, mattering), influence_rows(chosen, mattering)):
            Console().print(each)
    elif chosen.pooled:
        for found in honesty(chosen, table):
            Console().print(honesty_table(chosen, found))
    else:
        Console().print(study_summary(chosen, summary))
    failed = int((table["status"] != "done").sum())
    if failed:
        tell(f"{failed} of {len(table)} runs failed: see the reasons in {page}, or {out / 'failed'}")
    number, reasons = doubted(table)
    if number:
        tell(f"{number} of {len(table)} measurements are doubted: {reasons}")
    tell(f"report: {page}")


def plan(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO|DIR",
            help="A built-in name or TOML file, or an experiment folder with a reference scan and a planned test.",
        ),
    ],
    options: Options = "default",
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="CSV", help="Write the designs here, too, as a table.")
    ] = None,
    law: Annotated[
        str | None,
        typer.Option(
            "--law",
            metavar="NAME",
            help="Tell instead how well the parameters of a law would be known: of this test, with unloadings, and "
            "slower near yield.",
        ),
    ] = None,
    threads: Threads = None,
) -> None:
    """Tell what to expect of a test before it is made, and which motions it would not show.

    From the reference scan's sensitivities alone: the standard deviations of the test as it is, and with other
    numbers of radiographs a turn, turns, frames, flats and sections. They hold noise and prior, not model errors.

    The reference scan is simulated, or that of an experiment folder whose test/radiographs.tif need not be there:
    then `test` in experiment.toml says which angles, times and forces are planned.

    With --law it tells instead how well a law's parameters would be known, for other force programmes, too.

    Example:  `pdvc-bench plan quick`
    """
    if law is not None:
        tell_planned_law(scenario, law, options, out, threads)
        return
    with answering() as progress:
        from pdvc.experiment import DESCRIPTION, read_experiment
        from validation.job import write_text
        from validation.plan.designs import plan_experiment
        from validation.plan.tables import designs_csv, designs_table, weak_table

        read = read_options(options)
        folder = Path(scenario)
        if (folder / DESCRIPTION).is_file():
            experiment = read_experiment(folder, planned=True)
            use_threads(threads)
            name, found = experiment.title or str(folder), plan_experiment(experiment, read, progress=progress)
        else:
            from simulator.scenario import load_scenario
            from validation.plan.simulated import plan as work_out

            chosen = load_scenario(scenario)
            use_threads(threads)
            name, found = chosen.name, work_out(chosen, read, progress=progress)
        if out is not None:
            write_text(out, designs_csv(found))
    from rich.console import Console

    from validation.console import say_doubts

    console = Console()
    console.print(designs_table(found, name))
    console.print(weak_table(found))
    say_doubts(console, found.doubts)
    if out is not None:
        tell(f"table: {out}")
