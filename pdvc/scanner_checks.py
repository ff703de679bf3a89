"""Whether the scanner was in the test what it was in the reference scan, as far as measuring it would matter.

Air tells of the beam (`pdvc.air_level`), reference views of the geometry and of what changed during their scan
(`pdvc.view_trends`). What is smaller than the deviations that the measurement states is no reason to doubt it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pdvc.air_level import JOINED, air_level, doubts_of_air, worth_voxel
from pdvc.measurement import MeasuredMotion
from pdvc.preparation import AtRest, Prepared
from pdvc.setup import Setup
from pdvc.smoother import Smoother
from pdvc.verdict import Doubt
from pdvc.view_trends import FADING, MOST_PIXELS, ViewTrends, doubts_of_views, view_trends


def doubts_of_scanner(setup: Setup, prepared: Mapping[int, Prepared], motion: MeasuredMotion) -> tuple[Doubt, ...]:
    """Return what speaks against a motion by what its scanner did; `prepared` are the images of each scale."""
    # parts of a variance: squares add up
    parts = np.square(list(motion.std_by_source.values()) or [(0.0, 0.0, 0.0)])
    across, vertical, along = np.sqrt(parts.sum(axis=0)).tolist()
    of_beam = _of_beam(setup, along)
    scale = max(prepared)
    trends = reference_trends(setup, prepared[scale], scale)
    if trends is None:
        return of_beam
    geometry = setup.geometry
    of_views = doubts_of_views(
        trends,
        across_voxel=across,
        vertical_voxel=vertical,
        along_voxel=along,
        source_axis_voxel=geometry.source_axis_mm / geometry.voxel_mm,
    )
    # what a beam that drifts does to the sample's grey levels is told already
    return (*of_beam, *(doubt for doubt in of_views if not (of_beam and doubt.name == FADING)))


def _of_beam(setup: Setup, along_voxel: float) -> tuple[Doubt, ...]:
    """Return the doubt about the beam, where it was not corrected."""
    experiment, calibration = setup.experiment, setup.calibration
    found = air_level(experiment, calibration) if calibration.air is None else None
    if found is None:
        return ()
    geometry, reference = setup.geometry, experiment.reference
    joins = isinstance(setup.options.deformation[-1].solver, Smoother)
    return tuple(
        doubts_of_air(
            found,
            reference.angle_rad,
            experiment.test.angle_rad,
            worth_voxel=worth_voxel(reference.counts[0], calibration, geometry.source_axis_mm / geometry.voxel_mm),
            stated_voxel=along_voxel,
            joined=JOINED if joins else 1,
        )
    )


def reference_trends(setup: Setup, coarse: Prepared | AtRest, scale: int) -> ViewTrends | None:
    """Return what the reference views tell at a scale; None where they are too few, or too fine for a look."""
    systematic, reference = coarse.systematic, setup.experiment.reference
    views, window = len(systematic.view_rad), systematic.window
    if views * np.prod(systematic.shape) > MOST_PIXELS:
        return None
    systematic.ready(range(views))
    # at scale n every n-th view tells
    return view_trends(
        lambda i: coarse.view(scale * i)[window],
        lambda i: systematic.left(i)[window],
        systematic.view_rad,
        reference.time_s[::scale],
        scale,
        systematic.detector[0] / 2,
    )
