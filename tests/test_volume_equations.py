"""The equations of two volumes, against plain numpy, finite differences and Monte Carlo; and the inverse crime."""

from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from pdvc import gauss_newton
from pdvc.prior import Prior
from pdvc.sections import CONTRACTION, RIGID, SectionBasis
from pdvc.volume import Grid, Hull, Volume, halved
from pdvc.volume_equations import VolumePair, compare, used_voxels
from tests.laws import law
from tests.small_case import SECTIONS, VOXEL_MM, motion, textured, trilinear

SEVEN = replace(SECTIONS, motions=(*RIGID, CONTRACTION))
INNER_MM = VOXEL_MM * 22


def blank(volume):
    return replace(volume, values=np.zeros_like(volume.values))


def pair_of(reference, deformed, inner_mm=INNER_MM):
    """Compare over the middle of the bar, where its motion never leads out of the known height."""
    used = used_voxels(deformed.grid, deformed.hull, -inner_mm, inner_mm)
    return VolumePair(reference=reference, deformed=deformed, used=used, voxel_mm=VOXEL_MM)


def moved(reference, basis, amplitude):
    """Return G(x) = F(x - u(x)) on a grid with room for the motion, made by the kernel under test."""
    still, room = textured().grid, 8
    shape = tuple(n + 2 * room for n in still.shape)
    grid = replace(still, shape=shape, origin_mm=tuple(x - room * still.voxel_mm for x in still.origin_mm))
    empty = Volume(values=np.zeros(shape, dtype=np.float32), grid=grid, hull=textured().hull)
    pair = VolumePair(reference=reference, deformed=empty, used=np.ones(shape, dtype=bool), voxel_mm=VOXEL_MM)
    return replace(empty, values=compare(pair, basis, amplitude).residual)


def solved(pair, basis, start=None, deviation=1e3, **options):
    how = {"most_passes": 30, "least_change_voxel": 1e-5, **options}
    prior = Prior(deviation_voxel=np.full(basis.shape, deviation))
    start = np.zeros((1, *basis.shape)) if start is None else start[None]
    return gauss_newton.solve(lambda a: compare(pair, basis, a[0]).equations(), np.ones((1, 1)), start, prior, **how)


def places(grid, used):
    k, j, i = np.nonzero(used)
    return np.stack([i, j, k], axis=1) * grid.voxel_mm + np.array(grid.origin_mm)


@pytest.mark.parametrize("refined", [False, True])
@pytest.mark.parametrize("basis", [SECTIONS, SEVEN, replace(SECTIONS, height_mm=[0.1])], ids=["six", "seven", "one"])
def test_the_residual_is_that_of_plain_numpy(basis, refined):
    reference = halved(textured()) if refined else textured()
    deformed, amplitude = textured(0.8), motion(basis, 3)
    pair = pair_of(reference, deformed)
    found = compare(pair, basis, amplitude)
    x = places(deformed.grid, pair.used)
    was = x - basis.displacement(amplitude, x) * VOXEL_MM
    index = (was - np.array(reference.grid.origin_mm)) / reference.grid.voxel_mm
    inside = (index[:, 2] >= 1) & (index[:, 2] <= reference.grid.shape[0] - 2)
    assert inside.all()
    expected = trilinear(reference.values, index) - deformed.values[pair.used]
    np.testing.assert_allclose(found.residual[pair.used], expected, atol=2e-6)
    assert not found.residual[~pair.used].any()
    assert found.equations().rms == pytest.approx(np.sqrt((expected**2).mean()), rel=1e-6)
    assert found.voxels == len(x)


@pytest.mark.parametrize("basis", [SEVEN, replace(SEVEN, height_mm=[0.1])], ids=["sections", "one"])
def test_equations_are_those_of_sensitivities_by_finite_differences(basis):
    pair, amplitude = pair_of(halved(textured()), textured(0.8)), motion(basis, 4)
    change, columns = 1e-4, []
    for j, k in np.ndindex(basis.shape):
        step = np.zeros(basis.shape)
        step[j, k] = change
        ahead, behind = (compare(pair, basis, amplitude + side * step).residual[pair.used] for side in (1, -1))
        columns.append(-(ahead.astype(float) - behind) / (2 * change))
    s, rho = np.stack(columns, axis=1), compare(pair, basis, amplitude).residual[pair.used]
    equations = compare(pair, basis, amplitude).equations()
    # the gradient jumps between cells, and a few voxels change theirs within a finite step
    close = {"rtol": 2e-3, "atol": 2e-3 * np.abs(s.T @ s).max()}
    np.testing.assert_allclose(equations.matrix[0], s.T @ s, **close)
    np.testing.assert_allclose(equations.vector[0], s.T @ rho, rtol=2e-3, atol=2e-3 * np.abs(s.T @ rho).max())


def test_the_gradient_of_chi2_is_minus_twice_c():
    pair, amplitude = pair_of(halved(textured()), textured(0.8)), motion(SEVEN, 5)
    rng = np.random.default_rng(0)
    for _ in range(5):
        direction = rng.normal(size=SEVEN.shape)
        up, down = (compare(pair, SEVEN, amplitude + h * direction).chi2.sum() for h in (1e-4, -1e-4))
        expected = -2 * compare(pair, SEVEN, amplitude).equations().vector[0] @ direction.ravel()
        assert (up - down) / 2e-4 == pytest.approx(expected, rel=1e-3, abs=1e-2 * abs(expected))


def test_beyond_the_known_height_the_last_layer_goes_on_without_a_gradient():
    reference = textured()
    pair = pair_of(reference, blank(reference), inner_mm=10.0)
    one = SectionBasis(height_mm=[0.0], radius_mm=1.0, motions=(RIGID[2],))
    far = compare(pair, one, np.array([[200.0]]))
    np.testing.assert_allclose(far.residual[5][pair.used[5]], reference.values[1][pair.used[5]], atol=1e-6)
    assert far.equations().matrix[0, 0, 0] == 0


@law(15)
@given(st.integers(0, 1000), st.sampled_from([0.3, 1.0, 2.0]), st.sampled_from([SECTIONS, SEVEN]))
def test_a_volume_moved_by_the_same_interpolation_gives_its_motion_back(seed, size, basis):
    reference, amplitude = textured(), motion(basis, seed, size)
    amplitude[:, 3:] *= 0.3
    pair = pair_of(reference, moved(reference, basis, amplitude))
    started = amplitude + motion(basis, seed + 1, 0.3)
    found = solved(pair, basis, started).coefficients[0]
    x = places(pair.deformed.grid, pair.used)
    assert np.abs(basis.displacement(found - amplitude, x)).max() < 1e-5


def test_rigid_motion_of_several_voxels_is_found_from_rest():
    basis = SectionBasis(height_mm=[0.1], radius_mm=10 * VOXEL_MM)
    amplitude = np.array([[2.2, -1.7, 2.4, 0.4, -0.3, 0.6]])
    reference = textured(1.6)
    pair = pair_of(reference, moved(reference, basis, amplitude))
    np.testing.assert_allclose(solved(pair, basis).coefficients[0], amplitude, atol=1e-6)


def test_refining_takes_away_the_bias_of_trilinear_interpolation():
    """G is F shifted by a phase in Fourier space, exactly; F is then interpolated with and without refinement."""
    reference, shift = textured(), np.array([0.3, 0.25, 0.7])
    values = np.fft.ifftn(ndimage.fourier_shift(np.fft.fftn(reference.values.astype(float)), shift[::-1])).real
    deformed = replace(reference, values=values.astype(np.float32))
    one = SectionBasis(height_mm=[0.0], radius_mm=1.0, motions=RIGID[:3])
    errors = [
        np.abs(solved(pair_of(each, deformed), one).coefficients[0, 0] - shift).max()
        for each in (reference, halved(reference))
    ]
    assert errors[0] > 0.01
    assert errors[1] < 0.005


def white(noise):
    return noise


def reconstructed(noise):
    """Return noise such as reconstructions have: little of it at long waves across the axis, none at short ones."""
    return ndimage.gaussian_filter(noise, (0.9, 0.7, 0.7)) - ndimage.gaussian_filter(noise, (0.9, 1.6, 1.6))


@pytest.mark.parametrize(("coloured", "least", "most"), [(white, 0.7, 1.3), (reconstructed, 2.0, 5.0)])
def test_the_covariance_of_c_holds_for_white_and_for_correlated_noise(coloured, least, most):
    """Variances told by each draw against the variance of many; those that take the residual as white are wrong."""
    reference = halved(textured())
    clean = moved(reference, SEVEN, np.zeros(SEVEN.shape))
    rng, found, told, plain = np.random.default_rng(1), [], [], []
    for _ in range(30):
        noise = coloured(rng.normal(size=clean.values.shape))
        noise *= 0.02 / noise.std()
        pair = pair_of(reference, replace(clean, values=clean.values + noise.astype(np.float32)))
        found.append(solved(pair, SEVEN, least_change_voxel=1e-3).coefficients[0])
        last = compare(pair, SEVEN, found[-1])
        inverse = np.linalg.inv(last.equations().matrix[0])
        told.append(np.diag(inverse @ last.vector_covariance() @ inverse))
        plain.append(np.diag(inverse) * last.equations().rms ** 2)
    observed = np.var(found, axis=0).ravel()
    # 28 unknowns of 30 draws each: their mean ratio is known to about 7 %
    assert np.mean(observed / np.mean(told, axis=0)) == pytest.approx(1.05, abs=0.25)
    assert least < np.mean(observed / np.mean(plain, axis=0)) < most


def test_results_do_not_depend_on_the_number_of_threads():
    pair, amplitude = pair_of(textured(), textured(0.8)), motion(SEVEN)
    before, results = numba.get_num_threads(), []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            found = compare(pair, SEVEN, amplitude)
            equations = found.equations()
            results.append((equations.matrix, equations.vector, found.vector_covariance(), found.residual))
    finally:
        numba.set_num_threads(before)
    for one, two in zip(*results, strict=True):
        np.testing.assert_array_equal(one, two)


@law(20)
@given(st.integers(0, 100), st.floats(-1.5, 0.5), st.floats(0.6, 1.5))
def test_used_voxels_are_those_whose_centre_is_in_the_hull_and_between_the_heights(seed, low, high):
    rng = np.random.default_rng(seed)
    support = rng.uniform(0.3, 0.9, (5, 16))
    support[2] = -np.inf
    hull = Hull(z_mm=-1.0, slab_mm=0.37, support_mm=support)
    grid = Grid(shape=(21, 17, 15), voxel_mm=0.12, origin_mm=(-0.8, -1.0, -1.2))
    used = used_voxels(grid, hull, low, high)
    for k, j, i in rng.integers(0, grid.shape, (200, 3)):
        x, y, z = np.array(grid.origin_mm) + grid.voxel_mm * np.array([i, j, k])
        slab = int(np.floor((z + 1.0) / 0.37))
        inside = 0 <= slab < 5 and all(n @ [x, y] <= s for n, s in zip(hull.normals(), support[slab], strict=True))
        assert used[k, j, i] == (inside and low <= z <= high and k not in (0, 20))


def test_nonsense_is_refused_with_what_was_expected():
    volume = textured()
    used = np.zeros(volume.grid.shape, dtype=bool)
    with pytest.raises(ValueError, match=r"used voxels: expected some of \(64, 24, 30\), got 0"):
        VolumePair(reference=volume, deformed=volume, used=used, voxel_mm=VOXEL_MM)
    pair = pair_of(volume, volume)
    with pytest.raises(ValueError, match=r"amplitude: expected finite \(4, 6\), got \(1, 4, 6\)"):
        compare(pair, SECTIONS, np.zeros((1, *SECTIONS.shape)))
    with pytest.raises(ValueError, match="amplitude: expected finite"):
        compare(pair, SECTIONS, np.full(SECTIONS.shape, np.nan))
