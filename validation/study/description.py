"""A study: which experiments to simulate and measure, and how often; read from TOML, with built-in examples.

A base scenario and the options of a measurement are changed once (``[change]``), then by factors. A factor names one
key of them, or several that change together, by its path: ``scenario.detector.frames``, ``options.sections``. The
design says how the values of several factors are combined:

- ``grid``: every value of each with every value of the others;
- ``list``: the first values of all, then the second ones, and so on;
- ``latin-hypercube``: `samples` combinations, such that the range of each factor, cut into as many parts of equal
  probability, is met once in each part;
- ``morris``, ``sobol``: what an analysis of sensitivity asks for, of `samples` trajectories or pairs of points
  (`validation.study.points`).

A factor may also multiply what the base has (``relative``), so that 1 stands for a usual size.

Each combination is carried out `repetitions` times, with other noise of the same sample and detector. Repetition 3 of
one combination has the same random streams as repetition 3 of another, so that differences between combinations
can be taken in pairs.
"""

from __future__ import annotations

import copy
import difflib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pdvc.options import PROTOCOLS, MeasureOptions, check_discarded
from pdvc.settings import Settings, SettingsError
from simulator.scenario import Scenario, load_scenario
from validation.batch.engine import Scalar
from validation.batch.trial import BOUND_COLUMNS, RECOVERY_COLUMNS, Trial, score_columns
from validation.study.points import SAMPLED, block_length, unit_points

_TAKEN = ("seed", "repetition", "status", "reason", "seconds", "version", "key", "runs", "failed")


class Factor(Settings):
    """What a study varies: one key, or several that change together."""

    key: str | tuple[str, ...]
    """path of what changes, as scenario.detector.frames or options.sections; a list of paths changes together"""
    values: tuple[Any, ...] = ()
    """values to take; with several keys, a list of values for each; a table changes the keys that it names"""
    low: float | None = None
    """for a design of samples, instead of values: lower end of the range"""
    high: float | None = None
    """upper end of the range"""
    relative: bool = False
    """whether values are multiples of what the base has, a number or a list of them; the same for all keys"""
    log: bool = False
    """whether the range is even in the logarithm, and whether figures have a logarithmic axis"""
    name: str | None = None
    """column of the table; default: the last part of the (first) key"""
    names: tuple[str | int | float, ...] = ()
    """what the column says for each value; default: the value (of the first key)"""
    label: str | None = None
    """text beside the axis of figures; default: the name"""

    @model_validator(mode="after")
    def _values_or_range(self) -> Self:
        if "scenario.repetition" in self.keys:
            raise ValueError("another key: scenario.repetition is what `repetitions` counts")
        ends = (self.low is not None) + (self.high is not None)
        if bool(self.values) == bool(ends) or ends == 1:
            raise ValueError("either values, or low and high")
        if self.low is not None and self.high is not None:
            if self.low >= self.high:
                raise ValueError(f"low below high, got {self.low} and {self.high}")
            if self.log and self.low <= 0:
                raise ValueError(f"low above 0, as the range is even in the logarithm, got {self.low}")
            if not isinstance(self.key, str) and not self.relative:
                raise ValueError("values, as several keys change together")
        if self.names and len(self.names) != len(self.values):
            raise ValueError(f"as many names as values, {len(self.values)}, got {len(self.names)}")
        if self.relative and not all(type(value) in (int, float) for value in self.values):
            raise ValueError(f"numbers, as the factor is relative, got {self.values}")
        if not isinstance(self.key, str) and not self.relative:
            for row in self.values:
                if not isinstance(row, (list, tuple)) or len(row) != len(self.key):
                    raise ValueError(f"for each value a list of {len(self.key)}, one for each key, got {row!r}")
        return self

    @property
    def keys(self) -> tuple[str, ...]:
        """Return the paths that change."""
        return (self.key,) if isinstance(self.key, str) else self.key

    @property
    def column(self) -> str:
        """Return the name of the column in tables."""
        return self.name or self.keys[0].rpartition(".")[2]

    @property
    def axis_label(self) -> str:
        """Return the text beside the axis of figures."""
        return self.label or self.column.replace("_", " ")

    def rows(self) -> list[tuple[Any, ...]]:
        """Return for each value what each key becomes, or is multiplied by."""
        if self.relative:
            return [(value,) * len(self.keys) for value in self.values]
        return [(value,) if isinstance(self.key, str) else tuple(value) for value in self.values]


class Study(Settings):
    """Many simulated experiments: a base, what varies, and how often each is repeated."""

    name: str
    """short name, for folders"""
    title: str = ""
    """what the study asks, a line for its page"""
    scenario: str = "small"
    """base scenario: a built-in name, or a TOML file, relative to this one"""
    options: str = "default"
    """how to measure: default, paper, or a TOML file, relative to this one"""
    change: dict[str, Any] = Field(default_factory=dict)
    """changes of the base for all runs, as scenario.detector.frames = 1"""
    repetitions: Annotated[int, Field(ge=1, le=100_000)] = 10
    """noise draws of each combination"""
    seed: Annotated[int, Field(ge=0)] = 0
    """of the sample, the detector, all noise and the design"""
    design: Literal["grid", "list", "latin-hypercube", "morris", "sobol"] = "grid"
    """how the values of several factors are combined"""
    samples: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """combinations of a Latin hypercube, trajectories of Morris, or pairs of points of Sobol, a power of two"""
    pooled: bool = False
    """whether coverage is asked of all combinations together, each one draw of what may happen"""
    draw: tuple[str, ...] = ()
    """scores of a single run to draw against each factor, besides the errors: columns of the table"""
    laws: tuple[str, ...] = ()
    """laws to identify in each run, in place of scores of its motion: the true one, then wrong ones to ask for"""
    factor: tuple[Factor, ...] = ()
    """what varies; without any, the base is repeated"""

    @model_validator(mode="after")
    def _design_fits_factors(self) -> Self:
        sampled = self.design in SAMPLED
        if (self.samples is not None) != sampled:
            raise ValueError("samples for design = 'latin-hypercube', 'morris' or 'sobol', and for no other")
        if sampled and not self.factor:
            raise ValueError(f"at least one [[factor]] for design = {self.design!r}")
        if self.samples is not None and self.design == "sobol" and self.samples & (self.samples - 1):
            raise ValueError(f"samples a power of two for design = 'sobol', got {self.samples}")
        for factor in self.factor:
            if not factor.values and not sampled:
                raise ValueError(f"values of factor {factor.column}, as a {self.design} takes no low and high")
        lengths = {len(factor.values) for factor in self.factor}
        if self.design == "list" and len(lengths) > 1:
            raise ValueError(f"as many values of each factor in a list, got {sorted(lengths)}")
        taken = [*_TAKEN, *score_columns(), *BOUND_COLUMNS.values(), *RECOVERY_COLUMNS]
        for factor in self.factor:
            if factor.column in taken:
                raise ValueError(f"another name for factor {factor.column}: a column of the table has it already")
            taken.append(factor.column)
        for name in self.draw:
            if score_columns().get(name) not in (int, float):
                raise ValueError(f"draw of numbers among the scores, got {name!r}{_hint(name, list(score_columns()))}")
        return self

    @property
    def combinations(self) -> int:
        """Return how many combinations of the factors' values there are."""
        if self.samples is not None:
            return self.samples * block_length(self.design, len(self.factor))
        counts = [len(factor.values) for factor in self.factor]
        return math.prod(counts) if self.design == "grid" else min(counts, default=1)


@dataclass(frozen=True, kw_only=True)
class Combination:
    """One combination of the factors' values."""

    changes: tuple[tuple[str, Any], ...]
    """Path and value of all keys that factors change."""
    factors: dict[str, Any]
    """Column and what it says, of all factors."""


def builtin_studies() -> tuple[str, ...]:
    """Return the names of the studies that come with the package."""
    found = (files("validation.study") / "built_in").iterdir()
    return tuple(sorted(file.name.removesuffix(".toml") for file in found if file.name.endswith(".toml")))


def study_file(name_or_path: str | Path) -> Path:
    """Return the file of a built-in study by its name, or the path itself of any other."""
    name = str(name_or_path)
    if name in builtin_studies():
        return Path(str(files("validation.study") / "built_in" / f"{name}.toml"))
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.is_file():
        return path
    close = difflib.get_close_matches(name, builtin_studies(), n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    raise SettingsError(f"study: expected one of {', '.join(builtin_studies())}, or a TOML file, given {name!r}{hint}")


def trials_of(study: Study, path: Path) -> list[Trial]:
    """Return all trials of the study read from a file: combination by combination, repetitions in turn.

    Raises SettingsError, in one line that names file, key and value, before anything is carried out.
    """
    base = _changed_base(study, path)
    found = combinations(study, base)
    columns = _uniform([combination.factors for combination in found])
    trials = []
    for combination, factors in zip(found, columns, strict=True):
        scenario, options = _parsed(base, combination, path)
        for repetition in range(study.repetitions):
            repeated = scenario.model_copy(update={"repetition": repetition})
            trials.append(Trial(scenario=repeated, options=options, factors=factors))
    return trials


def combinations(study: Study, base: dict[str, Any]) -> list[Combination]:
    """Return the combinations of a study's factors; `base` tells which keys hold whole numbers."""
    if study.design in SAMPLED:
        return list(_sampled(study, base))
    choices = [_choices(factor, base) for factor in study.factor]
    together = zip(*choices, strict=True) if study.design == "list" and choices else product(*choices)
    return [_combined(chosen) for chosen in together]


def _choices(factor: Factor, base: dict[str, Any]) -> list[Combination]:
    shown = factor.names or [row[0] for row in factor.rows()]
    return [
        Combination(changes=_changes(factor, row, base), factors={factor.column: said})
        for row, said in zip(factor.rows(), shown, strict=True)
    ]


def _changes(factor: Factor, row: Sequence[Any], base: dict[str, Any]) -> tuple[tuple[str, Any], ...]:
    """Return what each key of a factor becomes."""
    if not factor.relative:
        return tuple(zip(factor.keys, row, strict=True))
    return tuple((key, _times(row[0], _look_up(base, key.split(".")))) for key in factor.keys)


def _times(share: float, usual: Any) -> Any:
    """Return a multiple of a number, whole if that is, or of each of a list."""
    if isinstance(usual, (list, tuple)):
        return [_times(share, each) for each in usual]
    return round(share * usual) if type(usual) is int else float(share * usual)


def _combined(chosen: Sequence[Combination]) -> Combination:
    factors = {name: value for each in chosen for name, value in each.factors.items()}
    return Combination(changes=tuple(change for each in chosen for change in each.changes), factors=factors)


def _sampled(study: Study, base: dict[str, Any]) -> Iterator[Combination]:
    assert study.samples is not None
    for point in unit_points(study.design, len(study.factor), study.samples, study.seed):  # type: ignore[arg-type]
        yield _combined([_at(factor, float(share), base) for factor, share in zip(study.factor, point, strict=True)])


def _at(factor: Factor, share: float, base: dict[str, Any]) -> Combination:
    """Return a factor's value at a share, 0 to 1, of its range."""
    if factor.low is None or factor.high is None:
        # a share of 1, where trajectories go, is the last value
        return _choices(factor, base)[min(int(share * len(factor.values)), len(factor.values) - 1)]
    if factor.log:
        value = float(np.exp(np.log(factor.low) + share * np.log(factor.high / factor.low)))
    else:
        value = factor.low + share * (factor.high - factor.low)
    if factor.relative:
        return Combination(changes=_changes(factor, (value,), base), factors={factor.column: value})
    usual = _look_up(base, factor.keys[0].split("."))
    # a number that is left open may be a whole one: the limits tell
    whole = type(usual) is int or (usual is None and factor.low == int(factor.low) and factor.high == int(factor.high))
    said = round(value) if whole else value
    return Combination(changes=((factor.keys[0], said),), factors={factor.column: said})


def _changed_base(study: Study, path: Path) -> dict[str, Any]:
    """Return scenario and options as plain values, after the study's changes and its seed."""
    folder = path.parent
    named = PROTOCOLS.get(study.options)
    try:
        scenario = load_scenario(folder / study.scenario if study.scenario.endswith(".toml") else study.scenario)
        options = named() if named else MeasureOptions.read(folder / study.options)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None
    base = {"scenario": scenario.model_dump(mode="json"), "options": options.model_dump(mode="json")}
    base["scenario"] |= {"seed": study.seed, "repetition": 0}
    _merge(base, study.change, f"{path}: change", ())
    for factor in study.factor:
        for key in factor.keys:
            _check_path(base, key, path)
            if factor.relative:
                _check_multiplied(_look_up(base, key.split(".")), key, path)
    return base


def _merge(values: dict[str, Any], changes: dict[str, Any], where: str, above: tuple[str, ...]) -> None:
    for key, change in changes.items():
        if key not in values:
            raise SettingsError(f"{where}.{'.'.join((*above, key))}: unknown key{_hint(key, list(values))}")
        if isinstance(change, dict) and isinstance(values[key], dict):
            _merge(values[key], change, where, (*above, key))
        else:
            values[key] = change


def _check_path(base: dict[str, Any], key: str, path: Path) -> None:
    """Raise SettingsError unless a factor's key is that of a scenario or of options."""
    part: Any = base
    names = key.split(".")
    for place, name in enumerate(names):
        if not isinstance(part, dict) or name not in part:
            near = [".".join((*names[:place], each)) for each in part] if isinstance(part, dict) else []
            hint = _hint(key, near) or _hint(key, list(_paths(base)))
            raise SettingsError(f"{path}: factor.key: {key!r}: unknown key{hint}")
        part = part[name]


def _check_multiplied(usual: Any, key: str, path: Path) -> None:
    """Raise SettingsError unless a multiple of what the base has is another number."""
    parts = usual if isinstance(usual, (list, tuple)) else [usual]
    if not (parts and all(type(part) in (int, float) for part in parts) and any(parts)):
        raise SettingsError(
            f"{path}: factor.key: {key!r}: expected a number other than 0 in the base, as the factor is relative, "
            f"found {usual!r}"
        )


def _hint(given: str, known: list[str]) -> str:
    close = difflib.get_close_matches(given, known, n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else ""


def _paths(values: dict[str, Any], above: str = "") -> Iterator[str]:
    for name, value in values.items():
        yield above + name
        if isinstance(value, dict):
            yield from _paths(value, f"{above}{name}.")


def _look_up(base: dict[str, Any], names: Sequence[str]) -> Any:
    part: Any = base
    for name in names:
        part = part[name]
    return part


def _parsed(base: dict[str, Any], combination: Combination, path: Path) -> tuple[Scenario, MeasureOptions]:
    values = copy.deepcopy(base)
    for key, value in combination.changes:
        *above, last = key.split(".")
        _merge(_look_up(values, above), {last: value}, f"{path}: factor", tuple(above))
    said = ", ".join(f"{key} = {value!r}" for key, value in combination.changes)
    where = f"{path}: {said}" if said else str(path)
    scenario = Scenario.parse(values["scenario"], where=f"{where}: scenario")
    options = MeasureOptions.parse(values["options"], where=f"{where}: options")
    try:
        check_discarded(options, scenario.geometry.cone_beam())
    except ValueError as error:
        raise SettingsError(f"{where}: options: {error}") from None
    return scenario, options


def _uniform(rows: list[dict[str, Any]]) -> list[dict[str, Scalar]]:
    """Return the rows with one type in each column: numbers if all are, else text."""
    columns = {name: _one_type([row[name] for row in rows]) for name in rows[0]}
    return [{name: column[n] for name, column in columns.items()} for n in range(len(rows))]


def _one_type(values: list[Any]) -> Sequence[Scalar]:
    kinds = {type(value) for value in values}
    if kinds <= {bool} or kinds <= {int} or kinds <= {str}:
        return values
    if kinds <= {int, float}:
        return [float(value) for value in values]
    return [value if isinstance(value, str) else json.dumps(value) for value in values]
