"""Pose geometry against closed forms, OpenCV and round trips."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.geometry.camera import (
    OPENCV_TO_OPENGL,
    PinholeIntrinsics,
    look_at,
    pixel_rays,
    project,
    rotation_about_z,
    rotation_angle_deg,
    turntable_camera_to_world,
)

CAMERA = PinholeIntrinsics(w=120, h=80, fl_x=210.0, fl_y=205.0, cx=61.0, cy=38.5)
POSE = look_at(np.array([0.4, -0.1, 0.2]), np.array([0.01, 0.02, 0.05]))
POINTS = np.random.default_rng(0).uniform(-0.05, 0.05, (50, 3))


def test_look_at_closed_form():
    pose = look_at(np.array([2.0, 0.0, 0.0]), np.zeros(3))
    expected = [[0, 0, 1, 2], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(pose, expected, atol=1e-15)
    np.testing.assert_allclose(POSE[:3, :3].T @ POSE[:3, :3], np.eye(3), atol=1e-14)
    assert np.linalg.det(POSE[:3, :3]) == pytest.approx(1.0)


def test_look_at_puts_the_target_in_the_middle_and_up_on_top():
    target = np.array([0.01, 0.02, 0.05])
    pixels, depth = project(np.stack([target, target + np.array([0.0, 0.0, 0.01])]), POSE, CAMERA)
    np.testing.assert_allclose(pixels[0], [CAMERA.cx, CAMERA.cy], atol=1e-12)
    assert depth[0] == pytest.approx(np.linalg.norm(POSE[:3, 3] - target))
    assert pixels[1, 0] == pytest.approx(CAMERA.cx)
    assert pixels[1, 1] < CAMERA.cy


def test_look_at_straight_down_is_refused():
    with pytest.raises(ValueError, match="parallel to the z axis"):
        look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0), (-0.3, 0.2, 0.01, -0.02)])
def test_projection_is_opencvs_half_a_pixel_further(distortion):
    world_to_camera = np.linalg.inv(POSE @ OPENCV_TO_OPENGL)
    matrix = CAMERA.matrix()
    matrix[:2, 2] -= 0.5  # OpenCV's first pixel centre is (0, 0)
    rotation, _ = cv2.Rodrigues(world_to_camera[:3, :3])
    theirs, _ = cv2.projectPoints(POINTS, rotation, world_to_camera[:3, 3], matrix, np.array(distortion))
    np.testing.assert_allclose(project(POINTS, POSE, CAMERA, distortion)[0], theirs[:, 0] + 0.5, atol=1e-9)
    assert project(POINTS[:0], POSE, CAMERA, distortion)[0].shape == (0, 2)


def test_rays_go_through_the_points_that_were_projected():
    pixels, depth = project(POINTS, POSE, CAMERA)
    origin, directions = pixel_rays(CAMERA, POSE, pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    distance = np.linalg.norm(POINTS - origin, axis=-1)
    np.testing.assert_allclose(origin + distance[:, None] * directions, POINTS, atol=1e-12)
    np.testing.assert_allclose(-(directions @ POSE[:3, 2]) * distance, depth, atol=1e-12)


@pytest.mark.parametrize("angle_deg", [0.0, 17.0, -90.0, 200.0])
def test_turning_the_object_is_turning_the_camera_back(angle_deg):
    turned = POINTS @ rotation_about_z(angle_deg)[:3, :3].T
    still = project(POINTS, turntable_camera_to_world(POSE, angle_deg), CAMERA)
    np.testing.assert_allclose(project(turned, POSE, CAMERA)[0], still[0], atol=1e-10)


def test_positive_angles_turn_counter_clockwise_seen_from_above():
    np.testing.assert_allclose(rotation_about_z(90.0)[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [1.0, 1.0, 1.0]])
@pytest.mark.parametrize("angle_deg", [0.0, 1e-7, 0.5, 90.0, 179.999, 180.0])
def test_a_rotation_about_any_axis_has_its_angle(axis, angle_deg):
    turn = np.eye(4)
    direction = np.array(axis) / np.linalg.norm(axis)
    turn[:3, :3] = Rotation.from_rotvec(np.deg2rad(angle_deg) * direction).as_matrix()
    assert rotation_angle_deg(turn @ POSE, POSE) == pytest.approx(angle_deg, rel=1.6e-8, abs=1e-12)


def test_half_a_turn_about_any_axis_is_a_number():
    """Rounding makes some of the chords longer than those of half a turn."""
    axes = np.random.default_rng(0).normal(size=(500, 3))
    turns = Rotation.from_rotvec(np.pi * axes / np.linalg.norm(axes, axis=1, keepdims=True)).as_matrix()
    assert rotation_angle_deg(np.eye(3), turns) == pytest.approx(np.full(500, 180.0), abs=3e-6)
