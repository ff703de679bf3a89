"""What an identification says, in rows and sentences: for the terminal and for its page."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pdvc.identify.choice import Choices
from pdvc.identify.result import INTEGRATED, Identification

_PERCENT = 100.0
FAR = 1000.0
"""Log evidence beyond which a law is so far off that only this is told of it."""


def parameter_rows(found: Identification, truth: Mapping[str, float] | None = None) -> list[list[str]]:
    """Return a row for each of the law's parameters and method: name, method, value, limits, and the truth."""
    rows = []
    for name in found.names[: found.of_law]:
        for method in found.methods:
            value, low, high = found.values(method)[name]
            known = "" if truth is None or name not in truth else f"{truth[name]:.4g}"
            rows.append([name, method, f"{value:.4g}", f"{low:.4g} to {high:.4g}", known])
    return rows


def nuisance_rows(found: Identification) -> list[list[str]]:
    """Return a row for each unknown that is none of the law's: name, value, limits."""
    values = found.values(INTEGRATED)
    return [
        [name, f"{values[name][0]:.3g}", f"{values[name][1]:.3g} to {values[name][2]:.3g}"]
        for name in found.names[found.of_law :]
    ]


def seen_sentences(found: Identification) -> list[str]:
    """Say which combinations of the parameters the test sees least, and how well."""
    said = []
    for deviation, weights in found.combinations():
        parts = sorted(weights.items(), key=lambda item: -abs(item[1]))
        most = [(name, weight) for name, weight in parts if abs(weight) > 0.3]
        if most[0][1] < 0:
            most = [(name, -weight) for name, weight in most]
        words = " ".join(f"{weight:+.2f} ln {name}" for name, weight in most).lstrip("+")
        said.append(f"{words}: known to {_PERCENT * deviation:.2g} %")
    return said


def evidence_sentence(found: Identification) -> str:
    """Say which law explains the test best."""
    if not found.log_evidence:
        return "No other law was compared."
    order = sorted(found.log_evidence, key=lambda kind: -found.log_evidence[kind])
    told = ", ".join(f"{kind} {_short(found.log_evidence[kind])}" for kind in order)
    return f"Log evidence over that of {found.law}: {told}."


def choice_rows(found: Choices) -> list[list[str]]:
    """Return a row for each true law: how often each was chosen, and how often the one asked for would be doubted."""
    return [
        [kind, *(str(number) for number in chosen), f"{doubted:.0%}"]
        for kind, chosen, doubted in zip(found.kinds, found.chosen().tolist(), found.doubted(), strict=True)
    ]


def choice_csv(found: Choices) -> str:
    """Return the log evidence of each law in each made-up test, as CSV: a line for each test."""
    lines = [",".join(("true_law", "draw", *found.kinds))]
    for kind, tests in zip(found.kinds, found.log_evidence, strict=True):
        lines += [",".join((kind, str(n), *(f"{value:.3f}" for value in test))) for n, test in enumerate(tests)]
    return "\n".join(lines) + "\n"


def compliance_sentence(found: Identification) -> str:
    """Say what is known of the machine's compliance."""
    value, deviation = found.compliance_mm_per_N
    if math.isnan(value):
        return "The experiment records no stroke: nothing is said of crosshead and machine (--stroke tells its rate)."
    return f"Machine compliance: ({1e4 * value:.3f} ± {1e4 * deviation:.3f}) 1e-4 mm/N, one standard deviation."


def _short(log_evidence: float) -> str:
    return f"under {-FAR:.0f}" if log_evidence < -FAR else f"{log_evidence:+.1f}"
