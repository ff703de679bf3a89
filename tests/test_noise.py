"""Noise propagated to the equations' right-hand side, against draws of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdvc.equations import linearise
from pdvc.noise import ImageNoise, Noise, known_from_residual, propagate, separate
from pdvc.prior import Prior
from pdvc.projection import sensitivities
from pdvc.radiographs import smoothed
from pdvc.rays import ray_vectors
from pdvc.systematic import Systematic
from pdvc.uncertainty import posterior
from tests.small_case import ANGLES, SCANNER, SECTIONS, SHAPE, STEPS, VOXEL_MM, motion, radiographs, time_functions

UNKNOWNS = SECTIONS.shape[0] * SECTIONS.shape[1]
VIEWS = STEPS // 2
"""The steps turn twice: each view is met twice."""
RAYS = ray_vectors(SCANNER, ANGLES).stacked()
AMPLITUDE = np.stack([motion(SECTIONS, seed, 0.6) for seed in range(STEPS)])


def systematic(share: float = 0.0) -> Systematic:
    first = np.arange(STEPS) % VIEWS
    return Systematic(
        fields=np.zeros((VIEWS, *SHAPE), dtype=np.float32),
        first=first,
        second=(first + (share > 0)) % VIEWS,
        share=np.full(STEPS, share),
        corner=(0, 0),
        shape=SHAPE,
    )


def uneven(seed: int, level: float) -> ImageNoise:
    """Return a noise that differs from row to row and column to column, and from image to image."""
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
    views = np.stack([seen(sources.view(v), of(sources.view(v))) for v in range(VIEWS)]).astype(np.float32)
    steps = np.stack([seen(sources.step(t), of(sources.step(t))) for t in range(STEPS)])
    moved = replace(places, fields=views).registered(slice(0, STEPS), RAYS, SECTIONS, AMPLITUDE, VOXEL_MM)
    return moved - steps


def right_hand_sides(sources: Noise, places: Systematic, draws: int) -> np.ndarray:
    """Return h (draw, function * unknown) of draws of noise, by the sensitivities that the equations are made of."""
    images = radiographs(SECTIONS, AMPLITUDE)
    fields = sensitivities(images.volume, images.rays, SHAPE, SECTIONS, AMPLITUDE, voxel_mm=VOXEL_MM)
    whole = np.zeros((STEPS, *SHAPE, UNKNOWNS + fields[0].values.shape[2]))
    for t, field in enumerate(fields):
        for row, first in enumerate(field.first):
            at = first * SECTIONS.shape[1]
            whole[t, row, :, at : at + field.values.shape[2]] = field.values[row]
    dense = whole[..., :UNKNOWNS].reshape(STEPS, -1, UNKNOWNS)
    residuals = np.stack([drawn(k, sources, places) for k in range(draws)]).reshape(draws, STEPS, -1)
    vectors = np.einsum("tpn,dtp->dtn", dense, residuals, optimize=True)
    return np.einsum("ft,dtn->dfn", time_functions(), vectors).reshape(draws, -1)


def propagated(sources: Noise, places: Systematic, functions: np.ndarray | None = None) -> np.ndarray:
    images = radiographs(SECTIONS, AMPLITUDE)
    chosen = time_functions() if functions is None else functions
    nothing = np.zeros_like(images.grey)
    return propagate(images, places, SECTIONS, AMPLITUDE, chosen, sources, nothing).covariance


def test_sensitivities_are_what_the_equations_are_made_of():
    images = radiographs(SECTIONS, np.zeros_like(AMPLITUDE))
    equations = linearise(images, SECTIONS, AMPLITUDE)
    one = Noise(
        step=lambda t: ImageNoise(variance=np.ones(SHAPE, np.float32), slope=np.zeros(SHAPE, np.float32)),
        view=lambda v: ImageNoise(variance=np.zeros(SHAPE, np.float32), slope=np.zeros(SHAPE, np.float32)),
        flat=np.zeros(SHAPE, dtype=np.float32),
    )
    alone = np.eye(STEPS)
    found = propagated(one, systematic(), alone)
    np.testing.assert_allclose(found, equations.matrix, rtol=1e-4, atol=1e-5 * np.abs(equations.matrix).max())


@pytest.mark.parametrize(
    ("sources", "share"),
    [
        (noise(views=0, flat=0), 0.0),
        (noise(steps=0, flat=0), 0.0),
        (noise(steps=0, flat=0), 0.3),
        (noise(steps=0, views=0), 0.3),
        (noise(), 0.0),
        (noise(smooth_px=0.8), 0.3),
    ],
    ids=["radiographs", "views", "between views", "flats", "all", "all, filtered"],
)
def test_the_covariance_is_that_of_draws(sources, share):
    places, draws = systematic(share), 250
    covariance = propagated(sources, places)
    scattered = right_hand_sides(sources, places, draws)
    # whitened by what is predicted, every direction has variance one: known to 9 % each from 250 draws; those that
    # hardly any pixel sees are left out, as their draws are single precision's
    values, vectors = np.linalg.eigh(covariance)
    strong = values > 1e-7 * values.max()
    white = scattered @ vectors[:, strong] / np.sqrt(values[strong])
    variances = (white**2).mean(axis=0)
    assert strong.sum() > 60
    # the filter is propagated as in a parallel beam, and cut off by the detector's edge
    assert abs(variances.mean() - 1) < (0.03 if sources.smooth_px == 0 else 0.08)
    assert np.abs(variances - 1).max() < (0.45 if sources.smooth_px == 0 else 0.7)


def test_steps_that_nothing_joins_have_the_blocks_of_the_whole_covariance():
    sources, places, one = noise(), systematic(0.3), np.eye(STEPS)
    apart = propagated(sources, places, 2 * one[:2])
    joined = propagated(sources, places, 2 * np.stack([one[0], one[0] + one[1]]))
    assert apart.shape == (2, UNKNOWNS, UNKNOWNS)
    np.testing.assert_allclose(joined[:UNKNOWNS, :UNKNOWNS], apart[0], rtol=1e-4, atol=1e-6 * apart[0].max())
    unjoined = joined[UNKNOWNS:, UNKNOWNS:] - apart.sum(axis=0)
    # flats are shared by all steps, a view by neighbours: two steps together are more than the sum of their blocks
    assert np.abs(unjoined).max() > 1e-3 * apart.max()


def test_residuals_that_are_noise_pass_the_tests_of_noise():
    sources, places = noise(flat=5e-3, smooth_px=0.8), systematic(0.3)
    images = radiographs(SECTIONS, AMPLITUDE)
    tests = propagate(
        images, places, SECTIONS, AMPLITUDE, time_functions(), sources, drawn(3, sources, places).astype(np.float32)
    ).tests
    assert tests.chi2_reduced == pytest.approx(1, abs=0.06)
    assert tests.lag1_row == pytest.approx(tests.lag1_row_expected, abs=0.05)
    assert tests.lag1_column == pytest.approx(tests.lag1_column_expected, abs=0.05)
    assert tests.lag1_row > 0.2


def test_residuals_that_are_more_than_noise_do_not():
    sources, places = noise(), systematic()
    images = radiographs(SECTIONS, AMPLITUDE)
    left = drawn(3, sources, places) + 0.03 * np.sin(np.arange(SHAPE[1]) / 3)
    tests = propagate(images, places, SECTIONS, AMPLITUDE, time_functions(), sources, left.astype(np.float32)).tests
    assert tests.chi2_reduced > 1.5
    assert tests.lag1_column > tests.lag1_column_expected + 0.2


def test_an_unknown_noise_is_taken_from_the_residual():
    assumed = known_from_residual(0.02, SHAPE, SHAPE, 0.7)
    rng = np.random.default_rng(2)
    step = smoothed((rng.normal(size=SHAPE) * np.sqrt(assumed.step(0).variance)).astype(np.float32), 0.7)
    view = smoothed((rng.normal(size=SHAPE) * np.sqrt(assumed.view(0).variance)).astype(np.float32), 0.7)
    # a view between pixels keeps 4/9 of its variance where its noise is white, more where it was filtered
    assert 0.02 * 0.9 < np.sqrt(step.var() + view.var() * 4 / 9) < 0.02 * 1.1


@pytest.mark.parametrize(("functions", "apart"), [(np.eye(4), True), (np.ones((1, 4)), False), (np.eye(4)[:2], True)])
def test_functions_that_share_no_step(functions, apart):
    assert separate(functions) is apart


def test_more_noise_makes_every_amplitude_less_known():
    images = radiographs(SECTIONS, AMPLITUDE)
    equations = linearise(images, SECTIONS, AMPLITUDE)
    believed = Prior(deviation_voxel=np.full(SECTIONS.shape, 30.0))
    quiet, loud = (
        posterior(equations, time_functions(), believed, {"all": propagated(noise(*levels), systematic())}).deviation
        for levels in ((1e-3, 1e-3, 1e-3), (1e-3, 2e-3, 1e-3))
    )
    assert (loud > quiet).all()


def test_the_sources_add_up_to_the_whole_covariance():
    images, nothing = radiographs(SECTIONS, AMPLITUDE), np.zeros((STEPS, *SHAPE), dtype=np.float32)
    equations = replace(linearise(images, SECTIONS, AMPLITUDE), chi2=np.full(STEPS, SHAPE[0] * SHAPE[1] * 1e-4))
    believed = Prior(deviation_voxel=np.full(SECTIONS.shape, 0.05))
    found = propagate(images, systematic(), SECTIONS, AMPLITUDE, time_functions(), noise(), nothing)
    known = posterior(equations, time_functions(), believed, found.parts)
    whole, sources = known.covariance, known.by_source
    expected = posterior(equations, time_functions(), believed, {"all": found.covariance}).covariance
    np.testing.assert_allclose(whole, expected, rtol=1e-6, atol=1e-9 * whole.max())
    assert set(sources) == {"radiographs", "views", "flats", "prior"}
    np.testing.assert_allclose(sum(sources.values()), whole, rtol=1e-6, atol=1e-9 * whole.max())
    # each of them matters here, so that none is lost unseen
    assert all(np.trace(part) > 0.02 * np.trace(whole) for part in sources.values())
