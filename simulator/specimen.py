"""The dog-bone: its section in closed form, and its closed surface as a triangle mesh.

In *specimen* axes the section is the rectangle |x| <= half_x(z), |y| <= half_y(z). A thinned side follows a
circular fillet of radius R,

    half(z) = min( half(0) + R - sqrt(R^2 - z^2), grip / 2 ),

and the other side is flat. The specimen stands in the *sample* frame of `pdvc.geometry` turned by
`turned_deg` about z, counter-clockwise from above: nobody mounts a sample along the voxels. Everything that
this module hands out is in the sample frame, except the half widths, which belong to the specimen axes.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Literal, Self

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from pdvc.settings import Settings

Positive = Annotated[float, Field(gt=0)]


class Specimen(Settings):
    """The dog-bone sample; by default the ligament of the paper, 1.31 x 0.91 mm2, fillet radius 20.5 mm."""

    width_mm: Positive = 1.31
    """ligament section along the specimen's x axis, mm"""
    thickness_mm: Positive = 0.91
    """ligament section along the specimen's y axis, mm"""
    fillet_radius_mm: Positive = 20.5
    """radius of the fillet that thins the ligament, mm"""
    thinned: Literal["x", "y", "both"] = "both"
    """which half widths follow the fillet: x, y or both"""
    grip_width_mm: Positive = 3.0
    """size of a thinned side in the grips, where the fillet has ended, mm"""
    length_mm: Positive = 13.0
    """modelled length along z, centred on the ligament, mm; it has to reach beyond the field of view"""
    turned_deg: float = 17.0
    """turn of the specimen about z in the sample frame, counter-clockwise from above, degrees"""
    facet_mm: Positive = 0.1
    """longest mesh edge along z, and across the ligament's sides, mm"""

    @model_validator(mode="after")
    def _grips_wider_than_ligament(self) -> Self:
        for side, name in (("x", "width_mm"), ("y", "thickness_mm")):
            if self.thinned in (side, "both") and self.grip_width_mm < getattr(self, name):
                raise ValueError(
                    f"grip_width_mm of at least {name} = {getattr(self, name)} mm, got {self.grip_width_mm} mm"
                )
            if self.thinned in (side, "both") and self._sag_mm(name) > self.fillet_radius_mm:
                raise ValueError(
                    f"fillet_radius_mm of at least {self._sag_mm(name):.6g} mm, to reach from {name} to "
                    f"grip_width_mm, got {self.fillet_radius_mm} mm"
                )
        if self.facet_error_mm > 1e-4 * (1 + 1e-9):
            raise ValueError(
                "facets within 1e-4 mm of the fillet: facet_mm of at most "
                f"{np.sqrt(8e-4 * self.fillet_radius_mm):.3g} mm, got {self.facet_mm} mm"
            )
        return self

    def _sag_mm(self, name: str) -> float:
        return (self.grip_width_mm - float(getattr(self, name))) / 2

    @property
    def facet_error_mm(self) -> float:
        """Return the largest distance between a facet and the fillet, facet^2 / (8 R), mm."""
        return self.facet_mm**2 / (8 * self.fillet_radius_mm)


def section_mm(specimen: Specimen, z_mm: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the half widths of the section at heights z, in specimen axes.

    half(z) = min(half(0) + R - sqrt(R^2 - z^2), grip / 2) on a thinned side, half(0) on a flat one.
    Shapes: those of z; mm.
    """
    z = np.asarray(z_mm, dtype=np.float64)
    radius = specimen.fillet_radius_mm
    sag = radius - np.sqrt(np.maximum(radius**2 - z**2, 0.0))
    half_x, half_y = np.full_like(z, specimen.width_mm / 2), np.full_like(z, specimen.thickness_mm / 2)
    if specimen.thinned != "y":
        half_x = np.minimum(half_x + sag, specimen.grip_width_mm / 2)
    if specimen.thinned != "x":
        half_y = np.minimum(half_y + sag, specimen.grip_width_mm / 2)
    return half_x, half_y


def area_mm2(specimen: Specimen, z_mm: ArrayLike) -> NDArray[np.float64]:
    """Return the area of the section at heights z, 4 half_x half_y; shape of z, mm2."""
    half_x, half_y = section_mm(specimen, z_mm)
    return 4 * half_x * half_y


def turn(specimen: Specimen, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Carry points (..., 3) from specimen axes to the sample frame: a turn by `turned_deg` about z, mm."""
    c, s = np.cos(np.deg2rad(specimen.turned_deg)), np.sin(np.deg2rad(specimen.turned_deg))
    return np.asarray(points_mm @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))


def turn_back(specimen: Specimen, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Carry points (..., 3) from the sample frame to specimen axes, mm: the inverse of `turn`."""
    c, s = np.cos(np.deg2rad(specimen.turned_deg)), np.sin(np.deg2rad(specimen.turned_deg))
    return np.asarray(points_mm @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def depth_mm(specimen: Specimen, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how deep points (n, 3) of the sample frame lie below the lateral surface, mm; negative outside.

    The matrix is an intersection of half spaces and of outsides of circular cylinders (the fillets), so that
    the depth of an inner point is the least of its distances to each: exact. The end faces do not count.
    """
    x, y, z = np.abs(turn_back(specimen, points_mm)).T
    to_x = _side_depth(specimen, x, z, specimen.width_mm / 2, specimen.thinned != "y")
    to_y = _side_depth(specimen, y, z, specimen.thickness_mm / 2, specimen.thinned != "x")
    return np.minimum(to_x, to_y)


def dog_bone(specimen: Specimen) -> trimesh.Trimesh:
    """Return the closed surface in the sample frame, mm, with outward normals.

    Sides and end faces are subdivided too, so that the surface stays accurate under motions that are not
    affine.
    """
    nx = max(2, int(np.ceil(specimen.width_mm / specimen.facet_mm)))
    ny = max(2, int(np.ceil(specimen.thickness_mm / specimen.facet_mm)))
    heights = _levels(specimen)
    ring = _perimeter(nx, ny)
    half = np.stack(section_mm(specimen, heights), axis=-1)
    inner = _inner_grid(nx, ny)
    rings = np.empty((len(heights), len(ring), 3))
    rings[..., :2] = ring * half[:, None, :]
    rings[..., 2] = heights[:, None]
    caps = [np.column_stack([inner * half[k], np.full(len(inner), heights[k])]) for k in (0, -1)]
    vertices = np.concatenate([rings.reshape(-1, 3), *caps])
    sides = _side_faces(len(heights), len(ring))
    cap = _cap_faces(nx, ny)
    top_ring = (len(heights) - 1) * len(ring)
    first_inner = len(heights) * len(ring)
    bottom = _numbered(cap, len(ring), 0, first_inner)[:, ::-1]
    top = _numbered(cap, len(ring), top_ring, first_inner + len(inner))
    return trimesh.Trimesh(turn(specimen, vertices), np.concatenate([sides, bottom, top]), process=False)


def _side_depth(
    specimen: Specimen, across: NDArray[np.float64], z: NDArray[np.float64], half: float, thinned: bool
) -> NDArray[np.float64]:
    if not thinned:
        return half - across
    radius = specimen.fillet_radius_mm
    # past the fillet's centre height only the grip face bounds the matrix
    fillet = np.where(z < radius, np.hypot(across - half - radius, z) - radius, np.inf)
    return np.minimum(fillet, specimen.grip_width_mm / 2 - across)


def _levels(specimen: Specimen) -> NDArray[np.float64]:
    """Return the heights of the mesh rings: the ends, the ends of the fillets, and even steps between."""
    half, radius = specimen.length_mm / 2, specimen.fillet_radius_mm
    ends = {half}
    for side, flat in (("x", specimen.width_mm), ("y", specimen.thickness_mm)):
        if specimen.thinned in (side, "both"):
            end = np.sqrt(radius**2 - (radius - (specimen.grip_width_mm - flat) / 2) ** 2)
            if specimen.facet_mm / 10 < end < half - specimen.facet_mm / 10:
                ends.add(float(end))
    knots = [0.0, *sorted(ends)]
    up = [np.array([0.0])]
    for low, high in itertools.pairwise(knots):
        up.append(np.linspace(low, high, int(np.ceil((high - low) / specimen.facet_mm)) + 1)[1:])
    upper = np.concatenate(up)
    return np.concatenate([-upper[:0:-1], upper])


def _perimeter(nx: int, ny: int) -> NDArray[np.float64]:
    """Return the outline of the square [-1, 1]^2, counter-clockwise from (-1, -1), (2 (nx + ny), 2)."""
    x, y = np.linspace(-1, 1, nx + 1), np.linspace(-1, 1, ny + 1)
    one_x, one_y = np.ones(nx), np.ones(ny)
    sides = ((x[:-1], -one_x), (one_y, y[:-1]), (x[:0:-1], one_x), (-one_y, y[:0:-1]))
    return np.concatenate([np.column_stack(side) for side in sides])


def _inner_grid(nx: int, ny: int) -> NDArray[np.float64]:
    x, y = np.linspace(-1, 1, nx + 1)[1:-1], np.linspace(-1, 1, ny + 1)[1:-1]
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _side_faces(levels: int, around: int) -> NDArray[np.int64]:
    k, i = (a.ravel() for a in np.meshgrid(np.arange(levels - 1), np.arange(around), indexing="ij"))
    j = (i + 1) % around
    a, b, c, d = k * around + i, k * around + j, (k + 1) * around + j, (k + 1) * around + i
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def _cap_faces(nx: int, ny: int) -> NDArray[np.int64]:
    """Return the triangles of an end face, normals up; ring points count from 0, inner ones after them."""
    number = np.empty((nx + 1, ny + 1), dtype=np.int64)
    number[:-1, 0] = np.arange(nx)
    number[-1, :-1] = nx + np.arange(ny)
    number[:0:-1, -1] = nx + ny + np.arange(nx)
    number[0, :0:-1] = 2 * nx + ny + np.arange(ny)
    number[1:-1, 1:-1] = 2 * (nx + ny) + np.arange((nx - 1) * (ny - 1)).reshape(nx - 1, ny - 1)
    a, b, c, d = (q.ravel() for q in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def _numbered(cap: NDArray[np.int64], around: int, ring: int, inner: int) -> NDArray[np.int64]:
    return np.where(cap < around, cap + ring, cap - around + inner)
