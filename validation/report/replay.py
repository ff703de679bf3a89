"""A self-contained page whose slider moves through the steps of a test: radiograph, residual, profiles together.

Images are JPEG, binned until the page is small enough to be sent: what that costs is said on the page.
"""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from pdvc.progress import Progress, silent
from pdvc.radiographs import Image, binned
from pdvc.whole import write_whole
from validation.report.steps import Profile, Steps
from validation.report.template import template
from validation.view.pictures import colours

LONGEST_PX = 640
"""Longest side of an image that is shown as it is, or binned no more."""
MOST_BYTES = 12_000_000
"""Of all images of a page together, as it holds them; else they are binned further."""
COARSEST = 16
QUALITY = 80
DIGITS = 5


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """The images of all steps, each as base64; the residual's is None where a step was not measured."""

    radiographs: tuple[str, ...]
    residuals: tuple[str | None, ...]
    binning: int
    """Pixels along a side of which one is the mean."""

    @property
    def size(self) -> int:
        """Return how many bytes they take on the page."""
        return sum(len(each or "") for each in (*self.radiographs, *self.residuals))


def write_replay(path: Path, steps: Steps, *, most_bytes: int = MOST_BYTES, progress: Progress = silent) -> Pictures:
    """Write the page; returns its images, which are binned until they take no more than so many bytes."""
    rows, columns = steps.shape
    binning = -(-max(rows, columns) // LONGEST_PX)
    pictures = pictures_of(steps, binning, progress)
    while pictures.size > most_bytes and pictures.binning < COARSEST:
        # bytes go with the number of pixels, so that this is nearly always enough
        wanted = int(np.ceil(pictures.binning * np.sqrt(pictures.size / most_bytes)))
        pictures = pictures_of(steps, min(max(wanted, pictures.binning + 1), COARSEST), progress)
    write_whole(path, page_of(steps, pictures).encode())
    return pictures


def pictures_of(steps: Steps, binning: int, progress: Progress = silent) -> Pictures:
    """Return all images, binned by a factor."""
    radiographs, residuals = [], []
    count = steps.measurement.recording.steps
    for step in range(count):
        radiographs.append(_gray(binned(steps.radiograph(step), binning)))
        field = steps.residual(step)
        residuals.append(None if field is None else _diverging(binned(field, binning) / steps.limit))
        progress("images", step + 1, count)
    return Pictures(radiographs=tuple(radiographs), residuals=tuple(residuals), binning=binning)


def page_of(steps: Steps, pictures: Pictures) -> str:
    """Return the page as text."""
    recording, fit = steps.measurement.recording, steps.measurement.fit
    data = {
        "words": [steps.words(step) for step in range(recording.steps)],
        "time_s": _listed(recording.time_s),
        "snr_db": _listed(fit.snr_final_db),
        "radiographs": pictures.radiographs,
        "residuals": pictures.residuals,
        "profiles": [_told(profile) for profile in steps.profiles],
    }
    top, bottom, left, right = recording.window
    rows, columns = steps.shape
    return template("replay.html").render(
        title=recording.title or "A test",
        verdict=steps.measurement.verdict.word,
        steps=recording.steps,
        data=data,
        profiles=steps.profiles,
        true_known=steps.truth is not None,
        limit=f"{steps.limit:g}",
        binning=pictures.binning,
        scale=[f"rgb({red} {green} {blue})" for red, green, blue in colours("RdBu_r")[::15]],
        # the used window, in per cent of the radiograph
        window={
            "left": 100 * left / columns,
            "top": 100 * top / rows,
            "width": 100 * (right - left) / columns,
            "height": 100 * (bottom - top) / rows,
        },
        chart=(files("validation.view") / "page" / "assets" / "chart.js").read_text(encoding="utf-8"),
    )


def _told(profile: Profile) -> dict[str, Any]:
    return {
        "name": profile.name,
        "unit": profile.unit,
        "height_mm": _listed(profile.height_mm),
        "limits": _listed(np.array(profile.limits)),
        "value": [_listed(row) for row in profile.value],
        "half": [_listed(row) for row in profile.half],
        "true": None if profile.true is None else [_listed(row) for row in profile.true],
    }


def _listed(values: NDArray[np.floating]) -> list[float | None]:
    """Return numbers to so many digits; what is not known is null."""
    return [float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in values]


def _gray(image: Image) -> str:
    """Return an image as JPEG, air (0) white and 1 black."""
    return _jpeg(Pillow.fromarray(np.round(255 * (1 - np.clip(image, 0, 1))).astype(np.uint8)))


def _diverging(image: Image) -> str:
    """Return an image as JPEG in colours from -1, blue, over white to 1, red."""
    place = np.round((np.clip(image, -1, 1) + 1) * 127.5).astype(np.uint8)
    return _jpeg(Pillow.fromarray(colours("RdBu_r")[place]))


def _jpeg(picture: Pillow.Image) -> str:
    buffer = io.BytesIO()
    # colours are kept at each pixel: a residual lives in them
    picture.save(buffer, "JPEG", quality=QUALITY, subsampling=0)
    return base64.b64encode(buffer.getvalue()).decode("ascii")
