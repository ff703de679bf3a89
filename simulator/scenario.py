"""A complete description of an experiment: one frozen record, read from TOML, with built-in examples.

A scenario and the version of this software determine every count of the simulated folder.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pdvc.experiment import GeometryEntry, check_held_steps
from pdvc.settings import Settings, SettingsError
from simulator.crack import Crack, outline_mm
from simulator.detector import Detector
from simulator.imperfections import Imperfections
from simulator.ingredients import Drive, MotionOptions
from simulator.kinematics import Motion
from simulator.loading import LoadHistory, Loading, load_history
from simulator.microstructure import Graphite
from simulator.misalignment import Misalignment
from simulator.solver_space import into_sections, time_functions
from simulator.specimen import Specimen, area_mm2, depth_mm, section_mm
from simulator.xray import XraySource

Floats = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]

HEIGHT_STEP_MM = 0.05
"""Distance of the heights at which strains are computed and motion profiles are given."""


class ScannerGeometry(GeometryEntry):
    """The scanner as recorded in experiment.toml; by default the paper's, at a magnification of 28."""

    source_axis_mm: Positive = 800 / 28
    """distance from the source to the rotation axis, mm"""
    source_detector_mm: Positive = 800.0
    """distance from the source to the detector, mm"""
    pixel_mm: Positive = 0.2996
    """pitch of the detector pixels as stored, mm"""
    rows: Annotated[int, Field(ge=1)] = 954
    """detector rows as stored"""
    columns: Annotated[int, Field(ge=1)] = 432
    """detector columns as stored"""


class Acquisition(Settings):
    """When and at which angles radiographs are taken, and how finely each is computed."""

    reference_views: Annotated[int, Field(ge=1)] = 600
    """radiographs of the reference scan, over one turn"""
    reference_view_s: Positive = 2.2
    """time from one reference radiograph to the next, s"""
    test_steps: Annotated[int, Field(ge=1)] = 127
    """radiographs of the test"""
    steps_per_turn: Annotated[int, Field(ge=1)] = 50
    """radiographs of the test in one turn of the stage"""
    step_s: Positive = 2.0
    """time from one radiograph of the test to the next, s"""
    start_deg: float = 0.0
    """stage angle of the first radiograph of each stack, degrees"""
    subpixels: Annotated[int, Field(ge=1)] = 2
    """rays along each side of a pixel"""
    exposure_samples: Annotated[int, Field(ge=1)] = 1
    """stage angles averaged into each radiograph while the stage turns; 1 stands still"""
    exposure_share: Share = 1.0
    """share of the turn between two radiographs during which an image is exposed"""
    force_noise_N: NotNegative = 1.0
    """standard deviation of the recorded force, N"""


class Interrupted(Settings):
    """Full scans on the way, as classical volume correlation needs them: the test is held, the sample does not move.

    All motion stands still meanwhile, also the stage's wobble and what a held sample would creep.
    """

    steps: tuple[Annotated[int, Field(ge=0)], ...] = ()
    """steps of the test, counted from 0, at which the sample is scanned over a full turn; usually none"""
    views: Annotated[int, Field(ge=1)] | None = None
    """radiographs of each scan; default: acquisition.reference_views"""
    view_s: Positive | None = None
    """time from one of its radiographs to the next, s; default: acquisition.reference_view_s"""


class Scenario(Settings):
    """A synthetic experiment: sample, scanner, acquisition, loading and motion."""

    name: str = "jailin2018"
    """short name, for folders"""
    title: str = "In situ tension of cast iron, after Jailin et al. 2018"
    """a line for figures and reports"""
    material: str = "nodular graphite cast iron"
    """what the sample is made of, for the reader"""
    seed: Annotated[int, Field(ge=0)] = 0
    """of all randomness: nodules, detector and noise"""
    repetition: Annotated[int, Field(ge=0)] = 0
    """number of the noise draw: other noise of images and of the recorded force, same sample and same detector"""
    discarded_rows: Annotated[int, Field(ge=0)] = 100
    """rows at the top and at the bottom that a measurement leaves out; sets the height that motion refers to"""
    specimen: Specimen = Specimen()
    """the dog-bone"""
    graphite: Graphite = Graphite()
    """the nodules"""
    geometry: ScannerGeometry = ScannerGeometry()
    """the scanner as recorded"""
    misalignment: Misalignment = Misalignment()
    """what the true scanner has beyond the recorded one"""
    xray: XraySource = XraySource()
    """the beam"""
    detector: Detector = Detector()
    """the detector"""
    scanner: Imperfections = Imperfections()
    """what a real scanner does beside making images"""
    acquisition: Acquisition = Acquisition()
    """when radiographs are taken"""
    interrupted: Interrupted = Interrupted()
    """full scans while the test is held"""
    loading: Loading = Loading()
    """the tensile test"""
    crack: Crack = Crack()
    """a crack that opens during the test"""
    motion: MotionOptions = MotionOptions()
    """how the sample moves"""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if 2 * self.discarded_rows >= self.geometry.rows:
            raise ValueError(
                f"discarded_rows below half of the {self.geometry.rows} detector rows, got {self.discarded_rows}"
            )
        if self.specimen.length_mm < 2 * self.visible_mm:
            raise ValueError(
                f"specimen.length_mm of at least {2 * self.visible_mm:.4g} mm, so that the sample's ends stay out "
                f"of sight, got {self.specimen.length_mm} mm"
            )
        check_held_steps(self.interrupted.steps, self.acquisition.test_steps, "interrupted.steps")
        if abs(self.loading.necking_at_mm) > self.specimen.length_mm / 2:
            raise ValueError(
                f"loading.necking_at_mm inside the sample, at most {self.specimen.length_mm / 2} mm from its middle, "
                f"got {self.loading.necking_at_mm} mm"
            )
        self._check_steps()
        self._check_crack()
        self._check_scanner()
        return self

    def _check_steps(self) -> None:
        steps = self.acquisition.test_steps
        for key, step, happens in (
            ("crack.first_step", self.crack.first_step, self.crack.opening_mm > 0),
            ("motion.slip.step", self.motion.slip.step, "slip" in self.motion.ingredients),
        ):
            if happens and step >= steps:
                raise ValueError(f"{key} below {steps}, the number of steps of the test, got {step}")

    def _check_scanner(self) -> None:
        recorded = self.geometry.cone_beam()
        try:
            self.misalignment.true_geometry(recorded)
        except ValueError as error:
            raise ValueError(f"misalignment of a scanner that there can be, {error}") from None
        self.scanner.open_beam.heel(recorded)

    def _check_crack(self) -> None:
        if self.crack.opening_mm == 0:
            return
        outline, gap = outline_mm(self.crack), self.graphite.gap_mm
        lateral = float(depth_mm(self.specimen, outline).min())
        depth = min(lateral, self.specimen.length_mm / 2 - float(np.abs(outline[:, 2]).max()))
        if depth < gap:
            raise ValueError(
                f"crack.centre_mm and crack.radius_mm of a crack that stays graphite.gap_mm = {gap} mm below the "
                f"sample's surface, got {list(self.crack.centre_mm)} mm and {self.crack.radius_mm} mm: "
                + (f"{depth:.3g} mm below it" if depth > 0 else f"{-depth:.3g} mm outside")
            )

    @property
    def view_mm(self) -> float:
        """Return the height above and below mid-plane that a measurement uses, mm, on the axis."""
        return (self.geometry.rows / 2 - self.discarded_rows) * self.geometry.cone_beam().voxel_mm

    @property
    def visible_mm(self) -> float:
        """Return the height of the sample above and below mid-plane that the detector sees, mm."""
        scanner = self.geometry.cone_beam()
        half_rows = scanner.rows / 2 * scanner.pixel_mm + abs(scanner.row_shift_mm)
        half_x, half_y = section_mm(self.specimen, self.specimen.length_mm / 2)
        farthest = scanner.source_axis_mm + float(np.hypot(half_x, half_y))
        return half_rows * farthest / scanner.source_detector_mm


@dataclass(frozen=True, kw_only=True)
class Course:
    """The course of an experiment: angles, times, loading and motion."""

    reference_angle_rad: Floats
    reference_time_s: Floats
    test_angle_rad: Floats
    test_time_s: Floats
    interrupted_angle_rad: Floats
    """Stage angles of each interrupted scan (view,)."""
    interrupted_time_s: Floats
    """Times of the interrupted scans (scan, view); the test's own clock stands still meanwhile."""
    history: LoadHistory
    """Force and strain at each step of the test."""
    motion: Motion
    """Motion of the material points during the test."""


def course_of(scenario: Scenario) -> Course:
    """Work out what happens in a scenario, and when."""
    plan, specimen = scenario.acquisition, scenario.specimen
    views, steps = np.arange(plan.reference_views, dtype=float), np.arange(plan.test_steps, dtype=float)
    start = math.radians(plan.start_deg)
    angle = start + 2 * np.pi * steps / plan.steps_per_turn
    half = specimen.length_mm / 2
    height = np.linspace(-half, half, 2 * math.ceil(half / HEIGHT_STEP_MM) + 1)
    area = area_mm2(specimen, height)
    history = load_history(scenario.loading, plan.step_s * steps, height, area)
    stroke_step, view = scenario.loading.plateau_steps, scenario.view_mm
    motion: Motion = scenario.motion.motion(
        Drive(history=history, area_mm2=area, angle_rad=angle, start_step=stroke_step, view_mm=view)
    )
    if scenario.motion.sections:
        levels = np.linspace(-view, view, scenario.motion.sections)
        motion = into_sections(motion, levels, time_functions(history.force_N, angle, stroke_step))
    held = scenario.interrupted
    held_views = np.arange(held.views or plan.reference_views, dtype=float)
    held_from_s = history.time_s[list(held.steps)]
    return Course(
        reference_angle_rad=start + 2 * np.pi * views / plan.reference_views,
        reference_time_s=plan.reference_view_s * views,
        test_angle_rad=angle,
        test_time_s=history.time_s,
        interrupted_angle_rad=start + 2 * np.pi * held_views / len(held_views),
        interrupted_time_s=held_from_s[:, None] + (held.view_s or plan.reference_view_s) * held_views,
        history=history,
        motion=motion,
    )


def builtin_names() -> tuple[str, ...]:
    """Return the names of the scenarios that come with the package."""
    found = (files("simulator") / "scenarios").iterdir()
    return tuple(sorted(file.name.removesuffix(".toml") for file in found if file.name.endswith(".toml")))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Read a built-in scenario by its name, or any other from its TOML file."""
    name = str(name_or_path)
    if name in builtin_names():
        return Scenario.read(Path(str(files("simulator") / "scenarios" / f"{name}.toml")))
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.is_file():
        return Scenario.read(path)
    close = difflib.get_close_matches(name, builtin_names(), n=1, cutoff=0.5)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    raise SettingsError(
        f"scenario: expected one of {', '.join(builtin_names())}, or a TOML file, given {name!r}{hint}"
    )
