"""Two volumes compared voxel by voxel: the normal equations of classical digital volume correlation.

With F the reference volume, G the volume of the deformed sample, u the trial motion and x the voxels used,

    rho(x)  = F(x - u(x)) - G(x)                                grey levels / mm
    S_i(x)  = Phi_i(x) . grad F(x - u(x))                       grey levels / mm / voxel;  d rho / d a_i = -S_i
    chi2    = sum_x rho(x)^2
    B_ij    = sum_x S_i(x) S_j(x),    c_i = sum_x S_i(x) rho(x)

and chi2 is lowered by the solution of B da = c, as with radiographs (`pdvc.projection`). F is interpolated
trilinearly, and grad F is the exact gradient of that. Beyond F's known height its last known layer goes on.

In a layer of voxels z is constant, so that u and Phi_jk = p_j(z) (G_k (x - z_j e_z) / radius + t_k), the motions of a
section, are linear in x and y. Nine moments of the gradient, m = (x, y, 1) (x) grad F, hold all that a layer says of
any motion: S_i = W_i(z) . m. A layer's 9 x 9 sums of m m^T are taken in one pass, and then spread over the two
sections that share the layer.

The noise of a reconstructed volume is not white: neighbouring voxels are correlated. The covariance of c is therefore
taken from the residual itself, block by block,

    cov c  ~  sum_b c_b c_b^T,       c_b = sum of S rho over the voxels of block b,

which holds whatever correlates inside a block (Liang and Zeger, Biometrika 73, 1986: the "sandwich" of clustered
data), and takes blocks as independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from pdvc.equations import Equations
from pdvc.sections import SectionBasis
from pdvc.volume import Grid, Hull, Volume

Floats = NDArray[np.float64]

BLOCK_VOXELS = 6
"""Edge of the blocks whose residuals are taken as independent."""


@dataclass(frozen=True, kw_only=True)
class VolumePair:
    """Two volumes of one scale that are to be matched."""

    reference: Volume
    """F, on any grid."""
    deformed: Volume
    """G; its grid is where the two are compared."""
    used: NDArray[np.bool_]
    """(z, y, x) the voxels of G that are compared."""
    voxel_mm: float
    """Voxel in which amplitudes are counted, mm: that of scale 1, whatever this scale."""

    def __post_init__(self) -> None:
        if self.used.shape != self.deformed.grid.shape or not self.used.any():
            raise ValueError(
                f"used voxels: expected some of {self.deformed.grid.shape}, got {self.used.sum()} of {self.used.shape}"
            )


@dataclass(frozen=True, kw_only=True)
class VolumeComparison:
    """What a trial motion leaves: the sums over each layer, and the weights that make equations of them."""

    weights: Floats
    """W (layer, section * motion, 9): from moments to sensitivities."""
    moments: Floats
    """Sums of m m^T (layer, 9, 9)."""
    blocks: Floats
    """Sums of m rho (layer, block, 9), for columns of BLOCK_VOXELS x BLOCK_VOXELS voxels."""
    chi2: Floats
    """(layer,), (grey level / mm)^2."""
    residual: NDArray[np.float32]
    """rho (z, y, x), grey levels / mm; zero in voxels that are not used."""
    voxels: int
    """Number of used voxels."""

    def equations(self) -> Equations:
        """Return B, c and chi2 as of one step, for the solvers."""
        size = self.weights.shape[1]
        matrix, vector = np.zeros((size, size)), np.zeros(size)
        for weight, moments, blocks in zip(self.weights, self.moments, self.blocks, strict=True):
            part = np.flatnonzero(weight.any(axis=1))
            active = weight[part]
            matrix[np.ix_(part, part)] += active @ moments @ active.T
            vector[part] += active @ blocks.sum(axis=0)
        return Equations(
            matrix=matrix[None],
            vector=vector[None],
            chi2=np.array([self.chi2.sum()]),
            residual=self.residual[None],
            pixels=self.voxels,
        )

    def vector_covariance(self) -> Floats:
        """Return cov c (section * motion, the same) from the residuals of blocks, (grey level^2 / mm^2 / voxel)^2."""
        size = self.weights.shape[1]
        result = np.zeros((size, size))
        for first in range(0, len(self.weights), BLOCK_VOXELS):
            layers = slice(first, first + BLOCK_VOXELS)
            part = np.flatnonzero(self.weights[layers].any(axis=(0, 2)))
            vectors = np.einsum("znm,zbm->bn", self.weights[layers, part], self.blocks[layers])
            result[np.ix_(part, part)] += vectors.T @ vectors
        return result


def compare(pair: VolumePair, basis: SectionBasis, amplitude: Floats) -> VolumeComparison:
    """Compare the moved reference volume with the deformed one, at amplitudes (section, motion), voxels.

    Raises ValueError for amplitudes that are not finite or of another shape.
    """
    if amplitude.shape != basis.shape or not np.isfinite(amplitude).all():
        raise ValueError(f"amplitude: expected finite {basis.shape}, got {amplitude.shape}")
    grid, target = pair.deformed.grid, pair.reference.grid
    z_mm = grid.origin_mm[2] + grid.voxel_mm * np.arange(grid.shape[0], dtype=np.float64)
    hats, shape = basis.weights(z_mm), grid.shape
    weights = hats[:, :, None, None] * _in_layers(basis.patterns(), z_mm)
    moved = (hats[:, :, None] * _in_layers(basis.affine(amplitude), z_mm)).sum(axis=1).reshape(-1, 3, 3)
    blocks_x, blocks_y = (-(-n // BLOCK_VOXELS) for n in (shape[2], shape[1]))
    moments, blocks = np.zeros((shape[0], 9, 9)), np.zeros((shape[0], blocks_y * blocks_x, 9))
    chi2, residual = np.zeros(shape[0]), np.zeros(shape, dtype=np.float32)
    _compare_layers(
        pair.reference.values,
        pair.deformed.values,
        pair.used,
        np.array([*grid.origin_mm, grid.voxel_mm]),
        np.array([*target.origin_mm, target.voxel_mm]),
        moved * pair.voxel_mm,
        pair.voxel_mm,
        BLOCK_VOXELS,
        blocks_x,
        moments,
        blocks,
        chi2,
        residual,
    )
    moments += np.tril(moments, -1).transpose(0, 2, 1)
    return VolumeComparison(
        weights=weights.reshape(shape[0], -1, 9),
        moments=moments,
        blocks=blocks,
        chi2=chi2,
        residual=residual,
        voxels=int(np.count_nonzero(pair.used)),
    )


def used_voxels(grid: Grid, hull: Hull, low_mm: float, high_mm: float) -> NDArray[np.bool_]:
    """Return the voxels (z, y, x) inside a hull and between two heights, mm, the outermost layers left out."""
    z, y, x = (grid.origin_mm[2 - axis] + grid.voxel_mm * np.arange(n) for axis, n in enumerate(grid.shape))
    slab = np.floor((z - hull.z_mm) / hull.slab_mm).astype(int)
    layers = (z >= low_mm) & (z <= high_mm) & (slab >= 0) & (slab < len(hull.support_mm))
    layers[[0, -1]] = False
    normals = hull.normals()
    reach = normals[:, 0, None, None] * x + normals[:, 1, None, None] * y[:, None]
    result = np.zeros(grid.shape, dtype=bool)
    for k in np.flatnonzero(layers):
        result[k] = (reach <= hull.support_mm[slab[k], :, None, None]).all(axis=0)
    return result


def _in_layers(affine: Floats, z_mm: Floats) -> Floats:
    """Turn affine maps (..., 3, 4) of (x, y, z) into maps of (x, y, 1) in each layer (layer, ..., 9), row by row."""
    z = z_mm.reshape(-1, *(1,) * (affine.ndim - 1))
    result = np.empty((len(z_mm), *affine.shape[:-1], 3))
    result[..., :2] = affine[..., :2]
    result[..., 2] = affine[..., 2] * z + affine[..., 3]
    return result.reshape(*result.shape[:-2], 9)


@njit(nogil=True, cache=True, error_model="numpy", parallel=True)
def _compare_layers(  # type: ignore[no-untyped-def]
    reference, deformed, used, place, target, moved, voxel_mm, edge, blocks_x, moments, blocks, chi2, residual
):
    """Compare layer by layer: a layer is one task, and its sums are in one order, whatever the threads.

    A task writes to its own layer of each result, and to nothing else.
    """
    for k in prange(deformed.shape[0]):
        _compare_layer(
            reference,
            deformed[k],
            used[k],
            place,
            place[2] + place[3] * k,
            target,
            moved[k],
            voxel_mm,
            edge,
            blocks_x,
            moments[k],
            blocks[k],
            chi2[k : k + 1],
            residual[k],
        )


@njit(nogil=True, cache=True, error_model="numpy")
def _compare_layer(  # type: ignore[no-untyped-def]
    reference, deformed, used, place, z, target, moved, voxel_mm, edge, blocks_x, moments, blocks, chi2, residual
):
    """Add the voxels of one layer; `moved` (3, 3) takes (x, y, 1) to u there, mm.

    `place` and `target` hold the centre of voxel (0, 0, 0) and the voxel of G's and F's grid, mm.
    """
    nz, ny, nx = reference.shape
    m, step = np.empty(9), target[3]
    for j in range(deformed.shape[0]):
        y = place[1] + place[3] * j
        for i in range(deformed.shape[1]):
            if not used[j, i]:
                continue
            x = place[0] + place[3] * i
            # x - u(x), in voxel indices of F
            a = (x - moved[0, 0] * x - moved[0, 1] * y - moved[0, 2] - target[0]) / step
            b = (y - moved[1, 0] * x - moved[1, 1] * y - moved[1, 2] - target[1]) / step
            c = (z - moved[2, 0] * x - moved[2, 1] * y - moved[2, 2] - target[2]) / step
            value, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
            # air where the voxel comes from beside F's grid
            if 0 <= a < nx - 1 and 0 <= b < ny - 1:
                # F's lowest and highest layer are empty: between the next ones it is known, beyond them they go on
                low, high = 1.0, nz - 2.0
                height = min(max(c, low), high)
                p, q, r = int(a), int(b), min(int(height), nz - 3)
                fa, fb, fc = a - p, b - q, height - r
                d000, d001 = reference[r, q, p], reference[r, q, p + 1]
                d010, d011 = reference[r, q + 1, p], reference[r, q + 1, p + 1]
                d100, d101 = reference[r + 1, q, p], reference[r + 1, q, p + 1]
                d110, d111 = reference[r + 1, q + 1, p], reference[r + 1, q + 1, p + 1]
                # along x, then y, then z; the derivatives are those of this interpolation
                e00, e01 = d000 + fa * (d001 - d000), d010 + fa * (d011 - d010)
                e10, e11 = d100 + fa * (d101 - d100), d110 + fa * (d111 - d110)
                f0, f1 = e00 + fb * (e01 - e00), e10 + fb * (e11 - e10)
                value = f0 + fc * (f1 - f0)
                gx = (1 - fc) * ((1 - fb) * (d001 - d000) + fb * (d011 - d010)) + fc * (
                    (1 - fb) * (d101 - d100) + fb * (d111 - d110)
                )
                gy = (1 - fc) * (e01 - e00) + fc * (e11 - e10)
                # what goes on unchanged has no slope along z
                if low <= c <= high:
                    gz = f1 - f0
            rho = value - deformed[j, i]
            residual[j, i] = rho
            chi2[0] += rho * rho
            # from a voxel of F to a unit amplitude: grey levels / mm / voxel
            scale = voxel_mm / step
            gx, gy, gz = gx * scale, gy * scale, gz * scale
            m[0], m[1], m[2] = gx * x, gx * y, gx
            m[3], m[4], m[5] = gy * x, gy * y, gy
            m[6], m[7], m[8] = gz * x, gz * y, gz
            # m rho by blocks: they add up to c, and tell its covariance; of m m^T the lower triangle
            block = (j // edge) * blocks_x + i // edge
            for row in range(9):
                blocks[block, row] += m[row] * rho
                for column in range(row + 1):
                    moments[row, column] += m[row] * m[column]
