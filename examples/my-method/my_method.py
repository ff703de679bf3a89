"""A method of one's own: a record with a function from an Experiment to a Measurement, announced in pyproject.toml."""

from dataclasses import replace

import numpy as np

from pdvc.experiment import Experiment
from pdvc.gauss_newton import GaussNewton
from pdvc.history import Force, Polynomial
from pdvc.measurement import Measurement
from pdvc.options import MeasureOptions, StageOptions
from pdvc.protocol import measure
from validation.methods.registry import Method


def follows_force(experiment: Experiment) -> Measurement:
    """Measure with the force, freed of its noise by a median over five steps, and a constant as time functions.

    Anything that takes an Experiment and fills in a Measurement is a method; this one leaves most to `measure`.
    """
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(experiment.test.force_N, 2, mode="edge"), 5)
    quiet = replace(experiment, test=replace(experiment.test, force_N=np.median(windows, axis=1)))
    stages = (StageOptions(scale=2, solver=GaussNewton()), StageOptions(scale=1, solver=GaussNewton()))
    options = MeasureOptions(time=(Force(), Polynomial(degree=0)), sections=6, deformation=stages)
    return measure(quiet, options)


FOLLOWS_FORCE = Method(
    name="follows-force",
    measure=follows_force,
    # pages of `pdvc-bench compare` print this
    assumes="Assume that the sample moves in proportion to the force, and by a shift before the test, but not with "
    "the stage.",
)
