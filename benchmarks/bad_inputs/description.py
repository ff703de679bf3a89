"""Bad `experiment.toml`: angles, distances, times, forces and noise that are not those of the stacks."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from benchmarks.bad_inputs.record import (
    ALL,
    BadInput,
    Floats,
    described,
    in_turn,
    picked,
    recorded,
    scaled,
    settled,
    stacks,
)
from pdvc.experiment import REFERENCE, TEST


def one_replaced(value: float) -> Callable[[Floats], Floats]:
    """Return the edit that puts a value in the place of the eighth number."""

    def edited(numbers: Floats) -> Floats:
        numbers[7] = value
        return numbers

    return edited


ANGLES = (
    BadInput(
        name="test-angles-reversed",
        change=recorded("test", "angle_deg", lambda a: a[::-1]),
        wrong="The angles of the test are listed from the last to the first.",
    ),
    BadInput(
        name="test-angles-negated",
        change=recorded("test", "angle_deg", np.negative),
        wrong="The angles of the test have the wrong sign.",
    ),
    BadInput(
        name="test-angles-zero",
        change=recorded("test", "angle_deg", np.zeros_like),
        wrong="The angles of the test were not recorded: all are zero.",
    ),
    BadInput(
        name="test-angles-in-radians",
        change=recorded("test", "angle_deg", np.deg2rad),
        wrong="The angles of the test are in radians.",
    ),
    BadInput(
        name="test-angles-in-gradians",
        change=recorded("test", "angle_deg", lambda a: a / 0.9),
        wrong="The angles of the test are in gradians, 400 to a turn.",
    ),
    BadInput(
        name="test-angles-slip",
        change=recorded("test", "angle_deg", lambda a: 1.02 * a),
        due="unknowable",
        wrong="The stage slipped by 2 % during the test: that is a sample which turns steadily in its grips.",
    ),
    BadInput(
        name="test-angles-offset",
        change=recorded("test", "angle_deg", lambda a: a + 90),
        wrong="The angles of the test are counted from elsewhere than those of the reference, by 90 degrees.",
    ),
    BadInput(
        name="reference-angles-reversed",
        change=recorded("reference", "angle_deg", lambda a: a[::-1]),
        wrong="The angles of the reference scan are listed from the last to the first.",
    ),
    BadInput(
        name="reference-angles-negated",
        change=recorded("reference", "angle_deg", np.negative),
        wrong="The angles of the reference scan have the wrong sign.",
    ),
    BadInput(
        name="reference-angles-in-radians",
        change=recorded("reference", "angle_deg", np.deg2rad),
        wrong="The angles of the reference scan are in radians.",
    ),
    BadInput(
        name="reference-angles-zero",
        change=recorded("reference", "angle_deg", np.zeros_like),
        wrong="The angles of the reference scan were not recorded: all are zero.",
    ),
    BadInput(
        name="reference-end-counted-twice",
        change=recorded("reference", "angle_deg", lambda a: np.linspace(0, 360, len(a))),
        wrong="The reference angles run from 0 to 360, both included, where the scan stopped a view before 360.",
    ),
    BadInput(
        name="all-angles-negated",
        change=in_turn(recorded("reference", "angle_deg", np.negative), recorded("test", "angle_deg", np.negative)),
        wrong="All angles have the wrong sign: the stage turns the other way.",
    ),
    BadInput(
        name="all-angles-in-radians",
        change=in_turn(recorded("reference", "angle_deg", np.deg2rad), recorded("test", "angle_deg", np.deg2rad)),
        wrong="All angles are in radians.",
    ),
    BadInput(
        name="all-mirrored-and-negated",
        due="unknowable",
        change=in_turn(
            stacks(lambda counts: counts[:, :, ::-1], *ALL),
            recorded("reference", "angle_deg", np.negative),
            recorded("test", "angle_deg", np.negative),
        ),
        wrong="All stacks are mirrored and all angles negated: that is what the mirrored sample would show.",
    ),
)
"""Angles."""

DISTANCES = (
    BadInput(
        name="pixel-a-tenth", change=scaled("geometry", "pixel_mm", 0.1), wrong="`pixel_mm` is a tenth of what it was."
    ),
    BadInput(
        name="pixel-ten-times", change=scaled("geometry", "pixel_mm", 10), wrong="`pixel_mm` is ten times what it was."
    ),
    BadInput(
        name="pixel-in-micrometres", change=scaled("geometry", "pixel_mm", 1000), wrong="`pixel_mm` is in micrometres."
    ),
    BadInput(
        name="source-axis-double",
        due="unknowable",
        change=scaled("geometry", "source_axis_mm", 2),
        wrong="`source_axis_mm` is twice what it was: a sample twice as large shows the same.",
    ),
    BadInput(
        name="source-axis-half",
        due="unknowable",
        change=scaled("geometry", "source_axis_mm", 0.5),
        wrong="`source_axis_mm` is half of what it was: a sample half as large shows the same.",
    ),
    BadInput(
        name="source-detector-half",
        change=scaled("geometry", "source_detector_mm", 0.5),
        wrong="`source_detector_mm` is half of what it was.",
    ),
    BadInput(
        name="distances-exchanged",
        due="error",
        change=settled("geometry", source_axis_mm=800.0, source_detector_mm=800 / 28),
        wrong="`source_axis_mm` and `source_detector_mm` are interchanged.",
    ),
    BadInput(
        name="axis-to-detector-for-source-to-axis",
        due="unknowable",
        change=settled("geometry", source_axis_mm=800 * 27 / 28),
        wrong="`source_axis_mm` is the distance from axis to detector: a larger sample shows the same.",
    ),
    BadInput(
        name="distances-in-metres",
        change=settled("geometry", source_axis_mm=0.8 / 28, source_detector_mm=0.8),
        wrong="Both distances are in metres.",
    ),
    BadInput(
        name="all-lengths-in-metres",
        change=settled("geometry", source_axis_mm=0.8 / 28, source_detector_mm=0.8, pixel_mm=0.0023968),
        wrong="Both distances and the pixels are in metres: a voxel of 0.09 micrometres.",
    ),
    BadInput(
        name="column-shift-wrong",
        change=settled("geometry", column_shift_mm=5 * 2.3968),
        wrong="`column_shift_mm` says 5 columns, where the detector stood in the middle.",
    ),
    BadInput(
        name="row-shift-wrong",
        change=settled("geometry", row_shift_mm=20 * 2.3968),
        wrong="`row_shift_mm` says 20 rows, where the detector stood in the middle.",
    ),
    BadInput(
        name="roll-wrong",
        change=settled("geometry", roll_deg=10.0),
        wrong="`roll_deg` says 10 degrees, where the detector stood upright.",
    ),
    BadInput(
        name="rows-and-columns-exchanged",
        due="error",
        change=settled("geometry", rows=54, columns=119),
        wrong="`rows` and `columns` are interchanged.",
    ),
    BadInput(
        name="distance-negative",
        due="error",
        change=scaled("geometry", "source_axis_mm", -1),
        wrong="`source_axis_mm` is negative.",
    ),
    BadInput(
        name="distance-nan", due="error", change=settled("geometry", pixel_mm=math.nan), wrong="`pixel_mm` is nan."
    ),
    BadInput(
        name="distance-infinite",
        due="error",
        change=settled("geometry", source_detector_mm=math.inf),
        wrong="`source_detector_mm` is infinite: a parallel beam.",
    ),
    BadInput(
        name="distance-with-unit",
        due="error",
        change=settled("geometry", pixel_mm="2.3968 mm"),
        wrong="`pixel_mm` is written with its unit, as text.",
    ),
)
"""Distances and pixels."""

LISTS = (
    BadInput(
        name="times-constant",
        change=recorded("test", "time_s", np.zeros_like),
        wrong="All times of the test are the same.",
    ),
    BadInput(
        name="times-decreasing",
        change=recorded("test", "time_s", lambda t: t[::-1]),
        wrong="The times of the test decrease.",
    ),
    BadInput(
        name="time-nan", due="error", change=recorded("test", "time_s", one_replaced(math.nan)), wrong="A time is nan."
    ),
    BadInput(
        name="angle-nan",
        due="error",
        change=recorded("test", "angle_deg", one_replaced(math.nan)),
        wrong="An angle of the test is nan.",
    ),
    BadInput(
        name="view-angle-infinite",
        due="error",
        change=recorded("reference", "angle_deg", one_replaced(math.inf)),
        wrong="An angle of the reference scan is infinite.",
    ),
    BadInput(
        name="force-nan",
        due="error",
        change=recorded("test", "force_N", one_replaced(math.nan)),
        wrong="A force is nan.",
    ),
    BadInput(
        name="force-in-micronewtons",
        change=recorded("test", "force_N", lambda f: 1e6 * f),
        wrong="The forces are a million times too large.",
    ),
    BadInput(
        name="force-one-spike",
        change=recorded("test", "force_N", one_replaced(1e9)),
        wrong="One force is 1e9 N: a reading that failed.",
    ),
    BadInput(
        name="one-angle-less",
        due="error",
        change=recorded("test", "angle_deg", lambda a: a[:-1]),
        wrong="An angle is missing from the list of the test.",
    ),
    BadInput(
        name="one-step", change=picked("test", TEST, lambda n: np.array([90])), wrong="The test is of one radiograph."
    ),
    BadInput(
        name="two-steps",
        change=picked("test", TEST, lambda n: np.array([20, 90])),
        wrong="The test is of two radiographs.",
    ),
    BadInput(
        name="views-of-half-a-turn",
        change=picked("reference", REFERENCE, lambda n: np.arange(n // 2)),
        wrong="The reference scan went half around only.",
    ),
    BadInput(
        name="views-miss-a-sector",
        change=picked("reference", REFERENCE, lambda n: np.r_[: n // 2, n // 2 + n // 4 : n]),
        wrong="A quarter of the reference scan is missing.",
    ),
    BadInput(
        name="five-views",
        change=picked("reference", REFERENCE, lambda n: np.arange(0, n, n // 5)),
        wrong="The reference scan is of five views.",
    ),
    BadInput(
        name="one-view",
        change=picked("reference", REFERENCE, lambda n: np.arange(1)),
        wrong="The reference scan is of one view.",
    ),
    BadInput(
        name="nineteen-views",
        change=picked("reference", REFERENCE, lambda n: np.arange(0, n, 4)),
        wrong="The reference scan is of 19 views, 19 degrees apart.",
    ),
)
"""What was recorded with each radiograph."""

ENTRIES = (
    BadInput(
        name="photons-hundred-times",
        change=scaled("acquisition", "photons_per_count", 100),
        wrong="`photons_per_count` is a hundred times what it was.",
    ),
    BadInput(
        name="photons-a-hundredth",
        change=scaled("acquisition", "photons_per_count", 0.01),
        wrong="`photons_per_count` is a hundredth of what it was.",
    ),
    BadInput(
        name="readout-three-hundred-times",
        change=scaled("acquisition", "readout_noise_counts", 300),
        wrong="`readout_noise_counts` is three hundred times what it was.",
    ),
    BadInput(
        name="frames-hundred-times",
        change=settled("acquisition", frames=500),
        wrong="`frames` says 500, where 5 were averaged.",
    ),
    BadInput(
        name="photons-negative",
        due="error",
        change=scaled("acquisition", "photons_per_count", -1),
        wrong="`photons_per_count` is negative.",
    ),
    BadInput(
        name="readout-nan",
        due="error",
        change=settled("acquisition", readout_noise_counts=math.nan),
        wrong="`readout_noise_counts` is nan.",
    ),
    BadInput(name="frames-zero", due="error", change=settled("acquisition", frames=0), wrong="`frames` is zero."),
    BadInput(
        name="unknown-key",
        due="error",
        change=settled("geometry", source_object_mm=28.57),
        wrong="`experiment.toml` has a key that nobody knows.",
    ),
    BadInput(
        name="key-misspelt",
        due="error",
        change=described(lambda values: values["geometry"].update(pixel=values["geometry"].pop("pixel_mm"))),
        wrong="`pixel_mm` is misspelt as `pixel`.",
    ),
    BadInput(
        name="no-geometry",
        due="error",
        change=described(lambda values: values.pop("geometry")),
        wrong="No [geometry].",
    ),
    BadInput(
        name="no-angles",
        due="error",
        change=described(lambda values: values["test"].pop("angle_deg")),
        wrong="[test] has no angles.",
    ),
)
"""Noise, and the keys themselves."""

CASES = (*ANGLES, *DISTANCES, *LISTS, *ENTRIES)
