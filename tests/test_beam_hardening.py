"""The polynomial and the hull of an elliptical bar seen with two energies: chords and attenuation in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from pdvc.beam_hardening import find_outline
from pdvc.geometry import ConeBeam
from pdvc.rays import ray_vectors
from pdvc.volume import Hull

SCANNER = ConeBeam(
    source_axis_mm=40.0, source_detector_mm=400.0, pixel_mm=0.5, rows=48, columns=52, column_shift_mm=0.8
)
COARSE = replace(SCANNER, pixel_mm=1.0, rows=24, columns=26)
ANGLES = np.linspace(0, 2 * np.pi, 120, endpoint=False)
HALF = np.array([0.65, 0.45])
CENTRE = np.array([0.1, -0.05])


def chords(geometry=SCANNER, angles=ANGLES, half=HALF, centre=CENTRE):
    """Return lengths (view, row, column) of the rays within an endless upright elliptical cylinder, mm."""
    return np.mean(list(chords_across(geometry, angles, half, centre)), axis=0)


def chords_across(geometry=SCANNER, angles=ANGLES, half=HALF, centre=CENTRE):
    """Yield these lengths at five places across the pixels in turn."""
    vectors = ray_vectors(geometry, angles).stacked()[:, :, None, None, :]
    row, column = np.indices((geometry.rows, geometry.columns))[..., None]
    for sub in (np.arange(5) - 2) / 5:
        d = vectors[:, 1] + row * vectors[:, 2] + (column + sub) * vectors[:, 3] - vectors[:, 0]
        length = np.linalg.norm(d, axis=-1)
        p = (vectors[:, 0, ..., :2] - centre) / half
        d = d[..., :2] / half / length[..., None]
        a, b, c = (d * d).sum(-1), (p * d).sum(-1), (p * p).sum(-1) - 1
        yield 2 * np.sqrt(np.maximum(b**2 - a * c, 0)) / a


def attenuation(length):
    """Return -log T of a beam of two energies, 0.6 with 0.9 / mm and 0.4 with 2.4 / mm."""
    return -np.log(0.6 * np.exp(-0.9 * length) + 0.4 * np.exp(-2.4 * length))


@pytest.fixture(scope="module")
def bar():
    length = chords()
    views = attenuation(length).astype(np.float32)
    return length, views, find_outline(lambda i: views[i], SCANNER, ANGLES, None)


def levels(views, polynomial):
    c1, c2, c3 = polynomial
    return c1 * views + c2 * views**2 + c3 * views**3


def test_the_fitted_polynomial_makes_grey_levels_proportional_to_length(bar):
    length, views, outline = bar
    deep = length > 0.3 * length.max()
    grey = levels(views, outline.polynomial)[deep]
    slope = (grey @ length[deep]) / (length[deep] @ length[deep])
    error = np.abs(grey - slope * length[deep]) / (slope * length.max())
    assert error.max() < 0.015
    # without it, attenuation strays farther
    raw = views[deep]
    slope = (raw @ length[deep]) / (length[deep] @ length[deep])
    assert np.abs(raw - slope * length[deep]).max() / (slope * length.max()) > 0.04


def slopes(polynomial, longest):
    """Return d ln G / d ln L at paths from half of the longest one to nine tenths."""
    length = np.linspace(0.3, 1, 701) * longest
    slope = np.gradient(np.log(levels(attenuation(length), polynomial)), np.log(length))
    return slope[200:600]


@pytest.mark.parametrize("scatter", [0.0, 0.08])
def test_grey_levels_change_with_length_in_proportion_whatever_nodules_and_photons_scatter(bar, scatter):
    # what a sample that becomes thinner is seen by; paths fitted to attenuations, which scatter, would rise too little
    length, views, _ = bar
    scattered = views * (1 + scatter * np.random.default_rng(0).standard_normal(views.shape)).astype(np.float32)
    found = find_outline(lambda i: scattered[i], SCANNER, ANGLES, None)
    assert np.abs(slopes(found.polynomial, length.max()) - 1).max() < 0.04


def test_nor_does_what_is_lighter_inside_and_stays_clear_of_the_faces_bend_the_curve():
    # rods in the middle of the bar, of nothing: long rays lose more of their path to them than short ones
    length = chords()
    turns = np.linspace(0, 2 * np.pi, 5, endpoint=False)
    places = np.vstack([[0.0, 0.0], 0.4 * np.column_stack([np.cos(turns), np.sin(turns)])]) * HALF
    rods = np.sum([chords(half=np.array([0.07, 0.07]), centre=CENTRE + place) for place in places], axis=0)
    views = attenuation(length - rods).astype(np.float32)
    found = find_outline(lambda i: views[i], SCANNER, ANGLES, None)
    # 0.15 where the rods are left in
    assert np.abs(slopes(found.polynomial, length.max()) - 1).max() < 0.1


def test_pixels_that_average_intensities_move_no_face():
    """A pixel shows -ln <exp(-a)>: less than the attenuation of its mean path, where a face crosses it."""
    lengths = list(chords_across(COARSE))
    views = -np.log(np.mean([np.exp(-attenuation(each)) for each in lengths], axis=0)).astype(np.float32)
    found = find_outline(lambda i: views[i], COARSE, ANGLES, None)
    # 0.25 for faces where grey levels are half
    assert np.abs(slopes(found.polynomial, np.max(lengths)) - 1).max() < 0.05


def test_nor_do_pixels_whose_attenuations_are_averaged():
    lengths = list(chords_across(COARSE))
    views = np.mean([attenuation(each) for each in lengths], axis=0).astype(np.float32)

    def off(binned):
        found = find_outline(lambda i: views[i], COARSE, ANGLES, None, binned=binned)
        return np.abs(slopes(found.polynomial, np.max(lengths)) - 1).max()

    assert off(5) < 0.04 < off(1)


def test_a_sample_of_a_few_pixels_is_all_edge_and_still_has_a_curve():
    views = attenuation(chords(half=np.array([0.05, 0.04]))).astype(np.float32)
    found = find_outline(lambda i: views[i], SCANNER, ANGLES, None)
    grey = levels(np.linspace(0.01, 1, 100) * views.max(), found.polynomial)
    assert (np.diff(grey) > 0).all()
    assert grey[-1] == pytest.approx(1, abs=1e-5)


def test_the_largest_grey_level_is_one(bar):
    _, views, outline = bar
    assert levels(views, outline.polynomial).max() == pytest.approx(1, abs=1e-5)


def supports(hull):
    """Return the bar's own supports (direction,), and the hull's in its filled slabs."""
    normals = Hull.normals()
    own = normals @ CENTRE + np.sqrt(((normals * HALF) ** 2).sum(axis=1))
    return own, hull.support_mm[np.isfinite(hull.support_mm).all(axis=1)]


def test_the_hull_encloses_the_bar_and_no_more_than_its_margin(bar):
    hull = bar[2].hull
    own, found = supports(hull)
    assert (found > own).all()
    # two voxels of margin, the voxel's own half diagonal, and one voxel of blur
    assert (found < own + 4 * SCANNER.voxel_mm).all()


def test_the_hull_reaches_as_high_as_every_view_sees(bar):
    low, high = bar[2].hull.box_mm()
    assert low[2] < -0.9
    assert high[2] > 0.9


def test_a_given_polynomial_is_only_scaled(bar):
    _, views, _ = bar
    given = (2.0, 0.3, -0.02)
    outline = find_outline(lambda i: views[i], SCANNER, ANGLES, given)
    np.testing.assert_allclose(np.array(outline.polynomial) * levels(views, given).max(), given, rtol=1e-5)
    own, found = supports(outline.hull)
    assert (found > own).all()


def test_pores_are_filled_and_specks_beside_the_sample_left_out():
    length = chords()
    speck = np.zeros(length.shape)
    vectors = ray_vectors(SCANNER, ANGLES).stacked()
    at = np.array([-0.85, 0.7, 0.2])
    for t, (source, corner, down, right) in enumerate(vectors):
        normal = np.cross(down, right)
        hit = source + (at - source) * ((corner - source) @ normal) / ((at - source) @ normal) - corner
        row, column = round(hit @ down / (down @ down)), round(hit @ right / (right @ right))
        speck[t, row - 1 : row + 2, column - 1 : column + 2] = 0.15
    views = attenuation(length + speck).astype(np.float32)
    hull = find_outline(lambda i: views[i], SCANNER, ANGLES, (1.0, 0.0, 0.0)).hull
    own, found = supports(hull)
    assert (found < own + 4 * SCANNER.voxel_mm).all()


def test_only_air_is_refused():
    with pytest.raises(ValueError, match="radiographs of a full scan: expected a sample, found only air"):
        find_outline(lambda _: np.zeros((48, 52), dtype=np.float32), SCANNER, ANGLES, None)


def test_noisy_air_is_refused():
    def air(view):
        return np.random.default_rng(view).normal(0, 0.01, (48, 52)).astype(np.float32)

    with pytest.raises(ValueError, match="radiographs of a full scan: expected a sample, found only air"):
        find_outline(air, SCANNER, ANGLES, None)
