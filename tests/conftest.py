"""Count the examples of laws, and tell how many at the end; keep threads from waiting for each other."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import wraps

import pytest

# Read when numpy and numba are loaded, here and in what tests start. Two workers on two cores have each twice as many
# threads as it has cores: on small matrices OpenBLAS then spends ten times as long waiting as it computes, and OpenMP
# waits in a loop for the next kernel. Numba keeps its threads: the kernels' results must not depend on them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Count each call of what hypothesis calls with its examples."""
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
