"""A study of 200 runs, disturbed, and what a second worker is worth: python -m benchmarks.disturbed.

The study `two-hundred.toml` is carried out; then once more, with one worker killed (SIGKILL) after 40 rows, the whole
study, workers and all, after 100, and the same command given again: its table has to be that of the undisturbed study,
row for row, but for times. Forty of its runs are carried out with one worker and with two, on nothing else's time.
Some 10 minutes on 2 cores.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd
import psutil

from benchmarks.rows import Row, keep, show

STUDY = Path(__file__).parent / "two-hundred.toml"


def start(out: Path, workers: int, study: Path = STUDY) -> subprocess.Popen[bytes]:
    """Begin a study, or go on with it."""
    command = [sys.executable, "-m", "validation.cli", "study", str(study), "-o", str(out), "--workers", str(workers)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def finished(out: Path, workers: int, study: Path = STUDY) -> float:
    """Carry a study out and return how long it took, s."""
    began = time.perf_counter()
    code = start(out, workers, study).wait()
    if code:
        raise SystemExit(f"{out}: expected the study to end with exit code 0, found {code}")
    return time.perf_counter() - began


def rows(out: Path) -> int:
    """Count the runs that are on disk."""
    return len(list((out / "runs").glob("*.parquet")))


def pace(out: Path) -> float:
    """Return the runs per second between the first row and the last: start and end of the study left out."""
    stamps = sorted(path.stat().st_mtime for path in (out / "runs").glob("*.parquet"))
    return (len(stamps) - 1) / (stamps[-1] - stamps[0])


def wait_for(out: Path, count: int) -> None:
    """Wait until so many runs are on disk."""
    while rows(out) < count:
        time.sleep(0.1)


def busy_worker(study: int) -> psutil.Process:
    """Return the worker that has computed most."""
    children = psutil.Process(study).children(recursive=True)
    return max(children, key=lambda child: sum(child.cpu_times()[:2]))


def table(out: Path) -> pd.DataFrame:
    """Return the table without what differs between any two computations of the same."""
    found = pd.read_parquet(out / "table.parquet")
    return found[[name for name in found if not str(name).startswith("seconds")]]


def main() -> None:
    """Carry out all three, compare and keep what was found."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        forty = folder / "forty.toml"
        forty.write_text(STUDY.read_text().replace("repetitions = 50", "repetitions = 10"))
        one, two = (finished(folder / f"workers-{count}", count, forty) for count in (1, 2))
        finished(folder / "calm", 2)
        calm = table(folder / "calm")
        study = start(folder / "disturbed", 2)
        wait_for(folder / "disturbed", 40)
        victim = busy_worker(study.pid)
        victim.kill()
        wait_for(folder / "disturbed", 100)
        os.killpg(study.pid, signal.SIGKILL)
        study.wait()
        for left in psutil.process_iter(["cmdline"]):
            if str(folder / "disturbed") in " ".join(left.info["cmdline"] or []):
                left.kill()
        kept = {path: path.stat().st_mtime_ns for path in (folder / "disturbed" / "runs").glob("*.parquet")}
        finished(folder / "disturbed", 2)
        again = sum(path.stat().st_mtime_ns != stamp for path, stamp in kept.items())
        disturbed = table(folder / "disturbed")
        found: Row = {
            "rows": len(disturbed),
            "different keys": disturbed["key"].nunique(),
            "rows when killed": len(kept),
            "of these done again": again,
            "same table as undisturbed": disturbed.equals(calm),
            "same table with 1 worker": table(folder / "workers-1").equals(table(folder / "workers-2")),
            "seconds of 40 runs, 1 worker": f"{one:.0f}",
            "2 workers": f"{two:.0f}",
            "scaling": f"{one / two:.2f}",
            "scaling of the runs alone": f"{pace(folder / 'workers-2') / pace(folder / 'workers-1'):.2f}",
        }
        show(found)
        keep([found], "disturbed")


if __name__ == "__main__":
    main()
