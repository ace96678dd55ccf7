"""The container's radius in drawn frames."""

import cv2
import numpy as np
import pytest
from exact_turntable import marker_turntable, point_turntable
from turntable_scene import MarkerScene

from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.poses.container_outline import container_radius

RADIUS_M, HEIGHT_M, OVER = 0.045, 0.07, 8


@pytest.fixture(scope="module")
def turntable():
    scene = MarkerScene(size_px=192, frames=9)
    return scene, point_turntable(marker_turntable(scene), 100)


def drawn(scene, shift_m, contrast):
    """Frames of a container before a noisy, patterned wall; its lid is at its height above z = 0."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.normal(size=(192, 192)), (0, 0), 3.0)
    images = []
    for pose in scene.camera_to_world:
        around = np.linspace(0.0, 2.0 * np.pi, 90)
        rim = RADIUS_M * np.stack([np.cos(around), np.sin(around)], axis=-1) + [shift_m, 0.0]
        corners = np.concatenate([np.column_stack([rim, np.full(90, z)]) for z in (0.0, HEIGHT_M)])
        pixels, _ = project(corners, pose, scene.intrinsics)
        hull = cv2.convexHull(np.float32(pixels * OVER)).astype(np.int32)
        covered = cv2.fillConvexPoly(np.zeros((192 * OVER, 192 * OVER), np.float32), hull, 1.0)
        covered = cv2.resize(covered, (192, 192), interpolation=cv2.INTER_AREA)
        image = 120.0 + 30.0 * wall / wall.std() * 0.3 * (1.0 - covered) + contrast * covered
        images.append(np.clip(image + rng.normal(size=image.shape), 0, 255).astype(np.uint8))
    return images


@pytest.mark.parametrize("shift_m", [0.0, 0.002])
def test_the_radius_is_that_of_the_drawn_container(turntable, shift_m):
    scene, machine = turntable
    top = HEIGHT_M - scene.first_camera_to_world[2, 3]
    radius, sigma = container_radius(drawn(scene, shift_m, 60.0), machine, top, HEIGHT_M / RADIUS_M / 2.0)
    assert radius == pytest.approx(RADIUS_M, rel=2.0 * sigma)
    assert sigma < 0.01


def test_what_is_hardly_seen_is_not_measured(turntable):
    scene, machine = turntable
    top = HEIGHT_M - scene.first_camera_to_world[2, 3]
    assert container_radius(drawn(scene, 0.0, 0.0), machine, top, HEIGHT_M / RADIUS_M / 2.0) is None
