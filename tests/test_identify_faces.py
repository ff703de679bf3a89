"""Where faces appear: a box of known area, whose radiographs are worked out here by other means, reconstructed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from pdvc.geometry import ConeBeam
from pdvc.identify.faces import SUBPIXELS, Scan, appearance, areas_between_faces, blur_of, paths_mm, seen_by_pixels
from pdvc.identify.outline import areas_of, directions_rad, outline_of
from pdvc.reconstruction import fdk
from pdvc.volume import Grid, Hull, Volume

HALF_MM = np.array([0.55, 0.4])
TURNED_RAD = np.deg2rad(17.0)
SCANNER = ConeBeam(
    source_axis_mm=40.0, source_detector_mm=800.0, pixel_mm=1.0, rows=15, columns=52, column_shift_mm=0.4
)
ANGLE_RAD = 2 * np.pi * np.arange(90) / 90
LEVEL = 1.3


def _box_paths(rays_a_pixel):
    """Return the paths of rays through the box (view, ray), mm, by the slabs between its faces."""
    c, s = np.cos(ANGLE_RAD), np.sin(ANGLE_RAD)
    place = (np.arange(SCANNER.columns * rays_a_pixel) + 0.5) / rays_a_pixel - SCANNER.columns / 2
    u = place * SCANNER.pixel_mm + SCANNER.column_shift_mm
    beam, across = np.stack([c, -s], axis=1), np.stack([-s, -c], axis=1)
    ray = SCANNER.source_detector_mm * beam[:, None] + u[:, None] * across[:, None]
    ray /= np.linalg.norm(ray, axis=2)[..., None]
    source = -SCANNER.source_axis_mm * beam[:, None]
    turn = np.array([[np.cos(TURNED_RAD), np.sin(TURNED_RAD)], [-np.sin(TURNED_RAD), np.cos(TURNED_RAD)]])
    ray, source = ray @ turn.T, source @ turn.T
    ends = np.sort(np.stack([(-HALF_MM - source) / ray, (HALF_MM - source) / ray]), axis=0)
    return np.maximum(ends[1].min(axis=2) - ends[0].max(axis=2), 0.0)


def _radii():
    angle = directions_rad() - TURNED_RAD
    return np.min(HALF_MM / np.abs(np.stack([np.cos(angle), np.sin(angle)], axis=1)), axis=1)


def _volume(blur_px):
    """Reconstruct the box as a detector shows it that averages intensities."""
    intensity = np.exp(-LEVEL * _box_paths(20))
    if blur_px:
        intensity = ndimage.gaussian_filter1d(intensity, 20 * blur_px, axis=1)
    seen = -np.log(intensity.reshape(len(ANGLE_RAD), SCANNER.columns, 20).mean(axis=2)).astype(np.float32)
    voxel = SCANNER.voxel_mm
    grid = Grid.around(np.array([-0.9, -0.9, -5 * voxel]), np.array([0.9, 0.9, 5 * voxel]), voxel)
    hull = Hull(z_mm=-1.0, slab_mm=2.0, support_mm=np.full((1, 16), 0.85))
    values = fdk(lambda i: np.tile(seen[i], (SCANNER.rows, 1)), SCANNER, ANGLE_RAD, grid, hull)
    return Volume(values=values, grid=grid, hull=hull)


@pytest.mark.parametrize("blur_px", [0.0, 0.45])
def test_a_box_has_its_area_although_pixels_move_its_faces_inwards(blur_px):
    scan = Scan(geometry=SCANNER, angle_rad=ANGLE_RAD, polynomial=(1.0, 0.0, 0.0))
    outline = outline_of(_volume(blur_px), -0.16, 0.16)
    true = 4 * HALF_MM.prod()
    found, perimeter = areas_of(outline.radius_mm)
    # 0.08 voxel and more
    assert ((found - true) / perimeter < -0.07 * SCANNER.voxel_mm).all()
    assert outline.level == pytest.approx(LEVEL, rel=0.01)
    # what is left is a hundredth of a voxel, of its corners, which are round in the volume
    left = (areas_between_faces(outline, scan) - true) / perimeter
    np.testing.assert_allclose(left / SCANNER.voxel_mm, 0, atol=0.02)
    assert blur_of(outline.radius_mm[2], outline, scan) ** 2 == pytest.approx(blur_px**2, abs=0.06)


def test_a_curved_polynomial_is_undone_before_pixels_average_and_done_again_after():
    """Faces move by what the detector sees, whatever grey levels are made of it."""
    grey = 0.8, 0.1, 0.0
    straight = Scan(geometry=SCANNER, angle_rad=ANGLE_RAD, polynomial=(1.0, 0.0, 0.0))
    areas = []
    for polynomial, level in (((2.0, 0.0, 0.0), 2 * LEVEL), (grey, LEVEL), ((1.0, 0.0, 0.0), 1e-3)):
        scan = Scan(geometry=SCANNER, angle_rad=ANGLE_RAD, polynomial=polynomial)
        areas.append(float(areas_of(appearance(_radii(), level, scan, 0.0)[0][None])[0][0]))
    plain = float(areas_of(appearance(_radii(), LEVEL, straight, 0.0)[0][None])[0][0])
    assert areas[0] == pytest.approx(plain, rel=1e-6)
    # attenuations are larger here, and what rises the steeper the higher it is makes more of the same mean
    assert areas[1] != pytest.approx(plain, rel=1e-4)
    # next to no attenuation: a mean of intensities is one of attenuations
    assert areas[2] == pytest.approx(4 * HALF_MM.prod(), rel=6e-3)
    assert areas[2] > plain * 1.005


def test_paths_through_a_polygon_are_those_between_the_faces_of_a_box():
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * HALF_MM
    c, s = np.cos(TURNED_RAD), np.sin(TURNED_RAD)
    found = paths_mm(corner @ np.array([[c, s], [-s, c]]), SCANNER, ANGLE_RAD)
    np.testing.assert_allclose(found, _box_paths(SUBPIXELS), atol=1e-9)


@pytest.mark.parametrize("jump", [0.2, 1.0, 2.5])
def test_a_face_seen_edge_on_moves_in_as_its_closed_form_says(jump):
    """The mean, over where in a pixel the face is, of what the pixel lacks: 1/2 coth(a / 2) - 1 / a of a."""
    behind = np.arange(SUBPIXELS + 1)[:, None]
    grey = jump * (np.arange(SUBPIXELS) < behind)
    scan = Scan(geometry=SCANNER, angle_rad=ANGLE_RAD, polynomial=(1.0, 0.0, 0.0))
    seen = seen_by_pixels(grey, scan, 0.0)[:, 0] / jump
    lacking = 0.5 - np.trapezoid(seen, dx=1 / SUBPIXELS)
    assert lacking == pytest.approx(0.5 / np.tanh(jump / 2) - 1 / jump, rel=0.02)
