"""Laws of one's own: what holds whatever the sample, the scanner and the noise are.

    pytest examples/test_my_law.py

Hypothesis draws the cases, and reduces a counter-example to a plain one. docs/strategies.md tells what can be drawn.
"""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from validation.scoring.centre_line import centre_line
from validation.testing.small_cases import SmallExperiment
from validation.testing.strategies import cone_beams, scenarios


@given(cone_beams(), st.integers(1, 6))
def test_larger_pixels_see_larger_voxels(scanner, factor):
    """A voxel is a pixel seen at the rotation axis."""
    np.testing.assert_allclose(scanner.binned(factor).voxel_mm, factor * scanner.voxel_mm)


def never_loaded(scenario):
    """Return the scenario without any stroke: the sample only moves as the stage and the machine do."""
    return scenario.model_copy(update={"loading": scenario.loading.model_copy(update={"stroke_mm_per_s": 0.0})})


# each example is simulated and measured from its counts, in about a second
@settings(max_examples=2, deadline=None, derandomize=True)
@given(scenarios(least_ingredients=2).map(never_loaded).map(SmallExperiment))
def test_a_sample_that_is_not_loaded_does_not_stretch(small):
    """Sections are some 15 voxels apart: a strain of three hundredths is half a voxel between two of them."""
    centre = centre_line(small.measurement)
    assert np.abs(centre.strain(centre.measured)).max() < 0.03
