"""What the reference views leave of their own re-projection tells of the scanner: where they moved, and how bright.

The volume F is made of all views, so that a view that differs from the others differs from its re-projection, too:
e_i = P_i F - f_i. Where that is f moved by d and brighter by s,

    e = d_right dm/dx + d_down dm/dy + d_roll (y dm/dx - x dm/dy) + s m,          m = (f + P F) / 2,

but for third powers of d, fitted to the pixels of each view by least squares. Over the views, d and s are fitted
by what scanners do (`pdvc.correction`): d by a constant, a drift from first to last view, and waves of one and of two
periods in a turn; s by a drift and by waves of two and four periods, in which a sample that is not round differs from
its correction for beam hardening. Opposite views see the same material.

A constant to the right is an axis that is not where it was told, and a constant turn a roll of the detector, as no
volume takes them up. Of a drift it takes up what opposite views agree on, where the texture is fine up to half. This
is a look, at one reconstruction that is at hand; `pdvc.self_calibration` finds all of it, and better. Deviations are
those of views, each of which errs by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pdvc.correction import modes_of
from pdvc.verdict import Doubt

Floats = NDArray[np.float64]
Image = NDArray[np.float32]

LEAST_VIEWS = 24
"""Views of which trends are told, at least."""
MOST_PIXELS = 8_000_000
"""Pixels of all views together, at most: more would be no look, and are not looked at."""
GEOMETRY, MOVING, FADING = "geometry", "moving-views", "fading"
TOLD = 5.0
"""Deviations by which something is told from nothing."""
OFF_PX = 0.15
"""Axis or roll that is doubted, px: a roll of a tenth was found to spoil no motion, an axis off by a quarter to do."""
MODES = ("drift", "cos", "sin", "cos 2", "sin 2")
"""Of `pdvc.correction.modes_of`, beside a constant; a bend would be hardly told from the waves."""


@dataclass(frozen=True, kw_only=True)
class ViewTrends:
    """What was found in the reference views, each as its value and its standard deviation."""

    axis_px: tuple[float, float]
    """By which the axis is seen to the right of where it was told, px as stored."""
    roll_px: tuple[float, float]
    """What the detector's roll is more than was told, px at half its height from its middle."""
    right_px: tuple[float, float]
    """By which the last view is to the right of the first, at least, but for what its angle does."""
    down_px: tuple[float, float]
    """The same, downwards."""
    fading: tuple[float, float]
    """Share by which the sample's grey levels are smaller in the last view than in the first."""


def view_trends(
    view: Callable[[int], Image],
    left: Callable[[int], Image],
    angle_rad: Floats,
    time_s: Floats,
    scale: int,
    half_rows: float,
) -> ViewTrends | None:
    """Return the trends of views at a scale; None where they are too few, or not all around.

    `view` and `left` give a view and its e (row, column), at angles and times (view,); `half_rows` is half of the
    detector's height, px at that scale.
    """
    if len(angle_rad) < LEAST_VIEWS or np.ptp(angle_rad) < 1.8 * np.pi:
        return None
    found = np.stack([_registered(view(i), left(i), half_rows) for i in range(len(angle_rad))])
    found[:, :3] *= scale
    modes = modes_of(angle_rad, time_s)
    waves = [modes[name] for name in MODES]
    uneven = [modes["drift"], *(wave(k * angle_rad) for k in (2, 4) for wave in (np.cos, np.sin))]
    (axis, right, *_), (_, down, *_), (roll, *_) = (_fitted(found[:, k], waves) for k in range(3))
    return ViewTrends(axis_px=axis, roll_px=roll, right_px=right, down_px=down, fading=_fitted(found[:, 3], uneven)[1])


def _registered(view: Image, left: Image, half_rows: float) -> Floats:
    """Return d to the right, downwards and by a roll, px, and s, of a view and its e (row, column)."""
    rows, columns = view.shape
    mean = view + left / 2
    down, right = np.gradient(mean)
    y, x = ((np.arange(count) - (count - 1) / 2) / half_rows for count in (rows, columns))
    roll = y[:, None] * right - x * down
    ways = np.stack([right, down, roll, mean]).reshape(4, -1).astype(float)
    return np.asarray(np.linalg.lstsq(ways @ ways.T, ways @ left.ravel().astype(float))[0])


def _fitted(values: Floats, modes: list[Floats]) -> list[tuple[float, float]]:
    """Return the constant and the share of each mode (view,) of values (view,), with its standard deviation."""
    design = np.stack([np.ones(len(values)), *modes], axis=1)
    inverse = np.linalg.pinv(design.T @ design)
    share = inverse @ design.T @ values
    rest = values - design @ share
    std = np.sqrt(np.diag(inverse) * (rest @ rest) / (len(values) - design.shape[1]))
    return list(zip(share.tolist(), std.tolist(), strict=True))


def doubts_of_views(
    found: ViewTrends, *, across_voxel: float, vertical_voxel: float, along_voxel: float, source_axis_voxel: float
) -> Iterator[Doubt]:
    """Give what trends of the reference views speak against; the rest are stated deviations of the motion, voxels.

    The test begins where the scan ended: half a drift away from the volume, which is that of the mean.
    """
    off = [
        f"{name} by {value:+.3f} +- {std:.3f} px"
        for name, (value, std) in (("the axis", found.axis_px), ("the roll", found.roll_px))
        if abs(value) > max(OFF_PX, TOLD * std)
    ]
    if off:
        yield Doubt(
            name=GEOMETRY,
            figure=f"geometry is off: the reference views differ from their re-projection as if {' and '.join(off)} "
            "were not as told",
            advice="self-calibrate, --self-calibrate geometry",
        )
    moved = [
        f"{abs(value):.3f} +- {std:.3f} px {way}"
        for (value, std), stated, way in (
            (found.right_px, across_voxel, "to the right" if found.right_px[0] > 0 else "to the left"),
            (found.down_px, vertical_voxel, "downwards" if found.down_px[0] > 0 else "upwards"),
        )
        if abs(value) > TOLD * std and abs(value) / 2 > stated
    ]
    if moved:
        yield Doubt(
            name=MOVING,
            figure=f"from the first to the last reference view the image moved by at least {' and '.join(moved)}, and "
            "the test follows",
            advice="the spot, the stage or the sample drifts: self-calibrate, --self-calibrate motion",
        )
    value, std = found.fading
    worth = abs(value) / 2 * source_axis_voxel
    if abs(value) > TOLD * std and worth > along_voxel:
        yield Doubt(
            name=FADING,
            figure=f"from the first to the last reference view the sample's grey levels change by {-value:+.2%} "
            f"+- {std:.2%}: half of that is worth {worth:.2g} voxel along the beam, where a deviation of "
            f"{along_voxel:.2g} is stated",
            advice="the tube's voltage drifts, or the panel glows after: let both settle, or correct its lag",
        )
