"""The report's figures: which data each draws, and what is said below it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pdvc.experiment import Experiment
from pdvc.measurement import Measurement
from pdvc.radiographs import calibrate, grey_levels
from validation.report import figures as draw
from validation.scoring.centre_line import CentreLine, TruePoints, centre_line, nan_mean
from validation.scoring.deviations import centre_line_deviation
from validation.scoring.noise_floor import NoiseFloor, noise_floor
from validation.scoring.scores import point_errors

SHOWN = (90 / 127, 110 / 127, 123 / 127)
"""Steps that the paper shows, as shares of the test."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A figure and what to say below it."""

    name: str
    caption: str
    figure: Figure


def pictures(measurement: Measurement, experiment: Experiment | None, truth: TruePoints | None) -> list[Picture]:
    """Draw all figures that the data allow, in the paper's order."""
    steps = selected_steps(len(measurement.recording.angle_rad))
    centre = centre_line(measurement, truth)
    result = []
    if experiment is not None:
        result.append(_radiographs(measurement, experiment, steps))
    result += [_force(measurement, steps), *_residuals(measurement, steps)]
    result += [_translations(centre), _snr(measurement), *_maps(centre)]
    if truth is not None:
        result.append(_errors(measurement, truth))
    result += _deviations(measurement, truth)
    floor = noise_floor(measurement, truth)
    if floor is not None:
        result.append(_noise_floor(floor))
    return result


def of_volumes(measurement: Measurement) -> bool:
    """Return whether volumes were compared, not radiographs: then no radiograph has a residual."""
    return measurement.fit.residual_final.size == 0


def selected_steps(steps: int) -> list[int]:
    """Return the three steps shown, at the shares of the test that the paper shows."""
    return sorted({min(round(share * steps), steps - 1) for share in SHOWN})


def _radiographs(measurement: Measurement, experiment: Experiment, steps: Sequence[int]) -> Picture:
    calibration = calibrate(experiment)
    images = [grey_levels(experiment.test.counts[step], calibration) for step in steps]
    largest = max(float(np.quantile(image, 0.9995)) for image in images)
    figure = _row(
        images,
        lambda axes: draw.draw_radiographs(
            [image / largest for image in images],
            _titles(measurement, steps),
            axes,
            window=measurement.recording.window,
        ),
    )
    return Picture(
        name="fig03_radiographs",
        caption="Radiographs of three steps after dark and flat correction: -log of the transmission over "
        "its largest value, without correction of beam hardening. The frame marks the pixels used.",
        figure=figure,
    )


def _force(measurement: Measurement, steps: Sequence[int]) -> Picture:
    figure, (ax,) = draw.new_figure(7.5, 3)
    draw.draw_force(measurement.recording.time_s, measurement.recording.force_N, steps, ax)
    return Picture(
        name="fig04_force",
        caption="Measured force; it serves only as one of the time functions. Dots: the steps shown in the "
        "other figures.",
        figure=figure,
    )


def _residuals(measurement: Measurement, steps: Sequence[int]) -> list[Picture]:
    if of_volumes(measurement):
        return []
    rows = (
        ("fig05_residual_initial", "before any motion is measured", measurement.fit.residual_initial),
        ("fig06_residual_rigid", "after the rigid stage", measurement.fit.residual_rigid),
        ("fig08_residual_final", "at the end", measurement.fit.residual_final),
    )
    # after the rigid stage and at the end share one scale: their difference is what sections add
    coarse = draw.scale_limit(list(measurement.fit.residual_initial[steps]))
    fine = draw.scale_limit(list(measurement.fit.residual_rigid[steps]))
    result = []
    for (name, when, fields), limit in zip(rows, (coarse, fine, fine), strict=True):
        shown = list(fields[steps])
        result.append(
            Picture(
                name=name,
                caption=_scale_caption(when, limit, coarse),
                figure=_residual_row(shown, _titles(measurement, steps), limit),
            )
        )
    return result


def _residual_row(fields: list[NDArray[np.float32]], titles: list[str], limit: float) -> Figure:
    return _row(fields, lambda axes: draw.draw_residuals(fields, titles, axes, limit=limit))


def _scale_caption(when: str, limit: float, coarse: float) -> str:
    zoom = "" if limit == coarse else f", {coarse / limit:.3g} times finer than before any motion"
    return (
        f"Residual (re-projected, moved volume minus radiograph) {when}, in the used pixels. One scale for "
        f"all panels: ±{limit:g} grey levels{zoom}. White is a perfect match."
    )


def _translations(centre: CentreLine) -> Picture:
    figure, (ax,) = draw.new_figure(7.5, 3.4)
    draw.draw_translations(centre, ax)
    return Picture(
        name="fig07_translations",
        caption="Translation of the sample at the end of the procedure, averaged over the heights on the "
        "axis that are observed at every step, in the frame of the sample."
        + ("" if centre.true is None else " Dashed: the truth."),
        figure=figure,
    )


def _snr(measurement: Measurement) -> Picture:
    figure, (ax,) = draw.new_figure(8.5, 3.4)
    fit = measurement.fit
    draw.draw_snr(
        fit.snr_initial_db, fit.snr_rigid_db, fit.snr_final_db, fit.snr_noise_db,
        float(nan_mean(fit.snr_reprojection_db)), ax,
    )  # fmt: skip
    return Picture(
        name="fig09_snr",
        caption="Signal-to-noise ratio of each step, "
        + (
            "20 log10(std(volume) / std(residual)) over the used voxels."
            if of_volumes(measurement)
            else "20 log10(std(radiograph) / std(residual)) over the used pixels. It swings with the turn because "
            "some angles hide the motion."
        ),
        figure=figure,
    )


def _maps(centre: CentreLine) -> list[Picture]:
    displacement, strain = draw.stretch_maps(centre)
    where = "at the sections" if centre.true is None else "of material points on the axis, by their reference height"
    return [
        Picture(
            name="fig10a_vertical_displacement",
            caption=f"Vertical displacement {where}, without rigid motion: at each step its mean over the "
            "heights is subtracted. Grey: not observed.",
            figure=displacement,
        ),
        Picture(
            name="fig10b_strain",
            caption=f"Axial strain between neighbouring heights {where}. Grey: not observed.",
            figure=strain,
        ),
    ]


def _errors(measurement: Measurement, truth: TruePoints) -> Picture:
    figure, (ax,) = draw.new_figure(8.5, 3.2)
    draw.draw_errors(point_errors(measurement, truth).by_step(), ax)
    return Picture(
        name="errors",
        caption="Error of each step, rms over the material points between the observed sections."
        + (
            ""
            if of_volumes(measurement)
            else " What one radiograph hardly shows, the motion along its beam, is known through the steps seen from "
            "other sides."
        ),
        figure=figure,
    )


def _deviations(measurement: Measurement, truth: TruePoints | None) -> list[Picture]:
    at_sections = centre_line_deviation(measurement)
    if truth is None:
        histories = Picture(
            name="uncertainty_histories",
            caption="Standard deviation at three sections on the axis, from noise and prior; that of the strain holds "
            "between the section and the next.",
            figure=draw.std_histories(at_sections),
        )
    else:
        histories = Picture(
            name="uncertainty_bands",
            caption="Error on the axis, measured less true, at three heights of the material at rest. Band: two "
            "standard deviations, from noise and prior, on either side; where they are right, it holds zero at 95 % "
            "of the steps. Strain: between that height and the next.",
            figure=draw.error_bands(centre_line_deviation(measurement, truth)),
        )
    maps = Picture(
        name="uncertainty_maps",
        caption="Standard deviation, from noise and prior, on the axis at each section; of the strain, between "
        "neighbouring sections. Each map has its own scale; the largest 2 % of its values lie beyond it. Grey: not "
        "observed.",
        figure=draw.std_maps(at_sections),
    )
    return [histories, maps]


def _noise_floor(floor: NoiseFloor) -> Picture:
    figure, (ax,) = draw.new_figure(8.5, 3.2)
    true = floor.true
    draw.draw_noise_floor(
        floor.level_mm,
        floor.temporal_by_level,
        None if true is None else true.level_mm,
        None if true is None else true.scatter_by_level,
        ax,
    )
    return Picture(
        name="noise_floor",
        caption="Noise floor: scatter of the measured motion beyond a rigid one, over the first "
        f"{floor.steps} steps, at constant load."
        + ("" if true is None else " Dashed: the scatter of the true error, rigid motion included."),
        figure=figure,
    )


def _row(images: Sequence[NDArray[Any]], paint: Callable[[list[Any]], object]) -> Figure:
    rows, columns = images[0].shape
    width = 2.5 * len(images) + 1.2
    figure, axes = draw.new_figure(width, min(2.2 * rows / columns, 6.0) + 0.9, len(images))
    paint(axes)
    return figure


def _titles(measurement: Measurement, steps: Sequence[int]) -> list[str]:
    degrees = np.rad2deg(measurement.recording.angle_rad)
    return [
        f"step {step}, {(degrees[step] + 180) % 360 - 180:.1f}°\n{measurement.recording.force_N[step]:.0f} N"
        for step in steps
    ]
