"""Plant faults in the numerical rooms, one at a time, and see whether a test fails: `make mutants`.

The faults are those of cosmic-ray that a person might make: another operator of arithmetic, a number one off, another
comparison, a condition turned round, a loop left out. Places in the code are drawn alike, by a seed, then one of the
faults that fit there. Each is planted in a copy of the project, and the tests of its module are run until one fails.

Numba keeps compiled kernels by the source file that a kernel is in. A module with kernels is therefore tested with an
empty cache of its own for each fault: nothing compiled from sound source can be met.
"""

from __future__ import annotations

import argparse
import os
import platform
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent

TESTS = {
    "projection": ("operators", "projection", "solvers"),
    "walk": ("operators", "projection", "solvers"),
    "pgd": ("solvers", "projected_laws", "measure"),
    "gauss_newton": ("solvers", "blocks", "projected_laws"),
    "equations": ("solvers", "projected_laws"),
    "banded": ("banded", "process"),
    "process": ("process", "smoother"),
    "smoother": ("smoother",),
    "uncertainty": ("uncertainty", "noise"),
    "prior": ("uncertainty", "solvers"),
    "history": ("history", "options"),
    "sections": ("sections", "operators", "measurement"),
    "radiographs": ("radiographs", "operators", "preparation"),
    "systematic": ("systematic", "operators", "noise"),
    "beam_hardening": ("beam_hardening", "preparation", "measure"),
    "preparation": ("preparation", "measure", "laws"),
    "solution": ("solvers", "blocks"),
}
"""The rooms of `pdvc` that are mutated, and the test files that guard each, those that fail soonest first."""

ARITHMETIC = "(Add|Sub|Mul|Div|Pow|FloorDiv)"
ORDER = "(Eq|NotEq|Lt|LtE|Gt|GtE)"
FAULTS = re.compile(
    f"core/(AddNot|NumberReplacer|ReplaceAndWithOr|ReplaceOrWithAnd|ReplaceBinaryOperator_{ARITHMETIC}_{ARITHMETIC}|"
    f"ReplaceBreakWithContinue|ReplaceContinueWithBreak|ReplaceComparisonOperator_{ORDER}_{ORDER}|"
    "ReplaceFalseWithTrue|ReplaceTrueWithFalse|ReplaceUnaryOperator_Delete_(Not|USub)|ZeroIterationForLoop)"
)
"""Left out: operators on bits, which numbers refuse, and `is`."""


@dataclass(frozen=True)
class Fault:
    """A fault that was planted, and what came of it."""

    room: str
    line: int
    operator: str
    change: str
    """The line as it was and as it became."""
    outcome: str
    """``killed``, ``out of time``, ``survived``, or ``incompetent`` where it could not be planted."""
    seconds: float


def draw(rooms: list[str], seed: int) -> Iterator[Any]:
    """Yield mutations of the modules in the working folder, each at another place, in an order drawn by the seed."""
    from cosmic_ray.commands.init import _all_work_items

    modules = [Path("pdvc") / f"{room}.py" for room in rooms]
    lines = {module: module.read_text(encoding="utf-8").splitlines() for module in modules}
    places: dict[tuple[str, tuple[int, int]], list[Any]] = {}
    for item in _all_work_items(modules, {}):
        (mutation,) = item.mutations
        # how a kernel is compiled, and whether it is kept, is told by the clock and not by a result
        if lines[mutation.module_path][mutation.start_pos[0] - 1].lstrip().startswith("@njit"):
            continue
        if FAULTS.fullmatch(mutation.operator_name):
            places.setdefault((str(mutation.module_path), mutation.start_pos), []).append(mutation)
    rng = random.Random(seed)
    order = sorted(places)
    print(f"{len(order)} places, {sum(map(len, places.values()))} faults")
    rng.shuffle(order)
    for place in order:
        yield rng.choice(places[place])


def command_of(room: str) -> str:
    """Return the command that tests a room until a test fails; examples of laws are the same in each run."""
    files = " ".join(f"tests/test_{name}.py" for name in TESTS[room])
    return f"{sys.executable} -m pytest -x -q -p no:cacheprovider --hypothesis-seed=0 {files}"


def has_kernels(room: str) -> bool:
    """Return whether numba compiles functions of a room's module."""
    return "@njit" in (Path("pdvc") / f"{room}.py").read_text(encoding="utf-8")


def tested(room: str, mutation: Any, limit_s: float) -> Fault:
    """Plant a mutation in the working folder, run the room's tests, and take it out again."""
    from cosmic_ray.mutating import mutate_and_test

    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as empty:
        os.environ["NUMBA_CACHE_DIR"] = empty if has_kernels(room) else str(Path("compiled").absolute())
        found = mutate_and_test([mutation], command_of(room), limit_s)
    changed = [line for line in (found.diff or "").splitlines() if re.match(r"[-+](?![-+])", line)]
    outcome = found.test_outcome.value if found.test_outcome else "incompetent"
    return Fault(
        room=room,
        line=mutation.start_pos[0],
        operator=mutation.operator_name.removeprefix("core/"),
        change=" -> ".join(line[1:].strip() for line in changed),
        outcome="out of time" if found.output == "timeout" else outcome,
        seconds=time.perf_counter() - started,
    )


def time_limits(rooms: list[str]) -> dict[str, float]:
    """Return how long each room's tests may take, s, from a run of the sound project; exits where one fails."""
    from cosmic_ray.testing import run_tests
    from cosmic_ray.work_item import TestOutcome

    os.environ["NUMBA_CACHE_DIR"] = str(Path("compiled").absolute())
    limits = {}
    for room in rooms:
        started = time.perf_counter()
        outcome, output = run_tests(command_of(room), 1800)
        if outcome is not TestOutcome.SURVIVED:
            sys.exit(f"{room}: the tests fail on the project as it is\n{output}")
        limits[room] = 60 + 3 * (time.perf_counter() - started)
        print(f"{room}: {time.perf_counter() - started:.0f} s")
    return limits


def report(faults: list[Fault]) -> str:
    """Return the result as Markdown: a line for each room, and each fault that was not killed."""
    lines = ["| room | planted | killed | out of time | survived |", "| --- | ---: | ---: | ---: | ---: |"]
    for room in (*TESTS, "all"):
        of_room = Counter(fault.outcome for fault in faults if room in ("all", fault.room))
        if of_room:
            counts = (of_room.total(), *(of_room[name] for name in ("killed", "out of time", "survived")))
            lines.append(f"| `{room}` | " + " | ".join(map(str, counts)) + " |")
    lines.append("")
    lines += [f"- `{f.room}.py:{f.line}` {f.operator}: `{f.change}`" for f in faults if f.outcome == "survived"]
    return "\n".join(lines)


def main() -> None:
    """Draw, plant and test as many faults as the command line allows."""
    parser = argparse.ArgumentParser(description="plant faults and see whether a test fails")
    parser.add_argument("--mutants", type=int, default=60, help="faults to plant")
    parser.add_argument("--minutes", type=float, default=25, help="time for them; what does not fit is left out")
    parser.add_argument("--seed", type=int, default=1, help="which faults")
    parser.add_argument("--rooms", nargs="+", default=list(TESTS), choices=list(TESTS), help="modules of pdvc")
    given = parser.parse_args()
    faults: list[Fault] = []
    with tempfile.TemporaryDirectory() as name:
        left_out = shutil.ignore_patterns(".*", "__pycache__", "out", "build", "*.egg-info")
        os.chdir(shutil.copytree(ROOT, Path(name) / "copy", ignore=left_out))
        os.environ["PYTHONPATH"] = os.getcwd()
        limits = time_limits(given.rooms)
        until = time.monotonic() + 60 * given.minutes
        for mutation in draw(given.rooms, given.seed):
            if len(faults) == given.mutants or time.monotonic() > until:
                break
            room = Path(mutation.module_path).stem
            faults.append(tested(room, mutation, limits[room]))
            fault = faults[-1]
            told = f"{len(faults):3d} {fault.outcome:12s} {fault.seconds:4.0f} s {fault.room}:{fault.line}"
            print(told, fault.change, flush=True)
    print(f"\n{len(faults)} faults by seed {given.seed}, {os.cpu_count()} cores, Python {platform.python_version()}\n")
    print(report(faults))


if __name__ == "__main__":
    main()
