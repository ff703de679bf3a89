"""One image without noise: motion, a leaning axis, and exposure while the stage turns."""

import numpy as np

from simulator.images import prepare, transmission
from simulator.sample import moved_body
from simulator.scenario import course_of
from tests.tiny_scenarios import tinier


def test_rigid_motion_by_a_step_of_the_stage_looks_like_the_next_view():
    # wobble-free turn about z by +10 degrees and stage at 0 = no motion and stage at +10 degrees
    turned = tinier(
        motion={
            "ingredients": ["backlash"],
            "backlash": {
                "before_mm": [0, 0, 0],
                "before_deg": [0, 0, 10],
                "start_mm": [0, 0, 0],
                "start_deg": [0] * 3,
            },
        }
    )
    bench = prepare(turned, course_of(turned))
    body = moved_body(bench.body, bench.course.motion, 0)
    one = transmission(bench, body, 0.3, 0.0)
    two = transmission(bench, bench.body, 0.3 + np.deg2rad(10), 0.0)
    np.testing.assert_allclose(one, two, atol=2e-6)


def test_a_lean_along_the_beam_axis_is_seen_and_a_zero_one_is_not():
    plain, leaning = tinier(), tinier(misalignment={"lean_deg": 5.0})
    images = []
    for scenario in (plain, leaning):
        bench = prepare(scenario, course_of(scenario))
        images.append(transmission(bench, bench.body, 0.7, 0.0))
    # the top comes nearer to the detector or the source: its image shrinks or grows, that of the middle stays
    assert np.abs(images[0] - images[1])[:8].max() > 10 * np.abs(images[0] - images[1])[38:42].mean()


def test_exposure_while_turning_is_the_mean_of_still_exposures():
    turning = tinier(acquisition={"exposure_samples": 2, "exposure_share": 0.5})
    bench = prepare(turning, course_of(turning))
    still = prepare(tinier(), course_of(tinier()))
    mean = sum(transmission(still, still.body, 0.4 + shift, 0.0) for shift in (-0.0125, 0.0125)) / 2
    np.testing.assert_allclose(transmission(bench, bench.body, 0.4, 0.1), mean, atol=1e-6)
