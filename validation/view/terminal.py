"""A test while it runs, in a terminal of 80 x 24 characters or more; where there is none, its lines as they come."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pdvc.record import Line, MeasurementLine, StepLine, line_of
from validation.view.places import LATEST, Places, check_words
from validation.view.state import HALF_95, State
from validation.view.tail import Tail

POLL_S = 0.25
"""Time between looks at the record."""
ABOVE, BESIDE = 9, 34
"""Lines of the screen above the profile, and columns beside its bars."""


def watch(places: Places, console: Console) -> None:
    """Show a test until its measurement is told."""
    if console.is_terminal:
        _draw(places, console)
        return
    for line in _lines(places):
        console.print(line.words(), markup=False, highlight=False, soft_wrap=True)


def _lines(places: Places) -> Iterator[Line]:
    """Yield the lines of a record as they come, the measurement last."""
    tail, told = Tail(places.record), 0
    while True:
        for line in _added(tail, places, told):
            told += 1
            yield line
            if isinstance(line, MeasurementLine):
                return
        time.sleep(POLL_S)


def _added(tail: Tail, places: Places, told: int) -> Iterator[Line]:
    """Yield the lines that were added after so many; raises ValueError where one is none of a record."""
    for number, added in enumerate(tail.added(), start=told + 1):
        where = f"{places.record}, line {number}"
        line = line_of(added.text, where)
        check_words(line, where)
        yield line


def _draw(places: Places, console: Console) -> None:
    tail, lines = Tail(places.record), list[Line]()
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as screen:
        while True:
            lines += _added(tail, places, len(lines))
            state, height = State.of(lines), console.size.height - 1
            screen.update(screen_of(state, time.time(), _lag_s(places), height, console.size.width), refresh=True)
            if state.measurement is not None:
                return
            time.sleep(POLL_S)


def _lag_s(places: Places) -> float:
    """Return the time from the newest radiograph's file to its motion; NaN where it is not known."""
    try:
        return float(json.loads((places.pictures / LATEST).read_bytes())["lag_s"])
    except (OSError, ValueError, KeyError, TypeError):
        return math.nan


def screen_of(state: State, now_s: float, lag_s: float, height: int, width: int) -> RenderableType:
    """Return what is shown of a test on a screen of so many lines and columns."""
    condition = state.condition(now_s)
    style = {"following": "bold green", "no new radiograph for a while": "bold yellow"}.get(condition, "bold")
    parts: list[RenderableType] = [
        Text(state.plan.title or "a test", style="bold", no_wrap=True, overflow="ellipsis"),
        Text(condition, style=style, no_wrap=True, overflow="ellipsis"),
    ]
    newest, said = state.newest, _said(state)
    lines = sum(-(-text.cell_len // width) for text in said)
    if newest is not None:
        parts += [_numbers(state, newest, now_s, lag_s), Text()]
        parts.append(_profile(state, newest, max(3, height - ABOVE - lines), width))
    return Group(*parts, *said)


def _numbers(state: State, newest: StepLine, now_s: float, lag_s: float) -> Table:
    half, length = HALF_95 * newest.mean_strain_std, state.length_mm
    strain = f"{number(100 * newest.mean_strain, 3)} ± {number(100 * half, 3)} %"
    extension = f"{number(length * newest.mean_strain, 4)} ± {number(length * half, 4)} mm"
    since = f"{passed(now_s - state.steps[-1].unix_s)}, usually {number(state.interval_s, 1)} s"
    table = Table.grid(padding=(0, 2), pad_edge=False)
    for row in (
        ("step", f"{newest.step} of 0 to {state.plan.steps - 1}", "force", f"{number(newest.force_N, 0)} N"),
        ("mean strain", strain, "since the last", "–" if state.complete else since),
        ("extension", extension, "file to motion", f"{number(lag_s, 2)} s"),
        ("alarms", str(len(state.alarms)), "work", f"{newest.seconds:.2f} s"),
        ("lost", str(len(state.lost)), "chi2", number(newest.chi2_reduced, 2)),
    ):
        table.add_row(*(Text(cell, style="dim" if k % 2 == 0 else "bold") for k, cell in enumerate(row)))
    return table


def _profile(state: State, newest: StepLine, most: int, width: int) -> Table:
    """Return strain against height as bars; where sections are many, the largest strain of each few neighbours."""
    every = -(-len(newest.strain) // most)
    height = state.plan.height_mm
    pairs = list(zip(newest.strain, newest.strain_std, height, height[1:], strict=False))
    groups = [pairs[k : k + every] for k in range(0, len(pairs), every)]
    largest = max((strain for strain in newest.strain if math.isfinite(strain)), default=0.0)
    scale = max(largest, 8 * HALF_95 * newest.mean_strain_std, 1e-6)
    alarmed = [line.place_mm[2] for line in state.alarms]
    table = Table.grid(padding=(0, 1), pad_edge=False)
    for group in reversed(groups):
        strain, deviation, bottom, top = max(group, key=lambda pair: pair[0] if math.isfinite(pair[0]) else -math.inf)
        length = max(0.0, strain / scale) * (width - BESIDE) if math.isfinite(strain) else 0.0
        at = any(group[0][2] <= z <= group[-1][3] for z in alarmed)
        table.add_row(
            Text(f"{(bottom + top) / 2:6.2f} mm", style="dim"),
            Text(f"{number(100 * strain, 2):>6} ± {number(100 * HALF_95 * deviation, 2)} %"),
            Text(bar(length) + (" alarm" if at else ""), style="red" if at else "blue", no_wrap=True),
        )
    return table


def number(value: float, digits: int) -> str:
    """Return a number, or a dash where it is not known."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


def passed(seconds: float) -> str:
    """Return a time that has passed."""
    for unit, length in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 3 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(seconds, 0):.0f} s"


def bar(length: float) -> str:
    """Return a bar of so many characters, to an eighth."""
    whole, eighths = divmod(round(8 * length), 8)
    return "█" * whole + " ▏▎▍▌▋▊▉"[eighths].strip()


def _said(state: State) -> list[Text]:
    """Return the last alarms, the last of all in full, and what was lost last."""
    said = [Text(line.words(), "bold white on red", no_wrap=True, overflow="ellipsis") for line in state.alarms[-3:-1]]
    said += [Text(line.words(), "bold white on red") for line in state.alarms[-1:]]
    return said + [Text(line.words(), "yellow", no_wrap=True, overflow="ellipsis") for line in state.lost[-1:]]
