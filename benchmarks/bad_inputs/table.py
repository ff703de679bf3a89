"""The table of docs/bad-inputs.md."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

from benchmarks.bad_inputs.bench import LARGE_STRAIN, MEASURED, Outcome

LONGEST = 150
"""Characters of an error that the table shows."""

_HEAD = """# Bad inputs

What the command line answers to inputs that are wrong, and to some that only look so: each row below is an experiment
that was simulated well, and then changed on disk as a user's mistake would, or arguments that ask for what cannot be
had.

Written by `make bad-inputs`, which fails while any row has a fault. `python -m benchmarks.bad_inputs --part followed`
writes one of the two tables anew, `measured` the other.

In capitals: what a user would not learn of.
"""

_MEASURED = """
## A measurement

`pdvc-bench measure` measured it, and `report` wrote the report.

Either an error is due, in one line, or a result whose verdict is `doubtful` or `failed`, with the reasons by name, on
the console, in the file and in the report. Good inputs are due the verdict `trusted`. *Strain* is the largest
|du_z/dz| between sections; 7 to 9 % are true.
"""

_UNKNOWABLE = """
Rows marked * have no fault that a folder could show: it is, to the last count, that of another sample, a larger or a
smaller one, or of another motion, which was measured well.
"""


_FOLLOWED = """
## A test that runs

`prepare`, `live`, `play`, `page` and `watch`, given on that experiment. An error is due, in one line. A radiograph
that cannot be used, or a wrong line of their table, is due a line that begins with `lost`, and the test is followed
on: here there are hardly any others.
"""


def page(measured: str, followed: str) -> str:
    """Return the page as Markdown, of its two parts."""
    return f"{_HEAD}{measured}{followed}"


def parts(text: str) -> tuple[str, str]:
    """Return the two parts of a page, of measurements and of tests that run; empty where there is none."""
    begin, middle = (text.find(part.splitlines()[1]) - 1 for part in (_MEASURED, _FOLLOWED))
    return ("", "") if min(begin, middle) < 0 else (text[begin:middle], text[middle:])


def measured_part(outcomes: Sequence[Outcome], where: str, seconds: float) -> str:
    """Return the part of measurements as Markdown: a summary, and a row for each input."""
    lines = [_MEASURED, f"{where}: {seconds / 60:.0f} minutes.\n", *summary(outcomes), _UNKNOWABLE]
    lines += ["| input | what was done wrong | what it gets | strain, % | s |", "| --- | --- | --- | ---: | ---: |"]
    return _table(lines, map(row, outcomes))


def followed_part(outcomes: Sequence[Outcome], where: str, seconds: float) -> str:
    """Return the part of tests that run as Markdown: a summary, and a row for each input."""
    lines = [_FOLLOWED, f"{where}: {seconds:.0f} seconds.\n", *summary(outcomes), ""]
    lines += ["| input | command | what was done wrong | what it gets | s |", "| --- | --- | --- | --- | ---: |"]
    return _table(lines, map(followed_row, outcomes))


def _table(lines: list[str], rows: Iterable[list[str]]) -> str:
    """Return lines, and rows of a table below them."""
    return (
        "\n".join([*lines, *(f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |" for cells in rows)]) + "\n"
    )


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the counts of answers and of faults, as a Markdown list."""
    bad = [outcome for outcome in outcomes if outcome.case.due in ("error", "warning")]
    good = [outcome for outcome in outcomes if outcome.case.due == "good"]
    faults = Counter(fault for outcome in outcomes for fault in outcome.faults)
    answers = Counter(outcome.answer for outcome in bad)
    told = [outcome for outcome in outcomes if outcome.case.due == "told"]
    verdicts = f"{answers['warning']} a verdict that is not `trusted`, " if answers["warning"] else ""
    nothing = answers["trusted"] + answers["nothing"]
    lines = [f"- {len(bad)} bad inputs: {answers['error']} get an error, {verdicts}{nothing} neither."]
    if told:
        lines.append(
            f"- {len(told)} bad radiographs, or lines of their table: "
            f"{sum(bool(outcome.lost) for outcome in told)} are told."
        )
    if good:
        lines.append(
            f"- {len(good)} good inputs: {sum(outcome.answer == 'trusted' for outcome in good)} are `trusted`, "
            f"{sum(outcome.answer == 'warning' for outcome in good)} doubted, "
            f"{sum(outcome.answer == 'error' for outcome in good)} refused."
        )
    return lines + [f"- {count} x {fault}" for fault, count in faults.most_common()]


def row(outcome: Outcome) -> list[str]:
    """Return the cells of a row: name, mistake, answer with its faults, strain in percent, seconds."""
    case = outcome.case
    faults = "; ".join(f"**{fault}**" for fault in outcome.faults)
    strain = "" if math.isnan(outcome.strain) else f"{outcome.strain * 100:.1f}"
    large = not math.isnan(outcome.strain) and abs(outcome.strain) > LARGE_STRAIN
    return [
        case.name + ("*" if case.due == "unknowable" else ""),
        case.wrong,
        "; ".join(part for part in (faults, said(outcome)) if part),
        f"**{strain}**" if large else strain,
        f"{outcome.seconds:.0f}",
    ]


def followed_row(outcome: Outcome) -> list[str]:
    """Return the cells of a row about a test that runs: name, command, mistake, answer with its faults, seconds."""
    name, wrong, answer, _, seconds = row(outcome)
    return [name, f"`{outcome.case.command}`", wrong, answer, seconds]


def said(outcome: Outcome) -> str:
    """Return what was lost or the error, shortened, or the verdict and its reasons."""
    if outcome.case.due == "told" and outcome.lost:
        return _short(" / ".join(outcome.lost))
    if outcome.code not in MEASURED:
        return _short(" / ".join(outcome.errors) or (outcome.console[-1] if outcome.console else ""))
    reasons = ", ".join(f"{name} ({figure})" for name, figure, _ in outcome.doubts)
    return f"{outcome.verdict}: {reasons}" if reasons else outcome.verdict or "a result without a verdict"


def _short(line: str) -> str:
    return line if len(line) <= LONGEST else line[: LONGEST - 4] + " ..."
