"""The tables of a comparison: rows for a spreadsheet, and the same numbers as text, Markdown and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from validation.compare.machine_time import Gain
from validation.compare.paired import QUANTITIES, Difference, MethodScores, StepErrors
from validation.scoring.bootstrap import Estimate

Row = dict[str, Any]

_UNITS = {"across_beam": "voxel", "vertical": "voxel", "along_beam": "voxel", "strain": "10⁻³"}
_NAMES = {"across_beam": "across", "vertical": "vertical", "along_beam": "along", "strain": "strain"}
_SCALE = {"strain": 1e3}
_UNKNOWN = "—"


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """A table as text; the first column is left-aligned, the others are right-aligned."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Return the table in Markdown, its caption before it."""
        lines = [f"| {' | '.join(cells)} |" for cells in (self.head, *self.rows)]
        lines.insert(1, f"| --- |{' ---: |' * (len(self.head) - 1)}")
        return f"{self.caption}\n\n" + "\n".join(lines) + "\n"

    def latex(self) -> str:
        """Return a LaTeX table; it needs the package booktabs."""
        head, *rows = (" & ".join(_escaped(cell) for cell in cells) + r" \\" for cells in (self.head, *self.rows))
        lines = [
            r"\begin{table}",
            rf"\caption{{{_escaped(self.caption)}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(self.head) - 1)}}}",
            r"\toprule",
            head,
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
        ]
        return "\n".join(lines) + "\n"


def method_row(scores: MethodScores) -> Row:
    """Return one row for a spreadsheet: each error with the bounds of its interval."""
    return {
        "scenario": scores.scenario,
        "method": scores.method,
        "repetitions": scores.done,
        "failed": scores.failed,
        "reason": scores.reason,
        "doubted": scores.doubted,
        "doubts": scores.doubts,
        "steps": scores.steps,
        "steps_measured": scores.measured,
        "steps_common": scores.common,
        "radiographs": scores.radiographs,
        "scanner_minutes": scores.minutes,
        "scanner_minutes_per_step": scores.minutes_per_step,
        **_columns("computing_seconds", scores.seconds),
        **{key: value for name in QUANTITIES for key, value in _columns(f"error_{name}", scores.error[name]).items()},
        **{
            key: value
            for name in QUANTITIES
            for key, value in _columns(f"own_error_{name}", scores.own_error[name]).items()
        },
    }


def difference_row(difference: Difference) -> Row:
    """Return one row for a spreadsheet: how much larger the errors of `method` are than those of `other`."""
    row: Row = {"scenario": difference.scenario, "method": difference.method, "other": difference.other}
    for name in QUANTITIES:
        row |= _columns(f"error_{name}", difference.error[name])
    return row


def step_rows(errors: StepErrors) -> list[Row]:
    """Return a row for each step that the method measured."""
    return [
        {"scenario": errors.scenario, "method": errors.method, "step": step}
        | {f"error_{name}": float(value) for name, value in zip(QUANTITIES, values, strict=True)}
        for step, values in enumerate(errors.error)
        if any(math.isfinite(value) for value in values)
    ]


def _columns(name: str, estimate: Estimate) -> Row:
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}


def score_table(scores: Sequence[MethodScores]) -> TextTable:
    """Return costs and errors of one scenario's methods, over the steps that all of them measured."""
    common = max((each.common for each in scores), default=0)
    return TextTable(
        caption=f"{scores[0].scenario}: rms errors over the {common} steps that all methods measured",
        head=("method", "radiographs", "scanner, min", "steps", "min per step", "computing, s", *_error_head()),
        rows=tuple(
            (
                each.method,
                str(each.radiographs) if each.done else _UNKNOWN,
                number(each.minutes) if each.done else _UNKNOWN,
                str(each.measured) if each.done else _UNKNOWN,
                number(each.minutes_per_step),
                with_interval(each.seconds),
                *_error_cells(each.error),
            )
            for each in scores
        ),
    )


def own_table(scores: Sequence[MethodScores]) -> TextTable:
    """Return errors over all the steps that each method measured."""
    return TextTable(
        caption=f"{scores[0].scenario}: rms errors of each method over all steps that it measured",
        head=("method", "steps", *_error_head()),
        rows=tuple((each.method, str(each.measured), *_error_cells(each.own_error)) for each in scores if each.done),
    )


def difference_table(differences: Sequence[Difference]) -> TextTable:
    """Return the paired differences of rms errors with the bounds of their intervals."""
    return TextTable(
        caption=f"{differences[0].scenario}: mean difference of rms errors, same data, same steps",
        head=("first method less second", *_error_head()),
        rows=tuple(
            (
                f"{each.method} − {each.other}",
                *(with_bounds(each.error[name], _SCALE.get(name, 1.0)) for name in QUANTITIES),
            )
            for each in differences
        ),
    )


def gain_table(found: Sequence[Gain], projections: str, volumes: str) -> TextTable:
    """Return what one measured step costs on the machine, by each definition."""
    return TextTable(
        caption=f"Cost of one measured step, by radiographs ({projections}) and by full scans ({volumes})",
        head=("definition", "radiographs", "of scans", "times", "min", "of scans, min", "times"),
        rows=tuple(
            (
                each.definition,
                number(each.projections.radiographs),
                number(each.volumes.radiographs),
                number(each.radiographs),
                number(each.projections.minutes),
                number(each.volumes.minutes),
                number(each.minutes),
            )
            for each in found
        ),
    )


def ratio_text(projections: Sequence[MethodScores], volumes: Sequence[MethodScores]) -> str:
    """Say how many times the errors by full scans those by radiographs are, each by the method that errs least."""
    parts = []
    for name in QUANTITIES:
        by_radiographs = min(each.error[name].value for each in projections)
        by_scans = min(each.error[name].value for each in volumes)
        parts.append(f"{_NAMES[name]} {number(by_radiographs / by_scans) if by_scans > 0 else _UNKNOWN}")
    return ", ".join(parts)


def _error_head() -> tuple[str, ...]:
    return tuple(f"{_NAMES[name]}, {_UNITS[name]}" for name in QUANTITIES)


def _error_cells(error: Mapping[str, Estimate]) -> tuple[str, ...]:
    return tuple(with_interval(error[name], _SCALE.get(name, 1.0)) for name in QUANTITIES)


def with_interval(estimate: Estimate, scale: float = 1.0) -> str:
    """Return value ± half the width of its interval, the width with two digits; a value alone has three."""
    value, half = estimate.value * scale, estimate.half_width * scale
    if not math.isfinite(half) or half <= 0:
        return number(value)
    digits = _digits(value, half)
    return f"{value:.{digits}f} ± {half:.{digits}f}"


def with_bounds(estimate: Estimate, scale: float = 1.0) -> str:
    """Return a value and the bounds of its interval in brackets, with a star where zero lies outside."""
    value, half = estimate.value * scale, estimate.half_width * scale
    if not math.isfinite(half) or half <= 0:
        return number(value)
    digits = _digits(value, half)
    low, high = (f"{bound * scale:.{digits}f}" for bound in (estimate.low, estimate.high))
    star = "*" if estimate.low > 0 or estimate.high < 0 else ""
    return f"{value:.{digits}f} [{low}, {high}]{star}"


def _digits(value: float, half: float) -> int:
    """Return the decimals that give two digits of half an interval, but no more than five of the value."""
    most = 4 - math.floor(math.log10(max(abs(value), half)))
    return max(min(1 - math.floor(math.log10(half)), most), 0)


def number(value: float) -> str:
    """Return a number with three digits, without an exponent where it is not needed."""
    if not math.isfinite(value):
        return _UNKNOWN
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.2e}"
    return f"{value:.{max(2 - math.floor(math.log10(abs(value))), 0)}f}"


_LATEX = {
    "±": r"$\pm$",
    "−": "$-$",
    "⁻³": "$^{-3}$",
    "—": "--",
    "*": "$^*$",
    "_": r"\_",
    "%": r"\%",
    "&": r"\&",
    "#": r"\#",
}


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text.replace("⁻³", "\0")).replace("\0", _LATEX["⁻³"])
