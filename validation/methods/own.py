"""Our own methods: the paper's, three more over the same equations, and classical volume correlation."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pdvc.experiment import Experiment
from pdvc.history import Steps
from pdvc.measure import measure
from pdvc.measurement import Measurement
from pdvc.options import MeasureOptions, StageOptions, paper_options
from pdvc.volume_correlation import correlate
from validation.methods.registry import looks_at_volumes


def _direct(scale: int | Literal["coarse"]) -> StageOptions:
    return StageOptions(scale=scale, solver="gauss-newton", most=12)


_SECTION_STAGES = (_direct(2), _direct(1))
_DIRECT = MeasureOptions(rigid=(_direct("coarse"), _direct(2)), deformation=_SECTION_STAGES)


def pgd(experiment: Experiment) -> Measurement:
    """Assume that few space-time modes hold the motion, of rigid sections and of the paper's seven time functions:
    eight of the sample as a whole, then four of its sections, each from one linearisation. All pixels count alike.

    The paper's protocol: `pdvc.options.paper_options`.
    """
    return measure(experiment, paper_options())


def gauss_newton(experiment: Experiment) -> Measurement:
    """Assume sections that move rigidly or contract, and nine time functions; solve for all unknowns at once, from
    coarse to fine. All pixels count alike, and a prior of 30 voxels holds what the radiographs do not determine.
    """
    return measure(experiment, _DIRECT)


def weighted(experiment: Experiment) -> Measurement:
    """Assume what gauss-newton does, and besides that the noise of each pixel is known, by which it is weighted.
    With the prior this is the efficient estimator, as far as motion, volume and noise are what the model says.
    """
    return measure(experiment, _DIRECT.model_copy(update={"weighting": "noise"}))


def each_step(experiment: Experiment) -> Measurement:
    """Assume sections that move rigidly or contract, and nothing about time: each radiograph is measured by itself,
    so that what it hardly shows, motion along its beam above all, is left to noise and to the prior of 30 voxels.

    The prior is meant at each step. With no other step to lean on, a motion of many pixels has to be found from one
    radiograph: the rigid stage begins at a coarser scale than that of the other methods.
    """
    coarsest = max(scale for scale in (2, 4, 8, 16) if scale == 2 or experiment.geometry.rows >= 25 * scale)
    scales = [scale for scale in (16, 8, 4, 2) if scale <= coarsest]
    options = MeasureOptions(
        time=(Steps(),),
        rigid=tuple(_direct(scale) for scale in scales),
        deformation=_SECTION_STAGES,
        # the one function of a step is sqrt(steps) there and zero elsewhere
        prior_voxel=30 / float(np.sqrt(len(experiment.test))),
    )
    return measure(experiment, options)


@looks_at_volumes
def classical_dvc(experiment: Experiment) -> Measurement:
    """Assume sections that move rigidly or contract, and a sample that stands still at some steps for as long as a
    full scan takes, without creep. Each scan is compared with the reference voxel by voxel; between scans nothing is
    known.

    Classical digital volume correlation: `pdvc.volume_correlation`.
    """
    return correlate(experiment, _DIRECT)
