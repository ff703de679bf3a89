"""Hypothesis strategies for laws about P-DVC: geometries, motions, sections, scenarios and small experiments.

Sizes are bounded, so that one example costs milliseconds, an experiment about a second. Everything shrinks towards
what is plainest: no shift, no roll, no motion, few pixels, few steps. `docs/strategies.md` has an example.

Needs hypothesis, which the extra `strategies` installs.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

try:
    from hypothesis import strategies as st
    from hypothesis.extra.numpy import arrays
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "validation.testing.strategies: expected hypothesis, found none: pip install 'pdvc-bench[strategies]'",
        name=error.name,
    ) from None

from pdvc.experiment import AcquisitionEntry, Description, GeometryEntry, StackEntry
from pdvc.geometry import ConeBeam
from pdvc.sections import RIGID, SectionBasis, SectionPattern
from simulator.kinematics import BeamMotion, Motion, RigidMotion, SectionMotion
from simulator.scenario import Scenario
from validation.testing.small_cases import ProjectedCase, SmallExperiment, small_scenario

Floats = NDArray[np.float64]

__all__ = [
    "amplitudes",
    "angles_rad",
    "beam_motions",
    "cone_beams",
    "descriptions",
    "motions",
    "projected_cases",
    "rigid_motions",
    "scenarios",
    "section_bases",
    "section_motions",
    "small_experiments",
]


# Geometry


def angles_rad() -> st.SearchStrategy[float]:
    """Draw stage angles of up to two turns either way, rad."""
    return st.floats(-2 * math.pi, 2 * math.pi)


@st.composite
def cone_beams(draw: st.DrawFn, *, least_columns: int = 24, most_columns: int = 48) -> ConeBeam:
    """Draw scanners with more rows than columns, shifts up to two pixels and a small roll.

    Voxels measure 0.03 to 0.1 mm, magnifications are 1.5 to 30.
    """
    source_axis_mm = draw(st.floats(20.0, 200.0))
    magnification = draw(st.floats(1.5, 30.0))
    voxel_mm = draw(st.floats(0.03, 0.1))
    pixel_mm = voxel_mm * magnification
    columns = draw(st.integers(least_columns, most_columns))
    return ConeBeam(
        source_axis_mm=source_axis_mm,
        source_detector_mm=source_axis_mm * magnification,
        pixel_mm=pixel_mm,
        rows=columns + draw(st.integers(1, 17)),
        columns=columns,
        column_shift_mm=draw(st.floats(-2.0, 2.0)) * pixel_mm,
        row_shift_mm=draw(st.floats(-2.0, 2.0)) * pixel_mm,
        roll_rad=draw(st.floats(-0.1, 0.1)),
    )


# Sections and their amplitudes, as pdvc measures them


@st.composite
def section_bases(draw: st.DrawFn, *, motions: tuple[SectionPattern, ...] = RIGID) -> SectionBasis:
    """Draw one to six sections at unequal heights of some mm, each with the named motions."""
    gaps = draw(st.lists(st.floats(0.1, 3.0), min_size=1, max_size=6))
    return SectionBasis(
        height_mm=draw(st.floats(-5.0, 5.0)) + np.cumsum(gaps), radius_mm=draw(st.floats(0.2, 4.0)), motions=motions
    )


def amplitudes(
    basis: SectionBasis, *, steps: int | None = None, largest_voxel: float = 2.0
) -> st.SearchStrategy[Floats]:
    """Draw amplitudes of a basis, voxels: (section, motion), or (step, section, motion) where steps are given.

    Of more than 40 numbers, only some differ from zero.
    """
    return _numbers(basis.shape if steps is None else (steps, *basis.shape), largest_voxel)


# Motions of material points, as the simulator prescribes them


def rigid_motions(*, steps: int = 1) -> st.SearchStrategy[RigidMotion]:
    """Draw rigid motions that turn by up to half a turn and shift by up to 2 mm in each direction."""
    return st.builds(
        RigidMotion,
        rotation_rad=_profiles((steps, 3), 1.8),
        translation_mm=_profiles((steps, 3), 2.0),
        centre_mm=_profiles((3,), 3.0),
    )


def beam_motions(*, steps: int = 1) -> st.SearchStrategy[BeamMotion]:
    """Draw stretched, bent, twisted and thinned beams of 12 mm, whose sections do not cross near the axis."""
    return st.builds(
        BeamMotion,
        knot_mm=st.just(np.linspace(-6.0, 6.0, 5)),
        displacement_mm=_profiles((steps, 5, 3), 0.4),
        rotation_rad=_profiles((steps, 5, 3), 0.2),
        stretch=_profiles((steps, 5), 0.1).map(lambda part: 1.0 + part),
    )


def section_motions(*, steps: int = 1) -> st.SearchStrategy[SectionMotion]:
    """Draw motions of five sections fixed in space, which do not cross near the axis."""
    return st.builds(
        SectionMotion,
        height_mm=st.just(np.linspace(-4.0, 4.0, 5)),
        translation_mm=_profiles((steps, 5, 3), 0.4),
        rotation_rad=_profiles((steps, 5, 3), 0.1),
    )


def motions(*, steps: int = 1) -> st.SearchStrategy[Motion]:
    """Draw motions of any of the three kinds."""
    return st.one_of(rigid_motions(steps=steps), beam_motions(steps=steps), section_motions(steps=steps))


def _profiles(shape: tuple[int, ...], size: float) -> st.SearchStrategy[Floats]:
    return _numbers(shape, 1.0).map(lambda part: size * part)


def _numbers(shape: tuple[int, ...], largest: float) -> st.SearchStrategy[Floats]:
    """Draw each number by itself, so that each shrinks to zero by itself, or, where they are many, only some."""
    each = math.prod(shape) <= 40
    return arrays(
        np.float64, shape, elements=st.floats(-largest, largest), fill=st.nothing() if each else st.just(0.0)
    )


# Experiments


@st.composite
def scenarios(draw: st.DrawFn, *, least_ingredients: int = 0) -> Scenario:
    """Draw small scenarios: at most 84 x 48 pixels, 48 views, 24 steps; the first turn at constant load.

    They differ in seed, detector, shifts and roll, sample's orientation, nodules, photons, angles, stroke, and in
    which ingredients move the sample, at least so many. A voxel is that of `small_scenario`, 0.129 mm.
    """
    turn, load = draw(st.integers(10, 12)), draw(st.integers(8, 12))
    pixel_mm = small_scenario().geometry.pixel_mm
    ingredients = ("tension", "bending", "torsion", "compliance", "backlash", "wobble")
    return small_scenario(
        {
            "seed": draw(st.integers(0, 999)),
            # faces along the beam make edges that no voxel follows; nobody mounts a sample so
            "specimen.turned_deg": draw(st.floats(12.0, 33.0)),
            "graphite.volume_fraction": draw(st.floats(0.07, 0.12)),
            "geometry.columns": draw(st.integers(42, 48)),
            "geometry.rows": draw(st.integers(68, 84)),
            "geometry.column_shift_mm": draw(st.floats(-1.0, 1.0)) * pixel_mm,
            "geometry.row_shift_mm": draw(st.floats(-1.0, 1.0)) * pixel_mm,
            "geometry.roll_deg": draw(st.floats(-1.0, 1.0)),
            "detector.photons_per_pixel": draw(st.sampled_from((8000.0, 4000.0, 2000.0))),
            "acquisition.reference_views": draw(st.integers(36, 48)),
            "acquisition.test_steps": turn + load,
            "acquisition.steps_per_turn": turn,
            "acquisition.start_deg": draw(st.floats(-180.0, 180.0)),
            "loading.plateau_steps": turn,
            # the stroke of the whole test, mm, over the time in which it is made
            "loading.stroke_mm_per_s": draw(st.floats(0.1, 0.3)) / (load * small_scenario().acquisition.step_s),
            "motion.ingredients": draw(
                st.lists(st.sampled_from(ingredients), unique=True, min_size=least_ingredients).map(sorted)
            ),
        }
    )


def small_experiments(*, least_ingredients: int = 0) -> st.SearchStrategy[SmallExperiment]:
    """Draw experiments simulated from `scenarios`; each is simulated, and measured, when first asked for."""
    return st.builds(SmallExperiment, scenarios(least_ingredients=least_ingredients))


@st.composite
def projected_cases(
    draw: st.DrawFn, *, motions: tuple[SectionPattern, ...] = RIGID, largest_voxel: float = 0.5
) -> ProjectedCase:
    """Draw textured bars moved by known amplitudes, with radiographs by pdvc's own projector and no noise.

    Detectors have 28 to 36 columns and more rows, a case has 10 to 16 steps over a turn and a half, two to four
    sections at unequal distances over the height that the detector sees, and four time functions.
    `largest_voxel` bounds the coefficients.
    """
    scanner = draw(cone_beams(least_columns=28, most_columns=36))
    steps, sections = draw(st.integers(10, 16)), draw(st.integers(2, 4))
    start = draw(angles_rad())
    gaps = np.array(draw(st.lists(st.floats(1.0, 2.0), min_size=sections - 1, max_size=sections - 1)))
    height = np.concatenate([[0.0], np.cumsum(gaps) / gaps.sum()]) - 0.5
    basis = SectionBasis(
        height_mm=height * scanner.rows * scanner.voxel_mm, radius_mm=scanner.columns / 4 * scanner.voxel_mm,
        motions=motions,
    )  # fmt: skip
    return ProjectedCase(
        scanner=scanner,
        sections=basis,
        angle_rad=start + np.linspace(0.0, 3 * math.pi, steps, endpoint=False),
        coefficients=draw(_numbers((4, *basis.shape), largest_voxel)),
        seed=draw(st.integers(0, 9)),
    )


# Files


@st.composite
def descriptions(draw: st.DrawFn) -> Description:
    """Draw what an `experiment.toml` may hold, every optional entry given or left out."""
    source_axis_mm = draw(st.floats(1.0, 1e3))

    def stack() -> StackEntry:
        count = draw(st.integers(1, 4))
        numbers = st.lists(st.floats(-1e4, 1e4), min_size=count, max_size=count).map(tuple)
        return StackEntry(angle_deg=draw(numbers), time_s=draw(numbers), force_N=draw(numbers))

    text = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=12)
    return Description(
        title=draw(text),
        material=draw(text),
        geometry=GeometryEntry(
            source_axis_mm=source_axis_mm,
            source_detector_mm=source_axis_mm * draw(st.floats(1.01, 100.0)),
            pixel_mm=draw(st.floats(1e-4, 1.0)),
            rows=draw(st.integers(1, 5000)),
            columns=draw(st.integers(1, 5000)),
            column_shift_mm=draw(st.floats(-9.0, 9.0)),
            row_shift_mm=draw(st.floats(-9.0, 9.0)),
            roll_deg=draw(st.floats(-5.0, 5.0)),
        ),
        acquisition=AcquisitionEntry(
            frames=draw(st.integers(1, 9)),
            photons_per_count=draw(st.none() | st.floats(1e-3, 1e3)),
            readout_noise_counts=draw(st.none() | st.floats(0.0, 1e3)),
        ),
        reference=stack(),
        test=stack(),
    )
