"""The protocol: what each stage is told."""

from __future__ import annotations

from pdvc.options import StageOptions
from pdvc.pgd import Pgd
from pdvc.protocol import measure
from validation.testing.small_cases import SmallExperiment, small_scenario


def test_the_last_stage_ends_at_the_noise_but_not_the_rigid_one_that_it_starts_from():
    """A sample at rest leaves noise alone: no mode of a section is worth its place, as Algorithm 1 says.

    The rigid stage sees filtered, coarse radiographs and is meant to take all of the rigid motion: it goes on as long
    as the residual falls.
    """
    scenario = small_scenario({"motion.ingredients": [], "detector.photons_per_pixel": 500.0})
    small = SmallExperiment(scenario)
    options = small.options.model_copy(
        update={
            "rigid": (StageOptions(scale=2, solver=Pgd(most_modes=3)),),
            "deformation": (StageOptions(scale=1, solver=Pgd(most_modes=3)),),
        }
    )
    rigid, sections = measure(small.experiment, options).fit.stages
    assert "residual at noise level" in sections.stop_reason
    assert len(sections.temporal) == 0
    assert "noise level" not in rigid.stop_reason
    assert len(rigid.temporal) > 0
