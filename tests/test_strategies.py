"""What strategies draw keeps its promises: valid, small, quick to see through, and plain once shrunk."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import find, given, settings
from hypothesis import strategies as st

from pdvc import gauss_newton
from pdvc.geometry import ConeBeam
from pdvc.prior import Prior
from pdvc.sections import SectionBasis
from pdvc.settings import SettingsError
from simulator.scenario import Scenario, course_of
from tests.laws import law
from validation.scoring.scores import score
from validation.testing.small_cases import ProjectedCase, SmallExperiment, small_scenario
from validation.testing.strategies import amplitudes, projected_cases, scenarios, section_bases, small_experiments

FEW = settings(max_examples=3, deadline=None, derandomize=True)
QUIET = settings(max_examples=100, deadline=None, derandomize=True, database=None)


@law(50)
@given(scenarios())
def test_scenarios_are_small_never_square_and_begin_with_a_turn_at_constant_load(scenario):
    plan, geometry = scenario.acquisition, scenario.geometry
    assert geometry.rows != geometry.columns
    assert geometry.rows * geometry.columns <= 84 * 48
    assert plan.reference_views <= 48
    assert 18 <= plan.test_steps <= 24
    force = course_of(scenario).history.force_N
    np.testing.assert_array_equal(force[: plan.steps_per_turn], scenario.loading.plateau_N)
    assert (np.diff(force[plan.steps_per_turn - 1 :]) > 0)[1:].all()


@law(50)
@given(scenarios())
def test_what_is_printed_of_an_experiment_makes_it_again(scenario):
    names = {"SmallExperiment": SmallExperiment, "small_scenario": small_scenario}
    assert eval(repr(SmallExperiment(scenario)), names).scenario == scenario


def test_scenarios_shrink_to_a_sample_at_rest_seen_by_the_smallest_detector():
    plain = find(scenarios(), lambda scenario: scenario.seed >= 3, settings=QUIET)
    assert plain.seed == 3
    assert plain.motion.ingredients == ()
    assert plain.geometry.columns == 42
    assert plain.geometry.roll_deg == plain.geometry.row_shift_mm == plain.acquisition.start_deg == 0


def test_projected_cases_shrink_to_no_motion_but_what_is_asked_for():
    plain = find(projected_cases(), lambda case: np.abs(case.coefficients).max() > 0.25, settings=QUIET)
    assert np.count_nonzero(plain.coefficients) <= 2
    assert len(plain.angle_rad) == 10
    assert len(plain.sections.height_mm) == 2


@FEW
@given(small_experiments())
def test_a_small_experiment_is_measured_to_a_fraction_of_a_voxel(small):
    assert small.experiment.test.counts.shape == (
        small.scenario.acquisition.test_steps,
        small.scenario.geometry.rows,
        small.scenario.geometry.columns,
    )
    scores = score(small.measurement, small.truth)
    # ten voxels of sample, nodules of three, 0.5 to 1 % of noise
    assert scores.error_voxel.across_beam < 0.1
    assert scores.error_voxel.vertical < 0.25
    assert small.experiment is small.experiment


@settings(max_examples=10, deadline=None, derandomize=True)
@given(projected_cases())
def test_the_equations_of_a_projected_case_ask_for_nothing_at_its_own_motion(case):
    at_truth = case.equations(case.amplitude)
    assert at_truth.rms < 1e-6 * case.images.grey.max()
    assert case.images.grey.std() > 0.1 * case.images.grey.max()
    used = case.images.grey.shape
    assert used[0] == len(case.angle_rad)
    assert used[1] > used[2]


def test_a_projected_case_is_solved_to_its_own_motion():
    scanner = ConeBeam(source_axis_mm=30.0, source_detector_mm=300.0, pixel_mm=0.5, rows=42, columns=32)
    sections = SectionBasis(height_mm=np.array([-0.9, 0.1, 0.8]), radius_mm=0.4)
    case = ProjectedCase(scanner, sections, np.linspace(0, 9, 12), np.full((4, 3, 6), 0.3))
    found = gauss_newton.solve(
        case.equations,
        case.time_functions,
        np.zeros_like(case.coefficients),
        Prior(deviation_voxel=np.full(case.sections.shape, 1e3)),
        most_passes=20,
        least_change_voxel=1e-5,
    )
    np.testing.assert_allclose(found.coefficients, 0.3, atol=1e-2)


@law(20)
@given(section_bases(), st.data())
def test_amplitudes_fit_their_basis_and_keep_their_bound(basis, data):
    alone = data.draw(amplitudes(basis, largest_voxel=0.5))
    together = data.draw(amplitudes(basis, steps=3))
    assert alone.shape == basis.shape
    assert together.shape == (3, *basis.shape)
    assert np.abs(alone).max() <= 0.5
    assert np.abs(together).max() <= 2


def test_a_misspelt_key_of_a_small_scenario_is_named():
    with pytest.raises(SettingsError, match=r"small_scenario: geometry\.row: unknown key"):
        small_scenario({"geometry.row": 60})
    assert small_scenario({"geometry.rows": 60, "seed": 3}) == Scenario.parse(
        {
            **small_scenario().model_dump(),
            "seed": 3,
            "geometry": {**small_scenario().geometry.model_dump(), "rows": 60},
        },
        where="test",
    )


def test_without_hypothesis_the_extra_to_install_is_named():
    code = "import sys; sys.modules['hypothesis'] = None; import validation.testing.strategies"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "pip install 'pdvc-bench[strategies]'" in result.stderr.splitlines()[-1]
