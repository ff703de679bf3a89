"""Noise propagated to the equations' right-hand side, against draws of it."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pdvc.equations import linearise
from pdvc.measurement import ResidualTests
from pdvc.noise import ImageNoise, Noise, Propagated, known_from_residual, propagate, separate
from pdvc.prior import Prior
from pdvc.projection import sensitivities
from pdvc.radiographs import smoothed
from pdvc.rays import ray_vectors
from pdvc.residual_tests import residual_tests
from pdvc.sensitivity_sums import Pile, Rows
from pdvc.systematic import Systematic
from pdvc.uncertainty import posterior
from tests.small_case import ANGLES, SCANNER, SECTIONS, SHAPE, STEPS, VOXEL_MM, motion, radiographs, time_functions

UNKNOWNS = SECTIONS.shape[0] * SECTIONS.shape[1]
RAYS = ray_vectors(SCANNER, ANGLES).stacked()
AMPLITUDE = np.stack([motion(SECTIONS, seed, 0.6) for seed in range(STEPS)])
VIEW_RAD = ANGLES[: STEPS // 2] + 0.1
"""The steps turn twice: each view is met twice."""


def systematic(*, alone: bool = False) -> Systematic:
    """Return nothing to subtract; each step looks along one view alone, or along some views around its direction."""
    # crowded views elsewhere make those of the steps the ones that are far apart
    crowd = np.mean(ANGLES[4:6]) + np.linspace(0, 1e-3, len(VIEW_RAD) + 3)
    return Systematic(
        left=lambda view: np.zeros(SHAPE, dtype=np.float32),
        view_rad=np.concatenate([VIEW_RAD, crowd]) if alone else VIEW_RAD,
        step_rad=ANGLES,
        corner=(0, 0),
        shape=SHAPE,
        detector=SHAPE,
        width_rad=1e-4 if alone else 0.3,
    )


ALONE, AROUND = systematic(alone=True), systematic()


@cache
def uneven(seed: int, level: float) -> ImageNoise:
    """Return a noise that differs from row to row and column to column, and from image to image.

    Kept, as every draw asks for that of every image.
    """
    row, column = np.indices(SHAPE) / 40
    variance = level**2 * (1 + 0.5 * np.sin(seed + 3 * row) * np.cos(2 * column))
    slope = 1 + 0.3 * np.cos(seed + row + column)
    return ImageNoise(variance=variance.astype(np.float32), slope=slope.astype(np.float32))


def noise(steps: float = 1e-2, views: float = 1e-2, flat: float = 1e-2, smooth_px: float = 0.0) -> Noise:
    return Noise(
        step=lambda t: uneven(t, steps),
        view=lambda v: uneven(100 + v, views),
        flat=uneven(1000, flat).variance,
        smooth_px=smooth_px,
    )


def drawn(draw: int, sources: Noise, places: Systematic) -> np.ndarray:
    """Return the noise (step, row, column) of the residual that one draw of all images leaves."""
    rng = np.random.default_rng(draw)

    def of(image: ImageNoise) -> np.ndarray:
        return np.sqrt(image.variance) * rng.normal(size=SHAPE)

    def seen(image: ImageNoise, own: np.ndarray) -> np.ndarray:
        return smoothed((own + image.slope * flat).astype(np.float32), sources.smooth_px)

    flat = np.sqrt(sources.flat) * rng.normal(size=SHAPE)
    count = range(len(places.view_rad))
    views = [seen(sources.view(v), of(sources.view(v))).astype(np.float32) for v in count]
    steps = np.stack([seen(sources.step(t), of(sources.step(t))) for t in range(STEPS)])
    whole = slice(0, STEPS)
    moved = replace(places, left=lambda v: views[v]).registered(whole, RAYS, SECTIONS, AMPLITUDE, VOXEL_MM)
    return moved - steps


def vectors(sources: Noise, places: Systematic, draws: int) -> np.ndarray:
    """Return c (draw, step, unknown) of draws of noise, by the sensitivities that the equations are made of."""
    images = radiographs(SECTIONS, AMPLITUDE)
    fields = sensitivities(images.volume, images.rays, SHAPE, SECTIONS, AMPLITUDE, voxel_mm=VOXEL_MM)
    width = fields[0].values.shape[1]
    whole = np.zeros((STEPS, *SHAPE, UNKNOWNS + width))
    for t, field in enumerate(fields):
        for row, first in enumerate(field.first):
            at = first * SECTIONS.shape[1]
            whole[t, row, :, at : at + width] = field.values[row].T
    dense = whole[..., :UNKNOWNS].reshape(STEPS, -1, UNKNOWNS)
    residuals = np.stack([drawn(k, sources, places) for k in range(draws)]).reshape(draws, STEPS, -1)
    return np.einsum("tpn,dtp->dtn", dense, residuals, optimize=True)


def propagated(sources: Noise, places: Systematic, functions: np.ndarray | None = None) -> Propagated:
    images = radiographs(SECTIONS, AMPLITUDE)
    chosen = time_functions() if functions is None else functions
    return propagate(images, places, SECTIONS, AMPLITUDE, chosen, sources)


def whitened(draws: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the variance of draws (draw, unknown) in each direction of a covariance, over what that predicts.

    Directions that hardly any pixel sees are left out, as their draws are single precision's.
    """
    values, directions = np.linalg.eigh(covariance)
    strong = values > 1e-7 * values.max()
    return np.asarray(((draws @ directions[:, strong]) ** 2).mean(axis=0) / values[strong])


def outcome(sources: Noise, places: Systematic, left: np.ndarray) -> ResidualTests:
    """Return the tests of a residual, less an edge to which noise moves from off the detector."""
    weight = np.zeros((1, *SHAPE), dtype=np.float32)
    weight[:, 5:-5, 5:-5] = 1
    images = replace(radiographs(SECTIONS, AMPLITUDE), weight=weight)
    unknowns = len(time_functions()) * UNKNOWNS
    residual = left.astype(np.float32)
    return residual_tests(images, places, SECTIONS, AMPLITUDE, sources, residual, unknowns)


def test_steps_look_along_one_view_alone_or_along_several():
    """What the cases below are about: views that two steps share in part, others in whole."""
    for places, fewest, most in ((ALONE, 1, 1), (AROUND, 2, 5)):
        sight = places.looked_along(slice(None), RAYS, SECTIONS, AMPLITUDE, VOXEL_MM)
        shares = [sight.of_step(t) for t in range(STEPS)]
        assert {len(share) for share in shares} <= set(range(fewest, most + 1))
        assert len(set().union(*shares)) < STEPS
    assert max(max(share.values()) for share in shares) < 0.8


def test_sensitivities_are_what_the_equations_are_made_of():
    images = radiographs(SECTIONS, np.zeros_like(AMPLITUDE))
    equations = linearise(images, SECTIONS, AMPLITUDE)
    one = Noise(
        step=lambda t: ImageNoise(variance=np.ones(SHAPE, np.float32), slope=np.zeros(SHAPE, np.float32)),
        view=lambda v: ImageNoise(variance=np.zeros(SHAPE, np.float32), slope=np.zeros(SHAPE, np.float32)),
        flat=np.zeros(SHAPE, dtype=np.float32),
    )
    found = propagated(one, ALONE, np.eye(STEPS)).covariance
    np.testing.assert_allclose(found, equations.matrix, rtol=1e-4, atol=1e-5 * np.abs(equations.matrix).max())


@pytest.mark.parametrize(
    ("sources", "places"),
    [
        (noise(views=0, flat=0), ALONE),
        (noise(steps=0, flat=0), ALONE),
        (noise(steps=0, flat=0), AROUND),
        (noise(steps=0, views=0), AROUND),
        (noise(), ALONE),
        (noise(smooth_px=0.8), AROUND),
    ],
    ids=["radiographs", "one view", "several views", "flats", "all", "all, filtered"],
)
def test_the_covariance_is_that_of_draws(sources, places):
    """Of all steps together, and of each by itself."""
    found, draws = propagated(sources, places), 160
    scattered = vectors(sources, places, draws)
    joint = np.einsum("ft,dtn->dfn", time_functions(), scattered).reshape(draws, -1)
    # whitened by what is predicted, every direction has variance one: known to 11 % each from 160 draws
    variances = whitened(joint, found.covariance)
    assert len(variances) > 60
    # the filter is propagated as in a parallel beam, and cut off by the detector's edge
    plain = sources.smooth_px == 0
    assert abs(variances.mean() - 1) < (0.03 if plain else 0.08)
    assert np.abs(variances - 1).max() < (0.45 if plain else 0.7)
    own = [whitened(scattered[:, t], sum(found.own.values())[t]) for t in range(STEPS)]
    assert abs(np.mean(np.concatenate(own)) - 1) < (0.03 if plain else 0.08)
    # of each step some twenty directions
    assert np.abs([each.mean() - 1 for each in own]).max() < (0.12 if plain else 0.2)


def test_each_source_is_told_by_itself_of_each_step_and_of_all():
    whole = propagated(noise(), AROUND)
    assert set(whole.parts) == {*whole.own, "systematic"} == {"radiographs", "views", "flats", "systematic"}
    for name, levels in {"radiographs": (1, 0, 0), "views": (0, 1, 0), "flats": (0, 0, 1)}.items():
        alone = propagated(noise(*(1e-2 * level for level in levels)), AROUND)
        for found, expected in ((whole.parts, alone.covariance), (whole.own, sum(alone.own.values()))):
            np.testing.assert_allclose(found[name], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_steps_that_nothing_joins_have_the_blocks_of_the_whole_covariance():
    sources, places, one = noise(), AROUND, np.eye(STEPS)
    found = propagated(sources, places, 2 * one[:2])
    apart = found.covariance
    joined = propagated(sources, places, 2 * np.stack([one[0], one[0] + one[1]])).covariance
    np.testing.assert_allclose(apart, 4 * sum(found.own.values())[:2], rtol=1e-6)
    assert apart.shape == (2, UNKNOWNS, UNKNOWNS)
    np.testing.assert_allclose(joined[:UNKNOWNS, :UNKNOWNS], apart[0], rtol=1e-4, atol=1e-6 * apart[0].max())
    unjoined = joined[UNKNOWNS:, UNKNOWNS:] - apart.sum(axis=0)
    # flats are shared by all steps, a view by neighbours: two steps together are more than the sum of their blocks
    assert np.abs(unjoined).max() > 1e-3 * apart.max()


def test_residuals_that_are_noise_pass_the_tests_of_noise():
    sources, places = noise(flat=5e-3, smooth_px=0.8), AROUND
    tests = outcome(sources, places, drawn(3, sources, places))
    assert tests.chi2_reduced == pytest.approx(1, abs=0.06)
    assert tests.lag1_row == pytest.approx(tests.lag1_row_expected, abs=0.05)
    assert tests.lag1_column == pytest.approx(tests.lag1_column_expected, abs=0.05)
    assert tests.lag1_row > 0.2


def test_noise_of_views_alone_is_as_alike_in_neighbouring_pixels_as_interpolation_makes_it():
    """White in the view, it is so no more where it is taken between pixels; flats are the same at the place itself."""
    for sources in (noise(steps=0, flat=0), noise(steps=1e-3, views=1e-3)):
        tests = outcome(sources, ALONE, drawn(4, sources, ALONE))
        assert tests.chi2_reduced == pytest.approx(1, abs=0.06)
        assert tests.lag1_row == pytest.approx(tests.lag1_row_expected, abs=0.03)
        assert tests.lag1_column == pytest.approx(tests.lag1_column_expected, abs=0.03)


def test_residuals_that_are_more_than_noise_do_not():
    sources, places = noise(), ALONE
    tests = outcome(sources, places, drawn(3, sources, places) + 0.03 * np.sin(np.arange(SHAPE[1]) / 3))
    assert tests.chi2_reduced > 1.5
    assert tests.lag1_column > tests.lag1_column_expected + 0.2


@pytest.mark.parametrize("smooth_px", [0.0, 0.7])
def test_an_unknown_noise_is_taken_from_the_residual(smooth_px):
    """As large as the residual is where views are registered to steps, between pixels and between views."""
    assumed = known_from_residual(0.02, SHAPE, SHAPE, smooth_px)
    left = np.concatenate([drawn(k, assumed, AROUND) for k in range(4)])
    assert np.sqrt((left**2).mean()) == pytest.approx(0.02, rel=0.1)
    assert not assumed.flat.any()
    assert not assumed.step(0).slope.any()


def test_interpolation_by_keys_leaves_57_70ths_of_the_variance_on_average():
    """The square of the kernel has that integral along each axis; a Gaussian mean over views leaves 1 / sqrt(pi)."""
    assumed = known_from_residual(1.0, SHAPE, SHAPE, 0.0)
    assert assumed.view(0).variance[0, 0] == pytest.approx(1 / (1 + (57 / 70) ** 2 / np.sqrt(np.pi)), rel=2e-3)


@pytest.mark.parametrize(("functions", "apart"), [(np.eye(4), True), (np.ones((1, 4)), False), (np.eye(4)[:2], True)])
def test_functions_that_share_no_step(functions, apart):
    assert separate(functions) is apart


def test_more_noise_makes_every_amplitude_less_known():
    images = radiographs(SECTIONS, AMPLITUDE)
    equations = linearise(images, SECTIONS, AMPLITUDE)
    believed = Prior(deviation_voxel=np.full(SECTIONS.shape, 30.0))
    quiet, loud = (
        posterior(
            equations, time_functions(), believed, {"all": propagated(noise(*levels), AROUND).covariance}
        ).deviation
        for levels in ((1e-3, 1e-3, 1e-3), (1e-3, 2e-3, 1e-3))
    )
    assert (loud > quiet).all()


def test_the_sources_add_up_to_the_whole_covariance():
    images = radiographs(SECTIONS, AMPLITUDE)
    equations = replace(linearise(images, SECTIONS, AMPLITUDE), chi2=np.full(STEPS, SHAPE[0] * SHAPE[1] * 1e-4))
    believed = Prior(deviation_voxel=np.full(SECTIONS.shape, 0.05))
    found = propagated(noise(), AROUND)
    known = posterior(equations, time_functions(), believed, found.parts)
    whole, sources = known.covariance, known.by_source
    expected = posterior(equations, time_functions(), believed, {"all": found.covariance}).covariance
    np.testing.assert_allclose(whole, expected, rtol=1e-6, atol=1e-9 * whole.max())
    assert set(sources) == {"radiographs", "views", "flats", "prior", "systematic"}
    np.testing.assert_allclose(sum(sources.values()), whole, rtol=1e-6, atol=1e-9 * whole.max())
    # each of them matters here, so that none is lost unseen
    assert all(np.trace(part) > 0.02 * np.trace(whole) for name, part in sources.items() if name != "systematic")


class LastFirst(Executor):
    """A pool of which the last is ready first."""

    def map(self, make, *asked, **others):
        return reversed([make(*each) for each in reversed(list(zip(*asked, strict=True)))])


def test_a_pile_has_the_same_bits_whichever_block_a_pool_begins_with():
    functions, found = np.random.default_rng(2).normal(size=(2, 3)), []
    for pool in (None, LastFirst()):
        rng = np.random.default_rng(3)
        pile = Pile(functions)
        for step in range(3):
            # from row to row far larger, so that sums in double precision are rounded
            values = (rng.normal(size=(64, 6, 7)) * np.geomspace(1, 1e9, 64)[:, None, None]).astype(np.float32)
            parts = [Rows(values=part, first=0) for part in values.reshape(4, 16, 6, 7)]
            # and no ray meets the sample in the last band
            nothing = Rows(values=np.zeros((16, 0, 7), dtype=np.float32), first=0)
            pile.add(step, range(5), [*parts, nothing].__getitem__, pool)
        found.append(pile.covariance(np.full((80, 7), 0.1, dtype=np.float32), 6))
    np.testing.assert_array_equal(found[0], found[1])
