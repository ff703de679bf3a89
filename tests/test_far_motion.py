"""Motions that no sample makes: solvers try them, and they write where they may, and are never taken."""

from __future__ import annotations

import numpy as np
import pytest

from pdvc.projection import normal_equations, project
from tests.small_case import ONE, SECTIONS, SHAPE, VOXEL_MM, rays_at, textured

FAR = 5e4
"""Voxels: far beyond the source, whose distance is 600."""


@pytest.mark.parametrize("size", [100.0, 700.0, 1100.0, FAR, 1e30])
@pytest.mark.parametrize("kind", [0, 2, 4])
def test_a_motion_however_large_leaves_the_other_step_alone(kind, size):
    """A ray that was followed behind the source met sections that its band had no room for, and wrote beyond it."""
    amplitude = np.zeros((2, *SECTIONS.shape))
    amplitude[1, ::2, kind] = size
    rays = np.stack([rays_at(0.4), rays_at(2.0)])
    target = np.ones((2, *SHAPE), dtype=np.float32)
    found = normal_equations(textured(), rays, SECTIONS, amplitude, target, target[:1], voxel_mm=VOXEL_MM)
    alone = normal_equations(textured(), rays[:1], SECTIONS, amplitude[:1], target[:1], target[:1], voxel_mm=VOXEL_MM)
    assert np.isfinite(found.matrix).all()
    np.testing.assert_array_equal(found.matrix[0], alone.matrix[0])
    assert found.chi2[0] == alone.chi2[0]


def test_a_motion_out_of_the_scanner_is_as_bad_as_can_be_and_never_projected():
    amplitude = np.zeros((2, *ONE.shape))
    amplitude[1, 0, 0] = FAR
    rays = np.stack([rays_at(0.4), rays_at(2.0)])
    target = np.zeros((2, *SHAPE), dtype=np.float32)
    found = normal_equations(textured(), rays, ONE, amplitude, target, target[:1] + 1, voxel_mm=VOXEL_MM)
    assert np.isfinite(found.chi2).tolist() == [True, False]
    assert found.chi2[1] == np.inf
    with pytest.raises(ValueError, match="amplitude: expected the sample in the beam, got it outside in 1 steps"):
        project(textured(), rays, SHAPE, ONE, amplitude, voxel_mm=VOXEL_MM)
