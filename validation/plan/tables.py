"""What a plan says, for the terminal and as CSV."""

from __future__ import annotations

import csv
import io
from dataclasses import asdict

from rich.box import SIMPLE
from rich.table import Table

from validation.plan.designs import INVISIBLE_VOXEL, Expected, Plan

HEADINGS = ("a turn", "turns", "steps", "frames", "flats", "sect.")
_QUANTITIES = ("across_beam", "vertical", "along_beam", "strain")


def designs_csv(plan: Plan) -> str:
    """Return a line for each design: what it is, and the expected standard deviations, voxels and strain."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    first = asdict(plan.own.design)
    writer.writerow([*first, "steps", *(f"std_{name}" for name in _QUANTITIES)])
    for each in (plan.own, *plan.others):
        values = [f"{getattr(each.deviation, name):.4g}" for name in _QUANTITIES]
        writer.writerow([*asdict(each.design).values(), each.design.steps, *values])
    return text.getvalue()


def designs_table(plan: Plan, name: str) -> Table:
    """Return the designs with their expected standard deviations; what differs from the first is bold."""
    table = Table(
        title=f"{name}: expected standard deviations",
        caption="Across the beam, vertical and along it in voxels; noise and prior, not errors of the model. "
        "First line: the test as it is.",
        box=SIMPLE,
        padding=(0, 1, 0, 0),
    )
    # narrow enough for a terminal of 80 columns, and whole where it is piped
    for heading in (*HEADINGS, "across", "vertical", "along", " strain"):
        table.add_column(heading, justify="right", no_wrap=True, min_width=len(heading))
    for each in (plan.own, *plan.others):
        table.add_row(*_design_cells(each, plan.own), *_deviation_cells(each), end_section=each is plan.own)
    return table


def _design_cells(each: Expected, own: Expected) -> list[str]:
    one, usual = each.design, own.design
    values = [
        (f"{one.steps_per_turn}", one.steps_per_turn != usual.steps_per_turn),
        (f"{one.turns:.3g}", one.turns != usual.turns),
        (f"{one.steps}", False),
        (f"{one.frames}", one.frames != usual.frames),
        (f"{one.flats}", one.flats != usual.flats),
        (f"{one.sections}", one.sections != usual.sections),
    ]
    return [f"[bold]{text}[/bold]" if changed else text for text, changed in values]


def _deviation_cells(each: Expected) -> list[str]:
    found = each.deviation
    return [
        f"{found.across_beam:.4f}",
        f"{found.vertical:.4f}",
        f"{found.along_beam:.3f}",
        f"{found.strain:.1e}",
    ]


def weak_table(plan: Plan) -> Table:
    """Return the weakest motions of the scenario's own design, and whether any is invisible."""
    count = len(plan.invisible)
    verdict = f"{count} known to no better than {INVISIBLE_VOXEL} voxel" if count else "none is invisible"
    table = Table(
        title="Motions that it shows least",
        caption=f"In voxels, and as a share of the prior's variance. Of independent motions: {verdict}.",
        box=SIMPLE,
        padding=(0, 1, 0, 0),
    )
    table.add_column("mostly made of", overflow="fold")
    for heading in ("across", "vertical", "along", "of prior"):
        table.add_column(heading, justify="right", no_wrap=True, min_width=len(heading))
    for each in plan.weak:
        across, vertical, along = each.deviation_voxel
        name = " and ".join(each.motions).replace("_", " ") or "many motions"
        table.add_row(name, f"{across:.4f}", f"{vertical:.4f}", f"{along:.4f}", f"{each.prior_share:.1e}")
    return table
