"""A look at an experiment before anything is measured: counts, air, noise, angles, onset of loading.

What is found here are figures alone; `pdvc.data_checks` says what is wrong with them.

    T = (I - D) / (I0 - D)                 transmission: 1 in air, small behind the sample
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pdvc.experiment import REFERENCE, TEST, Experiment
from pdvc.geometry import gaps_rad
from pdvc.likeness import Likeness, likeness
from pdvc.onset import onset
from pdvc.progress import Progress, silent
from pdvc.radiographs import Calibration, calibrate, detector_noise
from pdvc.seen_twice import SeenTwice, seen_twice

Floats = NDArray[np.float64]

EDGE_SHARE = 0.04
"""Share of the columns, on each side, that should see air."""
DARK = 0.02
"""A transmission under this is black."""
SHADE = 0.9
"""A transmission under this is behind a sample."""
BRIGHT = 1.3
"""A transmission above this is brighter than any air."""
CHANCE = 8
"""Pixels of an image that may hold its largest count without it being clipped."""
_PIXELS = 15_000
"""Pixels of an image that are looked at, about: rows are skipped in large ones."""


@dataclass(frozen=True, kw_only=True)
class StackLook:
    """What the images of a stack look like; transmissions by the mean flat and dark."""

    lowest: int
    """Smallest count of a pixel that is not bad."""
    median: float
    """Median count."""
    highest: int
    """Largest count of a pixel that is not bad."""
    at_top: Floats
    """(image,) share of pixels at the largest count of the image: next to nothing unless it saturates."""
    air: Floats
    """(image,) transmission next to the left or the right edge, the larger of both medians."""
    black: Floats
    """(image,) share of pixels that are black."""
    bright: Floats
    """(image,) share of pixels brighter than any air."""
    shaded: Floats
    """(image,) share of pixels behind the sample."""
    steepest: Floats
    """(image,) largest change from a column to the next, over the largest attenuation of its row; median over rows."""
    edge: Floats
    """(image,) share of rows that see the sample next to the left or the right edge."""


@dataclass(frozen=True, kw_only=True)
class Examination:
    """The figures of an experiment."""

    calibration: Calibration
    stacks: Mapping[str, StackLook]
    """By file name: test and reference radiographs."""
    flats_top: float
    """Share of pixels of the flats at their largest count."""
    flats_full: bool
    """Whether that is the largest count that a detector stores."""
    bad_share: float
    """Share of pixels that are not to be believed."""
    noise_ratio: float
    """Variance between flats over what the description says of it; NaN where either is not known."""
    largest_gap_rad: float
    """Largest gap between neighbouring angles of the reference views, rad."""
    repeated: tuple[int, ...]
    """Steps whose radiograph is that of an earlier step, count for count; none where there is no noise."""
    onset: int | None
    """Step before the force leaves its plateau; None where it does not."""
    seen_twice: SeenTwice | None
    """None where the views do not go all around, or before `with_angles`."""
    likeness: Likeness | None
    """None before `with_angles`."""


def examine(experiment: Experiment, *, progress: Progress = silent) -> Examination:
    """Look at all stacks of an experiment, one image after the other.

    Raises ValueError where the flats are not brighter than the darks.
    """
    calibration = calibrate(experiment)
    series = {REFERENCE: experiment.reference, TEST: experiment.test}
    total, done = sum(len(each) for each in series.values()), 0
    stacks = {}
    for name, each in series.items():
        stacks[name] = look_at(each.counts, calibration)
        done += len(each)
        progress("examine", done, total)
    return Examination(
        calibration=calibration,
        stacks=stacks,
        flats_top=share_at_top(experiment.flats),
        flats_full=full_scale(int(experiment.flats.max())),
        bad_share=float(calibration.bad.mean()),
        noise_ratio=_noise_ratio(experiment, calibration),
        largest_gap_rad=float(gaps_rad(np.sort(np.mod(experiment.reference.angle_rad, 2 * np.pi))).max()),
        repeated=_repeated(experiment),
        onset=onset(experiment.test.force_N),
        seen_twice=None,
        likeness=None,
    )


def with_angles(found: Examination, experiment: Experiment, *, progress: Progress = silent) -> Examination:
    """Return an examination with what opposite views, and the likeness of both stacks, tell of the angles."""
    progress("examine angles", 0, 2)
    twice = seen_twice(experiment.reference, experiment.geometry, found.calibration)
    progress("examine angles", 1, 2)
    like = likeness(experiment, found.calibration)
    progress("examine angles", 2, 2)
    return replace(found, seen_twice=twice, likeness=like)


def look_at(counts: NDArray[np.uint16], calibration: Calibration) -> StackLook:
    """Return what images of counts (image, row, column) look like."""
    rows, columns = counts.shape[1:]
    every = max(1, rows * columns // _PIXELS)
    some = np.s_[::every]
    dark, beam, good = calibration.dark[some], calibration.open_beam[some], ~calibration.bad[some]
    width = max(2, round(columns * EDGE_SHARE))
    lows, medians, highs = [], [], []
    found: dict[str, list[float]] = {
        name: [] for name in ("at_top", "air", "steepest", "black", "bright", "shaded", "edge")
    }
    for image in counts:
        part = np.asarray(image[some])
        seen = np.asarray((part - dark) / beam, dtype=np.float64)
        sides = [np.nanmedian(np.where(good, seen, np.nan)[:, at], axis=1) for at in np.s_[:width, -width:]]
        believed = part[good]
        lows.append(int(believed.min()))
        highs.append(int(believed.max()))
        medians.append(float(np.median(believed)))
        found["air"].append(max(float(np.nanmedian(side)) for side in sides))
        found["edge"].append(max(float((side < SHADE * found["air"][-1]).mean()) for side in sides))
        found["steepest"].append(_steepest(seen, good))
        inside = seen[good]
        at_top = int((believed == highs[-1]).sum())
        found["at_top"].append(at_top / believed.size if at_top >= CHANCE else 0.0)
        for name, chosen in (("black", inside < DARK), ("bright", inside > BRIGHT), ("shaded", inside < SHADE)):
            found[name].append(float(chosen.mean()))
    return StackLook(
        lowest=min(lows),
        median=float(np.median(medians)),
        highest=max(highs),
        **{name: np.array(values) for name, values in found.items()},
    )


def _steepest(transmission: Floats, good: NDArray[np.bool_]) -> float:
    """Return how steeply attenuation rises at the sample's edge: at once where a flat face lies along the beam."""
    attenuation = np.where(good, -np.log(np.clip(transmission, 1e-3, None)), 0.0)
    largest = np.maximum(attenuation.max(axis=1), 1e-3)
    # a dead column is no face
    rise = np.abs(np.diff(attenuation, axis=1)) * (good[:, 1:] & good[:, :-1])
    return float(np.median(rise.max(axis=1) / largest))


def share_at_top(counts: NDArray[np.uint16]) -> float:
    """Return the share of counts that are the largest of all."""
    return float((counts == counts.max()).mean())


def full_scale(count: int) -> bool:
    """Return whether a count is the largest that a detector of eight bits or more stores."""
    return count >= 255 and (count + 1) & count == 0


def _noise_ratio(experiment: Experiment, calibration: Calibration) -> float:
    """Return the variance between two flats over the one expected; NaN without a description or a second flat."""
    noise = detector_noise(experiment)
    if noise is None or len(experiment.flats) < 2:
        return float("nan")
    one, other = (experiment.flats[k].astype(float) for k in (0, 1))
    good = ~calibration.bad
    change = (one - other)[good]
    expected = 2 * (noise.relative_variance(calibration.open_beam) * calibration.open_beam**2)[good]
    # counts are whole numbers, which adds 1/12 to the variance of each
    return float(np.var(change) / (expected.mean() + 2 / 12))


def _repeated(experiment: Experiment) -> tuple[int, ...]:
    flats, counts = experiment.flats, experiment.test.counts
    if len(flats) > 1 and np.array_equal(flats[0], flats[1]):  # without noise the same state gives the same counts
        return ()
    seen: set[bytes] = set()
    found = []
    for step, image in enumerate(counts):
        key = hashlib.sha256(np.ascontiguousarray(image).tobytes()).digest()
        if key in seen:
            found.append(step)
        seen.add(key)
    return tuple(found)
