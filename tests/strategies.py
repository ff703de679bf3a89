"""Hypothesis strategies of the whole suite; no test module is imported here."""

from __future__ import annotations

import math

from hypothesis import strategies as st

from pdvc.geometry import ConeBeam


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
