"""Stop a testing machine at the first alarm: pdvc-bench live ... --json | python examples/stop_on_alarm.py."""

from __future__ import annotations

import json
import sys


def stop_machine() -> None:
    """Stop: here goes what your machine understands, a line on its serial port or a relay."""
    print("STOP", flush=True)


stopped = False
# read on to the end: were nobody there to read, live could not go on
for text in sys.stdin:
    line = json.loads(text)
    if line["what"] == "alarm" and not stopped:
        stop_machine()
        stopped = True
        print(f"{line['alarm']} at step {line['step']}: {line['reason']}", flush=True)
