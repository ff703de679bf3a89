"""What is wrong with an experiment's data, from the figures of `pdvc.examination`: errors, and doubts.

An error is raised where measuring would be a waste of time: no flats, no sample, a black radiograph, counts that are
none. Everything else is a doubt, which goes into the result with its figure and its remedy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pdvc.correction import Correction
from pdvc.examination import Examination, StackLook, examine, full_scale, with_angles
from pdvc.experiment import DESCRIPTION, FLATS, REFERENCE, TEST, Experiment, ExperimentError, Series
from pdvc.history import Ramp, TimeFunction
from pdvc.onset import LEAST_PLATEAU, force_noise, onset
from pdvc.progress import Progress, silent
from pdvc.verdict import Doubt, listed

Floats = NDArray[np.float64]

AIR_ERROR, AIR_DOUBT = 0.3, 0.03
"""Departures of the air's transmission from 1 that are refused, and doubted."""
SATURATED = 1e-3
"""Share of pixels at the largest count above which a stack is clipped: of ten thousand pixels one is chance."""
EDGE_SEEN = 0.02
"""Share of rows above which a sample covers a side of the detector."""
STEEP, FLAT_SHARE = 0.65, 0.25
"""Rise of attenuation within one column that a flat face along the beam makes; share of steps that may have it."""
NOISE_FACTOR = 1.5
"""The variance between flats may differ by this factor from what the description says: flats are few, pixels many."""
GAP_RAD = np.deg2rad(15.0)
"""Gap between reference views above which streaks are seen in the volume."""
ONE_DIRECTION = 0.9
"""Length of the mean of exp(2 i angle) above which all directions are within some 13 degrees (rms) of each other."""
FORCE_CHANGES = 10.0
"""Deviations of its noise by which a force changes that is not just noise."""
ONSET_STEPS = 3
"""Steps between the start of a ramp and the onset of loading that no force noise explains."""
FAN_TOLERANCE = 0.15
"""What the fan angle may differ from the stated one, as a share, beyond five standard deviations."""
AXIS_PX = 1.0
"""What the axis may be off, px."""
_AXIS = "axis"
PLANE_SHARE, PLANE_PX = 0.02, 3.0
"""What the plane of the source may be off: a share of the rows, or px where that is more."""
ALIKE, ANOTHER = 0.1, 0.4
"""A gain in correlation that is no chance; a correlation below which two pictures show different samples."""


def usable(experiment: Experiment, *, progress: Progress = silent) -> Examination:
    """Examine an experiment, its angles too; raises ExperimentError where it cannot be measured."""
    found = examine(experiment, progress=progress)
    check_usable(found, experiment)
    return with_angles(found, experiment, progress=progress)


def check_usable(found: Examination, experiment: Experiment) -> None:
    """Raise ExperimentError, in one line, where the counts cannot be those of an experiment."""
    if found.flats_top > 0.1 and found.flats_full:
        raise ExperimentError(
            f"{FLATS}: expected counts below saturation, found {found.flats_top:.0%} of the pixels at the largest "
            "count: expose shorter"
        )
    for name, look in found.stacks.items():
        _check_stack(name, look, clips=clips(look.highest, found.flats_top))
    if found.bad_share > 0.2:
        raise ExperimentError(
            f"{FLATS}: expected nearly all pixels alike, found {found.bad_share:.0%} bad ones: "
            "are flats and darks right?"
        )
    angle = experiment.reference.angle_rad
    if np.ptp(angle) < np.pi:
        turned = np.rad2deg(np.ptp(angle))
        hint = ": angle_deg is in degrees, are these radians?" if 5.9 < turned < 6.4 else ""
        raise ExperimentError(
            f"{DESCRIPTION}: reference.angle_deg: expected a full turn, found {turned:.4g} degrees{hint}"
        )


def clips(highest: int, flats_top: float) -> bool:
    """Return whether many pixels at the largest count mean that counts are clipped; `flats_top` of them in flats.

    Not where flats, too, hold one count in most pixels: a beam without noise on a detector without pattern.
    """
    return full_scale(highest) or flats_top < SATURATED


def _check_stack(name: str, look: StackLook, *, clips: bool) -> None:
    if look.lowest == look.highest:
        raise ExperimentError(f"{name}: expected radiographs, found {look.highest} counts in every pixel")
    for shares, least, what, advice in (
        (look.black, 0.9, "black", "leave these images and their entries out"),
        (look.at_top if clips else np.zeros(0), 0.5, "saturated", "leave these images and their entries out"),
        (look.bright, 0.2, "brighter than the open beam", "are these raw counts, and flats of the same exposure?"),
    ):
        found = np.flatnonzero(shares > least)
        if len(found):
            raise ExperimentError(
                f"{name}: expected a sample in the open beam, found {shares[found[0]]:.0%} of the pixels {what} in "
                f"image {listed(found)}: {advice}"
            )
    off = np.abs(look.air - 1) > AIR_ERROR
    if off.any():
        first = int(np.argmax(off))
        raise ExperimentError(
            f"{name}: expected air at the counts of the flats, found a transmission of {look.air[first]:.2f} at "
            f"the edges of image {listed(np.flatnonzero(off))}: are these raw counts, are flats "
            "and darks of the same exposure, and is air seen beside the sample?"
        )
    empty = np.flatnonzero(look.shaded < 0.01)
    if len(empty):
        raise ExperimentError(
            f"{name}: expected a sample, found only air in image {listed(empty)}: "
            f"{look.shaded[empty[0]]:.1%} of the pixels are behind anything"
        )


def doubts_of_data(found: Examination, experiment: Experiment) -> tuple[Doubt, ...]:
    """Return what the figures of an experiment speak against, before anything is measured."""
    return (
        *_of_counts(found),
        *_of_records(found, experiment),
        *_of_reference(found, experiment),
        *_of_angles(found, experiment),
    )


def cleared(doubts: tuple[Doubt, ...], correction: Correction | None) -> tuple[Doubt, ...]:
    """Return the doubts about a scanner as told that are left once a correction was found."""
    return doubts if correction is None else tuple(doubt for doubt in doubts if doubt.name != _AXIS)


def doubts_of_time(parts: tuple[TimeFunction, ...], series: Series) -> Iterator[Doubt]:
    """Give what is wrong with time functions for the steps of a test."""
    starts = [part.start for part in parts if isinstance(part, Ramp) and isinstance(part.start, int)]
    last, found = len(series) - 1, onset(series.force_N)
    for start in starts:
        if start >= last:
            yield Doubt(
                name="ramp-start",
                figure=f"a ramp starts at step {start}, but the last step is {last}: it was left out",
                advice="correct `start`, or leave the ramp out",
            )
    if any(isinstance(part, Ramp) and part.start == "onset" for part in parts) and last > LEAST_PLATEAU:
        yield from _of_onset(series.force_N, found)
    within = [start for start in starts if start < last]
    if found is not None and within and min(abs(start - found) for start in within) > ONSET_STEPS:
        yield Doubt(
            name="ramp-start",
            figure=f"ramps start at step {listed(within)}, but the force leaves its plateau after step {found}",
            advice="correct `start`, or leave it out: then it is found",
        )


def _of_onset(force_N: Floats, found: int | None) -> Iterator[Doubt]:
    """Tell of a force without an onset, but for one that was recorded and did not change."""
    if found is not None or 0 < np.ptp(force_N) < FORCE_CHANGES * force_noise(force_N):
        return
    yield Doubt(
        name="onset",
        figure="the force does not leave a plateau of three steps or more"
        if np.ptp(force_N)
        else "no force was recorded",
        advice="the ramp was left out: say at which step loading begins, `start` of the ramp among the time functions",
    )


def doubts_of_reference(found: Examination, experiment: Experiment) -> tuple[Doubt, ...]:
    """Return the doubts of those that look at full scans alone."""
    alone = replace(found, stacks={REFERENCE: found.stacks[REFERENCE]})
    return (*_of_counts(alone), *_of_reference(alone, experiment))


def _of_counts(found: Examination) -> Iterator[Doubt]:
    for name, look in found.stacks.items():
        off = np.flatnonzero(np.abs(look.air - 1) > AIR_DOUBT)
        if len(off):
            worst = off[np.abs(look.air[off] - 1).argmax()]
            yield Doubt(
                name="air-level",
                figure=f"{name}: air has a transmission of {look.air[worst]:.3f} where 1 is due, in {len(off)} images",
                advice="the beam changed, or flats and darks are not those of these radiographs",
                steps=_steps(name, off),
            )
        clipped = (
            np.flatnonzero(look.at_top > SATURATED) if clips(look.highest, found.flats_top) else np.zeros(0, dtype=int)
        )
        if len(clipped):
            yield Doubt(
                name="saturation",
                figure=f"{name}: {look.at_top.max():.1%} of the pixels are at the largest count, {look.highest}",
                advice="counts are clipped: expose shorter, or with fewer photons",
                steps=_steps(name, clipped),
            )
        dark = np.flatnonzero(look.black > SATURATED)
        if len(dark):
            yield Doubt(
                name="starvation",
                figure=f"{name}: up to {look.black.max():.1%} of the pixels see no more than 2 % of the beam",
                advice="nothing is measured behind them: more photons, a harder beam or a thinner sample",
                steps=_steps(name, dark),
            )
        flat = np.flatnonzero(look.steepest > STEEP)
        if name == TEST and len(flat) > FLAT_SHARE * len(look.steepest):
            yield Doubt(
                name="flat-faces",
                figure=f"{name}: at {len(flat)} of {len(look.steepest)} steps attenuation rises by more than "
                f"{STEEP:.0%} of its largest from one column to the next",
                advice="flat faces lie along the beam, where edges are interpolated badly: turn the sample, or use "
                "other angles",
                steps=_steps(name, flat),
            )
        cut = np.flatnonzero(look.edge > EDGE_SEEN)
        if len(cut):
            yield Doubt(
                name="out-of-view",
                figure=f"{name}: the sample covers a side of the detector in up to {look.edge.max():.0%} of the rows",
                advice="the whole width of the sample has to be seen at every angle",
                steps=_steps(name, cut),
            )
    if found.flats_top > SATURATED and found.flats_full:
        yield Doubt(
            name="saturation",
            figure=f"{FLATS}: {found.flats_top:.1%} of the pixels are at the largest count",
            advice="counts are clipped: expose shorter",
        )
    if found.bad_share > 0.02:
        yield Doubt(
            name="bad-pixels",
            figure=f"{found.bad_share:.1%} of the pixels are not to be believed",
            advice="look at flats and darks",
        )
    ratio = found.noise_ratio
    if np.isfinite(ratio) and not 1 / NOISE_FACTOR < ratio < NOISE_FACTOR:
        yield Doubt(
            name="noise-level",
            figure=f"flats scatter with {ratio:.3g} times the variance that [acquisition] in {DESCRIPTION} tells",
            advice="correct photons_per_count, readout_noise_counts or frames: standard deviations follow them",
        )


def _steps(name: str, images: NDArray[np.intp]) -> tuple[int, ...]:
    """Return images of a stack as steps, where they are those of the test."""
    return tuple(images.tolist()) if name == TEST else ()


def _of_records(found: Examination, experiment: Experiment) -> Iterator[Doubt]:
    test = experiment.test
    if found.repeated:
        yield Doubt(
            name="repeated-step",
            figure=f"{len(found.repeated)} radiographs of the test are, count for count, those of earlier steps",
            advice="no two exposures are the same: was a file copied twice?",
            steps=found.repeated,
        )
    late = np.flatnonzero(np.diff(test.time_s) <= 0) + 1
    if len(late):
        yield Doubt(
            name="times",
            figure=f"test.time_s does not increase at {len(late)} of {len(test)} steps",
            advice="are the steps in the order in which they were recorded?",
            steps=tuple(late.tolist()),
        )
    # directions half a turn apart see the same: their doubled angles are compared
    alike = float(np.abs(np.exp(2j * test.angle_rad).mean()))
    if alike > ONE_DIRECTION and len(test) > 1:
        yield Doubt(
            name="one-direction",
            figure="all radiographs of the test look nearly the same way: their directions have a resultant of "
            f"{alike:.2f}",
            advice="motion along the beam is not known: turn the sample during the test",
        )


def _of_reference(found: Examination, experiment: Experiment) -> Iterator[Doubt]:
    if found.largest_gap_rad > GAP_RAD:
        yield Doubt(
            name="coverage",
            figure=f"no reference view over {np.rad2deg(found.largest_gap_rad):.1f} degrees of the turn",
            advice="a reference scan goes all around, in steps of a few degrees",
        )
    twice = found.seen_twice
    if twice is None:
        return
    certain = twice.mismatch_reversed > 1.03 * twice.mismatch
    if twice.factor + 5 * twice.factor_std < 0 and certain:
        yield Doubt(
            name="rotation-sign",
            figure=f"opposite views fit together with {twice.factor:.2f} times the fan angle, where 1 is due "
            f"(mismatch {twice.mismatch:.2g} of attenuation, {twice.mismatch_reversed:.2g} with the sign given)",
            advice="the stage turned the other way: give reference and test angles the other sign",
            fatal=True,
        )
    elif certain and abs(twice.factor - 1) > max(FAN_TOLERANCE, 5 * twice.factor_std):
        yield Doubt(
            name="fan-angle",
            figure=f"opposite views fit together with {twice.factor:.2f} +- {twice.factor_std:.2f} times the fan "
            "angle, where 1 is due",
            advice="check pixel_mm and source_detector_mm",
        )
    if abs(twice.axis_px) > AXIS_PX:
        yield Doubt(
            name=_AXIS,
            figure=f"the axis is seen {twice.axis_px:+.1f} px from the column where the geometry says it is",
            advice="correct column_shift_mm by "
            f"{-twice.axis_px * experiment.geometry.pixel_mm:+.4g} mm, or crop all stacks alike",
        )
    rows = experiment.geometry.rows
    most = max(PLANE_PX, PLANE_SHARE * rows, 5 * twice.plane_std_px)
    if twice.plane_px is not None and abs(twice.plane_px) > most:
        yield Doubt(
            name="source-plane",
            figure=f"opposite views fit best {twice.plane_px:+.0f} px from the row where the geometry has the source",
            advice=f"correct row_shift_mm by {-twice.plane_px * experiment.geometry.pixel_mm:+.4g} mm, about",
        )


def _of_angles(found: Examination, experiment: Experiment) -> Iterator[Doubt]:
    like = found.likeness
    if like is None:
        return
    best, recorded = float(np.median(like.best)), float(np.median(like.recorded[like.steps]))
    for name, values, what in (
        ("upside-down", like.upside_down, "turned upside down"),
        ("left-right", like.mirrored, "mirrored left to right"),
    ):
        turned = float(np.median(values))
        if turned > best + ALIKE:
            yield Doubt(
                name=name,
                figure=f"radiographs of the test fit the reference views better {what} (correlation {turned:.2f}, "
                f"{best:.2f} as they are)",
                advice="turn one of the two stacks",
                fatal=True,
            )
            return
    if best < ANOTHER:
        yield Doubt(
            name="another-sample",
            figure=f"radiographs of the test are like no reference view (correlation {best:.2f} at best, 1 is due)",
            advice="are both stacks of the same sample, and is anything seen in them?",
            fatal=best < ANOTHER / 2,
        )
        return
    gain = like.best - like.recorded[like.steps]
    apart = np.abs(like.off_rad)
    elsewhere = (apart > 1.1 * like.spacing_rad) & (gain > ALIKE / 2)
    if elsewhere.mean() > 0.5:
        yield Doubt(
            name="test-angles",
            figure=f"at {int(elsewhere.sum())} of {len(elsewhere)} steps looked at, the radiograph is like the view "
            f"{np.rad2deg(np.median(apart[elsewhere])):.0f} degrees (median) from its angle (correlation {best:.2f}, "
            f"{recorded:.2f} at its angle)",
            advice=_what_of_the_angles(experiment),
        )
        return
    # one step by itself may move by much: only what is plain counts
    single = like.steps[(apart > 2 * like.spacing_rad) & (gain > 2 * ALIKE)]
    if len(single):
        yield Doubt(
            name="step-angle",
            figure=f"{len(single)} radiographs are like a view at another angle than theirs",
            advice="are steps exchanged, or their angles?",
            steps=tuple(single.tolist()),
        )


def _what_of_the_angles(experiment: Experiment) -> str:
    degrees = np.rad2deg(np.abs(experiment.test.angle_rad)).max()
    hint = " (are these radians?)" if 0 < degrees < 60 else ""
    return f"test.angle_deg: check their sign, order, unit and zero{hint}"
