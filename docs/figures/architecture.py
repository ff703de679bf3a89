"""Draw the rooms of the house and who imports whom, read from the code: docs/figures/architecture.svg.

    python docs/figures/architecture.py

Every room stands above all that it imports, so that all arrows point down; were there a circle of imports, the
drawing would fail. An arrow is left out where a longer way leads to the same room.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from html import escape
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("pdvc", "simulator", "validation")
RECORDS = "pdvc: records"
"""The part of pdvc that the simulator may import, and what that imports in turn."""
FILLS = {"pdvc": "#dce9f7", "simulator": "#fbe6cf", "validation": "#e6f1de"}
SAYS = {
    RECORDS: "geometry, experiment, settings and their files",
    "pdvc": "from radiographs to a motion and its uncertainty",
    "simulator": "from a scenario to counts and the truth",
    "cli": "the program pdvc-bench",
    "commands": "one function a command",
    "console": "progress, errors in one line",
    "job": "simulate, measure, score",
    "compare": "methods side by side",
    "study": "hundreds of runs",
    "plan": "before the test",
    "identify": "laws, many draws",
    "batch": "runs on many workers",
    "report": "figures and pages",
    "view": "a test while it runs",
    "doors": "other programs' files",
    "methods": "what can be compared",
    "scoring": "errors, intervals, bound",
    "testing": "laws of one's own",
}
WIDTH, ROW, BOX_WIDTH, BOX_HEIGHT = 1000, 104, 176, 54
GAP = 0.3
"""Room that an arrow takes on a floor that it passes, in boxes."""


def imports() -> Iterator[tuple[str, str]]:
    """Yield importing and imported module, of every import within the house."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module:
                    inner = [f"{node.module}.{each.name}" for each in node.names]
                    found = [each if is_module(each) else node.module for each in inner]
                elif isinstance(node, ast.Import):
                    found = [each.name for each in node.names]
                else:
                    continue
                yield from ((name, each) for each in found if each.split(".")[0] in PACKAGES)


def is_module(name: str) -> bool:
    """Return whether a dotted name is a module or a package of the house."""
    path = ROOT / name.replace(".", "/")
    return path.with_suffix(".py").is_file() or path.is_dir()


def records_of(edges: set[tuple[str, str]]) -> set[str]:
    """Return the modules of pdvc that the simulator reaches."""
    reached: set[str] = set()
    todo = {b for a, b in edges if a.startswith("simulator") and b.startswith("pdvc")}
    while todo:
        reached |= todo
        todo = {b for a, b in edges if a in todo} - reached
    return reached


def rooms() -> dict[str, set[str]]:
    """Return, for each room, the rooms that it imports from."""
    edges = set(imports())
    records = records_of(edges)

    def room(module: str) -> str:
        package, *rest = module.split(".")
        if package == "validation":
            return rest[0] if rest else "validation"
        return RECORDS if module in records else package

    result: dict[str, set[str]] = {}
    for a, b in sorted(edges):
        if (here := room(a)) != (there := room(b)):
            result.setdefault(here, set()).add(there)
            result.setdefault(there, set())
    return result


def floors(below: dict[str, set[str]]) -> dict[str, int]:
    """Return the floor of each room: one above the highest that it imports from."""
    floor: dict[str, int] = {}
    for name in TopologicalSorter(below).static_order():  # raises CycleError at a circle
        floor[name] = 1 + max((floor[each] for each in below[name]), default=-1)
    return floor


def reached(below: dict[str, set[str]], name: str) -> set[str]:
    """Return all rooms that one depends on, by whatever way."""
    return below[name].union(*(reached(below, each) for each in below[name]))


def arrows(below: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Return the imports that no longer way stands for."""
    return [
        (a, b)
        for a in sorted(below)
        for b in sorted(below[a])
        if not any(b in reached(below, other) for other in below[a] - {b})
    ]


def chains(floor: dict[str, int], drawn: list[tuple[str, str]]) -> list[list[str]]:
    """Return each arrow as the places it leads through: a gap of its own on every floor that it passes."""
    return [[a, *(f"{a}>{b}@{level}" for level in range(floor[a] - 1, floor[b], -1)), b] for a, b in drawn]


def places(floor: dict[str, int], chained: list[list[str]]) -> dict[str, tuple[float, float]]:
    """Return the middle of each room and gap: floors from the ground up, each sorted by what its rooms rest on."""
    levels = {each: floor[chain[0]] - k for chain in chained for k, each in enumerate(chain)}
    top = max(levels.values())
    place: dict[str, tuple[float, float]] = {}
    for level in range(top + 1):
        wish = {}
        for name in (each for each in levels if levels[each] == level):
            under = [place[b][0] for chain in chained for a, b in pairwise(chain) if a == name]
            wish[name] = sum(under) / len(under) if under else WIDTH / 2
        names = sorted(wish, key=lambda name: (wish[name], name))
        share = [GAP if ">" in name else 1.0 for name in names]
        left = 0.0
        for name, own in zip(names, share, strict=True):
            place[name] = ((left + own / 2) * WIDTH / sum(share), 46 + (top - level) * ROW)
            left += own
    return place


def line(chain: list[str], place: dict[str, tuple[float, float]]) -> str:
    """Return an arrow as an SVG path: upright where it meets a box or a gap, bent in between."""
    half = BOX_HEIGHT / 2
    x, y = place[chain[0]]
    path = f"M{x:.0f},{y + half:.0f}"
    for name in chain[1:]:
        start, (end_x, end_y) = (x, y + half), place[name]
        lean = (end_y - half - start[1]) / 2
        path += f" C{x:.0f},{start[1] + lean:.0f} {end_x:.0f},{end_y - half - lean:.0f} {end_x:.0f},{end_y - half:.0f}"
        if name != chain[-1]:
            path += f" V{end_y + half:.0f}"
        x, y = end_x, end_y
    return path


def drawing() -> str:
    """Return the picture as SVG."""
    below = rooms()
    floor = floors(below)
    chained = chains(floor, arrows(below))
    place = places(floor, chained)
    height = max(y for _, y in place.values()) + 80
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" font-family="sans-serif">',
        "<title>The rooms of pdvc-bench and what they import; every arrow points down</title>",
        '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0,0.5 L8,4 L0,7.5 z" fill="#667"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{height:.0f}" rx="8" fill="#fff"/>',
    ]
    for chain in chained:
        parts.append(
            f'<path d="{line(chain, place)}" fill="none" stroke="#667" stroke-width="1.3" marker-end="url(#head)"/>'
        )
    for name in sorted(floor):
        x, y = place[name]
        package = "pdvc" if name == RECORDS else name if name in PACKAGES else "validation"
        wide = BOX_WIDTH if package == "validation" else 330
        parts += [
            f'<rect x="{x - wide / 2:.0f}" y="{y - BOX_HEIGHT / 2:.0f}" width="{wide}" height="{BOX_HEIGHT}" rx="6" '
            f'fill="{FILLS[package]}" stroke="#556" stroke-width="1"/>',
            f'<text x="{x:.0f}" y="{y - 4:.0f}" text-anchor="middle" font-size="16" font-weight="bold">'
            f"{escape(name)}</text>",
            f'<text x="{x:.0f}" y="{y + 16:.0f}" text-anchor="middle" font-size="12.5">'
            f"{escape(SAYS.get(name, ''))}</text>",
        ]
    for k, (package, fill) in enumerate(FILLS.items()):
        parts.append(
            f'<rect x="{20 + 120 * k}" y="{height - 30:.0f}" width="14" height="14" fill="{fill}" stroke="#556"/>'
            f'<text x="{40 + 120 * k}" y="{height - 18:.0f}" font-size="13">{package}</text>'
        )
    return "\n".join([*parts, "</svg>"]) + "\n"


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(drawing(), encoding="utf-8")
