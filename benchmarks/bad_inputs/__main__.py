"""Give every bad input to the command line and write docs/bad-inputs.md: python -m benchmarks.bad_inputs.

Exit code 1 while any input gets another answer than is due. With --only, a few inputs by name, and no page.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.bad_inputs.bench import Bench
from benchmarks.bad_inputs.catalogue import CATALOGUE
from benchmarks.bad_inputs.table import page, row, summary
from benchmarks.timing import machine

PAGE = Path(__file__).parents[2] / "docs" / "bad-inputs.md"


def main() -> None:
    """Run from the command line."""
    names = [case.name for case in CATALOGUE]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bad_inputs", description=__doc__)
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, help="inputs side by side (default: all cores)"
    )
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=names, help="these inputs, and no page")
    parser.add_argument("--limit", type=float, default=600.0, metavar="S", help="longest time of a command, s")
    parser.add_argument("--out", type=Path, default=PAGE, metavar="FILE", help="the page to write")
    parser.add_argument("--work", type=Path, metavar="DIR", help="keep the simulated experiments here, for next time")
    given = parser.parse_args()
    cases = [case for case in CATALOGUE if given.only is None or case.name in given.only]
    # a thread for each process: inputs are carried out side by side
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    started, outcomes = time.perf_counter(), []
    with tempfile.TemporaryDirectory() as scratch:
        for outcome in Bench(given.work or Path(scratch), limit_s=given.limit).carry_out(cases, given.jobs):
            outcomes.append(outcome)
            name, _, answer, strain, seconds = row(outcome)
            print(f"{len(outcomes)}/{len(cases)}  {name}: {answer}; strain {strain or '-'} %; {seconds} s", flush=True)
    outcomes.sort(key=lambda outcome: names.index(outcome.case.name))
    print(*summary(outcomes), sep="\n")
    if given.only is None:
        given.out.write_text(page(outcomes, machine(), (time.perf_counter() - started) / 60), encoding="utf-8")
        print(f"page: {given.out}")
    sys.exit(any(outcome.faults for outcome in outcomes))


if __name__ == "__main__":
    main()
