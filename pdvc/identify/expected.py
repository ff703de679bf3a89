"""How well a law would be known of a test that is still to be made, for its force programme and for others.

From the reference scan alone: at rest, a step at a stage angle shows what the reference view next to it shows, and its
noise is as large. B(t) and V(t) of the planned steps are taken there; the law with the values it is thought to have
tells how its parameters move the sections, and the covariance follows as after the test, by
`pdvc.identify.integrated`. The process beside the law is assumed, not found: as smooth as in the simulated tests.
Errors of the image model, and noise that steps have in common, are not in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.experiment import Experiment, Series
from pdvc.geometry import nearest_angles
from pdvc.identify.carried import Carrier
from pdvc.identify.integrated import Radiographs, expected_covariance, radiographs_at
from pdvc.identify.model import Model, neck_ramps
from pdvc.identify.opening import problem_at, profile_from
from pdvc.identify.options import IdentifyOptions
from pdvc.onset import onset
from pdvc.options import MeasureOptions
from pdvc.preparation import prepare
from pdvc.progress import Progress, silent
from pdvc.setup import set_up
from pdvc.smoother import Smoother
from pdvc.state_space import Deviations, StateSpace

Floats = NDArray[np.float64]

RIGID_VOXEL, OWN_VOXEL, END_VOXEL, APPARENT_VOXEL = 2e-3, 2e-4, 0.05, 1e-3
"""Deviations of the process that are assumed: bends of the whole and of sections, ends, apparent motions; as found in
`quick` and `small`, rounded up."""
FORCE_NOISE_N = 1.0
"""Noise of a force that is not stated."""
_CYCLES, _CYCLE_SHARE = 2, 0.12
_NEAR_YIELD, _SLOW_SHARE = 0.15, 0.5


@dataclass(frozen=True, kw_only=True)
class ExpectedLaw:
    """What is expected of a force programme."""

    programme: str
    deviation: dict[str, float]
    """Relative standard deviation of each of the law's parameters."""


def expected_laws(
    experiment: Experiment, measure: MeasureOptions, options: IdentifyOptions, *, progress: Progress = silent
) -> tuple[ExpectedLaw, ...]:
    """Return what is expected of a planned test: as it is, with two unloadings, and slower near yield.

    Of the experiment's test only angles, times and forces are looked at. Raises ValueError where no load is planned,
    or the description does not tell the noise.
    """
    planned = experiment.test
    loaded = onset(planned.force_N)
    if loaded is None:
        raise ValueError("force_N: expected a planned test whose force leaves a plateau, found none")
    views = nearest_angles(planned.angle_rad, experiment.reference.angle_rad)
    counts = experiment.reference.counts[views]
    stand_in = replace(experiment, test=replace(planned, counts=counts), interrupted=())
    setup = set_up(stand_in, measure, progress=progress)
    fine = prepare(setup, 1, progress)
    basis, steps = setup.sections, len(views)
    still = np.zeros((steps, *basis.shape))
    problem = problem_at(setup, fine, basis, still, clear=False, progress=progress)
    spaces = Smoother().spaces(problem)
    radiographs = radiographs_at(problem, spaces, still.reshape(steps, -1))
    profile, share = profile_from(fine.images.volume, setup, options)
    voxel_mm = experiment.geometry.voxel_mm
    model = Model(
        law=options.law,
        profile=profile,
        area_deviation=share,
        reference_N=float(np.mean(experiment.reference.force_N)),
        force_noise_N=options.force_noise_N or FORCE_NOISE_N,
        carrier=Carrier(basis=basis, voxel_mm=voxel_mm, height_mm=profile.height_mm, shift_mm=np.zeros(steps)),
        neck=neck_ramps(steps, loaded) if options.neck else np.zeros((0, steps)),
        bridgman=options.bridgman,
    )
    programmes: dict[str, Callable[[], Floats]] = {
        "as planned": lambda: planned.force_N,
        f"{_CYCLES} unloadings": lambda: unloading(planned.force_N, loaded),
        "slower near yield": lambda: slower_near_yield(planned.force_N, loaded, _yield_N(model, planned)),
    }
    found = []
    for name, force in programmes.items():
        found.append(ExpectedLaw(programme=name, deviation=_deviations(model, force(), radiographs)))
        progress("force programmes", len(found), len(programmes))
    return tuple(found)


def assumed(space: StateSpace) -> Deviations:
    """Return the deviations that are assumed of whatever moves beside the law."""
    guess = space.first_guess()
    bends = np.full_like(guess.bend_voxel, OWN_VOXEL)
    bends[: space.rigid] = RIGID_VOXEL
    return replace(
        guess,
        bend_voxel=bends,
        end_voxel=np.full_like(guess.end_voxel, END_VOXEL),
        apparent_voxel=np.full_like(guess.apparent_voxel, APPARENT_VOXEL),
    )


def unloading(force_N: Floats, loaded: int) -> Floats:
    """Return a programme (step,) that ends as the given one, and is unloaded to the plateau twice on the way."""
    plateau, steps = float(np.mean(force_N[: max(loaded, 1)])), len(force_N)
    length = max(round(_CYCLE_SHARE * (steps - loaded)), 2)
    rest = np.interp(np.linspace(loaded, steps - 1, steps - loaded - _CYCLES * length), np.arange(steps), force_N)
    parts = np.array_split(rest, _CYCLES + 1)
    course = [force_N[:loaded], parts[0]]
    for part in parts[1:]:
        from_, back = course[-1][-1], part[0]
        half = length // 2
        course += [np.linspace(from_, plateau, half + 1)[1:], np.linspace(plateau, back, length - half + 1)[1:], part]
    return np.concatenate(course)


def slower_near_yield(force_N: Floats, loaded: int, yield_N: float) -> Floats:
    """Return a programme (step,) through the same forces, half of whose loaded steps are within 15 % of yield."""
    steps = len(force_N)
    rising = np.maximum.accumulate(force_N[loaded:])
    low, high = (1 - _NEAR_YIELD) * yield_N, (1 + _NEAR_YIELD) * yield_N
    first, last, top = rising[0], rising[-1], min(high, rising[-1])
    low = max(low, first)
    if not low < top:
        return force_N
    slow = round(_SLOW_SHARE * (steps - loaded))
    others = rising[(rising < low) | (rising > top)]
    fast = steps - loaded - slow
    picked = (
        np.interp(np.linspace(0, max(len(others) - 1, 0), fast), np.arange(len(others)), others)
        if len(others)
        else np.linspace(top, last, fast)
    )
    return np.concatenate([force_N[:loaded], np.sort(np.concatenate([picked, np.linspace(low, top, slow)]))])


def _yield_N(model: Model, planned: Series) -> float:
    """Return the force at which the smallest section has strained plastically by 0.2 %, at most the largest."""
    stress = float(model.law.flow_MPa(np.array([0.002]))[0])
    return min(stress * float(model.profile.area_mm2.min()), float(planned.force_N.max()))


def _deviations(model: Model, force_N: Floats, radiographs: Radiographs) -> dict[str, float]:
    covariance = expected_covariance(model, force_N, radiographs, assumed(radiographs.spaces[1]))
    names = model.unknowns.names[: model.unknowns.of_law]
    return dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=False))
