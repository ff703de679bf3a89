"""A simulated test, played as a scanner writes it and followed on a page: python examples/follow_a_test.py out/live.

Further arguments: a scenario, and seconds between radiographs. Ends when the test is over, or with Ctrl-C.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
import webbrowser
from contextlib import ExitStack, suppress
from pathlib import Path

from validation.view.places import Places

BENCH = (sys.executable, "-m", "pdvc_bench")


def main(folder: Path, scenario: str = "quick", pace_s: str = "2") -> None:
    """Play a test into a folder, and follow it from there."""
    experiment, arriving, ready, file = (folder / name for name in ("experiment", "arriving", "ready", "motion.nc"))
    for old in (*folder.glob("motion.nc*"), *folder.glob("arriving")):
        shutil.rmtree(old) if old.is_dir() else old.unlink()
    subprocess.run([*BENCH, "simulate", scenario, "-o", experiment], check=True)
    subprocess.run([*BENCH, "prepare", experiment, "--work", ready], check=True)
    arriving.mkdir()
    with ExitStack() as ends:

        def begin(*command: str | Path, **options: int) -> subprocess.Popen[str]:
            """Begin a command that ends with this script, however that comes."""
            process = ends.enter_context(subprocess.Popen([*BENCH, *command], text=True, **options))
            ends.callback(process.terminate)
            return process

        live = begin("live", experiment, "--radiographs", arriving, "--work", ready, "-o", file)
        record = Places(file=file).record
        while live.poll() is None and not (record.exists() and record.stat().st_size):
            time.sleep(0.1)
        url = begin("page", file, stdout=subprocess.PIPE).stdout.readline()
        print("the test is shown at", url, end="", flush=True)
        if os.environ.get("DISPLAY") or sys.platform in ("darwin", "win32"):
            webbrowser.open(url.strip())
        begin("play", experiment, "--to", arriving, "--pace", pace_s)
        if live.wait() == 0:
            time.sleep(1)  # that it is over is still to be shown
            print(f"the test is over; to see it again: pdvc-bench page {file}")
    sys.exit(live.returncode)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main(Path(sys.argv[1]), *sys.argv[2:])
