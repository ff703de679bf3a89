"""The protocol (section 4): calibrate, reconstruct, rigid stage at a coarse scale, section stage at scale 1.

Everything that takes long reports its progress; with a work folder, volumes and the rigid stage are kept there, so
that an interrupted measurement goes on where it was.
"""

from __future__ import annotations

import hashlib
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdvc import gauss_newton, pgd
from pdvc.beam_hardening import Outline, find_outline
from pdvc.equations import Equations, Images, linearise, residuals
from pdvc.experiment import Experiment, Series
from pdvc.geometry import ConeBeam
from pdvc.history import time_basis
from pdvc.measurement import Measurement, Stage
from pdvc.options import MeasureOptions, StageOptions, resolved
from pdvc.prior import Prior
from pdvc.progress import Progress, silent
from pdvc.projection import project
from pdvc.radiographs import (
    Calibration,
    binned,
    calibrate,
    coarsened,
    fill,
    grey_levels,
    grey_variance,
    snr_db,
)
from pdvc.rays import ray_vectors
from pdvc.reconstruction import fdk, seen_half_height_mm
from pdvc.sections import RIGID, SectionBasis
from pdvc.solution import Solution
from pdvc.systematic import Neighbours, Systematic, neighbouring_views
from pdvc.uncertainty import posterior
from pdvc.volume import Grid, Hull, Volume

__all__ = ["MeasureOptions", "StageOptions", "measure"]

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

_OUTLINE_ROWS = 240
"""The outline is found on radiographs binned to about this many rows."""
_OUTLINE_VIEWS = 150
_HULL_MARGIN_VOXEL = 3.0


def measure(
    experiment: Experiment, options: MeasureOptions, *, progress: Progress = silent, work: Path | None = None
) -> Measurement:
    """Measure the motion of the sample in an experiment.

    Raises ValueError, in one line, where the data cannot be used. `work` is a folder for intermediate results; they
    are used again only with the same experiment and options.
    """
    started = time.perf_counter()
    options = resolved(options, experiment.geometry)
    window = _window(experiment.geometry, options)
    store = _Store(work, experiment)
    calibration, outline = _calibrated(experiment, options, store, progress)
    time_functions = time_basis(options.time, experiment.test)
    rigid, sections = _bases(experiment.geometry, window, outline.hull, options)
    reconstructing = time.perf_counter()
    scales = {_scale(stage) for stage in (*options.rigid, *options.deformation)}
    prepared = {
        scale: _images(experiment, calibration, outline, window, scale, options, store, progress)
        for scale in sorted(scales, reverse=True)
    }
    fine = prepared[1]
    solving = time.perf_counter()

    def solved(basis: SectionBasis, start: Floats, stage: StageOptions, name: str) -> Solution:
        return _solve(prepared[_scale(stage)], basis, time_functions, start, stage, options, progress, name)

    stages: list[Stage] = []
    start = np.zeros((len(time_functions), *rigid.shape))
    for stage in options.rigid:
        solution = solved(rigid, start, stage, f"rigid, scale {stage.scale}")
        stages.append(_stage("rigid", stage, rigid, time_functions, solution))
        start = solution.coefficients
    start = sections.rigid(start, rigid)
    standing = np.zeros((len(experiment.test), *sections.shape))
    initial = residuals(fine.images, sections, standing, progress=progress, task="initial residual")
    moved = np.einsum("ft,fjk->tjk", time_functions, start)
    after_rigid = residuals(fine.images, sections, moved, progress=progress, task="rigid residual")
    for stage in options.deformation:
        solution = solved(sections, start, stage, f"deformation, scale {stage.scale}")
        stages.append(_stage("deformation", stage, sections, time_functions, solution))
        start = solution.coefficients
    known = posterior(solution.equations, time_functions, _prior(sections, options))
    amplitude = np.einsum("ft,fjk->tjk", time_functions, solution.coefficients)
    amplitude[:, ~known.observed] = np.nan
    snr = _snr_of(fine.images)
    ended = time.perf_counter()
    return Measurement(
        title=experiment.title,
        voxel_mm=experiment.geometry.voxel_mm,
        source_axis_mm=experiment.geometry.source_axis_mm,
        angle_rad=experiment.test.angle_rad,
        time_s=experiment.test.time_s,
        force_N=experiment.test.force_N,
        window=window,
        basis=sections,
        time_functions=time_functions,
        amplitude=amplitude,
        amplitude_std=np.where(known.observed[:, None], known.deviation, np.nan),
        data_share=np.where(known.observed[:, None], known.data_share, 0.0),
        observed=known.observed,
        stages=tuple(stages),
        snr_reprojection_db=fine.snr_reprojection_db,
        snr_initial_db=snr(initial),
        snr_rigid_db=snr(after_rigid),
        snr_final_db=snr(solution.equations.residual),
        snr_noise_db=fine.snr_noise_db,
        residual_initial=initial,
        residual_rigid=after_rigid,
        residual_final=solution.equations.residual,
        seconds={
            "outline": reconstructing - started,
            "reconstruct": solving - reconstructing,
            "measure": ended - solving,
        },
        options=options.template(),
        versions=_versions(),
    )


@dataclass(frozen=True, kw_only=True)
class _Prepared:
    """Hold one scale's images with what was learnt on the way."""

    images: Images
    snr_reprojection_db: Floats
    snr_noise_db: Floats
    noise_rms: float | None


def _window(geometry: ConeBeam, options: MeasureOptions) -> tuple[int, int, int, int]:
    """Return the used rows and columns: row_from, row_to, column_from, column_to."""
    rows, columns = options.discard_rows or 0, options.discard_columns or 0
    return rows, geometry.rows - rows, columns, geometry.columns - columns


def _bases(
    geometry: ConeBeam, window: tuple[int, int, int, int], hull: Hull, options: MeasureOptions
) -> tuple[SectionBasis, SectionBasis]:
    """Return the rigid basis, one section, and the section basis, spread over the used height."""
    low, high = hull.box_mm()
    radius = float(np.hypot(*(high - low)[:2]) / 4)
    top = _height_mm(geometry, window[0] - 0.5)
    bottom = _height_mm(geometry, window[1] - 0.5)
    heights = np.linspace(bottom, top, options.sections)
    rigid = SectionBasis(height_mm=np.array([(top + bottom) / 2]), radius_mm=radius, motions=RIGID)
    return rigid, SectionBasis(height_mm=heights, radius_mm=radius, motions=options.section_motions)


def _height_mm(geometry: ConeBeam, row: float) -> float:
    """Return the height at which the middle of a detector row looks through the axis, mm."""
    down = (row - (geometry.rows - 1) / 2) * geometry.pixel_mm + geometry.row_shift_mm
    return -down / geometry.magnification


def _calibrated(
    experiment: Experiment, options: MeasureOptions, store: _Store, progress: Progress
) -> tuple[Calibration, Outline]:
    calibration = calibrate(experiment)
    geometry, reference = experiment.geometry, experiment.reference
    factor = max(1, round(geometry.rows / _OUTLINE_ROWS))
    chosen = np.unique(np.linspace(0, len(reference), min(_OUTLINE_VIEWS, len(reference)), endpoint=False).astype(int))
    given = {"fit": None, "none": (1.0, 0.0, 0.0)}.get(str(options.beam_hardening), options.beam_hardening)

    def view(i: int) -> Image:
        return binned(grey_levels(reference.counts[chosen[i]], calibration), factor)

    outline = store.outline(
        f"outline {options.beam_hardening}",
        lambda: find_outline(
            view,
            geometry.binned(factor),
            reference.angle_rad[chosen],
            given if isinstance(given, tuple) else None,
            progress=progress,
        ),
    )
    return calibration.with_polynomial(outline.polynomial), outline


def _images(
    experiment: Experiment,
    calibration: Calibration,
    outline: Outline,
    window: tuple[int, int, int, int],
    scale: int,
    options: MeasureOptions,
    store: _Store,
    progress: Progress,
) -> _Prepared:
    """Prepare one scale: volume, radiographs of the window, weights, systematic residual."""
    geometry = experiment.geometry.binned(scale)
    part = tuple(edge // scale for edge in window)
    used = geometry.cropped(*part)
    view = _viewer(experiment.reference, calibration, scale)
    volume = _volume(experiment, geometry, outline, view, f"scale {scale} {options.beam_hardening}", store, progress)
    systematic, snr_reprojection = _systematic(experiment, geometry, part, view, volume, options, progress)
    grey, variance = _test_radiographs(experiment, calibration, part, scale, progress)
    good = ~_coarse_bad(calibration.bad, scale)[part[0] : part[1], part[2] : part[3]]
    weight = good[None].astype(np.float32)
    if options.weighting == "noise":
        if variance is None:
            raise ValueError(
                "weighting = 'noise': expected photons_per_count and readout_noise_counts in "
                "[acquisition] of experiment.toml, found none"
            )
        inverse = good / variance
        weight = np.asarray(inverse / inverse[:, good].mean(), dtype=np.float32)
    if not good.any():
        raise ValueError("mask: expected some used pixels, but all of the window are bad")
    return _Prepared(
        images=Images(
            rays=ray_vectors(used, experiment.test.angle_rad).stacked(),
            grey=grey,
            weight=weight,
            volume=volume,
            systematic=systematic if options.subtract_systematic else None,
            voxel_mm=experiment.geometry.voxel_mm,
        ),
        snr_reprojection_db=snr_reprojection,
        snr_noise_db=_noise_snr(grey, variance, good),
        noise_rms=None if variance is None else float(np.sqrt(variance[:, good].mean(dtype=float))),
    )


def _viewer(series: Series, calibration: Calibration, scale: int) -> Callable[[int], Image]:
    def view(i: int) -> Image:
        return coarsened(grey_levels(series.counts[i], calibration), scale)

    return view


def _volume(
    experiment: Experiment,
    geometry: ConeBeam,
    outline: Outline,
    view: Callable[[int], Image],
    name: str,
    store: _Store,
    progress: Progress,
) -> Volume:
    low, high = outline.hull.box_mm()
    radius = float(np.hypot(*np.maximum(np.abs(low), np.abs(high))[:2]))
    reach = seen_half_height_mm(geometry, radius)
    hull = outline.hull
    # two voxels of air around the hull keep interpolation, and its gradient, inside the grid
    margin = np.full(3, 2 * geometry.voxel_mm)
    low, high = low - margin, high + margin
    low[2], high[2] = max(low[2], -reach), min(high[2], reach)
    grid = Grid.around(low, high, geometry.voxel_mm)
    values = store.array(
        f"volume {name}",
        lambda: fdk(
            view,
            geometry,
            experiment.reference.angle_rad,
            grid,
            hull,
            progress=progress,
            task=f"reconstruct {geometry.voxel_mm * 1e3:.1f} um",
        ),
    )
    return Volume(values=values, grid=grid, hull=hull.grown(_HULL_MARGIN_VOXEL * geometry.voxel_mm))


def _systematic(
    experiment: Experiment,
    geometry: ConeBeam,
    part: tuple[int, ...],
    view: Callable[[int], Image],
    volume: Volume,
    options: MeasureOptions,
    progress: Progress,
) -> tuple[Systematic, Floats]:
    """Re-project the volume at the reference views next to the steps' angles."""
    reference = experiment.reference.angle_rad
    near: Neighbours = neighbouring_views(reference, experiment.test.angle_rad)
    needed = np.unique(np.concatenate([near.first, near.second]))
    rays = ray_vectors(geometry, reference[needed]).stacked()
    still = SectionBasis(height_mm=np.zeros(1), radius_mm=1.0)
    fields = np.zeros((len(needed), geometry.rows, geometry.columns), dtype=np.float32)
    snr = np.empty(len(needed))
    reached = _reached_rows(geometry, volume)
    window = (slice(part[0], part[1]), slice(part[2], part[3]))
    for n, i in enumerate(needed):
        grey = view(int(i))
        model = project(
            volume,
            rays[n : n + 1],
            (geometry.rows, geometry.columns),
            still,
            np.zeros((1, *still.shape)),
            voxel_mm=geometry.voxel_mm,
        )[0]
        fields[n, reached] = (model - grey)[reached]
        snr[n] = snr_db(grey[window], fields[n][window], np.ones_like(grey[window], dtype=bool))
        progress("re-projection", n + 1, len(needed))
    systematic = Systematic(
        fields=fields,
        first=np.searchsorted(needed, near.first),
        second=np.searchsorted(needed, near.second),
        share=near.share,
        corner=(part[0], part[2]),
        shape=(part[1] - part[0], part[3] - part[2]),
    )
    return systematic, snr


def _reached_rows(geometry: ConeBeam, volume: Volume) -> slice:
    """Return the rows whose rays stay within the volume's height where they cross the sample."""
    low, high = volume.hull.box_mm()
    radius = float(np.hypot(*np.maximum(np.abs(low), np.abs(high))[:2]))
    z = np.array(
        [volume.grid.origin_mm[2], volume.grid.origin_mm[2] + volume.grid.voxel_mm * (volume.grid.shape[0] - 1)]
    )
    down = -z * geometry.source_detector_mm / (geometry.source_axis_mm + radius) - geometry.row_shift_mm
    rows = down / geometry.pixel_mm + (geometry.rows - 1) / 2
    return slice(max(int(np.ceil(rows[1])) + 1, 0), min(int(np.floor(rows[0])), geometry.rows))


def _test_radiographs(
    experiment: Experiment, calibration: Calibration, part: tuple[int, ...], scale: int, progress: Progress
) -> tuple[Image, Image | None]:
    """Return grey levels and, where the noise is known, their variances, over the window (step, row, column)."""
    test = experiment.test
    window = (slice(part[0], part[1]), slice(part[2], part[3]))
    shape = (len(test), part[1] - part[0], part[3] - part[2])
    grey = np.empty(shape, dtype=np.float32)
    known = experiment.photons_per_count is not None and experiment.readout_noise_counts is not None
    variance = np.empty(shape, dtype=np.float32) if known else None
    # what Gaussian filter and binning leave of white noise (white input, unit variance), by its impulse response
    left = _noise_left(scale)
    for t in range(len(test)):
        grey[t] = coarsened(grey_levels(test.counts[t], calibration), scale)[window]
        if variance is not None:
            assert experiment.photons_per_count is not None
            assert experiment.readout_noise_counts is not None
            fine = grey_variance(
                test.counts[t],
                calibration,
                photons_per_count=experiment.photons_per_count,
                readout_noise_counts=experiment.readout_noise_counts,
                frames=experiment.frames,
                flats=len(experiment.flats),
            )
            fine = fill(fine, calibration.bad)
            variance[t] = left * binned(fine, scale)[window]
        progress(f"radiographs, scale {scale}", t + 1, len(test))
    return grey, variance


def _noise_left(scale: int) -> float:
    impulse = np.zeros((16 * scale, 16 * scale), dtype=np.float32)
    impulse[8 * scale, 8 * scale] = 1
    # every fine pixel of a block answers alike on average: sum over coarse pixels of the squared response
    return float(
        np.mean(
            [
                (coarsened(np.roll(impulse, (i, j), (0, 1)), scale) ** 2).sum()
                for i in range(scale)
                for j in range(scale)
            ]
        )
        * scale**2
    )


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


def _snr_of(images: Images) -> Callable[[Image], Floats]:
    used = images.weight > 0

    def snr(residual: Image) -> Floats:
        return np.array([snr_db(images.grey[t], residual[t], used[t % len(used)]) for t in range(len(residual))])

    return snr


def _prior(basis: SectionBasis, options: MeasureOptions) -> Prior:
    return Prior(deviation_voxel=np.full(basis.shape, options.prior_voxel))


def _solve(
    prepared: _Prepared,
    basis: SectionBasis,
    time_functions: Floats,
    start: Floats,
    stage: StageOptions,
    options: MeasureOptions,
    progress: Progress,
    name: str,
) -> Solution:
    passes = 0

    def at(amplitude: Floats) -> Equations:
        nonlocal passes
        passes += 1
        return linearise(prepared.images, basis, amplitude, progress=progress, task=f"{name}, pass {passes}")

    prior = _prior(basis, options)
    if stage.solver == "pgd":
        return pgd.solve(
            at,
            time_functions,
            start,
            prior,
            most_modes=stage.most,
            passes_per_mode=stage.passes_per_mode,
            least_gain=stage.least_gain,
            noise_rms=prepared.noise_rms if basis.shape[0] > 1 else None,
        )
    return gauss_newton.solve(
        at, time_functions, start, prior, most_passes=stage.most, least_change_voxel=stage.least_change_voxel
    )


def _scale(stage: StageOptions) -> int:
    assert isinstance(stage.scale, int), "options are resolved"
    return stage.scale


def _stage(name: str, options: StageOptions, basis: SectionBasis, time_functions: Floats, solution: Solution) -> Stage:
    return Stage(
        name=name,
        scale=_scale(options),
        solver=options.solver,
        unknowns=len(time_functions) * basis.shape[0] * basis.shape[1],
        temporal=solution.temporal,
        spatial=solution.spatial,
        rms=solution.rms,
        stop_reason=solution.stop_reason,
    )


class _Store:
    """Keep intermediate results in a work folder, under names that tell experiment and purpose apart."""

    def __init__(self, folder: Path | None, experiment: Experiment) -> None:
        self._folder = folder
        self._key = _fingerprint(experiment) if folder else ""

    def array(self, name: str, make: Callable[[], NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the array of that name, made and kept if it is not there."""
        path = self._path(name)
        if path is not None and path.exists():
            return np.asarray(np.load(path))
        values = make()
        if path is not None:
            _save(path, values)
        return values

    def outline(self, name: str, make: Callable[[], Outline]) -> Outline:
        """Return the outline of that name, made and kept if it is not there."""
        found: list[Outline] = []

        def packed() -> NDArray[np.float32]:
            outline = make()
            found.append(outline)
            head = [outline.hull.z_mm, outline.hull.slab_mm, *outline.polynomial]
            return np.concatenate([head, outline.hull.support_mm.ravel()])

        values = np.asarray(self.array(name, packed), dtype=float)
        hull = Hull(z_mm=values[0], slab_mm=values[1], support_mm=values[5:].reshape(-1, 16))
        return found[0] if found else Outline(hull=hull, polynomial=(values[2], values[3], values[4]))

    def _path(self, name: str) -> Path | None:
        if self._folder is None:
            return None
        digest = hashlib.sha256(f"{self._key} {name}".encode()).hexdigest()[:12]
        return self._folder / f"{name.split()[0]}-{digest}.npy"


def _save(path: Path, values: NDArray[np.float32]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        np.save(file, values)
    partial.replace(path)


def _fingerprint(experiment: Experiment) -> str:
    """Return a digest of the geometry, the angles and a sample of the reference counts."""
    digest = hashlib.sha256(repr(experiment.geometry).encode())
    reference = experiment.reference
    for part in (
        reference.angle_rad,
        experiment.flats,
        experiment.darks,
        reference.counts[:: max(1, len(reference) // 8)],
    ):
        digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def _versions() -> str:
    names = ("pdvc-bench", "numpy", "scipy", "numba")
    return ", ".join(f"{name} {version(name)}" for name in names) + f", Python {platform.python_version()}"
