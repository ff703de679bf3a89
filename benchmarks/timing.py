"""Take times fairly on a machine that others use too: in turns, several times, and as medians."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numba
import numpy as np


@dataclass(frozen=True)
class Seconds:
    """What a job takes: by the clock, and in processor time, which other programs disturb less."""

    wall: float
    cpu: float


def in_turns(jobs: Sequence[Callable[[], Any]], repeats: int) -> list[Seconds]:
    """Return the median times of each job, each run once before, then all in turns: A B A B."""
    for job in jobs:
        job()
    taken = np.array([[astuple(once(job)[0]) for job in jobs] for _ in range(repeats)])
    return [Seconds(float(wall), float(cpu)) for wall, cpu in np.median(taken, axis=0)]


def once(job: Callable[[], Any]) -> tuple[Seconds, Any]:
    """Return the times of one run, and what it returned."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = job()
    return Seconds(time.perf_counter() - wall, time.process_time() - cpu), result


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
