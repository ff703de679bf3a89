"""A test that is followed while its beam gets dim: python -m benchmarks.dim_beam out/quick/experiment.

Steps 60 to 89 are followed as `live` does, as they are and with the beam dimmed from step 80 on; told are the alarms,
and how far the motion of the dim radiographs is from that of the bright ones. With brightness told by the flats, and
by the air beside the sample.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.alarms import BEGINS, Fault, arrival, dimmed
from pdvc.alarms import Watch
from pdvc.compilation import compile_kernels
from pdvc.experiment import Experiment, read_experiment
from pdvc.live import step_line
from pdvc.options import DEFAULT, MeasureOptions
from pdvc.setup import set_up
from pdvc.tracker import Tracker

FIRST, LAST = 60, 90
SHARES = (0.96, 0.85)


def followed(
    experiment: Experiment, fault: Fault, options: MeasureOptions
) -> tuple[list[tuple[int, str]], NDArray[np.float64]]:
    """Return the alarms (step, name) of a test, and amplitudes (step, section, motion) of the steps not lost."""
    setup = set_up(experiment, options)
    tracker, watch = Tracker(setup), Watch(setup)
    raised: list[tuple[int, str]] = []
    amplitudes = []
    for step in range(FIRST, LAST):
        radiograph = fault(experiment, step)
        found = watch.seen(radiograph)
        if not any(alarm.spoils for alarm in found):
            taken = tracker.take(radiograph)
            found += watch.followed(step_line(setup, radiograph, taken, 0.0), taken)
            tracker.settle()
            amplitudes.append(taken.amplitude)
        raised += [(step, alarm.name) for alarm in watch.new(step, found)]
    return raised, np.array(amplitudes)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("experiment", type=Path)
    experiment = read_experiment(parser.parse_args().experiment)
    compile_kernels()
    for brightness in ("flats", "air"):
        options = DEFAULT.model_copy(update={"brightness": brightness})
        raised, clean = followed(experiment, arrival, options)
        print(f"{brightness}: no fault: alarms {raised}")
        for share in SHARES:
            raised, found = followed(experiment, partial(dimmed, share=share), options)
            told = "dim ones lost"
            if len(found) == len(clean):
                away = (found - clean)[BEGINS - FIRST :]
                told = f"motion of the dim ones {np.sqrt((away**2).mean()):.4f} voxel rms from that of the bright ones"
            print(f"{brightness}: beam at {share:.0%}: alarms {raised}; {told}")


if __name__ == "__main__":
    main()
