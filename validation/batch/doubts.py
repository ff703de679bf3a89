"""How many measurements of a table doubt themselves, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


def doubted(table: pd.DataFrame) -> tuple[int, str]:
    """Return how many measurements of a table are not trusted by their own checks, and `counted` reasons."""
    return int((table["verdict"].dropna() != "trusted").sum()), counted(table["doubts"].dropna())


def counted(doubts: Iterable[str]) -> str:
    """Return how often each name occurs in lists of names, as text: ``cut-ends 3, strain 1``."""
    found = Counter(name for each in doubts for name in each.split(", ") if name)
    return ", ".join(f"{name} {count}" for name, count in found.most_common())
