"""A study whose runs identify a law: measured in full, identified by every method, and asked for wrong laws, too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from pdvc.digest import digest, software
from pdvc.experiment import Experiment
from pdvc.identify.laws import law_named
from pdvc.identify.options import IdentifyOptions
from pdvc.identify.protocol import identify
from pdvc.identify.result import Identification
from pdvc.measurement import Measurement
from pdvc.protocol import measure
from validation.batch.engine import Part, Result, Scalar
from validation.batch.trial import Trial, Volumes, clean_parts, simulated
from validation.identify.draws import METHODS, estimated
from validation.identify.recovery import recovery
from validation.study.description import Study
from validation.study.summary import by_combination

CHOSEN, AHEAD = "chosen", "ahead"
"""Columns: the law of the largest evidence, and that of the first law over the best other one, in log evidence."""


@dataclass(frozen=True, kw_only=True)
class IdentifiedTrial:
    """A trial of a study in which laws are identified; a `validation.batch.engine.Run`."""

    trial: Trial
    laws: tuple[str, ...]
    """The first is identified and compared with the others; each of these is then asked for as if it were right."""

    @cached_property
    def key(self) -> str:
        """Return a digest of all that the result depends on."""
        return digest("identified", self.trial.key, self.laws, software("pdvc", "simulator", "validation"))

    @property
    def columns(self) -> Mapping[str, Scalar]:
        """Return what says which run this is."""
        return self.trial.columns

    @property
    def score_columns(self) -> Mapping[str, type]:
        """Return names and types of the scores."""
        names = law_named(self.laws[0]).values()
        numbers = (*estimated(names), *(f"seconds_{method}" for method in METHODS), AHEAD)
        return {
            **dict.fromkeys(numbers, float),
            CHOSEN: str,
            **dict.fromkeys((f"{kind}_doubted" for kind in self.laws), bool),
        }

    def parts(self) -> tuple[Part, ...]:
        """Return what other trials may share."""
        return *clean_parts(self.trial.scenario), Volumes(self.trial.scenario, self.trial.options)

    def carry_out(self, shared: Path) -> Result:
        """Simulate, measure and identify; raises ValueError where that cannot be done."""
        scenario, options = self.trial.scenario, self.trial.options
        with simulated(scenario, shared) as (experiment, _, _):
            work = shared / Volumes(scenario, options).name
            measurement = measure(experiment, options, work=work)
            stroke = scenario.loading.stroke_mm_per_s
            found = {kind: self._asked(kind, experiment, measurement, stroke, work) for kind in self.laws}
        best = found[self.laws[0]]
        scores: dict[str, Scalar] = {}
        for method, each in best.methods.items():
            scores[f"seconds_{method}"] = each.seconds
            for name, value, deviation in zip(best.names[: best.of_law], each.vector, each.deviation, strict=False):
                scores |= {f"{method}:{name}": float(value), f"{method}:{name}_deviation": float(deviation)}
        evidence = best.log_evidence or {best.law: 0.0}
        scores[CHOSEN] = max(evidence, key=lambda kind: evidence[kind])
        scores[AHEAD] = -max((value for kind, value in evidence.items() if kind != best.law), default=float("nan"))
        for kind, each_law in found.items():
            scores[f"{kind}_doubted"] = each_law.better() is not None
        return Result(scores=scores)

    def _asked(
        self, kind: str, experiment: Experiment, measurement: Measurement, stroke: float, work: Path
    ) -> Identification:
        others = self.laws if kind == self.laws[0] else self.laws[:1]
        options = IdentifyOptions(law=law_named(kind), compare=others, stroke_mm_per_s=stroke)
        return identify(experiment, measurement, options, work=work)


def identified_trials(study: Study, trials: Sequence[Trial]) -> list[IdentifiedTrial]:
    """Return the trials of a study as runs that identify its laws; raises ValueError for a law that is not known."""
    for kind in study.laws:
        law_named(kind)
    return [IdentifiedTrial(trial=trial, laws=study.laws) for trial in trials]


def recovery_of(study: Study, trials: Sequence[Trial], table: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return what was recovered of the law, and what was said of laws, of each combination of a study's factors.

    The columns of the first are those of `validation.identify.recovery`; of the second, the share of runs in which
    the first law had the largest evidence, and in which each law, asked for, was doubted.
    """
    recovered: list[pd.DataFrame] = []
    said: list[dict[str, object]] = []
    for number, (combination, runs) in enumerate(by_combination(study, table)):
        scenario = trials[number * study.repetitions].scenario
        found = recovery(runs, scenario)
        recovered.append(found.assign(**combination)[[*combination, *found.columns]])
        done = runs[runs["status"] == "done"]
        said.append(
            {
                **combination,
                "runs": len(done),
                "right": float(np.mean(done[CHOSEN] == study.laws[0])) if len(done) else np.nan,
                AHEAD: float(done[AHEAD].min()) if len(done) else np.nan,
                **{f"{kind}_doubted": float(done[f"{kind}_doubted"].astype(float).mean()) for kind in study.laws},
            }
        )
    return pd.concat(recovered, ignore_index=True), pd.DataFrame(said)
