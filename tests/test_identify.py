"""Identification: areas, what sections see of a law, and parameters from equations that are made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pdvc.equations import Equations, joined
from pdvc.experiment import Series
from pdvc.history import Angle, time_basis
from pdvc.identify.beam import elongation_mm
from pdvc.identify.carried import Carrier, shift_of
from pdvc.identify.choice import Choices, choices
from pdvc.identify.crosshead import from_crosshead
from pdvc.identify.expected import assumed, slower_near_yield, unloading
from pdvc.identify.integrated import Radiographs, expected_covariance, free_motion, integrated, log_evidence
from pdvc.identify.laws import Ludwik, Swift, law_named
from pdvc.identify.model import Model, neck_ramps
from pdvc.identify.outline import areas_of, matrix_level, outline_of, profile_of
from pdvc.identify.two_step import seen_motions, unweighted, weighted, zeroed
from pdvc.noise import Propagated
from pdvc.prior import Prior
from pdvc.sections import CONTRACTION, RIGID, TRANSLATION_Z, SectionBasis
from pdvc.smoother import Smoother, slow_functions
from pdvc.solution import Problem
from pdvc.volume import Grid, Volume, hull_of
from simulator.kinematics import BeamMotion

BASIS = SectionBasis(height_mm=np.linspace(-2.0, 2.0, 7), radius_mm=0.6, motions=(*RIGID, CONTRACTION))
STEPS, LOADED = 44, 10
FORCE_N = 250 + 420 * np.clip((np.arange(STEPS) - LOADED) / (STEPS - 1 - LOADED), 0, None) ** 0.7
TRUE = Ludwik(young_MPa=168e3, yield_MPa=300.0, hardening_MPa=579.5, exponent=0.2211)
VOXEL_MM = 0.04


def _profile():
    z = np.linspace(-3.0, 3.0, 101)
    return profile_of(z, 1.15 + 0.1 * z**2, heights=101)


def _model(law=None, shift_mm=None, neck=True, noise_N=0.5):
    shift = np.zeros(STEPS) if shift_mm is None else shift_mm
    profile = _profile()
    return Model(
        law=law or Ludwik(),
        profile=profile,
        area_deviation=0.002,
        reference_N=250.0,
        force_noise_N=noise_N,
        carrier=Carrier(basis=BASIS, voxel_mm=VOXEL_MM, height_mm=profile.height_mm, shift_mm=shift),
        neck=neck_ramps(STEPS, LOADED) if neck else np.zeros((0, STEPS)),
    )


def _truth(model):
    vector = model.unknowns.mean.copy()
    vector[: model.unknowns.of_law] = np.log(list(TRUE.values().values()))
    return vector


def _cylinder(voxel_mm, radius_mm, dent=False):
    grid = Grid.around(np.array([-1.0, -1.0, -1.5]), np.array([1.1, 1.0, 1.5]), voxel_mm)
    z, y, x = (grid.origin_mm[2 - k] + voxel_mm * np.arange(grid.shape[k]) for k in range(3))
    away = np.hypot(x - 0.1, y[:, None])
    disc = np.clip((radius_mm - away) / voxel_mm + 0.5, 0, 1)
    values = np.repeat(0.3 * disc[None], len(z), axis=0).astype(np.float32)
    if dent:
        hole = np.hypot(np.hypot(x - 0.1 - radius_mm, y[:, None])[None], z[:, None, None]) < 0.12
        values[hole] = 0.0
    return Volume(values=values, grid=grid, hull=hull_of(values > 0, grid, 4))


@pytest.mark.parametrize("dent", [False, True])
def test_the_area_of_a_cylinder_is_found_with_and_without_a_dent(dent):
    outline = outline_of(_cylinder(0.04, 0.6, dent), -1.3, 1.3)
    area, perimeter = areas_of(outline.radius_mm)
    np.testing.assert_allclose(area, np.pi * 0.36, rtol=5e-3)
    np.testing.assert_allclose(perimeter, 2 * np.pi * 0.6, rtol=5e-3)
    assert outline.height_mm[0] == pytest.approx(-1.3, abs=0.05)
    assert matrix_level(_cylinder(0.04, 0.6).values) == pytest.approx(0.3, rel=0.02)


def test_a_volume_of_air_has_no_outline():
    with pytest.raises(ValueError, match=r"volume: expected a sample between 5 and 6 mm, found none"):
        outline_of(_cylinder(0.08, 0.6), 5.0, 6.0)


def test_sections_see_a_uniform_stretch_as_it_is():
    """U = e Z and z = Z + d + U: u_z = e (z - d) / (1 + e) in what moves beyond d, and (1 - 1/s) across."""
    shift = np.full(1, 0.13)
    z = np.linspace(-3.5, 3.5, 301)
    carrier = Carrier(basis=BASIS, voxel_mm=VOXEL_MM, height_mm=z, shift_mm=shift)
    strain, stretch = np.full((1, 301), 0.05), np.full((1, 301), 0.976)
    found = carrier.amplitude(strain, stretch)[0]
    axial = BASIS.motions.index(TRANSLATION_Z)
    np.testing.assert_allclose(found[:, axial] * VOXEL_MM, 0.05 / 1.05 * (BASIS.height_mm - 0.13), atol=1e-8)
    across = found[:, BASIS.motions.index(CONTRACTION)] * VOXEL_MM
    np.testing.assert_allclose(across, (1 - 1 / 0.976) * 0.6, atol=1e-12)
    whole = found[None].copy()
    whole[0, :, axial] += 0.13 / VOXEL_MM
    np.testing.assert_allclose(shift_of(BASIS, whole, VOXEL_MM), shift, atol=1e-9)


def test_sections_see_what_the_simulators_beam_does():
    """Displacements on the axis, of an independent code, at points between the sections."""
    model = _model()
    vector = _truth(model)
    elastic, plastic = model.strains(vector, FORCE_N)
    z, strain = model.profile.height_mm, elastic + plastic
    grown = np.concatenate([np.zeros((STEPS, 1)), np.cumsum((strain[:, 1:] + strain[:, :-1]) / 2, axis=1)], axis=1)
    moved = np.zeros((STEPS, len(z), 3))
    moved[..., 2] = (grown - grown[:, [50]]) * (z[1] - z[0])
    motion = BeamMotion(
        knot_mm=z, displacement_mm=moved, rotation_rad=np.zeros_like(moved), stretch=np.ones((STEPS, len(z)))
    )
    points = np.zeros((9, 3))
    points[:, 2] = np.linspace(-1.8, 1.8, 9)
    now = motion.forward(points, STEPS - 1)
    found = BASIS.displacement(model.amplitude(vector, FORCE_N)[-1].reshape(BASIS.shape), now)[:, 2]
    # what hats cannot follow between sections
    np.testing.assert_allclose(found * VOXEL_MM, (now - points)[:, 2], atol=1.5e-3)


def test_sensitivities_are_the_slopes_of_the_amplitudes():
    model = _model()
    vector = _truth(model)
    vector[-1] = 0.004
    linear = model.linear(vector, FORCE_N)
    np.testing.assert_array_equal(linear.amplitude, model.amplitude(vector, FORCE_N))
    for k, deviation in enumerate(model.unknowns.deviation):
        step = np.zeros(len(vector))
        step[k] = 1e-4 * deviation
        slope = (model.amplitude(vector + step, FORCE_N) - model.amplitude(vector - step, FORCE_N)) / (2 * step[k])
        scale = np.abs(slope).max()
        np.testing.assert_allclose(linear.slopes[..., k], slope, atol=2e-3 * scale, err_msg=model.unknowns.names[k])
    of_force = (model.amplitude(vector, FORCE_N + 1e-3) - model.amplitude(vector, FORCE_N - 1e-3)) / 2e-3
    np.testing.assert_allclose(linear.by_force, of_force, atol=2e-3 * np.abs(of_force).max())


def test_a_neck_grows_in_the_last_quarter():
    ramps = neck_ramps(STEPS, LOADED)
    assert ramps.shape == (3, STEPS)
    assert not ramps[:, : STEPS - 1 - round(0.25 * (STEPS - 1 - LOADED)) - 1].any()
    np.testing.assert_array_equal(ramps[:, -1], 1.0)
    assert (np.diff(ramps, axis=1) >= 0).all()


def _radiographs(model, vector, rng, *, noise_N=0.5, noise_voxel=0.01, law_only=False):
    """Return made-up equations of a motion by a law, and a wandering of the whole, with the forces recorded."""
    steps, unknowns = STEPS, int(np.prod(BASIS.shape))
    axial = BASIS.motions.index(TRANSLATION_Z)
    motion = model.amplitude(vector, FORCE_N).reshape(steps, *BASIS.shape)
    if not law_only:
        motion[..., axial] += np.cumsum(rng.normal(0, 0.02, steps))[:, None]
    true = motion.reshape(steps, unknowns)
    root = rng.normal(size=(steps, unknowns, unknowns)) / np.sqrt(unknowns) + 2 * np.eye(unknowns)
    matrix = root @ root.transpose(0, 2, 1)
    own = matrix * noise_voxel**2
    about = true + 0.02 * rng.normal(size=true.shape)
    noise = noise_voxel * np.einsum("tnm,tm->tn", root, rng.normal(size=true.shape))
    angle = 2 * np.pi * np.arange(steps) / 15
    recorded = FORCE_N + noise_N * rng.normal(size=steps)
    series = Series(
        counts=np.zeros((steps, 0, 0), dtype=np.uint16),
        angle_rad=angle,
        time_s=2.0 * np.arange(steps),
        force_N=recorded,
    )
    problem = Problem(
        linearise=lambda _: None,
        basis=BASIS,
        series=series,
        time_functions=np.eye(steps) * np.sqrt(steps),
        start=about.reshape(steps, *BASIS.shape) / np.sqrt(steps),
        prior=Prior(deviation_voxel=np.full(BASIS.shape, 30.0)),
        noise_rms=None,
    )
    solver, slow = Smoother(), slow_functions(problem)
    trend = time_basis((Angle(),), series)
    equations = Equations(
        matrix=matrix,
        vector=np.einsum("tnm,tm->tn", matrix, true - about) + noise,
        chi2=np.ones(steps),
        residual=np.zeros((steps, 1, 1), dtype=np.float32),
        pixels=1,
    )
    found = Radiographs(
        problem=problem,
        spaces=tuple(solver.space(BASIS, series.time_s, trend, 30.0, modes) for modes in (5, None)),
        amplitude=about,
        equations=equations,
        noise=Propagated(
            parts={"radiographs": joined(own, slow)}, own={"radiographs": own}, systematic=np.zeros((steps, unknowns))
        ),
        slow=slow,
    )
    return found, recorded


def test_hardly_any_noise_gives_the_law_back():
    model = _model(noise_N=1e-3)
    vector = _truth(model)
    radiographs, force = _radiographs(model, vector, np.random.default_rng(0), noise_N=1e-3, noise_voxel=1e-4)
    found = integrated(model, force, vector + 0.1 * model.unknowns.deviation, radiographs)
    law = slice(0, model.unknowns.of_law)
    # all areas together are known to 0.2 %, and stresses no better
    np.testing.assert_allclose(found.estimate.vector[law], vector[law], atol=4e-3)
    np.testing.assert_allclose(found.of_law, model.amplitude(vector, FORCE_N), atol=5e-3)


def test_intervals_hold_the_truth_and_the_force_is_found_better_than_recorded():
    model = _model()
    vector = _truth(model)
    rng = np.random.default_rng(1)
    z, better = [], []
    for _ in range(4):
        radiographs, force = _radiographs(model, vector, rng)
        found = integrated(model, force, vector, radiographs)
        deviation = np.sqrt(np.diag(found.estimate.covariance))
        z.append(((found.estimate.vector - vector) / deviation)[:4])
        better.append(np.std(found.force_N - FORCE_N) / np.std(force - FORCE_N))
        assert set(found.by_source) >= {"radiographs", "force", "process", "systematic"}
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.6
    assert np.mean(better) < 0.98


def test_two_steps_find_the_law_of_a_motion_as_it_is():
    model = _model(noise_N=1e-2)
    vector = _truth(model)
    observed = np.ones(len(BASIS.height_mm), dtype=bool)
    seen = seen_motions(BASIS, observed)
    amplitude = model.amplitude(vector, FORCE_N) + 0.3 * np.ones(np.prod(BASIS.shape)) * (seen_axial())
    plain = unweighted(model, amplitude, seen, FORCE_N, len(observed))
    # the sample's shift is free, and does not count
    np.testing.assert_allclose(plain.vector[:4], vector[:4], atol=2e-3)
    covariance = np.repeat(1e-4 * np.eye(np.prod(BASIS.shape))[None], STEPS, axis=0)
    found = weighted(model, amplitude, covariance, seen, FORCE_N, len(observed), plain.vector)
    np.testing.assert_allclose(found.vector[:4], vector[:4], atol=2e-2)
    np.testing.assert_allclose(zeroed(amplitude, LOADED)[:LOADED].mean(axis=0), 0, atol=1e-12)


def seen_axial():
    axial = np.zeros(BASIS.shape)
    axial[:, BASIS.motions.index(TRANSLATION_Z)] = 1
    return axial.ravel()


def test_force_and_crosshead_find_law_and_machine_together():
    model = _model(noise_N=0.01, neck=False)
    vector = _truth(model)
    elastic, plastic = model.strains(vector, FORCE_N)
    stroke = 3e-4 * (FORCE_N - 250) + elongation_mm(elastic + plastic, model.profile)
    found = from_crosshead(model, FORCE_N, stroke, LOADED, model.unknowns.mean)
    np.testing.assert_allclose(found.vector[1:4], vector[1:4], atol=0.05)
    # Young's modulus and the machine's compliance are one: told by their deviations
    assert np.sqrt(found.covariance[0, 0]) > 0.3


def test_evidence_prefers_the_law_that_made_the_motion():
    model = _model()
    vector = _truth(model)
    radiographs, force = _radiographs(model, vector, np.random.default_rng(2))
    found = integrated(model, force, vector, radiographs)
    own = log_evidence(model, force, found.estimate.vector, radiographs, found.deviations)
    linear = replace(model, law=law_named("linear").started_for(600.0))
    seen = seen_motions(BASIS, np.ones(len(BASIS.height_mm), dtype=bool))
    start = unweighted(linear, found.amplitude, seen, force, len(BASIS.height_mm)).vector
    assert log_evidence(linear, force, start, radiographs, found.deviations) < own - 10


def test_without_a_law_the_motion_is_found_too():
    model = _model()
    radiographs, _ = _radiographs(model, _truth(model), np.random.default_rng(3))
    amplitude, covariance, deviations = free_motion(radiographs)
    again, _, kept = free_motion(radiographs, deviations)
    assert kept is deviations
    np.testing.assert_array_equal(again, amplitude)
    assert (np.einsum("tnn->tn", covariance) > 0).all()


def test_unknowns_in_their_own_units():
    unknowns = _model(law=Swift()).unknowns
    natural = unknowns.natural(unknowns.mean)
    np.testing.assert_allclose(natural[: unknowns.of_law], list(Swift().values().values()))
    assert unknowns.names[unknowns.of_law :] == (
        "area_share", "poisson_elastic", "poisson_plastic", "neck_1", "neck_2", "neck_3",
    )  # fmt: skip
    assert unknowns.law(Swift(), unknowns.mean).values() == pytest.approx(Swift().values())


def test_force_programmes_keep_their_steps_and_their_ends():
    unloaded_twice = unloading(FORCE_N, LOADED)
    slow = slower_near_yield(FORCE_N, LOADED, 350.0)
    for programme in (unloaded_twice, slow):
        assert len(programme) == STEPS
        assert programme[-1] == pytest.approx(FORCE_N[-1])
        np.testing.assert_array_equal(programme[:LOADED], FORCE_N[:LOADED])
    assert (unloaded_twice[LOADED:] < 255).sum() >= 2
    near = np.abs(slow[LOADED:] - 350) <= 0.15 * 350 + 1e-9
    assert near.mean() >= 0.5
    np.testing.assert_array_equal(slower_near_yield(FORCE_N, LOADED, 5000.0), FORCE_N)


def test_unloading_shows_young_and_less_noise_shows_more():
    model = replace(_model(), law=TRUE)
    radiographs, _ = _radiographs(model, _truth(model), np.random.default_rng(4))
    known = assumed(radiographs.spaces[1])
    planned, cycled = (
        np.sqrt(np.diag(expected_covariance(model, force, radiographs, known)))
        for force in (FORCE_N, unloading(FORCE_N, LOADED))
    )
    assert cycled[0] < planned[0]
    quiet = replace(model, force_noise_N=0.1)
    assert (np.sqrt(np.diag(expected_covariance(quiet, FORCE_N, radiographs, known)))[:4] < planned[:4]).all()


def test_the_share_that_e_is_wrong_by_is_found_and_does_not_move_the_law():
    """c(t) + b w(t) of a known b: found within its deviation; without it as an unknown, the law would take it."""
    model = _model()
    vector = _truth(model)
    radiographs, force = _radiographs(model, vector, np.random.default_rng(6))
    rng = np.random.default_rng(7)
    unknowns = radiographs.amplitude.shape[1]
    # an e that pulls at the sections as a stretch would that grows with the load, and at all else a little
    pull = 0.1 * model.linear(vector, FORCE_N).slopes[..., 1] + 0.002 * rng.normal(size=(STEPS, unknowns))
    w = np.einsum("tnm,tm->tn", radiographs.equations.matrix, pull)
    wrong = replace(radiographs.equations, vector=radiographs.equations.vector - 1.5 * w)
    told = replace(radiographs, noise=replace(radiographs.noise, systematic=w), equations=wrong)
    untold = replace(told, noise=radiographs.noise)
    plain = integrated(model, force, vector, radiographs, rounds=1)
    found, misled = (integrated(model, force, vector, each, plain.deviations) for each in (told, untold))
    assert found.share[0] == pytest.approx(-1.5, abs=4 * found.share[1])
    assert found.share[1] < 0.5
    away = [abs(each.estimate.vector - plain.estimate.vector)[:4].max() for each in (found, misled)]
    assert away[0] < 0.3 * away[1]
    # what is not known of e is in the covariance, and told as its part
    assert 0 < found.by_source["systematic"][1, 1] < found.estimate.covariance[1, 1]
    assert (np.diag(found.estimate.covariance)[1:4] > np.diag(plain.estimate.covariance)[1:4]).all()


def test_made_up_tests_are_told_apart_where_laws_differ_much_and_the_one_asked_for_is_doubted():
    model = _model()
    vector = _truth(model)
    radiographs, force = _radiographs(model, vector, np.random.default_rng(8))
    found = integrated(model, force, vector, radiographs, rounds=1)
    observed = np.ones(len(BASIS.height_mm), dtype=bool)
    opened = SimpleNamespace(
        model=model,
        force_N=force,
        amplitude=radiographs.amplitude,
        loaded=LOADED,
        seen=seen_motions(BASIS, observed),
        sections=len(observed),
    )
    result = choices(opened, radiographs, found, ("linear", "ludwik"), 1)
    assert result.kinds == ("ludwik", "linear")
    np.testing.assert_array_equal(result.chosen(), [[1, 0], [0, 1]])
    assert result.error_rate() == 0
    np.testing.assert_array_equal(result.doubted(), [0, 1])


def test_wrong_choices_are_counted():
    evidence = np.array([[[0.0, -1.0], [-5.0, 0.0]], [[0.0, -1.0], [-9.0, 0.0]]])
    result = Choices(kinds=("ludwik", "swift"), log_evidence=evidence)
    np.testing.assert_array_equal(result.chosen(), [[1, 1], [1, 1]])
    assert result.error_rate() == 0.5
    np.testing.assert_array_equal(result.doubted(), [0.5, 0.5])
