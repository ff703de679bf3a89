"""How many examples of a law are tried: few in the usual tests, hundreds in `make laws`."""

from __future__ import annotations

import os

from hypothesis import settings

AT_LEAST = int(os.environ.get("PDVC_LAW_EXAMPLES", "0"))
"""Examples that every law is asked for; 0: as many as it says itself."""


def law(examples: int = 100, *, cost: int = 1) -> settings:
    """Return the settings of a law: other examples each time, so many, or more where `PDVC_LAW_EXAMPLES` asks for it.

    A law whose example costs as much as `cost` usual ones, seconds each, is asked for so many times fewer.
    """
    return settings(max_examples=max(examples, AT_LEAST // cost), deadline=None, print_blob=True)
