"""Standard deviations of displacement and strain, from the covariance of the amplitudes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdvc.sections import SectionBasis

Floats = NDArray[np.float64]

BEAM = ("across", "vertical", "along")
"""Names of the rows of `beam_frame`: directions in which one radiograph sees differently well."""


@dataclass(frozen=True, kw_only=True)
class Quantities:
    """One number for each direction and for the strain; NaN where there is none."""

    across_beam: float
    vertical: float
    along_beam: float
    strain: float


@dataclass(frozen=True, kw_only=True)
class Knowledge:
    """How well a motion is known, or would be: the covariance of its amplitudes, with all that it refers to."""

    basis: SectionBasis
    time_functions: Floats
    """Orthonormal (function, step)."""
    angle_rad: Floats
    """(step,)"""
    voxel_mm: float
    covariance: Floats
    """voxel^2, as of `pdvc.measurement.MeasuredMotion`."""

    def quantities(self, point_mm: Floats, displacement_mm: Floats) -> Quantities:
        """Return rms standard deviations over steps and those material points that are between the sections.

        `point_mm` (point, 3) at rest, `displacement_mm` (step, point, 3). Displacements in voxels. The strain is that
        between material levels of the axis, about a section apart.
        """
        positions = np.asarray(point_mm[None] + displacement_mm)
        low, high = self.basis.height_mm[[0, -1]]
        axis = points_on_axis(point_mm, float(np.mean(np.diff(self.basis.height_mm))))
        turned, strain = [], []
        for step, x in enumerate(positions):
            covariance = step_covariance(self.covariance, self.time_functions, step)
            inside = (x[:, 2] >= low) & (x[:, 2] <= high)
            turned.append(turned_std(self.basis, covariance, float(self.angle_rad[step]), x[inside]))
            levels = axis[inside[axis]]
            now, before = x[levels, 2], point_mm[levels, 2]
            stretched = np.diff(now) / np.diff(before)
            strain.append(strain_std(self.basis, covariance, now, self.voxel_mm) * stretched)
        across, vertical, along = np.sqrt((np.concatenate(turned) ** 2).mean(axis=0)).tolist()
        of_strain = float(np.sqrt((np.concatenate(strain) ** 2).mean()))
        return Quantities(across_beam=across, vertical=vertical, along_beam=along, strain=of_strain)


def step_covariance(covariance: Floats, time_functions: Floats, step: int) -> Floats:
    """Return the covariance (unknown, unknown), voxel^2, of one step's amplitudes, from that of all coefficients."""
    sigma = time_functions[:, step]
    if covariance.ndim == 3:
        # mostly one function: to multiply all others by zero takes the time of reading them
        own = np.flatnonzero(sigma)
        return np.asarray(np.tensordot(sigma[own] ** 2, covariance[own], axes=1))
    functions = len(sigma)
    blocks = covariance.reshape(functions, -1, functions, len(covariance) // functions)
    return np.asarray(np.einsum("f,fngm,g->nm", sigma, blocks, sigma, optimize=True))


def turned_std(basis: SectionBasis, covariance: Floats, angle_rad: float, points_mm: Floats) -> Floats:
    """Return the standard deviations of u (point, 3), voxels, across the beam, vertical and along the beam.

    `covariance` (section * motion, the same), voxel^2, is that of one step's amplitudes; `points_mm` (point, 3).
    """
    shapes = (beam_frame(angle_rad) @ basis.shapes(points_mm).reshape(len(points_mm), 3, -1)).reshape(
        3 * len(points_mm), -1
    )
    variance = ((shapes @ covariance) * shapes).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0)).reshape(-1, 3))


def strain_std(basis: SectionBasis, covariance: Floats, height_mm: Floats, voxel_mm: float) -> Floats:
    """Return the standard deviation (height - 1,) of the strain between heights on the axis, without unit."""
    points = np.zeros((len(height_mm), 3))
    points[:, 2] = height_mm
    vertical = basis.shapes(points)[:, 2].reshape(len(points), -1)
    difference = np.diff(vertical, axis=0) * voxel_mm / np.diff(height_mm)[:, None]
    variance = ((difference @ covariance) * difference).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0)))


def beam_frame(angle_rad: ArrayLike) -> Floats:
    """Return the directions in which one radiograph sees differently well, at stage angles (...,): (..., 3, 3).

    Rows: across the beam e_c, vertical e_z, along the beam e_b (`pdvc.geometry`).
    """
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    zero = np.zeros_like(c)
    rows = ((-s, -c, zero), (zero, zero, zero + 1), (c, -s, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def points_on_axis(point_mm: Floats, spacing_mm: float) -> NDArray[np.intp]:
    """Return which points are nearest the axis, from the bottom up, levels about `spacing_mm` apart."""
    from_axis = np.hypot(point_mm[:, 0], point_mm[:, 1])
    order = np.lexsort((from_axis, np.round(point_mm[:, 2], 6)))
    height = np.round(point_mm[order, 2], 6)
    first = order[np.concatenate([[True], np.diff(height) > 0])]
    if len(first) < 2:
        return np.asarray(first)
    stride = max(1, round(spacing_mm / float(np.mean(np.diff(point_mm[first, 2])))))
    return np.asarray(first[(len(first) - 1) % stride // 2 :: stride])
