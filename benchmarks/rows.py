"""Print rows as they come, and keep them as a table."""

from __future__ import annotations

import csv
from pathlib import Path

Row = dict[str, object]


def show(row: Row) -> None:
    """Print a row at once."""
    print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)


def keep(rows: list[Row], name: str) -> None:
    """Write rows of the same keys to benchmarks/results/NAME.csv."""
    path = Path(__file__).parent / "results" / f"{name}.csv"
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
