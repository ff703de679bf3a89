"""Stop a testing machine when something breaks: pdvc-bench live ... --json | python examples/stop_on_alarm.py."""

from __future__ import annotations

import json
import sys


def stop_machine() -> None:
    """Stop: here goes what your machine understands, a line on its serial port or a relay."""
    print("STOP", flush=True)


# loading that begins is a sudden motion, too
stop_on, stopped = {"crack", "localisation", "beam", "stage", "out-of-view"}, False
# read on to the end: were nobody there to read, live could not go on
for text in sys.stdin:
    line = json.loads(text)
    if line["what"] == "alarm" and line["alarm"] in stop_on and not stopped:
        stop_machine()
        stopped = True
        print(f"{line['alarm']} at step {line['step']}: {line['reason']}", flush=True)
