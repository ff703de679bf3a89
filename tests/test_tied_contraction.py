"""The smoother expects sections to contract by half of their strain. Where they do not, its intervals have to hold.

The tiny experiment, with a sample that contracts by 0.3 of its strain, elastic and plastic.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
import pytest

from pdvc.experiment import Experiment, read_experiment
from pdvc.measurement import Measurement
from pdvc.options import MeasureOptions, StageOptions
from pdvc.protocol import measure
from pdvc.sections import CONTRACTION
from pdvc.smoother import Smoother
from pdvc.state_space import LEAST_VARIANCE, Deviations, StateSpace
from simulator.scanner import simulate
from simulator.scenario import Scenario
from simulator.truth import Truth, read_truth
from tests.tiny_scenarios import TINY
from validation.scoring.interval_calibration import true_coefficients
from validation.scoring.scores import score

RATIO = 0.3
LIGAMENT_MM = 1.5
"""Height above and below mid-plane in which the sample yields, mm."""


class WithoutSlack(StateSpace):
    """A state whose contraction is what the tie says, and no other: its own modes stay zero."""

    def bend_variance(self, deviations: Deviations) -> np.ndarray:
        return self._bound(super().bend_variance(deviations))

    def end_variance(self, deviations: Deviations) -> np.ndarray:
        return self._bound(super().end_variance(deviations))

    def _bound(self, variance: np.ndarray) -> np.ndarray:
        own = self.group == self.rigid + self.basis.motions.index(CONTRACTION)
        return np.where(own, LEAST_VARIANCE, variance)


@dataclass(frozen=True)
class Case:
    """What was measured, and the truth."""

    measured: Measurement
    truth: Truth

    def contraction_z(self, within_mm: float = np.inf) -> np.ndarray:
        """Return errors of the contraction over their stated deviations, (step, section), at load."""
        motion = self.measured.motion
        functions, voxel_mm = motion.time_functions, self.measured.recording.voxel_mm
        nearest, _ = true_coefficients(motion.basis, functions, voxel_mm, self.truth)
        error = motion.amplitude - np.einsum("ft,fjk->tjk", functions, nearest)
        kind, here = motion.basis.motions.index(CONTRACTION), np.abs(motion.basis.height_mm) < within_mm
        loaded = self.truth.force_N > self.truth.force_N[0]
        return (error / motion.amplitude_std)[loaded][:, here, kind]


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> tuple[Experiment, Truth]:
    values = tomllib.loads(TINY)
    values["seed"] = 1
    values["motion"] = {"tension": {"poisson_elastic": RATIO, "poisson_plastic": RATIO}}
    folder = tmp_path_factory.mktemp("tied")
    simulate(Scenario.parse(values, where="tied"), folder, workers=1)
    return read_experiment(folder), read_truth(folder)


@pytest.fixture(scope="module")
def measured(experiment: tuple[Experiment, Truth]) -> Callable[..., Case]:
    """Return how to measure the experiment with a tie, or none."""

    def with_tie(tie: float | str) -> Case:
        *coarse, last = MeasureOptions().deformation
        finest = StageOptions(scale=last.scale, solver=Smoother(contraction_of_strain=tie))
        options = MeasureOptions(deformation=(*coarse, finest))
        return Case(measure(experiment[0], options), experiment[1])

    return with_tie


@pytest.mark.parametrize("tie", [0.5, "none"])
def test_intervals_hold_whether_a_wrong_contraction_is_expected_or_none(measured, tie):
    case = measured(tie)
    found = score(case.measured, case.truth).calibration
    assert max(astuple(found.z_rms)) < 1.4
    assert min(astuple(found.coverage_95)) > 0.85
    z = case.contraction_z()
    assert np.sqrt(np.mean(z**2)) < 1.4
    assert np.mean(np.abs(z) < 1.96) > 0.85
    assert np.sqrt(np.mean(case.contraction_z(LIGAMENT_MM) ** 2)) < 2


def test_a_wrong_contraction_that_has_to_be_believed_is_noticed_by_its_intervals(measured, monkeypatch):
    monkeypatch.setattr("pdvc.smoother.StateSpace", WithoutSlack)
    z = measured(0.5).contraction_z(LIGAMENT_MM)
    assert np.sqrt(np.mean(z**2)) > 3
    assert np.mean(np.abs(z) < 1.96) < 0.6
