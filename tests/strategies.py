"""Hypothesis strategies of the whole suite; no test module is imported here."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from pdvc.experiment import AcquisitionEntry, Description, GeometryEntry, StackEntry
from pdvc.geometry import ConeBeam
from pdvc.sections import RIGID, SectionBasis
from simulator.kinematics import BeamMotion, RigidMotion, SectionMotion


@st.composite
def cone_beams(draw: st.DrawFn) -> ConeBeam:
    """Draw scanners that see some mm around the axis: never square, with shifts of pixels and a small roll."""
    source_axis_mm = draw(st.floats(20.0, 200.0))
    magnification = draw(st.floats(1.5, 30.0))
    voxel_mm = draw(st.floats(0.03, 0.1))
    pixel_mm = voxel_mm * magnification
    columns = draw(st.integers(24, 48))
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


angles_rad = st.floats(-2 * math.pi, 2 * math.pi)


@st.composite
def section_bases(draw: st.DrawFn, *, motions: tuple[str, ...] = RIGID) -> SectionBasis:
    """Draw one to six sections at unequal heights of some mm."""
    gaps = draw(st.lists(st.floats(0.1, 3.0), min_size=1, max_size=6))
    return SectionBasis(
        height_mm=draw(st.floats(-5.0, 5.0)) + np.cumsum(gaps), radius_mm=draw(st.floats(0.2, 4.0)), motions=motions
    )


@st.composite
def descriptions(draw: st.DrawFn) -> Description:
    """Draw what an `experiment.toml` may hold, every optional entry given or left out."""
    source_axis_mm = draw(st.floats(1.0, 1e3))

    def stack() -> StackEntry:
        count = draw(st.integers(1, 4))
        numbers = st.lists(st.floats(-1e4, 1e4), min_size=count, max_size=count).map(tuple)
        return StackEntry(angle_deg=draw(numbers), time_s=draw(numbers), force_N=draw(numbers))

    text = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=12)
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


finite = st.floats(-1.0, 1.0, allow_nan=False)


def _profile(draw: st.DrawFn, shape: tuple[int, ...], size: float) -> NDArray[np.float64]:
    count = math.prod(shape)
    return size * np.array(draw(st.lists(finite, min_size=count, max_size=count))).reshape(shape)


@st.composite
def rigid_motions(draw: st.DrawFn) -> RigidMotion:
    """Draw one step of a rigid motion, up to half a turn."""
    return RigidMotion(
        rotation_rad=_profile(draw, (1, 3), 1.8),
        translation_mm=_profile(draw, (1, 3), 2.0),
        centre_mm=_profile(draw, (3,), 3.0),
    )


@st.composite
def beam_motions(draw: st.DrawFn) -> BeamMotion:
    """Draw one step of a stretched, bent, twisted and thinned beam, whose sections do not cross."""
    knots = np.linspace(-6.0, 6.0, 5)
    return BeamMotion(
        knot_mm=knots,
        displacement_mm=_profile(draw, (1, 5, 3), 0.4),
        rotation_rad=_profile(draw, (1, 5, 3), 0.2),
        stretch=1.0 + _profile(draw, (1, 5), 0.1),
    )


@st.composite
def section_motions(draw: st.DrawFn) -> SectionMotion:
    """Draw one step of a motion by sections fixed in space."""
    return SectionMotion(
        height_mm=np.linspace(-4.0, 4.0, 5),
        translation_mm=_profile(draw, (1, 5, 3), 0.4),
        rotation_rad=_profile(draw, (1, 5, 3), 0.1),
    )


motions = st.one_of(rigid_motions(), beam_motions(), section_motions())
