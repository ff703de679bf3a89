"""What speaks against a measurement once it is made: from its residuals, its motion, and how its stages ended."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pdvc.cells import CRACK, LEAST_STEPS, Spot
from pdvc.experiment import DESCRIPTION
from pdvc.geometry import ConeBeam
from pdvc.measurement import Measurement
from pdvc.verdict import Doubt, Stop
from pdvc.volume import Hull, Volume
from pdvc.window import free_columns, kept_heights_mm

Floats = NDArray[np.float64]

REPROJECTED_DB, NOT_REPROJECTED_DB = 15.0, 6.0
"""SNR of the reference views against the volume, dB, below which it is doubted, and not believed at all."""
EXPLAINED_DB, UNEXPLAINED_DB = 15.0, 8.0
"""The same for the radiographs of the test at the end."""
WORSE_DB = 6.0
"""A residual twice as large: the test's against that of the reference views, a step's against that of the others."""
MORE_THAN_NOISE = 2.0
"""chi2 / (N - p) above which standard deviations, made from noise, are plainly too small."""
LARGE_STRAIN = 0.5
PRIOR_DEVIATIONS = 3.0
"""Standard deviations of the prior beyond which the prior is wrong, not the amplitude rare."""
FROM_DATA = 0.5
"""Share of a motion's prior variance that the data remove at least."""
FEW_STEPS = 3
STILL_MOVES_VOXEL = 0.02
"""A last change as large as this, rms: what a good measurement errs by across the beam."""
HULL_MARGIN_PX = 6.0
"""Columns by which the hull's shadow is wider than the sample's: its margin, and a voxel of the coarse outline."""
CUT_ROWS = 0.02
"""Share of the used rows whose rays may leave the volume through a cut end, at most, at any step."""
STRENGTH_MPA = 5000.0
"""Stress beyond that of any structural material."""


def doubts_of_result(found: Measurement, volume: Volume, geometry: ConeBeam, prior_voxel: float) -> tuple[Doubt, ...]:
    """Return what speaks against a measurement; `volume` is that of scale 1, `geometry` the scanner's."""
    return (
        *_of_residuals(found),
        *_of_motion(found, prior_voxel, np.arange(len(found.motion.amplitude))),
        *_of_ends(found, volume, geometry),
        *_of_window(found, volume.hull, geometry),
        *_of_convergence(found),
        *_of_basis(found),
        *_of_force(found, volume.hull),
    )


def doubts_of_spots(spots: Sequence[Spot]) -> tuple[Doubt, ...]:
    """Return what speaks against a measurement by where on the sample its residual showed something new, by step."""
    over = [t for t, spot in enumerate(spots) if t >= LEAST_STEPS and spot.score > CRACK]
    if not over:
        return ()
    most = max((spots[t] for t in over), key=lambda spot: spot.score)
    x, y, z = most.place_mm
    return (
        Doubt(
            name="crack",
            figure=f"from step {over[0]} on the residual shows less material than before at x = {x:.2f}, y = {y:.2f}, "
            f"z = {z:.2f} mm, by {most.score:.0f} deviations",
            advice="a crack, a void, or a neck narrower than sections, which they do not follow: look at the residual",
            steps=tuple(over),
        ),
    )


def doubts_of_solution(found: Measurement, prior_voxel: float) -> tuple[Doubt, ...]:
    """Return what speaks against a measurement made from full scans: its motion, at the steps that were scanned."""
    scanned = np.isfinite(found.motion.amplitude[:, found.motion.observed]).all(axis=(1, 2))
    steps = replace(
        found.motion, amplitude=found.motion.amplitude[scanned], data_share=found.motion.data_share[scanned]
    )
    return (*_of_motion(replace(found, motion=steps), prior_voxel, np.flatnonzero(scanned)), *_of_convergence(found))


def _of_residuals(found: Measurement) -> Iterator[Doubt]:
    again = float(np.median(found.fit.snr_reprojection_db))
    if not again >= REPROJECTED_DB:
        yield Doubt(
            name="reference-volume",
            figure=f"the reference views differ from their own re-projected volume: SNR {again:.1f} dB, at least "
            f"{REPROJECTED_DB:.0f} is due",
            advice="check geometry and angles of the reference scan, and that the sample did not move during it",
            fatal=not again >= NOT_REPROJECTED_DB,
        )
    final = found.fit.snr_final_db
    typical = float(np.median(final))
    if not typical >= EXPLAINED_DB or typical < again - WORSE_DB:
        yield Doubt(
            name="not-explained",
            figure=f"the moved volume explains the radiographs of the test with an SNR of {typical:.1f} dB, "
            f"the reference views with {again:.1f} dB",
            advice="the motion is outside sections and time functions, or too large to follow, or angles are wrong",
            fatal=not typical >= UNEXPLAINED_DB,
        )
    worse = np.flatnonzero(~(final >= typical - WORSE_DB))
    if len(worse):
        yield Doubt(
            name="step-residual",
            figure=f"the residual is more than twice that of the other steps at {len(worse)} of {len(final)}",
            advice="at these steps the motion was not found, or the radiograph is of something else",
            steps=tuple(worse.tolist()),
        )
    tests, noise_known = found.fit.residual_tests, bool(np.isfinite(found.fit.snr_noise_db).any())
    if tests is not None and noise_known and tests.chi2_reduced > MORE_THAN_NOISE:
        yield Doubt(
            name="more-than-noise",
            figure=f"the residual holds {tests.chi2_reduced:.1f} times the variance of noise",
            advice="standard deviations tell of noise alone: errors are larger than they say",
        )
    if tests is not None and noise_known and tests.chi2_reduced < 1 / MORE_THAN_NOISE:
        yield Doubt(
            name="noise-level",
            figure=f"the residual holds {tests.chi2_reduced:.2g} times the variance of the noise that is stated",
            advice=f"correct photons_per_count, readout_noise_counts or frames in {DESCRIPTION}",
        )


def _of_motion(found: Measurement, prior_voxel: float, number: NDArray[np.intp]) -> Iterator[Doubt]:
    """Look at amplitudes; `number` are the steps they belong to."""
    basis, seen = found.motion.basis, found.motion.observed
    amplitude = found.motion.amplitude[:, seen]
    if not np.isfinite(amplitude).all():
        yield Doubt(
            name="not-finite",
            figure="some amplitudes are not numbers",
            advice="look at the stages: nothing was measured there",
            fatal=True,
        )
        return
    if not seen.all():
        yield Doubt(
            name="unobserved",
            figure=f"{int((~seen).sum())} of {len(seen)} sections are not seen by any used pixel",
            advice="fewer sections, or a larger window",
        )
    if seen.sum() > 1:
        # what a section does to its own point of the axis
        shift = np.array([motion.shift[2] for motion in basis.motions], dtype=float)
        vertical = (amplitude @ shift) * found.recording.voxel_mm
        # u belongs to the current height z: du/dz = e / (1 + e)
        slope = np.diff(vertical, axis=1) / np.diff(basis.height_mm[seen])
        folded = np.flatnonzero((slope >= 1).any(axis=1))
        strain = np.max(np.abs(slope) / np.maximum(1 - slope, 1e-9), axis=1)
        large = np.flatnonzero(strain > LARGE_STRAIN)
        if len(folded):
            yield Doubt(
                name="folded",
                figure="sections change places",
                advice="no sample does this: the motion was not found",
                steps=tuple(number[folded].tolist()),
                fatal=len(folded) > len(strain) / 4,
            )
        elif len(large):
            yield Doubt(
                name="strain",
                figure=f"the largest strain between sections is {strain.max():.0%}",
                advice="can the sample do this? strains beyond 50 % are outside what was tried",
                steps=tuple(number[large].tolist()),
            )
    moved = np.sqrt((amplitude**2).mean(axis=0)).max()
    if moved > PRIOR_DEVIATIONS * prior_voxel:
        yield Doubt(
            name="prior",
            figure=f"an amplitude is {moved:.3g} voxels rms, {moved / prior_voxel:.1f} times prior_voxel",
            advice="raise prior_voxel: it holds the motion back",
        )
    shares = np.nanmean(found.motion.data_share[:, seen], axis=(0, 1)) if seen.any() else np.ones(0)
    believed = [name for name, share in zip(basis.names, shares, strict=False) if share < FROM_DATA]
    if believed:
        yield Doubt(
            name="prior-alone",
            figure=f"the radiographs determine less than half of {', '.join(believed)}",
            advice="these are the prior's values: more views a turn, or fewer motions",
        )


def _of_ends(found: Measurement, volume: Volume, geometry: ConeBeam) -> Iterator[Doubt]:
    share = cut_rows(found, volume, geometry)
    over = np.flatnonzero(share > CUT_ROWS)
    if len(over):
        rows = found.recording.window[1] - found.recording.window[0]
        more = int(np.ceil(share.max() * rows)) + 1
        yield Doubt(
            name="cut-ends",
            figure=f"rays of up to {share.max():.0%} of the used rows leave the volume through its cut ends",
            advice=f"leave out {more} rows more: discard_rows = {found.recording.window[0] + more}",
            steps=tuple(over.tolist()),
        )


def _of_window(found: Measurement, hull: Hull, geometry: ConeBeam) -> Iterator[Doubt]:
    low, high = found.motion.basis.height_mm[[0, -1]]
    _, _, left, right = found.recording.window
    cut = max(left, geometry.columns - right) - free_columns(geometry, hull, low, high)
    if cut > HULL_MARGIN_PX:
        yield Doubt(
            name="narrow-window",
            figure=f"the used columns leave out {cut:.0f} px of the sample on a side",
            advice="its edges tell most of motions across the beam: lower discard_columns",
        )


def cut_rows(found: Measurement, volume: Volume, geometry: ConeBeam) -> Floats:
    """Return the share of used rows (step,) whose rays, moved back, leave the volume where it is cut in height."""
    radius = volume.hull.radius_mm()
    bottom, top = kept_heights_mm(volume.grid)
    row = np.arange(found.recording.window[0], found.recording.window[1]) - (geometry.rows - 1) / 2
    rise = -(row * geometry.pixel_mm + geometry.row_shift_mm) / geometry.source_detector_mm
    reach = np.stack([rise * (geometry.source_axis_mm - radius), rise * (geometry.source_axis_mm + radius)])
    points = np.zeros((reach.size, 3))
    points[:, 2] = reach.ravel()
    result = np.empty(len(found.motion.amplitude))
    for step, amplitude in enumerate(found.motion.amplitude):
        moved = found.motion.basis.displacement(np.nan_to_num(amplitude), points)[:, 2] * found.recording.voxel_mm
        was = reach - moved.reshape(reach.shape)
        result[step] = ((was < bottom) | (was > top)).any(axis=0).mean()
    return result


def _of_convergence(found: Measurement) -> Iterator[Doubt]:
    last = found.fit.stages[-1]
    if last.stop is Stop.UNFINISHED and not last.last_change_voxel < STILL_MOVES_VOXEL:
        yield Doubt(
            name="not-converged",
            figure=last.stop_reason,
            advice="allow the last stage more passes: `most_passes`, or `most_modes`",
        )


def _of_basis(found: Measurement) -> Iterator[Doubt]:
    functions, steps = found.motion.time_functions.shape
    alone = (np.count_nonzero(found.motion.time_functions, axis=0) <= 1).all()
    if steps < FEW_STEPS or (functions >= steps and not alone):
        yield Doubt(
            name="few-steps",
            figure=f"{functions} time functions for {steps} steps",
            advice="nothing joins the steps: what one radiograph hardly shows, as motion along the beam, is not known",
        )


def _of_force(found: Measurement, hull: Hull) -> Iterator[Doubt]:
    filled = hull.support_mm[np.isfinite(hull.support_mm).all(axis=1)]
    half = filled.shape[1] // 2
    # of a square as wide as the hull where that is thinnest
    area = float((filled[:, :half] + filled[:, half:]).min() ** 2)
    stress = float(np.abs(found.recording.force_N).max()) / area
    if stress > STRENGTH_MPA:
        yield Doubt(
            name="force",
            figure=f"the largest force makes {stress:.3g} MPa in the thinnest section",
            advice="test.force_N is in N: check its unit",
        )


def check_finite(measurement: Measurement) -> None:
    """Raise ValueError where a number of a measurement is not finite that a reader would take for measured."""
    seen = measurement.motion.observed
    numbers: dict[str, NDArray[np.floating]] = {
        "displacements": measurement.motion.amplitude[:, seen],
        "standard deviations": measurement.motion.amplitude_std[:, seen],
        "covariances": measurement.motion.covariance,
        "residuals": measurement.fit.residual_final,
        "SNR": np.stack([measurement.fit.snr_initial_db, measurement.fit.snr_rigid_db, measurement.fit.snr_final_db]),
    }
    wrong = [name for name, values in numbers.items() if not np.isfinite(values).all()]
    if wrong:
        raise ValueError(
            f"measurement: expected finite numbers, found others among {', '.join(wrong)}: the radiographs cannot be "
            "measured with these options"
        )
