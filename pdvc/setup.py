"""What every measurement starts from: calibration, outline, window, sections and options, found once and handed on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.beam_hardening import Outline, find_outline
from pdvc.brightness import air_pixels, brightness
from pdvc.correction import Correction, corrected, correction_of, motion_after, text_of, view_motion
from pdvc.experiment import Experiment, Series
from pdvc.geometry import ConeBeam
from pdvc.history import time_basis
from pdvc.late_light import image_time_s, without_late_light
from pdvc.measurement import Recording
from pdvc.options import MeasureOptions, ResolvedOptions, check_discarded, resolved
from pdvc.prior import Prior
from pdvc.progress import Progress, silent
from pdvc.radiographs import IDENTITY, Calibration, binned, calibrate, grey_levels
from pdvc.sections import RIGID, SectionBasis, SectionPattern
from pdvc.seen_twice import seen_twice
from pdvc.self_calibration import self_calibrated
from pdvc.store import Keep, Store
from pdvc.verdict import listed
from pdvc.volume import Hull
from pdvc.window import height_mm, used_window

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

_OUTLINE_ROWS = 240
"""The outline is found on radiographs binned to about this many rows."""
_OUTLINE_VIEWS = 150
_AIR_VIEWS = 24
"""Reference views in which air is looked for."""
ROWS_OF_A_SECTION = 2


@dataclass(frozen=True, kw_only=True)
class Setup:
    """An experiment made ready to be measured: what does not depend on the scale, nor on the motion."""

    experiment: Experiment
    """With the geometry as it was told, or as self-calibration found it."""
    told: ConeBeam
    """The geometry as it was told, at scale 1."""
    correction: Correction | None
    """What self-calibration found, where it was asked for."""
    options: ResolvedOptions
    store: Store
    calibration: Calibration
    """Of the detector, with the beam-hardening polynomial."""
    outline: Outline
    """The sample's hull in the reference scan."""
    window: tuple[int, int, int, int]
    """Used rows and columns at scale 1: row_from, row_to, column_from, column_to."""
    rigid: SectionBasis
    """The sample as one rigid body: one section."""
    sections: SectionBasis
    """The sections, spread over the used height."""

    @property
    def geometry(self) -> ConeBeam:
        """Return the scanner's geometry at scale 1."""
        return self.experiment.geometry

    @property
    def view_motion_px(self) -> Floats | None:
        """Return how each reference view moved (view, 3), px, as in `pdvc.correction`; None where none did."""
        if self.correction is None:
            return None
        views = self.experiment.reference
        found = view_motion(self.correction.values_px, views.angle_rad, views.time_s)
        return found if found.any() else None

    def test_motion_px(self, angle_rad: Floats) -> Floats | None:
        """Return how radiographs of the test at stage angles (step,) moved (step, 3), px; None where none did.

        The scanner is as the last view left it, and its stage does at an angle what it did there.
        """
        if self.correction is None:
            return None
        found = motion_after(self.correction.values_px, angle_rad)
        return found if found.any() else None

    def recording(self) -> Recording:
        """Return what was recorded, for the result."""
        test = self.experiment.test
        return Recording(
            title=self.experiment.title,
            voxel_mm=self.geometry.voxel_mm,
            source_axis_mm=self.geometry.source_axis_mm,
            angle_rad=test.angle_rad,
            time_s=test.time_s,
            force_N=test.force_N,
            window=self.window,
            brightness=self._brightness(),
        )

    def _brightness(self) -> Floats | None:
        """Return the brightness of each radiograph of the test and its deviation (step, 2), if air tells it."""
        calibration = self.calibration
        air = calibration.air
        if air is None:
            return None
        beam, dark = calibration.open_beam, calibration.dark
        return np.array([brightness(counts - dark, beam, air) for counts in self.experiment.test.counts])

    def time_functions(self) -> Floats:
        """Return the orthonormal time functions (function, step) of the options.

        Raises ValueError where they leave a step without any: nothing could be said about it.
        """
        functions = time_basis(self.options.time, self.experiment.test)
        without = np.flatnonzero(~functions.any(axis=0))
        if len(without):
            raise ValueError(
                f"time: expected functions of which one or more is not zero at each step, all are zero at step "
                f"{listed(without.tolist())}: add a constant, kind = 'polynomial' of degree 0 (a list in an options "
                "file stands in place of the default one)"
            )
        return functions

    def prior(self, basis: SectionBasis) -> Prior:
        """Return the prior of the options for a basis."""
        return Prior(deviation_voxel=np.full(basis.shape, self.options.prior_voxel))

    def with_sections(self, count: int) -> SectionBasis:
        """Return the section basis with another number of sections."""
        return section_basis(self.geometry, self.window, self.outline.hull, count, self.sections.motions)


def set_up(
    experiment: Experiment, options: MeasureOptions, *, work: Path | None = None, progress: Progress = silent
) -> Setup:
    """Calibrate, outline the sample in the reference scan, and choose window and sections.

    `work` is a folder for intermediate results. Raises ValueError, in one line, where options and experiment do not
    fit each other, or no sample is found.
    """
    told = experiment.geometry
    check_discarded(options, told)
    experiment = _without_lag(experiment, options)
    correction = _corrected(experiment, options, Store(work, experiment), progress)
    if correction is not None:
        experiment = replace(experiment, geometry=corrected(told, correction.values_px))
    geometry, store = experiment.geometry, Store(work, experiment)
    calibration, outline = _calibrated(experiment, options, store, progress)
    window = used_window(geometry, outline.hull, options.discard_rows, options.discard_columns)
    rigid, sections = _bases(geometry, window, outline.hull, options)
    return Setup(
        experiment=experiment,
        told=told,
        correction=correction,
        options=resolved(options, experiment, window[0], window[2]),
        store=store,
        calibration=calibration,
        outline=outline,
        window=window,
        rigid=rigid,
        sections=sections,
    )


def _without_lag(experiment: Experiment, options: MeasureOptions) -> Experiment:
    """Return an experiment without the light that came late, if the options tell of any."""
    if not options.lag:
        return experiment
    calibration, light = calibrate(experiment), np.ones(experiment.flats.shape[1:], dtype=np.float32)
    found: list[Series] = []
    for name, series in (("reference", experiment.reference), ("test", experiment.test)):
        counts, light = without_late_light(
            series.counts,
            calibration.dark,
            calibration.open_beam,
            options.lag,
            image_time_s(series.time_s, name),
            light,
        )
        found.append(replace(series, counts=counts))
    reference, test = found
    return replace(experiment, reference=reference, test=test)


def _corrected(experiment: Experiment, options: MeasureOptions, store: Store, progress: Progress) -> Correction | None:
    """Return what self-calibration finds, if it is asked for; kept for every test with the same reference scan."""
    sought = options.self_calibration
    if sought == "none":
        return None

    def found() -> dict[str, NDArray[Any]]:
        # where the axis is by opposite views is a good first guess, and an outline needs it
        twice = seen_twice(experiment.reference, experiment.geometry, calibrate(experiment))
        axis_px = 0.0 if twice is None else twice.axis_px
        guess = corrected(experiment.geometry, {"column_shift": -axis_px})
        nearly = replace(experiment, geometry=guess)
        calibration, outline = _calibrated(nearly, options, Store(None, nearly), progress)
        correction = self_calibrated(
            experiment.reference,
            experiment.geometry,
            calibration,
            outline.hull,
            sought,
            axis_px=axis_px,
            progress=progress,
        )
        return {"correction": np.array(text_of(correction))}

    kept = store.of_reference("self-calibration", (sought, options.beam_hardening, options.brightness), found)
    return correction_of(str(kept["correction"]))


def _calibrated(
    experiment: Experiment, options: MeasureOptions, store: Store, progress: Progress
) -> tuple[Calibration, Outline]:
    calibration = calibrate(experiment)
    if options.brightness == "air":
        calibration = with_air(experiment, calibration)
    given = {"fit": None, "none": IDENTITY}.get(str(options.beam_hardening), options.beam_hardening)
    polynomial = given if isinstance(given, tuple) else None
    keep = partial(store.of_reference, "outline", (calibration, polynomial))
    outline = outlined(experiment.reference, experiment.geometry, calibration, polynomial, keep, progress)
    return calibration.with_polynomial(outline.polynomial), outline


def with_air(experiment: Experiment, calibration: Calibration) -> Calibration:
    """Return a calibration that knows where air is seen in every radiograph; the same where it is nowhere."""
    series = experiment.reference
    some = np.unique(np.linspace(0, len(series), min(_AIR_VIEWS, len(series)), endpoint=False).astype(int))
    return replace(
        calibration,
        air=air_pixels((grey_levels(series.counts[i], calibration) for i in some), calibration.bad),
    )


def outlined(
    series: Series,
    geometry: ConeBeam,
    calibration: Calibration,
    polynomial: tuple[float, float, float] | None,
    keep: Keep,
    progress: Progress,
) -> Outline:
    """Return the sample's outline in a full scan; `calibration` without beam hardening, else as in `find_outline`."""
    factor = max(1, round(geometry.rows / _OUTLINE_ROWS))
    chosen = np.unique(np.linspace(0, len(series), min(_OUTLINE_VIEWS, len(series)), endpoint=False).astype(int))

    def view(i: int) -> Image:
        return binned(grey_levels(series.counts[chosen[i]], calibration), factor)

    def found() -> dict[str, Floats]:
        outline = find_outline(
            view, geometry.binned(factor), series.angle_rad[chosen], polynomial, binned=factor, progress=progress
        )
        hull = outline.hull
        return {
            "place_mm": np.array([hull.z_mm, hull.slab_mm]),
            "support_mm": hull.support_mm,
            "polynomial": np.array(outline.polynomial),
        }

    kept = keep(found)
    z_mm, slab_mm = kept["place_mm"]
    c1, c2, c3 = (float(c) for c in kept["polynomial"])
    return Outline(
        hull=Hull(z_mm=float(z_mm), slab_mm=float(slab_mm), support_mm=kept["support_mm"]), polynomial=(c1, c2, c3)
    )


def _bases(
    geometry: ConeBeam, window: tuple[int, int, int, int], hull: Hull, options: MeasureOptions
) -> tuple[SectionBasis, SectionBasis]:
    """Return the rigid basis, one section with the rigid motions that the sections can follow, and the sections."""
    sections = section_basis(geometry, window, hull, options.sections_for(geometry.rows), options.motions)
    middle = np.array([(sections.height_mm[0] + sections.height_mm[-1]) / 2])
    single = {
        motion: SectionBasis(height_mm=middle, radius_mm=sections.radius_mm, motions=(motion,)) for motion in RIGID
    }
    followed = tuple(motion for motion, alone in single.items() if sections.reproduces(alone))
    if not followed:
        raise ValueError(
            "section_motions: expected some by which the sample can move as one rigid body, got "
            f"{', '.join(options.section_motions)}"
        )
    return SectionBasis(height_mm=middle, radius_mm=sections.radius_mm, motions=followed), sections


def section_basis(
    geometry: ConeBeam,
    window: tuple[int, int, int, int],
    hull: Hull,
    count: int,
    motions: tuple[SectionPattern, ...],
) -> SectionBasis:
    """Return sections spread over the used height; raises ValueError for sections closer than two rows."""
    if count > max((window[1] - window[0]) / ROWS_OF_A_SECTION, 2):
        raise ValueError(
            f"sections: expected at most one for every {ROWS_OF_A_SECTION} of the {window[1] - window[0]} used rows, "
            f"got {count}"
        )
    low, high = hull.box_mm()
    radius = float(np.hypot(*(high - low)[:2]) / 4)
    top = height_mm(geometry, window[0] - 0.5)
    bottom = height_mm(geometry, window[1] - 0.5)
    return SectionBasis(height_mm=np.linspace(bottom, top, count), radius_mm=radius, motions=motions)
