"""One image without noise: motion, a leaning axis, and exposure while the stage turns."""

import numpy as np
import pytest
import trimesh

from simulator.images import clear_image, prepare, transmission
from simulator.radiography import Body
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


def ball(x, radius=0.12):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation([x, 0.0, 0.0])
    none = {"centres_mm": np.zeros((0, 3)), "shapes_mm": np.zeros((0, 3, 3))}
    return Body(vertices_mm=np.array(mesh.vertices), faces=np.array(mesh.faces, dtype=np.int64), **none)


@pytest.mark.parametrize("samples", [1, 3, 9])
def test_what_the_stage_turns_through_in_an_exposure_is_blurred_along_the_arc(samples):
    """The mean of n places on an arc of the angle a is nearer to the axis by sin(a / 2) / (n sin(a / 2 n))."""
    far = {"source_axis_mm": 1e6, "source_detector_mm": 1.0001e6, "pixel_mm": 0.05, "rows": 24, "columns": 64}
    turning = tinier(geometry=far, acquisition={"exposure_samples": samples, "exposure_share": 0.8, "subpixels": 4})
    bench = prepare(turning, course_of(turning))
    arc = 0.8 * 0.6
    # the radius stands across the beam in the middle of the exposure
    taken = 1 - transmission(bench, ball(1.0), np.pi / 2, 0.6).astype(float)
    columns = (np.arange(64 * 4) - (64 * 4 - 1) / 2) * 0.05 / 4
    radius = -(taken.sum(axis=0) @ columns) / taken.sum()
    expected = np.sin(arc / 2) / (samples * np.sin(arc / 2 / samples))
    assert radius == pytest.approx(expected, abs=2e-4)


def test_a_pixel_that_the_sample_covers_in_part_shows_the_mean_of_its_light():
    """Not of its attenuation: half covered, it shows -ln((1 + T) / 2), which is less than half of -ln T."""
    far = {"source_axis_mm": 1e6, "source_detector_mm": 1.0001e6, "pixel_mm": 0.1, "rows": 20, "columns": 30}
    scenario = tinier(geometry=far, acquisition={"subpixels": 4}, detector={"blur_px": 0.0})
    bench = prepare(scenario, course_of(scenario))
    # from y = -0.55 mm to 0.55 mm: columns 9.5 to 20.5, in the middle of a pixel
    mesh = trimesh.creation.box([1.0, 1.1, 4.0])
    none = {"centres_mm": np.zeros((0, 3)), "shapes_mm": np.zeros((0, 3, 3))}
    body = Body(vertices_mm=np.array(mesh.vertices), faces=np.array(mesh.faces, dtype=np.int64), **none)
    profile = clear_image(bench, body, 0.0, 0.0)[10]
    inside = profile[14]
    np.testing.assert_allclose(profile[[9, 20]], (1 + inside) / 2, rtol=1e-3)
    np.testing.assert_allclose(profile[10:20], inside, rtol=1e-3)
    assert -np.log(profile[9]) < -0.45 * np.log(inside)
