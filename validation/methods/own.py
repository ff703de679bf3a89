"""Our own methods: the paper's, three more over the same equations, and classical volume correlation."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pdvc.experiment import Experiment
from pdvc.gauss_newton import GaussNewton
from pdvc.history import Steps
from pdvc.measurement import Measurement
from pdvc.options import MeasureOptions, StageOptions, paper_options
from pdvc.protocol import measure
from pdvc.volume_correlation import correlate
from validation.methods.registry import Method


def _direct(scale: int | Literal["coarse"]) -> StageOptions:
    return StageOptions(scale=scale, solver=GaussNewton(most_passes=12))


_SECTION_STAGES = (_direct(2), _direct(1))
_SECTIONS = 15
"""As in the paper, for the methods beside the default one."""
_DIRECT = MeasureOptions(sections=_SECTIONS, rigid=(_direct("coarse"), _direct(2)), deformation=_SECTION_STAGES)


def pgd(experiment: Experiment) -> Measurement:
    """Measure by the paper's protocol, `pdvc.options.paper_options`."""
    return measure(experiment, paper_options())


def smoother(experiment: Experiment) -> Measurement:
    """Measure by the default protocol."""
    return measure(experiment)


def gauss_newton(experiment: Experiment) -> Measurement:
    """Measure by direct solves of all unknowns, from coarse to fine, with time functions and the paper's sections."""
    return measure(experiment, _DIRECT)


def weighted(experiment: Experiment) -> Measurement:
    """Measure as `gauss_newton` does, with pixels weighted by their noise."""
    return measure(experiment, _DIRECT.model_copy(update={"weighting": "noise"}))


def each_step(experiment: Experiment) -> Measurement:
    """Measure each radiograph by itself.

    The prior is meant at each step. With no other step to lean on, a motion of many pixels has to be found from one
    radiograph: the rigid stage begins at a coarser scale than that of the other methods.
    """
    coarsest = max(scale for scale in (2, 4, 8, 16) if scale == 2 or experiment.geometry.rows >= 25 * scale)
    scales = [scale for scale in (16, 8, 4, 2) if scale <= coarsest]
    options = MeasureOptions(
        sections=_SECTIONS,
        time=(Steps(),),
        rigid=tuple(_direct(scale) for scale in scales),
        deformation=_SECTION_STAGES,
        # the one function of a step is sqrt(steps) there and zero elsewhere
        prior_voxel=30 / float(np.sqrt(len(experiment.test))),
    )
    return measure(experiment, options)


def classical_dvc(experiment: Experiment) -> Measurement:
    """Correlate the interrupted scans with the reference scan: `pdvc.volume_correlation`."""
    return correlate(experiment, _DIRECT)


PGD = Method(
    name="pgd",
    measure=pgd,
    assumes="Assume that few space-time modes hold the motion, of rigid sections and of the paper's seven time "
    "functions: eight of the sample as a whole, then four of its sections, each from one linearisation. All pixels "
    "count alike.",
)
SMOOTHER = Method(
    name="smoother",
    measure=smoother,
    assumes="Assume sections that move rigidly or contract, and a motion of any history, smooth over the steps as far "
    "as the radiographs say so but for events; contraction is expected to keep the volume, and found where it does "
    "not.",
)
GAUSS_NEWTON = Method(
    name="gauss-newton",
    measure=gauss_newton,
    assumes="Assume sections that move rigidly or contract, and nine time functions; solve for all unknowns at once, "
    "from coarse to fine. All pixels count alike, and a prior of 30 voxels holds what the radiographs do not "
    "determine.",
)
WEIGHTED = Method(
    name="weighted",
    measure=weighted,
    assumes="Assume what gauss-newton does, and besides that the noise of each pixel is known, by which it is "
    "weighted. With the prior this is the efficient estimator, as far as motion, volume and noise are what the model "
    "says.",
)
EACH_STEP = Method(
    name="each-step",
    measure=each_step,
    assumes="Assume sections that move rigidly or contract, and nothing about time: each radiograph is measured by "
    "itself, so that what it hardly shows, motion along its beam above all, is left to noise and to the prior of 30 "
    "voxels.",
)
CLASSICAL_DVC = Method(
    name="classical-dvc",
    measure=classical_dvc,
    assumes="Assume sections that move rigidly or contract, and a sample that stands still at some steps for as long "
    "as a full scan takes, without creep. Each scan is compared with the reference voxel by voxel; between scans "
    "nothing is known.",
    looks_at="volumes",
)
