import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import cKDTree

from simulator.microstructure import Graphite, Nodules, place
from simulator.specimen import Specimen, area_mm2, depth_mm

SPECIMEN = Specimen(thinned="both", grip_width_mm=1.5, length_mm=4.0)
HALF_HEIGHT = 1.2


@pytest.fixture(scope="module")
def nodules() -> Nodules:
    return place(Graphite(), SPECIMEN, np.random.default_rng(0), HALF_HEIGHT)


def test_no_two_nodules_are_nearer_than_the_gap(nodules):
    tree = cKDTree(nodules.centre_mm)
    pairs = tree.query_pairs(2 * nodules.radius_mm.max() + 0.002, output_type="ndarray")
    distance = np.linalg.norm(np.diff(nodules.centre_mm[pairs], axis=1)[:, 0], axis=-1)
    assert len(pairs) > 1000
    assert (distance - nodules.radius_mm[pairs].sum(axis=1)).min() >= 0.002


def test_nodules_lie_inside_the_matrix(nodules):
    assert (depth_mm(SPECIMEN, nodules.centre_mm) - nodules.radius_mm).min() >= 0.002
    assert (np.abs(nodules.centre_mm[:, 2]) + nodules.radius_mm).max() <= HALF_HEIGHT


def test_the_volume_fraction_is_met(nodules):
    volume, _ = quad(lambda z: float(area_mm2(SPECIMEN, z)), -HALF_HEIGHT, HALF_HEIGHT)
    graphite = (4 / 3 * np.pi * nodules.radius_mm**3).sum()
    assert graphite / volume == pytest.approx(0.11, abs=4e-4)


def test_sizes_follow_the_cut_lognormal_law(nodules):
    d = 2 * nodules.radius_mm
    assert d.min() >= 0.008
    assert d.max() <= 0.09
    assert d.mean() == pytest.approx(0.032, rel=0.02)
    assert d.std() / d.mean() == pytest.approx(0.35, rel=0.05)


def test_the_count_per_area_is_usual_for_nodular_cast_iron(nodules):
    cut = [np.sum(np.abs(nodules.centre_mm[:, 2] - z) < nodules.radius_mm) for z in np.linspace(-1, 1, 41)]
    areas = area_mm2(SPECIMEN, np.linspace(-1, 1, 41))
    assert 100 < np.sum(cut) / np.sum(areas) < 200


def test_nodules_are_ordered_and_fill_the_height_evenly(nodules):
    z = nodules.centre_mm[:, 2]
    assert np.all(np.diff(z) >= 0)
    lower = np.sum(nodules.radius_mm[z < 0] ** 3) / np.sum(nodules.radius_mm**3)
    assert lower == pytest.approx(0.5, abs=0.03)


def test_the_same_seed_gives_the_same_nodules_and_another_seed_others(nodules):
    again = place(Graphite(), SPECIMEN, np.random.default_rng(0), HALF_HEIGHT)
    other = place(Graphite(), SPECIMEN, np.random.default_rng(1), HALF_HEIGHT)
    np.testing.assert_array_equal(again.centre_mm, nodules.centre_mm)
    assert not np.array_equal(other.centre_mm[:10], nodules.centre_mm[:10])


def test_no_graphite_is_no_nodule():
    assert len(place(Graphite(volume_fraction=0), SPECIMEN, np.random.default_rng(0), 1.0)) == 0


def test_graphite_that_does_not_fit_is_refused():
    crowded = Graphite(volume_fraction=0.25, gap_mm=0.03)
    with pytest.raises(ValueError, match=r"graphite\.volume_fraction: .* found no place"):
        place(crowded, SPECIMEN, np.random.default_rng(0), 0.2)


def test_the_mean_has_to_lie_between_the_limits():
    with pytest.raises(ValueError, match="mean_diameter_mm between"):
        Graphite(mean_diameter_mm=0.1)
