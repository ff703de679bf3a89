"""The command line, pdvc-bench; what takes long to import is imported by the command that needs it."""

from __future__ import annotations

from typing import Annotated

import typer

from validation.commands import doors, identifying, live, many, one, replaying, watching
from validation.commands.parts import Debugging

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


@app.callback()
def _common(
    debug: Annotated[bool, typer.Option("--debug", help="Show the whole traceback of an error.")] = False,
) -> None:
    Debugging.on = debug


for _command in (
    *(one.scenarios, one.options, one.simulate, one.inspect, one.measure, one.score, one.report, one.run),
    *(replaying.replay, replaying.movie),
    *(many.compare, many.studies, many.study, many.plan),
    *(identifying.identify, identifying.identify_draws, identifying.identify_choice),
    *(live.prepare, live.live, live.play),
    *(watching.page, watching.watch),
    doors.export,
):
    app.command()(_command)
app.command("import")(doors.import_)


if __name__ == "__main__":
    app()
