"""The commands about laws: identify one, and many draws of an experiment whose law is known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from validation.commands.parts import (
    ExperimentFolder,
    ScenarioName,
    Threads,
    Workers,
    answering,
    read_options,
    tell,
    use_threads,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from rich.table import Table

    from pdvc.identify.options import IdentifyOptions
    from pdvc.progress import Progress
    from simulator.scenario import Scenario
    from validation.batch.trial import Trial
    from validation.study.description import Study

Laws = Annotated[
    list[str] | None,
    typer.Option(
        "--law",
        metavar="NAME",
        help="The law: ludwik, voce, ramberg-osgood, swift, linear, multi-voce, or yours. Again: laws to compare it "
        "with. Unless given: ludwik, compared with all others.",
    ),
]
Stroke = Annotated[
    float | None,
    typer.Option(
        "--stroke",
        metavar="MM_PER_S",
        help="Rate of the crosshead from the onset of loading on; without it nothing is said of the machine.",
    ),
]


def identify(
    experiment: ExperimentFolder,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="The identification to write (NetCDF).")],
    measurement: Annotated[
        Path | None,
        typer.Option(
            "--measurement",
            metavar="FILE",
            help="A measurement of this experiment. Unless given: it is measured first.",
        ),
    ] = None,
    law: Laws = None,
    stroke: Stroke = None,
    until: Annotated[
        int | None, typer.Option("--until", min=4, metavar="N", help="Use the first N steps only; all, unless given.")
    ] = None,
    options: Annotated[
        Path | None,
        typer.Option("--identify-options", metavar="TOML", help="All options of an identification; those above win."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="DIR", help="Where report.html and figures/ go; none, unless given."),
    ] = None,
    truth: Annotated[
        bool, typer.Option("--truth", help="Show the true law of a simulated experiment in the report.")
    ] = False,
    threads: Threads = None,
) -> None:
    """Identify an elastoplastic law: its parameters with 95 % intervals, and what speaks against it.

    Radiographs and recorded force are taken together in one likelihood; beside it stand two-step identifications from
    the measured motion and, with --stroke, one from force and crosshead alone.

    Example:  `pdvc-bench identify out/quick/experiment --measurement out/quick/measurement.nc -o law.nc`
    """
    with answering() as progress:
        from pdvc.experiment import read_experiment
        from pdvc.identify.options import IdentifyOptions
        from pdvc.identify.protocol import identify as find
        from pdvc.identify.result import write_identification
        from pdvc.measurement_file import read_measurement
        from pdvc.resumable import measure_into
        from validation.identify.page import write_page

        asked = options_of(IdentifyOptions() if options is None else IdentifyOptions.read(options), law, stroke, until)
        opened = read_experiment(experiment)
        scenario = _scenario_of(experiment) if truth else None
        use_threads(threads)
        if measurement is None:
            measured = measure_into(out.with_name(out.stem + "-motion.nc"), opened, progress=progress)
        else:
            measured = read_measurement(measurement)
        found = find(opened, measured, asked, progress=progress)
        write_identification(found, out)
        page = None if report is None else write_page(report, found, scenario)
    from rich.console import Console

    from validation.identify.tables import compliance_sentence, evidence_sentence, parameter_rows, seen_sentences

    console = Console()
    console.print(_table(["parameter", "method", "value", "95 %"], [row[:4] for row in parameter_rows(found)]))
    for sentence in (evidence_sentence(found), compliance_sentence(found), *seen_sentences(found)):
        console.print(sentence, highlight=False, soft_wrap=True)
    for doubt in found.doubts():
        console.print(f"doubt: {doubt}", highlight=False, soft_wrap=True)
    tell(f"identification: {out}")
    if page is not None:
        tell(f"report: {page}")


def identify_draws(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Where everything goes.")],
    draws: Annotated[int, typer.Option("--draws", min=1, metavar="N", help="Draws of noise and texture.")] = 50,
    law: Laws = None,
    workers: Workers = None,
) -> None:
    """Identify the law of many draws of a scenario by every method: bias, random error, coverage, time.

    Each draw has other noise and other nodules, and the same shape, motion and law.

    Writes a row for each draw as soon as it is finished, and at the end DIR/table.csv and DIR/recovery.csv.
    Interrupted, it goes on where it was when the same command is given again.

    Example:  `pdvc-bench identify-draws quick --draws 50 -o out/draws`
    """
    with answering(resume="give the same command again to go on from here") as progress:
        from pdvc.identify.options import IdentifyOptions
        from pdvc.lock import held
        from simulator.scenario import load_scenario
        from validation.batch.engine import run_trials
        from validation.identify.draws import draws as draws_of
        from validation.identify.recovery import recovery
        from validation.job import write_text

        chosen = load_scenario(scenario)
        asked = options_of(IdentifyOptions(), law or ["ludwik"], None, None)
        with held(out):
            table = run_trials(draws_of(chosen, asked, draws), out, workers=workers, progress=progress)
            found = recovery(table, chosen)
            write_text(out / "table.csv", table.to_csv(index=False))
            write_text(out / "recovery.csv", found.to_csv(index=False))
    from rich.console import Console

    Console().print(_table(list(found.columns), _cells(found)))
    failed = int((table["status"] != "done").sum())
    if failed:
        tell(f"{failed} of {len(table)} draws failed: see {out / 'failed'}")
    tell(f"table: {out / 'recovery.csv'}")


def identify_choice(
    experiment: ExperimentFolder,
    measurement: Annotated[
        Path, typer.Option("--measurement", metavar="FILE", help="A measurement of this experiment.")
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="CSV", help="The log evidence of each law in each made-up test.")
    ],
    draws: Annotated[int, typer.Option("--draws", min=1, metavar="N", help="Made-up tests of each law.")] = 10,
    law: Laws = None,
    options: Annotated[
        Path | None,
        typer.Option("--identify-options", metavar="TOML", help="All options of an identification; those above win."),
    ] = None,
    threads: Threads = None,
) -> None:
    """Tell how often the choice among laws would be right in a test like this one.

    Of each law, the one that explains the test best makes radiographs and forces with this test's noise; the largest
    evidence then chooses among all, and the law asked for (the first) is doubted as in an identification.

    Example:  `pdvc-bench identify-choice out/quick/experiment --measurement out/quick/measurement.nc -o choice.csv`
    """
    with answering() as progress:
        from pdvc.experiment import read_experiment
        from pdvc.identify.options import IdentifyOptions
        from pdvc.identify.protocol import choice
        from pdvc.measurement_file import read_measurement
        from validation.identify.tables import choice_csv, choice_rows
        from validation.job import write_text

        asked = options_of(IdentifyOptions() if options is None else IdentifyOptions.read(options), law, None, None)
        use_threads(threads)
        found = choice(read_experiment(experiment), read_measurement(measurement), asked, draws, progress=progress)
        write_text(out, choice_csv(found))
    from rich.console import Console

    Console().print(_table(["true law", *found.kinds, f"{found.kinds[0]} doubted"], choice_rows(found)))
    tell(f"wrong choices: {found.error_rate():.0%} of {found.log_evidence[..., 0].size}")
    tell(f"table: {out}")


def study_of_laws(
    study: Study,
    trials: Sequence[Trial],
    out: Path,
    scheduler: str | None,
    workers: int | None,
    progress: Progress,
) -> None:
    """Carry out a study whose runs identify laws, and tell what was recovered and said of them."""
    from pdvc.lock import held
    from validation.batch.engine import run_trials
    from validation.identify.study import identified_trials, recovery_of
    from validation.job import write_text

    runs = identified_trials(study, trials)
    with held(out):
        table = run_trials(runs, out, scheduler=scheduler, workers=workers, progress=progress)
        recovered, said = recovery_of(study, trials, table)
        for name, frame in (("table", table), ("recovery", recovered), ("laws", said)):
            write_text(out / f"{name}.csv", frame.to_csv(index=False))
    from rich.console import Console

    for frame in (recovered, said):
        Console().print(_table(list(frame.columns), _cells(frame)))
    failed = int((table["status"] != "done").sum())
    if failed:
        tell(f"{failed} of {len(table)} runs failed: see {out / 'failed'}")
    tell(f"tables: {out / 'recovery.csv'}, {out / 'laws.csv'}")


def tell_planned_law(scenario: str, law: str, options: str, out: Path | None, threads: int | None) -> None:
    """Tell how well the parameters of a law would be known of a test that is still to be made."""
    with answering() as progress:
        from pdvc.experiment import DESCRIPTION, read_experiment
        from pdvc.identify.expected import expected_laws
        from pdvc.identify.laws import law_named
        from pdvc.identify.options import IdentifyOptions
        from validation.job import write_text

        asked, read, folder = IdentifyOptions(law=law_named(law)), read_options(options), Path(scenario)
        use_threads(threads)
        if (folder / DESCRIPTION).is_file():
            found = expected_laws(read_experiment(folder, planned=True), read, asked, progress=progress)
        else:
            from simulator.scenario import load_scenario
            from validation.identify.planned import plan_law

            found = plan_law(load_scenario(scenario), read, asked, progress=progress)
        headings = ["force programme", *found[0].deviation]
        if out is not None:
            lines = [headings, *([each.programme, *map(str, each.deviation.values())] for each in found)]
            write_text(out, "".join(",".join(line) + "\n" for line in lines))
    from rich.console import Console

    rows = [[each.programme, *(f"{100 * value:.2g} %" for value in each.deviation.values())] for each in found]
    Console().print(_table(headings, rows))
    tell("standard deviations, relative; of an assumed process beside the law, without errors of the image model")


def _scenario_of(folder: Path) -> Scenario:
    from simulator.truth import read_scenario

    return read_scenario(folder)


def options_of(
    options: IdentifyOptions, law: list[str] | None, stroke: float | None, until: int | None
) -> IdentifyOptions:
    """Return options with what the command line says beside them; raises SettingsError for a law that is not known."""
    from pdvc.identify.laws import Law, law_named

    kinds = [str(kind.model_fields["kind"].default) for kind in Law.kinds()]
    changes: dict[str, object] = {}
    if law:
        changes |= {"law": law_named(law[0]), "compare": tuple(law_named(kind).kind for kind in law[1:])}
    elif not options.compare:
        changes["compare"] = tuple(kind for kind in kinds if kind != options.law.kind)
    if stroke is not None:
        if stroke <= 0:
            raise ValueError(f"--stroke: expected a rate above 0 mm/s, given {stroke}")
        changes["stroke_mm_per_s"] = stroke
    if until is not None:
        changes["until"] = until
    return options.model_copy(update=changes)


def _cells(frame: pd.DataFrame) -> list[list[str]]:
    """Return the cells of a table as text."""
    return [[f"{cell:.3g}" if isinstance(cell, float) else str(cell) for cell in row] for row in frame.values.tolist()]


def _table(headings: list[str], rows: list[list[str]]) -> Table:
    from rich.box import SIMPLE
    from rich.table import Table

    table = Table(box=SIMPLE, padding=(0, 1, 0, 0))
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table
