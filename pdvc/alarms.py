"""Alarms of a test that is followed: what a person, or the machine that pulls, should know at once.

| alarm | what is tested | limit |
| --- | --- | --- |
| beam | transmission of the air beside the sample, less 1 | 0.03; from 0.05 on the radiograph is lost |
| beam-drift | what the air of 16 radiographs, less that of the views, is worth along the beam | its deviation |
| saturation | share of pixels at the largest count | 0.001 |
| out-of-view | share of rows in which the sample covers a side of the detector, or a section that is off it | 0.02 |
| stage | likeness to what is seen from where the stage was, less that from where it should be | 0.05, then lost |
| sudden | a rigid motion that differs from what was expected, over what is usual and what was uncertain | 6 |
| localisation | growth of strain in a section beyond its part of that of all, over how far sections usually are | 8 |
| crack | residual that is new somewhere on the sample, over its deviation (`pdvc.cells`) | 8 |

One that goes on is raised again every `QUIET` steps: where a crack is shows the better, the more directions it was
seen from.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdvc.air_level import BEAM_DRIFT, JOINED, TOLD, air_of, worth_voxel
from pdvc.cells import CRACK, LEAST_STEPS, Cells, Spot
from pdvc.data_checks import AIR_DOUBT, AIR_ERROR, EDGE_SEEN, SATURATED, clips
from pdvc.deviations import beam_frame
from pdvc.examination import StackLook, look_at, share_at_top
from pdvc.geometry import within_half_turn
from pdvc.incoming import Arrival
from pdvc.likeness import Beside
from pdvc.record import AlarmLine, StepLine
from pdvc.robust import usual_size
from pdvc.sections import (
    ROTATION_X,
    ROTATION_Y,
    ROTATION_Z,
    TRANSLATION_X,
    TRANSLATION_Y,
    TRANSLATION_Z,
    SectionPattern,
)
from pdvc.setup import Setup
from pdvc.tracker import Taken
from pdvc.window import height_mm

Floats = NDArray[np.float64]

AIR_LOST = 0.05
"""Departure of the air's transmission from 1 above which the motion is not to be told from a radiograph."""
STAGE = 0.05
"""By how much more a radiograph is like what is seen from where the stage was, than from where it should be."""
SUDDEN, LOCAL = 6.0, 8.0
"""Limits of what is over its deviation."""
USUAL = 20
"""Steps that tell what is usual."""
SPAN, BEFORE = 8, 2
"""Steps over which strain grows, and how many times as many before it is compared with."""
LOCAL_SHARE = 0.5
"""Share by which a section's strain grew more than was its part, at least."""
CERTAIN = 3.0
"""Deviations of its growth by which the sample has to stretch, for its sections to have a share."""
TURNED_VOXEL = 4.0
"""Voxels by which the outline turns from a radiograph to the next, for the two to look different."""
QUIET = 10
"""Steps after which an alarm that goes on is raised again."""


@dataclass(frozen=True, kw_only=True)
class Alarm:
    """Something that a radiograph shows, and should not."""

    name: str
    value: float
    limit: float
    reason: str
    place_mm: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    """Where on the sample, as it was at rest (x, y, z), as far as it is known."""
    spoils: bool = False
    """Whether the motion cannot be told from this radiograph."""

    def line(self, step: int) -> AlarmLine:
        """Return its line for a record."""
        place = self.place_mm
        return AlarmLine(
            step=step, alarm=self.name, value=self.value, limit=self.limit, reason=self.reason, place_mm=place
        )


class Watch:
    """Watches a test: each radiograph as it comes, and the motion that was found."""

    def __init__(self, setup: Setup) -> None:
        """Begin without a radiograph."""
        self._setup = setup
        self._beside = Beside(setup.experiment, setup.calibration)
        self._cells = Cells(setup.geometry.cropped(*setup.window), setup.sections, setup.outline.hull)
        some = np.linspace(0, len(setup.experiment.reference) - 1, 24).astype(int)
        reference = look_at(setup.experiment.reference.counts[some], setup.calibration)
        self._edge, self._flats_top = float(reference.edge.max()), share_at_top(setup.experiment.flats)
        self._air = None
        if setup.calibration.air is None:
            self._air = air_of(setup.experiment, setup.calibration, (setup.experiment.reference,))
        if self._air is not None:
            self._views_air = self._air.levels(setup.experiment.reference.counts[some])
        distance = setup.geometry.source_axis_mm / setup.geometry.voxel_mm
        self._worth = worth_voxel(setup.experiment.reference.counts[0], setup.calibration, distance)
        self._beams: list[tuple[float, float]] = []
        self.spot: Spot | None = None
        """Where the newest step shows most that is new; None after few steps."""
        self._newest, self._angle_rad = -1, math.nan
        self._before = np.zeros((0, 0), dtype=np.float32)
        self._raised: dict[str, int] = {}
        self._jumps: list[Floats] = []
        self._strains: list[Floats] = []

    def seen(self, radiograph: Arrival) -> tuple[Alarm, ...]:
        """Look at a radiograph before anything is measured on it; return all that is wrong with it."""
        found = list(self._of_counts(look_at(radiograph.counts[None], self._setup.calibration)))
        if radiograph.step > self._newest and not any(alarm.spoils for alarm in found):
            found += self._of_stage(radiograph)
            if self._air is not None:
                self._beams = [*self._beams[1 - JOINED :], self._air.level(radiograph.counts)]
        return tuple(found)

    def followed(self, line: StepLine, taken: Taken) -> tuple[Alarm, ...]:
        """Look at the motion that was found; return all that is wrong. Steps older than the newest are left out."""
        if line.step <= self._newest:
            return ()
        self._newest = line.step
        spot = self._cells.add(taken.residual, taken.amplitude, np.deg2rad(line.angle_deg))
        self.spot = spot if self._cells.steps > LEAST_STEPS else None
        return (
            *self._of_beam(line),
            *self._of_place(taken),
            *self._of_motion(line, taken),
            *self._of_strain(line),
            *self._of_spot(),
        )

    def new(self, step: int, alarms: tuple[Alarm, ...]) -> tuple[Alarm, ...]:
        """Return those of a step's alarms that were not raised a few steps ago."""
        fresh = []
        for alarm in alarms:
            if abs(step - self._raised.get(alarm.name, -QUIET)) >= QUIET:
                self._raised[alarm.name] = step
                fresh.append(alarm)
        return tuple(fresh)

    def kept(self) -> dict[str, NDArray[Any]]:
        """Return all that has to be known to be restored."""
        return {
            **self._cells.kept(),
            "newest": np.array(self._newest),
            "angle": np.array(self._angle_rad),
            "before": self._before,
            "names": np.array(list(self._raised), dtype=str),
            "raised": np.array(list(self._raised.values()), dtype=np.int64),
            "beams": np.array(self._beams),
            "jumps": np.array(self._jumps),
            "strains": np.array(self._strains),
        }

    def restore(self, kept: Mapping[str, NDArray[Any]]) -> None:
        """Know again what it knew when `kept` was asked."""
        self._cells.restore(kept)
        self._newest, self._angle_rad, self._before = int(kept["newest"]), float(kept["angle"]), kept["before"]
        self._raised = dict(zip(kept["names"].tolist(), kept["raised"].tolist(), strict=True))
        self._beams = [(float(level), float(std)) for level, std in kept["beams"]]
        self._jumps = list(kept["jumps"])
        self._strains = list(kept["strains"])

    def _of_spot(self) -> Iterator[Alarm]:
        if self.spot is not None and self.spot.score > CRACK:
            x, y, z = self.spot.place_mm
            yield Alarm(
                name="crack",
                value=self.spot.score,
                limit=CRACK,
                reason=f"at x = {x:.2f}, y = {y:.2f}, z = {z:.2f} mm the residual shows less material than before, by "
                f"{self.spot.score:.1f} deviations",
                place_mm=self.spot.place_mm,
            )

    def _of_counts(self, look: StackLook) -> Iterator[Alarm]:
        """Give what is wrong with the counts of a radiograph."""
        edge, air, top, covered = self._edge, float(look.air[0]), float(look.at_top[0]), float(look.edge[0])
        if not abs(air - 1) <= AIR_DOUBT:
            # where brightness is told by the air, a radiograph is lost where data of a whole test would be refused
            lost = not abs(air - 1) <= (AIR_LOST if self._setup.calibration.air is None else AIR_ERROR)
            yield Alarm(
                name="beam",
                value=abs(air - 1),
                limit=AIR_DOUBT,
                reason=f"air has a transmission of {air:.2f} where 1 is due",
                spoils=lost,
            )
        if top > SATURATED and clips(look.highest, self._flats_top):
            yield Alarm(
                name="saturation",
                value=top,
                limit=SATURATED,
                reason=f"{top:.1%} of the pixels are at the largest count, {look.highest}",
            )
        if covered > edge + EDGE_SEEN:
            yield Alarm(
                name="out-of-view",
                value=covered,
                limit=edge + EDGE_SEEN,
                reason=f"the sample covers a side of the detector in {covered:.0%} of the rows",
            )

    def _of_beam(self, line: StepLine) -> Iterator[Alarm]:
        """Compare what a beam that is not that of the reference scan is worth with the deviation that is stated."""
        if len(self._beams) < JOINED:
            return
        sides = np.array(self._beams), self._views_air
        beam, views = (float(each[:, 0].mean()) for each in sides)
        off, noise = beam - views, float(np.sqrt(sum((each[:, 1] ** 2).mean() / len(each) for each in sides)))
        stated = float(np.sqrt(np.mean(np.array(line.displacement_std)[:, 2] ** 2)))
        if abs(off) > TOLD * noise and abs(off) * self._worth > stated:
            yield Alarm(
                name=BEAM_DRIFT,
                value=abs(off) * self._worth,
                limit=stated,
                reason=f"by the air of {JOINED} radiographs the beam is off that of the reference scan by {off:+.3%}, "
                f"which is worth {abs(off) * self._worth:.2g} voxel along the beam",
            )

    def _of_stage(self, radiograph: Arrival) -> Iterator[Alarm]:
        picture, angle = self._beside.binned(radiograph.counts), radiograph.angle_rad
        before, turned = self._before, abs(angle - self._angle_rad)
        outline = self._setup.outline.hull.radius_mm() / self._setup.geometry.voxel_mm
        # a whole turn on, it looks as before
        if before.size and abs(within_half_turn(turned)) * outline > TURNED_VOXEL:
            recorded, was = self._beside.likeness(picture, angle, before, self._angle_rad)
            if was - recorded > STAGE:
                yield Alarm(
                    name="stage",
                    value=was - recorded,
                    limit=STAGE,
                    reason=f"seen from where it was before (correlation {was:.2f}), {np.rad2deg(turned):.1f} degrees "
                    f"from the recorded angle, rather than from there ({recorded:.2f})",
                    spoils=True,
                )
                return
        self._before, self._angle_rad = picture, angle

    def _of_place(self, taken: Taken) -> Iterator[Alarm]:
        basis, geometry = self._setup.sections, self._setup.geometry
        ends = np.zeros((2, 3))
        ends[:, 2] = basis.height_mm[[0, -1]]
        moved = ends[:, 2] + basis.displacement(taken.amplitude, ends)[:, 2] * geometry.voxel_mm
        top, bottom = height_mm(geometry, 0), height_mm(geometry, geometry.rows - 1)
        off = max(float(moved.max()) - top, bottom - float(moved.min())) / geometry.voxel_mm
        if off > 0:
            yield Alarm(
                name="out-of-view",
                value=off,
                limit=0.0,
                reason=f"the outermost section is {off:.1f} rows off the detector",
            )

    def _of_motion(self, line: StepLine, taken: Taken) -> Iterator[Alarm]:
        """Compare the rigid motion that a radiograph shows, the mean over the sections, with what was expected.

        Along the beam it hardly shows any: there, only what the process is taken for changes suddenly.
        """
        sections, motions = taken.amplitude.shape
        seen = _seen(self._setup.sections.names, np.deg2rad(line.angle_deg))
        if not seen:
            return
        shown = np.array(list(seen.values())) @ np.tile(np.eye(motions), sections) / sections
        jump = shown @ (taken.amplitude - taken.expected).ravel()
        past, self._jumps = self._jumps, [*self._jumps[-USUAL + 1 :], jump]
        if len(past) < LEAST_STEPS:
            return
        usual = usual_size(np.array(past), axis=0)
        score = np.abs(jump) / np.sqrt(usual**2 + np.einsum("mu,uv,mv->m", shown, taken.uncertain, shown))
        most = int(np.argmax(score))
        if score[most] > SUDDEN:
            yield Alarm(
                name="sudden",
                value=float(score[most]),
                limit=SUDDEN,
                reason=f"{list(seen)[most]}, the sample is {jump[most]:+.2f} voxel from where it was expected, "
                f"{score[most]:.0f} deviations of what is usual",
            )

    def _of_strain(self, line: StepLine) -> Iterator[Alarm]:
        """Compare how strain grew, section by section, with how it grew before.

        Its part of the growth of all is what a section has after its part before. How far sections usually are from
        that is seen in all of them: where the whole ligament yields, no section leaves the others.
        """
        kept = (1 + BEFORE) * SPAN + 1
        self._strains = [*self._strains[1 - kept :], np.stack([line.strain, line.strain_std])]
        if len(self._strains) < kept or not line.strain:
            return
        (first, _), (middle, between), (last, now) = (self._strains[k] for k in (0, BEFORE * SPAN, -1))
        before, grown = middle - first, last - middle
        # errors of neighbouring steps are alike: this is more than that of their difference
        certain = CERTAIN * math.sqrt(float((now**2 + between**2).sum()))
        if before.sum() < certain or grown.sum() < certain:
            return
        part = before * grown.sum() / before.sum()
        excess = grown - part
        score = excess / max(float(usual_size(excess - np.median(excess))), 1e-300)
        most = int(np.argmax(excess))
        if score[most] > LOCAL and excess[most] > LOCAL_SHARE * max(part[most], grown.mean()):
            height = self._setup.sections.height_mm
            place = float(height[most : most + 2].mean())
            yield Alarm(
                name="localisation",
                value=float(score[most]),
                limit=LOCAL,
                reason=f"at z = {place:.2f} mm strain grew by {100 * grown[most]:.2f} % in {SPAN} steps, where its "
                f"part is {100 * part[most]:.2f} %",
                place_mm=(math.nan, math.nan, place),
            )


def _seen(names: tuple[str, ...], angle_rad: float) -> dict[str, Floats]:
    """Return the rigid motions of a section that a radiograph shows, as shares of its motions (motion,)."""
    across, _, along = beam_frame(angle_rad)
    shares: dict[str, dict[SectionPattern, float]] = {
        "across the beam": {TRANSLATION_X: across[0], TRANSLATION_Y: across[1]},
        "vertically": {TRANSLATION_Z: 1.0},
        "by rotation about the beam": {ROTATION_X: along[0], ROTATION_Y: along[1]},
        "by rotation about the axis": {ROTATION_Z: 1.0},
    }
    found = {
        direction: np.array([{each.name: share for each, share in parts.items()}.get(name, 0.0) for name in names])
        for direction, parts in shares.items()
    }
    return {direction: share for direction, share in found.items() if share.any()}
