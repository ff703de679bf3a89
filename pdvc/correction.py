"""What a scanner is beside what it is told to be: a correction of its geometry, and of each reference view.

Everything is counted in pixels of the detector as stored, so that all of it can be compared; a turn by what it does at
half the detector's height from the middle. A view that moved in the plane of the image is moved back before it is
used. With the source where it is that is exact for a detector that moved; a sample that moved across the beam, along
the axis or about the beam looks alike, but for its depth over the distance from the source.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pdvc.geometry import ConeBeam

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

DIRECTIONS = ("right", "down", "turn")
"""How a view may have moved in the plane of the image, px; a turn from columns towards rows, at half the height."""
GEOMETRY = {"column_shift": "right", "roll": "turn"}
"""Of the geometry, as in `pdvc.geometry.ConeBeam`, what is added to it, px; and which way all views move with it."""
UNSEEN = {"row_shift": 1.0, "source_detector": 1.0, "source_axis": 0.0}
"""Of the geometry what a slender sample does not show: a plane of the source that is elsewhere changes views as a
sample that moved along the axis does, and a distance as a sample of another size does, but for depth over the distance
from the source: so many times the rms of that is seen. What the axis is from the source only sets the scale."""
MODES = ("drift", "bend", "cos", "sin", "cos 2", "sin 2")
"""How a motion may depend on the view: on its time, and on the stage angle."""
MOTION = tuple(
    f"{direction} {mode}"
    for direction in DIRECTIONS
    for mode in MODES
    # to the right as cos theta, and turned as cos theta, is how a sample looks that stands elsewhere, or leans
    if direction == "down" or mode not in ("cos", "sin")
)

State = Literal["found", "none", "not observable"]


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One number of a correction, as it was found, or why it was not."""

    name: str
    """One of `GEOMETRY`, `MOTION` or `UNSEEN`."""
    value_px: float = 0.0
    """What is added to what was told, px; zero where it is left as told."""
    std_px: float = float("nan")
    """Its standard deviation, px; NaN where it was not sought."""
    seen: float = 1.0
    """Share of what it does to the views that no other volume does as well: 0 where it cannot be found."""
    state: State = "found"
    """Found; none: sought, and not told from zero; or not sought, as it is not seen."""

    def __str__(self) -> str:
        """Return a line for the reader."""
        if self.state == "not observable":
            return f"{self.name}: not observable, left as told: {self.seen:.1%} of what it does to the views is seen"
        size = f"{self.value_px:+.3f}" if self.state == "found" else "none,"
        return f"{self.name}: {size} +- {self.std_px:.3f} px"


@dataclass(frozen=True, kw_only=True)
class Correction:
    """What self-calibration found: see `pdvc.self_calibration`."""

    parameters: tuple[Parameter, ...]
    rounds: int
    """Times that the scan was reconstructed, registered and corrected."""
    last_change_px: float
    """The largest change in the last round, px."""
    rms_before: float
    """What re-projection left of the views as told, rms, grey levels, at the scale of the last round."""
    rms_after: float
    """The same with the correction."""

    @property
    def values_px(self) -> dict[str, float]:
        """Return what is added to what was told, px, by name."""
        return {each.name: each.value_px for each in self.parameters}

    @property
    def lines(self) -> tuple[str, ...]:
        """Return what was found, and what was not, for the reader."""
        ended = f"{self.rounds} rounds, the last changed {self.last_change_px:.4f} px"
        left = f"re-projection left {self.rms_before:.4f}, now {self.rms_after:.4f} grey levels rms"
        return (*map(str, self.parameters), f"{ended}; {left}")


def text_of(correction: Correction) -> str:
    """Return a correction as JSON, to be kept."""
    return json.dumps(asdict(correction))


def correction_of(text: str) -> Correction:
    """Return the correction that `text_of` made a text of."""
    values = json.loads(text)
    return Correction(**{**values, "parameters": tuple(Parameter(**each) for each in values["parameters"])})


def corrected(told: ConeBeam, values_px: Mapping[str, float]) -> ConeBeam:
    """Return a geometry with what `values_px` of `GEOMETRY` add to it, px."""
    return replace(
        told,
        column_shift_mm=told.column_shift_mm + values_px.get("column_shift", 0.0) * told.pixel_mm,
        roll_rad=told.roll_rad + values_px.get("roll", 0.0) / (told.rows / 2),
    )


def view_motion(values_px: Mapping[str, float], angle_rad: Floats, time_s: Floats) -> Floats:
    """Return how views at angles and times (view,) moved (view, 3), along `DIRECTIONS`, px, by values of `MOTION`."""
    return _moved(values_px, modes_of(angle_rad, time_s), len(time_s))


def _moved(values_px: Mapping[str, float], modes: Mapping[str, Floats], images: int) -> Floats:
    result = np.zeros((images, len(DIRECTIONS)))
    for name in MOTION:
        direction, mode = name.split(" ", maxsplit=1)
        result[:, DIRECTIONS.index(direction)] += values_px.get(name, 0.0) * modes[mode]
    return result


def motion_after(values_px: Mapping[str, float], angle_rad: Floats) -> Floats:
    """Return how images moved that were taken right after the views, at angles (image,): (image, 3), px.

    What drifted stays where the last view had it; waves go with the angle of the stage, whenever it comes by.
    """
    modes = modes_of(angle_rad, angle_rad)
    ended = modes_of(np.zeros(2), np.arange(2.0))
    for name in ("drift", "bend"):
        modes[name] = np.full(len(angle_rad), ended[name][-1])
    return _moved(values_px, modes, len(angle_rad))


def rays_of_moved(rays_mm: Floats, motion_px: Floats, scale: int, middle_px: Floats, half_rows: float) -> Floats:
    """Return the rays (image, 4, 3), mm, that pixels of images show which moved by (image, 3), px as stored.

    `rays_mm` (image, 4, 3) are source, corner, row and column of the pixels as they are told, as in `pdvc.rays`, in
    pixels `scale` times as large; `middle_px` (2,) is the middle of the detector, and `half_rows` half its height, in
    rows and columns of these counted from the corner.
    """
    result = rays_mm.copy()
    for ray, (right, down, turn) in zip(result, motion_px, strict=True):
        c, s = np.cos(turn / (half_rows * scale)), np.sin(turn / (half_rows * scale))
        back = np.array([[c, -s], [s, c]])  # from where a pixel is (row, column) to where what it shows is due
        ways = ray[2:].T  # mm for each row and column
        ray[1] += ways @ (middle_px - back @ (middle_px + np.array([down, right]) / scale))
        ray[2:] = (ways @ back).T
    return result


def modes_of(angle_rad: Floats, time_s: Floats) -> dict[str, Floats]:
    """Return each of `MODES` (view,): a drift by one from first to last, a bend of mean zero, and waves of one."""
    time = time_s if np.ptp(time_s) > 0 else np.arange(len(time_s), dtype=float)
    t = (time - time.min()) / max(float(np.ptp(time)), 1e-300) - 0.5
    waves = (np.cos(angle_rad), np.sin(angle_rad), np.cos(2 * angle_rad), np.sin(2 * angle_rad))
    return dict(zip(MODES, (t, 6 * t**2 - 0.5, *waves), strict=True))


def moved_back(image: Image, motion_px: Iterable[float], scale: int = 1) -> Image:
    """Return a view (row, column), binned by `scale`, as it would be had it not moved, px along `DIRECTIONS`."""
    right, down, turn = motion_px
    if not (right or down or turn):
        return image
    angle = turn / (image.shape[0] * scale / 2)
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([[c, s], [-s, c]])  # from the place where a pixel is due (row, column) to where it is
    centre = (np.array(image.shape) - 1) / 2
    offset = centre - turned @ centre + np.array([down, right]) / scale
    return np.asarray(ndimage.affine_transform(image, turned, offset, order=3, mode="nearest"), dtype=np.float32)
