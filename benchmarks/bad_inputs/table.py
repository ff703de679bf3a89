"""The table of docs/bad-inputs.md."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from benchmarks.bad_inputs.bench import LARGE_STRAIN, MEASURED, Outcome

LONGEST = 150
"""Characters of an error that the table shows."""

_HEAD = """# Bad inputs

What `pdvc-bench measure` answers to inputs that are wrong, and to some that only look so. Each row is an experiment
that was simulated well, and then changed on disk as a user's mistake would, or options that ask for what cannot be
had. Then the command line measured it and wrote the report.

Either an error is due, in one line, or a result whose verdict is `doubtful` or `failed`, with the reasons by name, on
the console, in the file and in the report. Good inputs are due the verdict `trusted`. In capitals: what a user would
not learn of. *Strain* is the largest |du_z/dz| between sections; 7 to 9 % are true.

Written by `make bad-inputs`, which fails while any row has a fault.
"""

_UNKNOWABLE = """
Rows marked * have no fault that a folder could show: it is, to the last count, that of another sample, a larger or a
smaller one, or of another motion, which was measured well.
"""


def page(outcomes: Sequence[Outcome], where: str, minutes: float) -> str:
    """Return the page as Markdown: a summary, and a row for each input."""
    lines = [_HEAD, f"{where}: {minutes:.0f} minutes.\n", *summary(outcomes), _UNKNOWABLE]
    lines += ["| input | what was done wrong | what it gets | strain, % | s |", "| --- | --- | --- | ---: | ---: |"]
    lines += [f"| {' | '.join(cell.replace('|', '/') for cell in row(outcome))} |" for outcome in outcomes]
    return "\n".join(lines) + "\n"


def summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the counts of answers and of faults, as a Markdown list."""
    bad = [outcome for outcome in outcomes if outcome.case.due in ("error", "warning")]
    good = [outcome for outcome in outcomes if outcome.case.due == "good"]
    faults = Counter(fault for outcome in outcomes for fault in outcome.faults)
    answers = Counter(outcome.answer for outcome in bad)
    lines = [
        f"- {len(bad)} bad inputs: {answers['error']} get an error, {answers['warning']} a verdict that is not "
        f"`trusted`, {answers['trusted'] + answers['nothing']} neither.",
        f"- {len(good)} good inputs: {sum(outcome.answer == 'trusted' for outcome in good)} are `trusted`, "
        f"{sum(outcome.answer == 'warning' for outcome in good)} doubted, "
        f"{sum(outcome.answer == 'error' for outcome in good)} refused.",
    ]
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


def said(outcome: Outcome) -> str:
    """Return the error, shortened, or the verdict and its reasons."""
    if outcome.code not in MEASURED:
        line = " / ".join(outcome.errors) or (outcome.console[-1] if outcome.console else "")
        return line if len(line) <= LONGEST else line[: LONGEST - 4] + " ..."
    reasons = ", ".join(f"{name} ({figure})" for name, figure, _ in outcome.doubts)
    return f"{outcome.verdict}: {reasons}" if reasons else outcome.verdict or "a result without a verdict"
