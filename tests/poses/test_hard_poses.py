"""Sessions that hardly fix a turntable: each is solved, or refused in a sentence that says why."""

import cv2
import numpy as np
import pytest
from exact_turntable import (
    SIDE_M,
    adjusted,
    in_object_frame,
    marker_observations,
    marker_turntable,
    pose_errors,
    started,
)
from scipy.spatial.transform import Rotation
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, rotation_about_z
from hsi_sc_nerf.poses.feature_poses import KnownCamera
from hsi_sc_nerf.poses.marker_poses import poses_from_markers
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.structure_from_motion import structure_from_motion
from hsi_sc_nerf.poses.turntable import rotations_about_z, square_corners
from hsi_sc_nerf.poses.turntable_from_poses import turntable_from_poses

INFO = SessionInfo(marker_side_m=SIDE_M)


def normals_deg(one, other):
    """Angles between the markers' normals of two turntables."""
    cosine = (one.marker_poses[:, :3, 2] * other.marker_poses[:, :3, 2]).sum(-1)
    return np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))


EDGE_ON = np.sin(np.deg2rad(0.5))
"""Cosine to the normal of a marker that is seen at half a degree."""


@pytest.mark.parametrize(("noise_px", "largest_deg", "largest_mm"), [(0.0, 1e-3, 1e-2), (0.05, 0.15, 1.5)])
def test_markers_that_lie_edge_on_do_no_harm(noise_px, largest_deg, largest_mm):
    scene = MarkerScene(frames=18, elevation_deg=-4.0)  # two centimetres above the disc
    true = marker_turntable(scene)
    seen = marker_observations(true, noise_px, least_cosine=EDGE_ON)
    assert len(marker_observations(true, least_cosine=np.sin(np.deg2rad(4.0)))) < 0.5 * len(seen)
    rotation_deg, place_mm = pose_errors(in_object_frame(adjusted(started(scene, seen), seen)), scene.camera_to_world)
    assert rotation_deg < largest_deg
    assert place_mm < largest_mm


def test_the_sequence_decides_between_the_two_poses_of_a_marker():
    """Before a long lens, the pose with the smaller error is often the wrong one of the two."""
    distance_m = 0.45 * np.tan(np.deg2rad(15.5)) / np.tan(np.deg2rad(2.5))
    scene = MarkerScene(frames=24, fov_deg=5.0, distance_m=distance_m)
    true = marker_turntable(scene)
    seen = marker_observations(true, 0.2)
    start = started(scene, seen)
    camera = np.array([[true.focal_px, 0, scene.size_px / 2], [0, true.focal_px, scene.size_px / 2], [0, 0, 1.0]])
    to_room, wrong = rotations_about_z(true.angles_rad), 0
    for row in range(len(seen)):
        at = np.searchsorted(true.markers, seen.marker[row])
        rotation = true.camera_rotation @ to_room[seen.frame[row]] @ true.marker_poses[at, :3, :3]
        _, both, *_ = cv2.solvePnPGeneric(
            square_corners(SIDE_M), seen.corners_px[row], camera, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        first, second = (
            (Rotation.from_matrix(rotation).inv() * Rotation.from_rotvec(r.ravel())).magnitude() for r in both
        )
        wrong += first > second
    assert wrong > 0.3 * len(seen)
    assert normals_deg(start, true).max() < 15.0
    assert normals_deg(adjusted(start, seen), true).max() < 1.0


def test_two_frames_fix_no_axis_but_have_poses_by_a_known_camera():
    images, names = [np.zeros((48, 64), np.uint8)] * 2, ["a", "b"]
    for find in (lambda: poses_from_markers(images, names, INFO), lambda: structure_from_motion(images, names)):
        with pytest.raises(InputError, match=r"2 frame\(s\) \(a, b\) cannot fix"):
            find()
    with pytest.raises(InputError, match=r"1 frame\(s\) \(a\) cannot fix"):
        poses_from_markers(images[:1], names[:1], INFO)
    first = look_at([0.4, 0.0, 0.2], [0, 0, 0.06])
    camera = KnownCamera(PinholeIntrinsics(64, 48, 100.0, 100.0, 32.0, 24.0), (0.0,) * 4, first, "ccw")
    info = SessionInfo(frame_angles_deg=(0.0, 180.0))
    poses = find_poses(images, names, info, "angles", camera=camera)
    np.testing.assert_allclose(poses.camera_to_world, [first, rotation_about_z(-180.0) @ first], atol=1e-12)


@pytest.mark.slow
def test_markers_of_a_table_that_does_not_turn_are_named():
    scene = MarkerScene(frames=4, noise=0.01)
    scene.camera_to_world[:] = scene.camera_to_world[0]
    with pytest.raises(InputError, match=r"share[^\n]*markers \d+[^\n]* stand still"):
        poses_from_markers(scene.render(), scene.names(), INFO)


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "step_deg"), [("y", 2.0), ("z", 40.0)])
def test_a_camera_that_turns_where_it_stands_is_refused(axis, step_deg):
    scene = MarkerScene(frames=9, noise=0.01)
    for i, pose in enumerate(scene.camera_to_world):
        pose[:] = scene.first_camera_to_world
        pose[:3, :3] @= Rotation.from_euler(axis, (i - 4) * step_deg, degrees=True).as_matrix()
    with pytest.raises(InputError, match="axis goes through the camera"):
        poses_from_markers(scene.render(), scene.names(), INFO)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("step_deg", [3.0, 18.0])
def test_free_poses_of_a_camera_that_turns_where_it_stands_are_refused(noise, step_deg):
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (10, 1, 1))
    for i, pose in enumerate(poses):
        pose[:3, :3] = Rotation.from_euler("yx", [i * step_deg, 20.0], degrees=True).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ ([0.3, 0.1, 0.2] + noise * rng.normal(size=3))
    with pytest.raises(InputError, match="axis goes through the camera"):
        turntable_from_poses(poses, rng.normal(size=(5, 3)), 500.0, (128.0, 128.0))


def test_a_camera_far_above_the_table_still_has_an_axis():
    """Seen from 87 degrees above, the axis is near the camera, and the poses are determined all the same."""
    scene = MarkerScene(frames=18, elevation_deg=87.0)
    seen = marker_observations(marker_turntable(scene), 0.0, least_cosine=EDGE_ON)
    found = adjusted(started(scene, seen), seen)
    assert found.distance == pytest.approx(marker_turntable(scene).distance, rel=1e-3)
