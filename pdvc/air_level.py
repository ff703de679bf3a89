"""Whether the beam was as bright in the test as in the reference scan, by the air beside the sample.

Where a pixel sees air in every radiograph, the mean over these pixels

    b = mean of (I - D) / (I0 - D),        var b = mean of var I / (I0 - D)^2 / pixels

tells the beam of an image over that of the flats. The noise of the flats is in all images alike, and in no
difference of two. A radiograph is compared with the reference view that looks along its direction: what that view
leaves of its re-projection, its beam with it, is subtracted. Of that difference, delta, the mean over as many
steps as a measurement joins counts: what changes from one step to the next averages out.

A beam that is dimmer by delta adds delta to all attenuations, as a larger sample does. One that is larger by epsilon,
and nearer to the source by as much of its distance R, has the outline it had, and grey levels 1 + epsilon times as
large, so that by least squares over the pixels, with g the grey level and q the attenuation,

    epsilon = delta sum g (dg / dq) / sum g^2         R epsilon along the beam
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.brightness import air_pixels
from pdvc.experiment import Experiment, Series
from pdvc.geometry import nearest_angles
from pdvc.radiographs import IDENTITY, Calibration, binned, detector_noise, grey_levels, grey_of, slope_of
from pdvc.robust import usual_size
from pdvc.verdict import Doubt

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

BEAM_DRIFT = "beam-drift"
LOOKED_AT, COLUMNS = 16, 50
"""Images of each stack in which air is looked for, binned to about this many columns."""
PIXELS = 60_000
"""Pixels of air that tell the beam of an image, about: some are skipped where there are more."""
FAR_OFF = 6.0
"""Deviations from which on a pixel shows something else than air."""
BLOCKS = 16
"""Blocks of pixels that tell the deviation of their mean, where the noise is not stated."""
JOINED = 16
"""Steps that a measurement joins, about."""
TOLD, MATTERS = 3.0, 2.0
"""A difference over what noise makes of it, rms over the steps, from which on it is one; its worth over the stated
deviation from which on it is doubted: the sample scatters into the air, and turns."""


@dataclass(frozen=True, kw_only=True)
class AirLevel:
    """The beam of each image over that of the flats, and its standard deviation but for the noise of the flats."""

    reference: Floats
    """(view, 2)"""
    test: Floats
    """(step, 2)"""


@dataclass(frozen=True, kw_only=True)
class Air:
    """The pixels that see air in all radiographs, and what they should hold."""

    pixels: NDArray[np.intp]
    """Numbers of the pixels in an image (pixel,)."""
    dark: Image
    """Counts (pixel,)."""
    open_beam: Image
    """Counts without the dark (pixel,)."""
    variance: float | None
    """Of a pixel's (I - D) / (I0 - D) by the noise of I, where it is stated."""

    def level(self, counts: NDArray[np.uint16]) -> tuple[float, float]:
        """Return b of an image (row, column) and its standard deviation."""
        ratio = np.asarray((counts.ravel()[self.pixels] - self.dark) / self.open_beam, dtype=float)
        middle = float(np.median(ratio))
        off = ratio - middle
        # a zinger, or debris, shows another thing
        kept = off[np.abs(off) <= FAR_OFF * max(float(usual_size(off)), 1e-12)]
        mean = middle + float(kept.mean())
        if self.variance is not None:
            return mean, float(np.sqrt(self.variance * max(mean, 1e-3) / len(kept)))
        blocks = np.array([block.mean() for block in np.array_split(kept, min(BLOCKS, len(kept)))])
        return mean, float(blocks.std(ddof=1) / np.sqrt(len(blocks)))

    def levels(self, counts: NDArray[np.uint16]) -> Floats:
        """Return b and its standard deviation (image, 2) of images (image, row, column)."""
        with ThreadPoolExecutor(numba.get_num_threads()) as pool:
            return np.array(list(pool.map(self.level, counts)))


def air_of(experiment: Experiment, calibration: Calibration, stacks: tuple[Series, ...]) -> Air | None:
    """Return the pixels that see air in all images of some stacks; None where there are too few."""
    found = _air(stacks, replace(calibration, polynomial=IDENTITY, air=None))
    if found is None:
        return None
    pixels = np.flatnonzero(found)[:: max(1, int(found.sum()) // PIXELS)]
    beam, noise = calibration.open_beam.ravel()[pixels], detector_noise(experiment)
    return Air(
        pixels=pixels,
        dark=calibration.dark.ravel()[pixels],
        open_beam=beam,
        variance=None if noise is None else float(noise.relative_variance(beam).mean(dtype=float)),
    )


def air_level(experiment: Experiment, calibration: Calibration) -> AirLevel | None:
    """Return the beam of all images, told by pixels that see air in both stacks; None where there are too few."""
    stacks = (experiment.reference, experiment.test)
    air = air_of(experiment, calibration, stacks)
    if air is None:
        return None
    reference, test = (air.levels(series.counts) for series in stacks)
    return AirLevel(reference=reference, test=test)


def _air(stacks: tuple[Series, ...], calibration: Calibration) -> NDArray[np.bool_] | None:
    """Return the pixels (row, column) that see air in all images; `calibration` without air or polynomial."""
    rows, columns = calibration.bad.shape
    coarse = max(1, columns // COLUMNS)
    few = calibration.binned(coarse)
    chosen = ((each, np.linspace(0, len(each) - 1, min(LOOKED_AT, len(each))).astype(int)) for each in stacks)
    views = (grey_levels(binned(each.counts[k], coarse), few) for each, numbers in chosen for k in numbers.tolist())
    seen = air_pixels(views, few.bad)
    if seen is None:
        return None
    air = np.zeros((rows, columns), dtype=bool)
    fine = np.kron(seen, np.ones((coarse, coarse), dtype=bool))
    air[: fine.shape[0], : fine.shape[1]] = fine
    return air & ~calibration.bad


def worth_voxel(counts: NDArray[np.uint16], calibration: Calibration, source_axis_voxel: float) -> float:
    """Return R epsilon / delta, voxels along the beam, by a radiograph (row, column) of the sample."""
    q = grey_levels(counts, replace(calibration, polynomial=IDENTITY)).astype(float)
    g = grey_of(q, calibration.polynomial)
    return float(source_axis_voxel * (g * slope_of(q, calibration.polynomial)).sum() / (g**2).sum())


def doubts_of_air(
    found: AirLevel,
    view_rad: Floats,
    step_rad: Floats,
    *,
    worth_voxel: float,
    stated_voxel: float,
    joined: int = JOINED,
) -> Iterator[Doubt]:
    """Give the doubt about a beam of the test that is not that of the reference scan.

    `view_rad` (view,) and `step_rad` (step,) are the stage angles; `worth_voxel` as of the function of that name;
    `stated_voxel` the standard deviation of the motion along the beam; `joined` the steps that the measurement joins.
    """
    view = found.reference[nearest_angles(step_rad, view_rad)]
    off = found.test[:, 0] - view[:, 0]
    variance = found.test[:, 1] ** 2 + view[:, 1] ** 2
    width = min(joined, len(off))
    mean = ndimage.uniform_filter1d(off, width, mode="nearest")
    noise = float(np.sqrt(variance.mean() / width))
    size = float(np.sqrt(max(np.mean(mean**2) - noise**2, 0.0)))
    if size <= TOLD * noise or size * worth_voxel <= MATTERS * stated_voxel:
        return
    whole, last = float(off.mean()), len(found.reference) // 4 or 1
    within = float(found.reference[-last:, 0].mean() - found.reference[:last, 0].mean())
    yield Doubt(
        name=BEAM_DRIFT,
        figure=f"by the air beside the sample the beam of the test is off that of the reference scan by {whole:+.3%} "
        f"on average, {size:.3%} rms, known to {noise:.3%} (within the reference scan it changed by {within:+.3%}): "
        f"worth {size * worth_voxel:.2g} voxel along the beam, where a deviation of {stated_voxel:.2g} is stated",
        advice="measure with brightness = 'air', or take flats anew right before the test",
        steps=tuple(np.flatnonzero(np.abs(mean) * worth_voxel > MATTERS * stated_voxel).tolist()),
    )
