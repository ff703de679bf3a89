"""Take times fairly on a machine that others use too: in turns, several times, and as medians."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np


def in_turns(jobs: Sequence[Callable[[], Any]], repeats: int) -> list[float]:
    """Return the median time of each job, s, each run once before, then all in turns: A B A B."""
    for job in jobs:
        job()
    times = np.empty((repeats, len(jobs)))
    for i in range(repeats):
        for j, job in enumerate(jobs):
            started = time.perf_counter()
            job()
            times[i, j] = time.perf_counter() - started
    return [float(value) for value in np.median(times, axis=0)]


def once(job: Callable[[], Any]) -> tuple[float, Any]:
    """Return the time of one run, s, and what it returned."""
    started = time.perf_counter()
    result = job()
    return time.perf_counter() - started, result


def with_threads(count: int, job: Callable[[], Any]) -> Callable[[], Any]:
    """Return the job, run on this many of numba's threads."""

    def run() -> Any:
        before = numba.get_num_threads()
        numba.set_num_threads(min(count, before))
        try:
            return job()
        finally:
            numba.set_num_threads(before)

    return run


def machine() -> str:
    """Return the processor, its number of cores, the versions and the load, in a line."""
    import platform

    name = "unknown processor"
    try:
        with open("/proc/cpuinfo") as file:
            name = next(line.split(":")[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or name
    return (
        f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}, numba {numba.__version__}, "
        f"numpy {np.__version__}; load average {os.getloadavg()[0]:.1f}"
    )
