"""What every solver starts from at a scale: the volume at rest, the radiographs, and what is known of their noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from pdvc.correction import moved_back, rays_of_moved
from pdvc.equations import Images
from pdvc.experiment import Experiment, Series
from pdvc.geometry import ConeBeam
from pdvc.noise import ImageNoise, Noise
from pdvc.options import MeasureOptions
from pdvc.progress import Progress, silent
from pdvc.projection import project_at_rest
from pdvc.radiographs import (
    Calibration,
    DetectorNoise,
    binned,
    coarsened,
    detector_noise,
    grey_levels,
    grey_noise,
    sharpened,
    smoothed,
    snr_db,
)
from pdvc.rays import ray_vectors
from pdvc.reconstruction import fdk, one_of
from pdvc.sections import SectionBasis
from pdvc.setup import Setup, set_up
from pdvc.store import Keep
from pdvc.systematic import Systematic, nothing_ready
from pdvc.volume import Hull, Volume
from pdvc.window import reached_rows, scan_grid

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

_VIEWS_AT_HAND = 16
"""Reference views whose noise is kept: steps that follow each other look along some of the same."""


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """The images of one scale, with what was learnt on the way."""

    images: Images
    systematic: Systematic
    """What the volume's re-projection leaves, whether or not it is subtracted."""
    view: Callable[[int], Image]
    """A reference view (row, column), grey levels, over the whole detector."""
    snr_noise_db: Floats
    noise_rms: float | None

    def without_outliers(self, pixels: NDArray[np.bool_]) -> Prepared:
        """Return the same with some pixels (step, row, column) of no weight."""
        weight = np.where(pixels, np.float32(0), self.images.weight)
        return replace(self, images=replace(self.images, weight=weight))

    def without(self, pattern: Image) -> Prepared:
        """Return the same without a pattern (row, column), grey levels, that all images have in common."""
        found = self.systematic
        systematic = replace(found, left=lambda i: found.left(i) + pattern)
        images = replace(
            self.images,
            grey=self.images.grey - pattern[found.window],
            systematic=None if self.images.systematic is None else systematic,
        )
        return replace(self, images=images, systematic=systematic, view=lambda i: self.view(i) - pattern)


@dataclass(frozen=True, kw_only=True)
class AtRest:
    """What one scale takes from the reference scan: all that there is before the test begins."""

    scale: int
    volume: Volume
    geometry: ConeBeam
    """Of this scale, the whole detector."""
    part: tuple[int, ...]
    """The used window at this scale: row_from, row_to, column_from, column_to."""
    view: Callable[[int], Image]
    """A reference view (row, column), grey levels, over the whole detector."""
    systematic: Systematic
    """What the volume's re-projection leaves; it knows of no step yet."""


def at_rest(setup: Setup, scale: int, progress: Progress = silent, *, all_views: bool = False) -> AtRest:
    """Return what one scale takes from the reference scan; e of all views at once, or as steps look along them."""
    experiment, options = setup.experiment, setup.options
    geometry = experiment.geometry.binned(scale)
    part = tuple(edge // scale for edge in setup.window)
    view = _viewer(experiment.reference, setup.calibration, scale, options.smooth_px, setup.view_motion_px)
    volume = reference_volume(setup, scale, progress)
    systematic = _systematic(experiment.reference, geometry, part, view, volume, setup.sections.radius_mm, scale)
    if all_views:
        systematic = _of_all_views(setup, scale, systematic, progress)
    return AtRest(scale=scale, volume=volume, geometry=geometry, part=part, view=view, systematic=systematic)


def _of_all_views(setup: Setup, scale: int, systematic: Systematic, progress: Progress) -> Systematic:
    """Return the same with e of all views at hand; every experiment with the same reference scan finds it kept."""

    def made() -> dict[str, NDArray[np.float16]]:
        left = np.empty((len(systematic.view_rad), *systematic.detector), dtype=np.float16)
        for start in range(0, len(left), _VIEWS_AT_HAND):
            some = range(start, min(start + _VIEWS_AT_HAND, len(left)))
            systematic.ready(some)
            for i in some:
                left[i] = systematic.left(i)
            progress(f"views, scale {scale}", some.stop, len(left))
        return {"e": left}

    depends = (setup.calibration, setup.outline.hull, scale, _care(setup), setup.view_motion_px)
    kept = setup.store.of_reference("left", depends, made)["e"]
    return replace(systematic, left=lambda i: kept[i].astype(np.float32), ready=nothing_ready)


def prepare(setup: Setup, scale: int, progress: Progress = silent) -> Prepared:
    """Prepare one scale: volume, radiographs of the window, weights, systematic residual."""
    return with_radiographs(setup, at_rest(setup, scale, progress), setup.experiment.test, progress)


def with_radiographs(setup: Setup, rest: AtRest, test: Series, progress: Progress = silent) -> Prepared:
    """Prepare radiographs of the test at the scale of what is known at rest."""
    experiment, options, part = setup.experiment, setup.options, rest.part
    grey, variance = _test_radiographs(setup, test, part, rest.scale, progress)
    good = ~_coarse_bad(setup.calibration.bad, rest.scale)[part[0] : part[1], part[2] : part[3]]
    if not good.any():
        raise ValueError("mask: expected some used pixels, but all of the window are bad")
    weight = good[None].astype(np.float32)
    if options.weighting == "noise":
        if variance is None:
            raise ValueError(
                "weighting = 'noise': expected photons_per_count and readout_noise_counts in "
                "[acquisition] of experiment.toml, found none"
            )
        inverse = good / variance
        weight = np.asarray(inverse / inverse[:, good].mean(), dtype=np.float32)
    systematic = replace(rest.systematic, step_rad=test.angle_rad)
    return Prepared(
        images=Images(
            rays=_rays_of_test(setup, rest, test.angle_rad),
            grey=grey,
            weight=weight,
            volume=rest.volume,
            systematic=systematic if options.subtract_systematic else None,
            voxel_mm=experiment.geometry.voxel_mm,
        ),
        systematic=systematic,
        view=rest.view,
        snr_noise_db=_noise_snr(grey, variance, good),
        noise_rms=None if variance is None else float(np.sqrt(variance[:, good].mean(dtype=float))),
    )


def _rays_of_test(setup: Setup, rest: AtRest, angle_rad: Floats) -> Floats:
    """Return the rays (step, 4, 3) of the window at stage angles (step,), mm, where the scanner was in the test."""
    geometry, part = rest.geometry, rest.part
    rays = ray_vectors(geometry.cropped(*part), angle_rad).stacked()
    motion_px = setup.test_motion_px(angle_rad)
    if motion_px is None:
        return rays
    middle = (np.array([geometry.rows, geometry.columns]) - 1) / 2 - np.array([part[0], part[2]])
    return rays_of_moved(rays, motion_px, rest.scale, middle, geometry.rows / 2)


def keep_volumes(
    experiment: Experiment, options: MeasureOptions, folder: Path, *, progress: Progress = silent
) -> None:
    """Make what a measurement takes from the reference scan alone, outline and volumes, and keep it in a folder.

    Every measurement that works in this folder (`measure(..., work=folder)`), of an experiment with the same
    reference scan, finds it there: see `volume_choices`.
    """
    setup = set_up(experiment, options, work=folder, progress=progress)
    for scale in setup.options.scales:
        reference_volume(setup, scale, progress)


def volume_choices(options: MeasureOptions, geometry: ConeBeam) -> tuple[tuple[int, ...], object, float, bool]:
    """Return what volumes of a scanner depend on, of some options: scales, beam hardening, filter, sharpening."""
    scales = {stage.at(geometry).scale for stage in (*options.rigid, *options.deformation)}
    return tuple(sorted(scales, reverse=True)), options.beam_hardening, options.smooth_px, options.sharpen


def _viewer(
    series: Series, calibration: Calibration, scale: int, smooth_px: float, motion_px: Floats | None = None
) -> Callable[[int], Image]:
    """Return the function that gives a radiograph at a scale; `motion_px` (view, 3) is what each is moved back by."""

    def view(i: int) -> Image:
        seen = smoothed(grey_levels(series.counts[i], calibration), smooth_px)
        return coarsened(seen if motion_px is None else moved_back(seen, motion_px[i]), scale)

    return view


def reference_volume(setup: Setup, scale: int, progress: Progress = silent) -> Volume:
    """Reconstruct the reference scan at a scale; every experiment with the same reference scan finds it kept."""
    calibration, hull, care = setup.calibration, setup.outline.hull, _care(setup)
    depends = (calibration, hull, scale, care, setup.view_motion_px)
    keep = partial(setup.store.of_reference, "volume", depends)
    series = setup.experiment.reference
    motion_px = setup.view_motion_px
    return scan_volume(series, setup.geometry, calibration, hull, scale, care, keep, progress, motion_px)


@dataclass(frozen=True, kw_only=True)
class Care:
    """What is done for a volume beyond reconstructing it."""

    smooth_px: float = 0.0
    """Filter of the radiographs, px."""
    sharpen: bool = False
    """Whether radiographs are sharpened by what interpolation blurs, and the phase of what it shifts is corrected."""


def _care(setup: Setup) -> Care:
    return Care(smooth_px=setup.options.smooth_px, sharpen=setup.options.sharpen)


def scan_volume(
    series: Series,
    geometry: ConeBeam,
    calibration: Calibration,
    hull: Hull,
    scale: int,
    care: Care,
    keep: Keep,
    progress: Progress,
    motion_px: Floats | None = None,
) -> Volume:
    """Reconstruct a full scan at a scale, inside a hull; `geometry` is that of scale 1.

    `motion_px` (view, 3) is what each view is moved back by, as in `pdvc.correction`.

    At scale n one of n / 2 views is used: for pixels n times as large they are twice as close as at scale 1.
    """
    view, geometry = _viewer(series, calibration, scale, care.smooth_px, motion_px), geometry.binned(scale)
    grid, chosen = scan_grid(geometry, hull), one_of(series.angle_rad, scale // 2)

    def seen(i: int) -> Image:
        image = view(int(chosen[i]))
        return sharpened(image) if care.sharpen else image

    def reconstructed() -> dict[str, NDArray[np.float32]]:
        task = f"reconstruct {geometry.voxel_mm * 1e3:.1f} um"
        return {"F": fdk(seen, geometry, series.angle_rad[chosen], grid, hull, progress=progress, task=task)}

    values = keep(reconstructed)["F"]
    reached = hull.around_voxels(geometry.voxel_mm)
    phase = phase_correction(values) if care.sharpen else 0.0
    return Volume(values=values, grid=grid, hull=reached, phase=phase)


def phase_correction(values: NDArray[np.float32]) -> float:
    """Return k^2 / 6 of the volume's texture along z, by its slopes: k^2 = sum (second differences)^2 / sum (first)^2.

    At most that of a wave of six voxels: what is finer is noise.
    """
    first, second = (
        sum(float(np.square(layer, dtype=float).sum()) for layer in _differences(values, n)) for n in (1, 2)
    )
    return min(second / max(first, 1e-300), 1.0) / 6


def _differences(values: NDArray[np.float32], order: int) -> Iterator[NDArray[np.float32]]:
    """Yield the differences of a volume's layers, or the differences of these."""
    for k in range(len(values) - order):
        yield np.diff(values[k : k + order + 1], order, axis=0)


def _systematic(
    reference: Series,
    geometry: ConeBeam,
    part: tuple[int, ...],
    view: Callable[[int], Image],
    volume: Volume,
    radius_mm: float,
    scale: int,
) -> Systematic:
    """Return what re-projecting the volume leaves; views are re-projected as steps are found to look along them.

    `radius_mm`, half of half the section's diagonal, tells within which angle e changes. It changes the slower the
    larger the pixels are: at scale n every n-th view tells it.
    """
    shape = (geometry.rows, geometry.columns)
    reached = reached_rows(geometry, volume.grid, volume.hull)
    rays = ray_vectors(geometry, reference.angle_rad).stacked()

    kept: dict[int, NDArray[np.float16]] = {}

    def ready(views: Sequence[int]) -> None:
        missing = [i for i in views if i not in kept]
        if not missing:
            return
        at_once = numba.get_num_threads()
        # rays are walked by all threads together, a view is read and filtered by one of them
        with ThreadPoolExecutor(at_once) as pool:
            for start in range(0, len(missing), at_once):
                some = [scale * i for i in missing[start : start + at_once]]
                seen = pool.map(view, some)
                again = project_at_rest(volume, rays[some], shape)
                for i, grey, projected in zip(missing[start : start + at_once], seen, again, strict=True):
                    # 11 bits are kept, of all views: e is a few times its noise
                    kept[i] = np.zeros(shape, dtype=np.float16)
                    kept[i][reached] = (projected - grey)[reached]

    def left(i: int) -> Image:
        ready([i])
        return kept[i].astype(np.float32)

    return Systematic(
        left=left,
        ready=ready,
        view_rad=reference.angle_rad[::scale],
        step_rad=np.empty(0),
        corner=(part[0], part[2]),
        shape=(part[1] - part[0], part[3] - part[2]),
        detector=shape,
        width_rad=0.5 * geometry.voxel_mm / radius_mm,
    )


def _test_radiographs(
    setup: Setup, test: Series, part: tuple[int, ...], scale: int, progress: Progress
) -> tuple[Image, Image | None]:
    """Return grey levels and, where the noise is known, their variances, over the window (step, row, column)."""
    calibration, smooth_px = setup.calibration, setup.options.smooth_px
    window = (slice(part[0], part[1]), slice(part[2], part[3]))
    shape = (len(test), part[1] - part[0], part[3] - part[2])
    grey = np.empty(shape, dtype=np.float32)
    noise = detector_noise(setup.experiment)
    variance = None if noise is None else np.empty(shape, dtype=np.float32)
    view = _viewer(test, calibration, scale, smooth_px)
    left = _noise_left(scale, smooth_px)

    def read(t: int) -> None:
        grey[t] = view(t)[window]
        if variance is not None and noise is not None:
            fine, slope = grey_noise(test.counts[t], calibration, noise)
            fine += slope**2 * noise.relative_variance(calibration.open_beam, len(setup.experiment.flats))
            variance[t] = left * binned(fine, scale)[window]

    # a radiograph is read and filtered by one thread
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        for done, _ in enumerate(pool.map(read, range(len(test)))):
            progress(f"radiographs, scale {scale}", done + 1, len(test))
    return grey, variance


def noise_of(setup: Setup, systematic: Systematic) -> Noise | None:
    """Return the noise of all images at scale 1, if the experiment's description tells of it."""
    experiment, calibration = setup.experiment, setup.calibration
    noise = detector_noise(experiment)
    if noise is None:
        return None
    known: DetectorNoise = noise

    @lru_cache(maxsize=_VIEWS_AT_HAND)
    def view(i: int) -> ImageNoise:
        variance, slope = grey_noise(experiment.reference.counts[i], calibration, known)
        return ImageNoise(variance=variance, slope=slope)

    def step(t: int) -> ImageNoise:
        return radiograph_noise(setup, systematic, known, experiment.test.counts[t])

    flat = known.relative_variance(calibration.open_beam, len(experiment.flats))
    return Noise(step=step, view=view, flat=flat, smooth_px=setup.options.smooth_px)


def radiograph_noise(
    setup: Setup, systematic: Systematic, noise: DetectorNoise, counts: NDArray[np.uint16]
) -> ImageNoise:
    """Return the noise, over the window of scale 1, of a radiograph of the test by its counts (row, column)."""
    variance, slope = grey_noise(counts, setup.calibration, noise)
    return ImageNoise(variance=variance[systematic.window], slope=slope[systematic.window])


def stated_noise(setup: Setup, systematic: Systematic) -> tuple[Noise, DetectorNoise]:
    """Return the noise of all images at scale 1, and the detector's; raises ValueError where none is stated."""
    noise, detector = noise_of(setup, systematic), detector_noise(setup.experiment)
    if noise is None or detector is None:
        raise ValueError(
            "noise: expected photons_per_count and readout_noise_counts in [acquisition] of experiment.toml, "
            "found none"
        )
    return noise, detector


@lru_cache
def _noise_left(scale: int, smooth_px: float) -> float:
    """Return what filters and binning leave of the variance of white noise, by their impulse response."""
    size = 16 * scale + 2 * int(4 * smooth_px + 1)
    impulse = np.zeros((size - size % scale,) * 2, dtype=np.float32)
    middle = len(impulse) // 2
    impulse[middle, middle] = 1
    # every fine pixel of a block answers alike on average: sum over coarse pixels of the squared response
    shifted = (np.roll(impulse, (i, j), (0, 1)) for i in range(scale) for j in range(scale))
    answers = [(coarsened(smoothed(image, smooth_px), scale) ** 2).sum() for image in shifted]
    return float(np.mean(answers) * scale**2)


def _coarse_bad(bad: NDArray[np.bool_], scale: int) -> NDArray[np.bool_]:
    return np.asarray(binned(bad.astype(np.float32), scale) > 0.3)


def _noise_snr(grey: Image, variance: Image | None, good: NDArray[np.bool_]) -> Floats:
    if variance is None:
        return np.full(len(grey), np.nan)
    return np.array(
        [
            20 * np.log10(np.std(g[good], dtype=float) / np.sqrt(v[good].mean(dtype=float)))
            for g, v in zip(grey, variance, strict=True)
        ]
    )


def snr_reprojection(prepared: Prepared, basis: SectionBasis, amplitude: Floats) -> Floats:
    """Return the SNR (view,), dB, of the views that the steps look along, against the re-projected volume.

    At amplitudes (step, section, motion), voxels; views in the order of the reference scan.
    """
    systematic, images = prepared.systematic, prepared.images
    sight = systematic.looked_along(slice(None), images.rays, basis, amplitude, images.voxel_mm)
    window, used = systematic.window, np.ones(systematic.shape, dtype=bool)
    views = np.unique(sight.views[sight.share > 0]).tolist()
    return np.array([snr_db(prepared.view(i)[window], systematic.left(i)[window], used) for i in views])


def snr_of(images: Images) -> Callable[[Image], Floats]:
    """Return the function that gives the SNR (step,), dB, of residual fields (step, row, column) of these images."""
    used = images.weight > 0

    def snr(residual: Image) -> Floats:
        return np.array([snr_db(images.grey[t], residual[t], used[t % len(used)]) for t in range(len(residual))])

    return snr
