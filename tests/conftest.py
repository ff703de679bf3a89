"""Count the examples of laws, and tell how many at the end; keep workers and threads from waiting for each other."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import wraps

import pytest

# Read when numpy and numba are loaded, here and in what tests start. Two workers on two cores have each twice as many
# threads as it has cores: on small matrices OpenBLAS then spends ten times as long waiting as it computes, and OpenMP
# waits in a loop for the next kernel. Numba keeps its threads: the kernels' results must not depend on them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

LONGEST = ("kills", "laws", "study", "examples", "package", "compare", "public", "tied_contraction", "noise", "store")
"""Files that take longest: begun first, so that no worker ends with one of them while the others have nothing left."""
KERNELS = """
from pdvc.compilation import compile_comparison, compile_kernels
from validation.testing.small_cases import SmallExperiment, small_scenario

compile_kernels()
compile_comparison()
SmallExperiment(small_scenario()).measurement
"""


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Return the address of a scheduler whose one worker is this process, which has its kernels loaded."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.worker.profile.enabled": False}),  # it looks on a hundred times a second
        LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0", silence_logs=logging.CRITICAL
        ) as cluster,
    ):
        yield cluster.scheduler_address


def pytest_configure(config: pytest.Config) -> None:
    """Compile the kernels once, before workers do so each by itself; hand out files in the order below.

    What does not compile is left to the tests.
    """
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        config.option.loadscopereorder = False  # those with the most tests first, whatever they take
        paths = os.pathsep.join([str(config.rootpath), os.environ.get("PYTHONPATH", "")])
        subprocess.run([sys.executable, "-c", KERNELS], env={**os.environ, "PYTHONPATH": paths}, check=False)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files, and count each call of what hypothesis calls with its examples."""
    place = {f"test_{name}": k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))
    for item in items:
        handle = getattr(getattr(item, "obj", None), "hypothesis", None)
        if handle is not None and not hasattr(handle.inner_test, "examples"):
            handle.inner_test = _counted(handle.inner_test)


def _counted(function):  # type: ignore[no-untyped-def]
    @wraps(function)
    def counted(*args, **kwargs):  # type: ignore[no-untyped-def]
        counted.examples += 1
        return function(*args, **kwargs)

    counted.examples = 0
    return counted


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Note with a law how many examples it was tried on: a worker's reports are all that its parent sees."""
    handle = getattr(getattr(item, "obj", None), "hypothesis", None)
    if handle is None:
        return (yield)
    before = handle.inner_test.examples
    try:
        return (yield)
    finally:
        item.user_properties.append(("examples", handle.inner_test.examples - before))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Tell how many laws were tried on how many examples."""
    reports = [each for group in ("passed", "failed") for each in terminalreporter.getreports(group)]
    counts = {each.nodeid: dict(each.user_properties).get("examples") for each in reports if each.when == "call"}
    laws = {name: int(count) for name, count in counts.items() if count is not None}
    if laws:
        fewest = min(laws, key=laws.__getitem__)
        terminalreporter.write_line(
            f"{len(laws)} laws on {sum(laws.values())} examples; fewest: {laws[fewest]} of {fewest}"
        )
