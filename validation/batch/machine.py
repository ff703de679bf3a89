"""On what many runs were carried out, in words."""

from __future__ import annotations

import os
import platform


def machine(scheduler: str | None, workers: int | None) -> str:
    """Return where a study ran, in words."""
    here = (
        f"{platform.machine()}, {os.cpu_count()} processors, {platform.system()}, Python {platform.python_version()}"
    )
    if scheduler is not None:
        return f"Dask scheduler {scheduler}; asked from {here}"
    return f"{workers or os.cpu_count()} local workers on {here}"
