"""The light of the tube, against its closed forms."""

import numpy as np
import pytest

from pdvc.geometry import ConeBeam
from simulator.detector import Conditions, Detector, detector_maps, expose_dark, expose_flat, record
from simulator.images import maps_of
from simulator.open_beam import OpenBeam
from tests.tiny_scenarios import tinier

QUIET = Detector(
    bad_pixel_fraction=0.0, gain_spread=0.0, beam_falloff=0.0, readout_noise_counts=0.0, photons_per_pixel=1e9
)
SCANNER = ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=61, columns=45)
MAPS = detector_maps(QUIET, 30, 41, np.random.default_rng(0))


def taken(beam, value=1.0, time_s=0.0, seed=0, detector=QUIET):
    image = np.full((30, 41), value, dtype=np.float32)
    conditions = Conditions(beam=beam, time_s=time_s)
    counts = record(image, detector, MAPS, np.random.default_rng(seed), conditions)
    return counts - detector.dark_counts


def test_a_drift_since_the_flats_adds_the_same_to_every_attenuation():
    beam = OpenBeam(drift_per_hour=-0.02)
    flat = expose_flat(QUIET, MAPS, np.random.default_rng(0), Conditions(beam=beam)) - QUIET.dark_counts
    for transmission in (0.3, 1.0):
        attenuation = -np.log(taken(beam, transmission, time_s=1800.0) / flat).mean()
        assert attenuation == pytest.approx(-np.log(transmission) - np.log(1 - 0.01), abs=2e-4)


def test_a_tilt_grows_to_opposite_ends_with_time():
    beam = OpenBeam(tilt_per_hour=0.04)
    light = taken(beam, time_s=900.0) / QUIET.counts_full
    np.testing.assert_allclose(light.mean(axis=0), 1 + 0.01 * np.linspace(-1, 1, 41), atol=1e-4)
    np.testing.assert_allclose(taken(beam) / QUIET.counts_full, 1, atol=3e-4)


@pytest.mark.parametrize("frames", [1, 5])
def test_the_current_of_a_mean_of_frames_errs_by_the_root_of_their_number_less(frames):
    beam = OpenBeam(current_spread=0.01)
    detector = QUIET.model_copy(update={"frames": frames})
    light = np.array([taken(beam, seed=n, detector=detector).mean() for n in range(400)]) / QUIET.counts_full
    assert light.mean() == pytest.approx(1, abs=4 * 0.01 / np.sqrt(frames * 400))
    assert light.std() == pytest.approx(0.01 / np.sqrt(frames), rel=4 / np.sqrt(800))


def test_a_dark_image_knows_nothing_of_the_beam():
    beam = OpenBeam(current_spread=0.1, drift_per_hour=0.1)
    assert np.all(expose_dark(QUIET, MAPS, np.random.default_rng(0), Conditions(beam=beam)) == 800)


def test_the_heel_is_what_the_target_takes_on_the_longer_way_out():
    beam = OpenBeam(target_attenuation=0.1, anode_deg=12.0, heel_deg=0.0)
    heel = beam.heel(SCANNER)
    assert heel[30, 22] == 1
    for column in (0, 10, 44):
        psi = np.arctan((column - 22) * 0.5 / 300.0)
        # a layer of the depth d is crossed in d / sin(angle to the surface)
        way, middle = 1 / np.sin(np.deg2rad(12) - psi), 1 / np.sin(np.deg2rad(12))
        np.testing.assert_allclose(heel[:, column], np.exp(-0.1 * (way - middle)), rtol=1e-5)
    assert heel[0, 44] < 1 < heel[0, 0]


def test_the_heel_falls_towards_the_anode():
    down = OpenBeam(target_attenuation=0.1, heel_deg=90.0).heel(SCANNER)
    assert down[60, 22] < 1 < down[0, 22]
    np.testing.assert_allclose(down, down[:, ::-1], rtol=1e-5)
    assert OpenBeam().heel(SCANNER) is None


def test_the_heel_is_in_the_open_beam_of_flats_and_radiographs():
    plain, heeled = (
        maps_of(tinier(scanner={"open_beam": {"target_attenuation": size, "anode_deg": 30.0}})) for size in (0.0, 0.1)
    )
    recorded = tinier().geometry.cone_beam()
    heel = OpenBeam(target_attenuation=0.1, anode_deg=30.0).heel(recorded)
    np.testing.assert_allclose(heeled.beam, plain.beam * heel, rtol=1e-6)


def test_pixels_below_the_surface_of_the_target_are_refused():
    # rows reach arctan(15 / 300) = 2.86 degrees from the middle
    with pytest.raises(ValueError, match=r"anode_deg above 2\.862 degrees, .*, got 2\.0 degrees"):
        OpenBeam(target_attenuation=0.1, anode_deg=2.0).heel(SCANNER)
