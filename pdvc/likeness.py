"""Which reference view each radiograph of the test is most like: a look at angles and stacks before any measurement.

Radiographs are binned to some hundred and twenty rows, freed of what varies slowly, and correlated, over small shifts,

    r(t, v) = max over shifts of  <g_t, f_v> / (|g_t| |f_v|)         without unit, 1 where they are the same

with the view at the recorded angle, for every step; for some steps, the least like among them, also with views all
around the turn, and with the radiograph upside down. A sample that moves by less than a tenth of the picture stays
most like itself at the angle where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from pdvc.experiment import Experiment
from pdvc.geometry import ConeBeam, within_half_turn
from pdvc.radiographs import Calibration, binned, grey_levels

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

ROWS = 120
"""Radiographs are binned to about this many rows."""
DETAIL_PX = 2.0
"""What is smoother than this, px of the binned radiograph, is left out: an outline is alike at many angles."""
VIEWS = 72
"""Views all around the turn, at most, that a step is compared with."""
EVENLY, LEAST_LIKE = 10, 8
"""Steps that are compared with views all around: so many spread over the test, and the least like."""


@dataclass(frozen=True, kw_only=True)
class Likeness:
    """How like radiographs of the test are to reference views."""

    recorded: Floats
    """(step,) correlation with the reference view at the recorded angle."""
    steps: NDArray[np.int64]
    """The steps that were compared with views all around."""
    best: Floats
    """(looked at,) their largest correlation with any view."""
    off_rad: Floats
    """(looked at,) angle of that view less the recorded one, rad, -pi to pi."""
    spacing_rad: float
    """Angle between the views compared with, rad."""
    upside_down: Floats
    """(looked at,) the largest correlation after turning the radiograph upside down."""
    mirrored: Floats
    """(looked at,) the largest correlation after exchanging left and right."""


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """The two reference views next to each step's angle, and the share of the second."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    share: Floats


def neighbouring_views(reference_rad: Floats, test_rad: Floats) -> Neighbours:
    """Find the reference views on both sides of each test angle, over the turn's end too."""
    turned = np.mod(reference_rad, 2 * np.pi)
    order = np.argsort(turned, kind="stable")
    ring = turned[order]
    at = np.mod(test_rad, 2 * np.pi)
    after = np.searchsorted(ring, at - 1e-9)
    first = order[(after - 1) % len(ring)]
    second = order[after % len(ring)]
    gap = np.mod(turned[second] - turned[first], 2 * np.pi)
    way = np.mod(at - turned[first], 2 * np.pi)
    share = np.where(gap > 0, np.minimum(way / np.where(gap > 0, gap, 1), 1), 0)
    # a step at a reference angle takes that view alone
    share = np.where(share > 1 - 1e-6, 1.0, np.where(share < 1e-6, 0.0, share))
    first, second = np.where(share == 1, second, first), np.where(share == 0, first, second)
    return Neighbours(first=first, second=second, share=np.where(first == second, 0.0, share))


def likeness(experiment: Experiment, calibration: Calibration) -> Likeness:
    """Compare the radiographs of the test with the reference views."""
    reference, test = experiment.reference, experiment.test
    bins, compare = _comparison(experiment.geometry)
    few = calibration.binned(bins)
    own, place = np.unique(_nearest(reference.angle_rad, test.angle_rad), return_inverse=True)
    views = compare.prepared(_images(reference.counts, few, bins, own))
    steps = compare.prepared(_images(test.counts, few, bins, np.arange(len(test))))
    recorded = np.array([compare.pair(steps[t], views[v]) for t, v in enumerate(place)])
    looked_at = np.union1d(
        np.linspace(0, len(test) - 1, min(EVENLY, len(test))).astype(np.int64), np.argsort(recorded)[:LEAST_LIKE]
    )
    around = np.unique(np.linspace(0, len(reference), min(VIEWS, len(reference)), endpoint=False).astype(np.int64))
    all_around = compare.prepared(_images(reference.counts, few, bins, around))

    def with_all(counts: NDArray[np.uint16]) -> Floats:
        """Return correlations (looked at, 1 + view) with the view at the recorded angle, and with all around."""
        spectra = compare.prepared(_images(counts, few, bins, looked_at))
        return np.array(
            [
                [compare.pair(one, view) for view in (views[place[t]], *all_around)]
                for one, t in zip(spectra, looked_at, strict=True)
            ]
        )

    found = with_all(test.counts)
    angle = np.column_stack([test.angle_rad[looked_at], np.tile(reference.angle_rad[around], (len(looked_at), 1))])
    best = np.take_along_axis(angle, found.argmax(axis=1)[:, None], axis=1)[:, 0]
    return Likeness(
        recorded=recorded,
        steps=looked_at,
        best=found.max(axis=1),
        off_rad=within_half_turn(best - test.angle_rad[looked_at]),
        spacing_rad=2 * np.pi / len(around),
        upside_down=with_all(test.counts[:, ::-1]).max(axis=1),
        mirrored=with_all(test.counts[:, :, ::-1]).max(axis=1),
    )


class Beside:
    """Compares a radiograph with the one before it, and with the view from where the stage should be by now."""

    def __init__(self, experiment: Experiment, calibration: Calibration) -> None:
        self._reference = experiment.reference
        self._bins, self._compare = _comparison(experiment.geometry)
        self._few = calibration.binned(self._bins)

    def binned(self, counts: NDArray[np.uint16]) -> Image:
        """Return the picture (row, column) that is compared, of counts (row, column)."""
        return np.asarray(_images(counts[None], self._few, self._bins, np.zeros(1, dtype=np.int64))[0])

    def likeness(self, picture: Image, angle_rad: float, before: Image, before_rad: float) -> tuple[float, float]:
        """Return how like a picture is to what is seen from its angle, and from that of the picture before it.

        Correlations with the reference view from there; where it was before, that with the picture itself if it is
        smaller: faces that come to lie along the beam make a view like many others.
        """
        angles = np.array([angle_rad, before_rad])
        views = [self.binned(self._reference.counts[k]) for k in _nearest(self._reference.angle_rad, angles)]
        this, *others = self._compare.prepared(np.stack([picture, *views, before]))
        recorded, *was = (self._compare.pair(this, other) for other in others)
        return recorded, min(was)


def _comparison(geometry: ConeBeam) -> tuple[int, _Compare]:
    """Return the pixels that are binned into one, along each axis, and what compares such pictures."""
    bins = max(1, round(min(geometry.rows / ROWS, geometry.columns / 40)))
    return bins, _Compare((geometry.rows // bins, geometry.columns // bins))


def _nearest(reference_rad: Floats, test_rad: Floats) -> NDArray[np.int64]:
    """Return the reference view that is nearest to each test angle."""
    near = neighbouring_views(reference_rad, test_rad)
    return np.asarray(np.where(near.share > 0.5, near.second, near.first))


def _images(counts: NDArray[np.uint16], few: Calibration, bins: int, which: NDArray[np.int64]) -> Image:
    """Return images (which, row, column), binned before their logarithm; `few` is the calibration of such pixels."""
    return np.stack([grey_levels(binned(counts[k], bins), few) for k in which])


class _Compare:
    """Correlate pictures of one size over shifts of up to a tenth of it."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._reach = tuple(max(1, size // 10) for size in shape)
        self._padded = tuple(fft.next_fast_len(size + reach) for size, reach in zip(shape, self._reach, strict=True))
        edge = max(1, shape[0] // 10)
        window = np.zeros(shape)
        window[edge : shape[0] - edge] = 1
        self._window = ndimage.gaussian_filter1d(window, edge / 3, axis=0)

    def prepared(self, images: Image) -> list[NDArray[np.complex64]]:
        """Return the spectra of pictures freed of what varies slowly, of norm one."""
        result = []
        for image in images:
            detail = (image - ndimage.gaussian_filter(image, DETAIL_PX, mode="nearest")) * self._window
            norm = float(np.sqrt((detail**2).sum()))
            detail = detail / norm if norm > 0 else np.zeros(self._shape)
            result.append(fft.rfft2(detail.astype(np.float32), s=self._padded))
        return result

    def pair(self, one: NDArray[np.complex64], other: NDArray[np.complex64]) -> float:
        """Return the largest correlation of two spectra over the shifts allowed."""
        found = fft.irfft2(one * other.conj(), s=self._padded)
        rows, columns = self._reach
        part = np.concatenate([found[: rows + 1], found[-rows:]])
        return float(max(part[:, : columns + 1].max(), part[:, -columns:].max()))
