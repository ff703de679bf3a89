"""The page about an identification, report.html, and its figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.axes import Axes

from pdvc.identify.laws import Law, Ludwik
from pdvc.identify.result import Identification
from pdvc.whole import write_whole
from validation.identify.figures import draw_correlation, draw_law, draw_missed
from validation.identify.tables import (
    compliance_sentence,
    evidence_sentence,
    nuisance_rows,
    parameter_rows,
    seen_sentences,
)
from validation.identify.truth import truth_of
from validation.report.figures import new_figure, save
from validation.report.template import template

if TYPE_CHECKING:
    from simulator.scenario import Scenario

CAPTIONS = {
    "law": "Flow stress against plastic strain, with the 95 % band of the integrated identification.",
    "missed": "Where the law fails: strain of the free measurement less that of the law, in the measurement's "
    "standard deviations.",
    "correlation": "Correlations of the unknowns: what is near one, or minus one, the test tells only together.",
}


def write_page(folder: Path, found: Identification, scenario: Scenario | None = None) -> Path:
    """Write report.html and figures/; with the scenario of a simulated experiment, the truth stands beside it."""
    truth: Mapping[str, float] | None = None
    true_law: Law | None = None
    if scenario is not None:
        truth = truth_of(scenario.loading)
        true_law = Ludwik().with_values(truth)
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    pictures = []
    drawn: dict[str, Callable[[Axes], Axes]] = {
        "law": lambda ax: draw_law(found, ax=ax, truth=true_law),
        "missed": lambda ax: draw_missed(found, ax=ax),
        "correlation": lambda ax: draw_correlation(found, ax=ax),
    }
    for name, draw in drawn.items():
        figure, (ax,) = new_figure(7.0, 4.0)
        draw(ax)
        data = save(figure, folder / "figures" / f"identification_{name}.png", dpi=120)
        pictures.append({"name": name, "caption": CAPTIONS[name], "data": data})
    text = template("identification.html").render(
        found=found,
        truth=truth,
        doubts=found.doubts(),
        evidence=evidence_sentence(found),
        parameters=parameter_rows(found, truth),
        nuisances=nuisance_rows(found),
        combinations=seen_sentences(found),
        compliance=compliance_sentence(found),
        pictures=pictures,
    )
    page = folder / "report.html"
    write_whole(page, text.encode())
    return page
