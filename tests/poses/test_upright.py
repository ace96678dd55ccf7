"""Which way up images are, on rendered and on exact markers."""

import numpy as np
import pytest
from exact_turntable import marker_observations, marker_turntable
from turntable_scene import MarkerScene

from hsi_sc_nerf.poses.upright import image_rotation_from_markers, rotation_from_corners


@pytest.fixture(scope="module")
def upright():
    return MarkerScene(size_px=128, frames=2, turn_deg=70.0, noise=0.005).render()


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
def test_the_rotation_of_rendered_images_is_found(upright, rotation_deg):
    images = [np.rot90(image, rotation_deg // 90) for image in upright]
    assert image_rotation_from_markers(images, "DICT_5X5_50") == rotation_deg


def rotated(corners_px, rotation_deg):
    """Pixels of an image that is turned counter-clockwise; y points down."""
    angle = np.deg2rad(rotation_deg)
    return corners_px @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@pytest.mark.parametrize("elevation_deg", [12.0, 30.0, 60.0])
@pytest.mark.parametrize("turn_deg", [10.0, 240.0, 360.0])
@pytest.mark.parametrize(
    "options", [{}, {"side_markers": 0, "disc_markers": 5}, {"side_markers": 12, "disc_markers": 4}]
)
def test_the_rotation_is_found_at_many_views_with_a_rolled_camera(elevation_deg, turn_deg, options):
    scene = MarkerScene(size_px=256, frames=4, elevation_deg=elevation_deg, turn_deg=turn_deg, **options)
    seen = marker_observations(marker_turntable(scene), noise_px=0.3)
    for rotation_deg in (0, 90, 180, 270):
        corners = rotated(seen.corners_px, rotation_deg + 8.0)
        assert rotation_from_corners(seen.frame, seen.marker, corners) == rotation_deg


def test_nothing_is_said_without_markers_on_the_disc():
    scene = MarkerScene(size_px=256, frames=4, disc_markers=0)
    seen = marker_observations(marker_turntable(scene), noise_px=0.3)
    assert rotation_from_corners(seen.frame, seen.marker, seen.corners_px) is None
    assert image_rotation_from_markers([np.full((64, 64), 90, np.uint8)] * 2, "DICT_5X5_50") is None
