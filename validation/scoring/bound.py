"""The Cramer-Rao bound: the least random error that an unbiased measurement of a scenario's radiographs can have.

The noise of each pixel is known and independent, that of a radiograph of the test and that of the reference scan in
the same direction, both of photons and readout:

    v(t, p) = v_g(t, p) + sum_v a_tv^2 v_v(p)         a_tv: share of view v at the step (`pdvc.systematic`)

The sample at rest is known no better than its reference scan shows it. The detector's fixed pattern is taken as known:
all radiographs together tell it. With S the sensitivities at the true motion and P the prior's precision, the
information is

    I = sum_t sigma(t) sigma(t)^T (x) S(t)^T diag(1 / v(t)) S(t) + P,          C >= I^-1

S is pdvc's own, from the scenario without any noise, so that what reconstruction blurs is missing in it; the
radiographs are not filtered. That steps a turn apart share the noise of a view is left out, which lowers the bound.

Efficiency is the bound over the random error that was observed, both as standard deviations.
"""

from __future__ import annotations

import json
import tempfile
import uuid
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc.deviations import Knowledge, Quantities
from pdvc.equations import Images, joined, linearise
from pdvc.experiment import Experiment, read_experiment
from pdvc.noise import mean_of_views, separate
from pdvc.options import MeasureOptions
from pdvc.preparation import prepare, stated_noise
from pdvc.prior import solved
from pdvc.progress import Progress, silent
from pdvc.sections import SectionBasis
from pdvc.setup import set_up
from simulator.scanner import simulate
from simulator.scenario import Scenario
from simulator.truth import read_truth
from validation.scoring.centre_line import TruePoints
from validation.scoring.interval_calibration import true_coefficients

Floats = NDArray[np.float64]

_PHOTONS = 1e13
"""Photons in a pixel of what counts as free of noise: the rounding of counts is a hundred times as much."""


def noise_free(scenario: Scenario) -> Scenario:
    """Return the scenario with so many photons that only the rounding of counts is left, and no bad pixel."""
    quiet = {"photons_per_pixel": _PHOTONS, "readout_noise_counts": 0.0, "bad_pixel_fraction": 0.0}
    return scenario.model_copy(update={"detector": scenario.detector.model_copy(update=quiet), "repetition": 0})


def bound_of(
    scenario: Scenario, options: MeasureOptions, clean: Path | None = None, *, progress: Progress = silent
) -> tuple[Knowledge, TruePoints]:
    """Return the bound of a scenario for the bases and the prior of some options, and the true motion.

    `clean` is a folder of noise-free radiographs (`simulator.clean`), shared with other work on the scenario.
    """
    options = options.model_copy(update={"smooth_px": 0.0})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate(noise_free(scenario), folder, clean=clean, progress=progress)
        experiment, truth = read_experiment(folder), read_truth(folder)
        detector = scenario.detector
        known = replace(
            experiment,
            photons_per_count=detector.photons_per_count,
            readout_noise_counts=detector.readout_noise_counts,
            frames=detector.frames,
        )
        return _bound(known, truth, options, progress), truth


def _bound(experiment: Experiment, truth: TruePoints, options: MeasureOptions, progress: Progress) -> Knowledge:
    """Return the bound from an experiment whose counts are free of the noise that its description tells of."""
    setup = set_up(experiment, options, progress=progress)
    basis, time_functions = setup.sections, setup.time_functions()
    prepared = prepare(setup, 1, progress)
    noise, _ = stated_noise(setup, prepared.systematic)
    voxel_mm = experiment.geometry.voxel_mm
    coefficients, _ = true_coefficients(basis, time_functions, voxel_mm, truth)
    amplitude = np.einsum("ft,fjk->tjk", time_functions, coefficients)
    systematic, images = prepared.systematic, prepared.images
    sight = systematic.looked_along(slice(None), images.rays, basis, amplitude, voxel_mm)
    information = np.stack(
        [
            1 / (noise.step(t).variance + mean_of_views(noise, sight.of_step(t)).variance[systematic.window])
            for t in range(len(amplitude))
        ]
    )
    images = replace(images, weight=np.where(images.weight > 0, information, 0).astype(np.float32))
    return Knowledge(
        basis=basis,
        time_functions=time_functions,
        angle_rad=experiment.test.angle_rad,
        voxel_mm=voxel_mm,
        covariance=_inverse(images, basis, amplitude, time_functions, options.prior_voxel, progress),
    )


def _inverse(
    images: Images,
    basis: SectionBasis,
    amplitude: Floats,
    time_functions: Floats,
    prior_voxel: float,
    progress: Progress,
) -> Floats:
    equations = linearise(images, basis, amplitude, progress=progress, task="bound")
    size = basis.shape[0] * basis.shape[1]
    if separate(time_functions):
        first = [int(np.argmax(f != 0)) for f in time_functions]
        matrices = [f[t] ** 2 * equations.matrix[t] for t, f in zip(first, time_functions, strict=True)]
        return np.stack([solved(m + np.eye(size) / prior_voxel**2, np.eye(size)) for m in matrices])
    matrix = joined(equations.matrix, time_functions)
    return solved(matrix + np.eye(len(matrix)) / prior_voxel**2, np.eye(len(matrix)))


def kept_bound(scenario: Scenario, options: MeasureOptions, path: Path, clean: Path) -> Quantities:
    """Return the bound's quantities, computed and kept as JSON in a file unless they are there."""
    try:
        return Quantities(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):  # not there, or damaged
        found, truth = bound_of(scenario, options, clean)
        quantities = found.quantities(truth.point_mm, truth.displacement_mm)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
        partial.write_text(json.dumps(asdict(quantities)), encoding="utf-8")
        partial.replace(path)
        return quantities
