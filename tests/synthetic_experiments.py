"""Experiments of random counts, without simulating anything: for what reads and writes them."""

from __future__ import annotations

import numpy as np

from pdvc.experiment import Experiment, Series
from pdvc.geometry import ConeBeam
from tests.radiograph_files import random_counts

GEOMETRY = ConeBeam(
    source_axis_mm=30.0,
    source_detector_mm=300.0,
    pixel_mm=0.5,
    rows=4,
    columns=3,
    column_shift_mm=0.3,
    row_shift_mm=-0.2,
    roll_rad=0.02,
)


def experiment(geometry: ConeBeam = GEOMETRY, seed: int = 0) -> Experiment:
    """Return five views at rest, three steps, two flats and a dark."""
    size = geometry.rows, geometry.columns

    def series(count: int, start: float) -> Series:
        return Series(
            counts=random_counts(seed + count, (count, *size)),
            angle_rad=start + 0.3 * np.arange(count),
            time_s=2.0 * np.arange(count) + 0.5,
            force_N=250.0 + np.arange(count) ** 2,
        )

    return Experiment(
        title="random",
        material="none",
        geometry=geometry,
        frames=1,
        photons_per_count=None,
        readout_noise_counts=None,
        reference=series(5, 0.1),
        test=series(3, -1.0),
        flats=random_counts(seed + 50, (2, *size)),
        darks=random_counts(seed + 60, (1, *size)),
    )
