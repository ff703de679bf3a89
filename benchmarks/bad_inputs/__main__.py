"""Give every bad input to the command line and write docs/bad-inputs.md: python -m benchmarks.bad_inputs.

Exit code 1 while any input gets another answer than is due. With --only, a few inputs by name, and no page.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.bad_inputs.bench import Bench, Outcome
from benchmarks.bad_inputs.catalogue import CATALOGUE, FOLLOWED
from benchmarks.bad_inputs.record import BadInput
from benchmarks.bad_inputs.table import followed_part, measured_part, page, parts, row, summary
from benchmarks.timing import machine

PAGE = Path(__file__).parents[2] / "docs" / "bad-inputs.md"
PARTS = {"measured": CATALOGUE, "followed": FOLLOWED}
"""Tables of the page."""


def main() -> None:
    """Run from the command line."""
    names = [case.name for case in (*CATALOGUE, *FOLLOWED)]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bad_inputs", description=__doc__)
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, help="inputs side by side (default: all cores)"
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=names, help="these inputs, and no page")
    parser.add_argument("--part", choices=PARTS, help="this table alone; the other stays as the page has it")
    parser.add_argument("--limit", type=float, default=600.0, metavar="S", help="longest time of a command, s")
    parser.add_argument("--out", type=Path, default=PAGE, metavar="FILE", help="the page to write")
    parser.add_argument("--work", type=Path, metavar="DIR", help="keep the simulated experiments here, for next time")
    given = parser.parse_args()
    wanted = given.only or names
    chosen = {part: [case for case in cases if case.name in wanted] for part, cases in PARTS.items()}
    # a thread for each process: inputs are carried out side by side
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    made, faults = dict[str, str](), False
    with tempfile.TemporaryDirectory() as scratch:
        bench = Bench(given.work or Path(scratch), limit_s=given.limit)
        for part, cases in chosen.items():
            if not cases or given.part not in (None, part):
                continue
            started = time.perf_counter()
            outcomes = carried_out(bench, cases, given.jobs)
            write = measured_part if part == "measured" else followed_part
            made[part] = write(outcomes, machine(), time.perf_counter() - started)
            faults |= any(outcome.faults for outcome in outcomes)
    if given.only is None:
        before = dict(zip(PARTS, parts(given.out.read_text(encoding="utf-8")), strict=True)) if given.part else {}
        given.out.write_text(page(**(before | made)), encoding="utf-8")
        print(f"page: {given.out}")
    sys.exit(faults)


def carried_out(bench: Bench, cases: Sequence[BadInput], jobs: int) -> list[Outcome]:
    """Carry out cases, and return their outcomes in the same order; a line is printed for each."""
    outcomes: dict[str, Outcome] = {}
    for outcome in bench.carry_out(cases, jobs):
        outcomes[outcome.case.name] = outcome
        name, _, answer, strain, seconds = row(outcome)
        print(f"{len(outcomes)}/{len(cases)}  {name}: {answer}; strain {strain or '-'} %; {seconds} s", flush=True)
    found = [outcomes[case.name] for case in cases]
    print(*summary(found), sep="\n")
    return found


if __name__ == "__main__":
    main()
