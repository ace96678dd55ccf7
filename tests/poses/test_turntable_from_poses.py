"""From free poses to the machine: exact round trips, partial turns, either direction, wrong poses, no turn at all."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.turntable import Tracks
from hsi_sc_nerf.poses.turntable_from_poses import looks_up_deg, reversed_in_depth, turntable_from_poses, upright

CAMERA = 500.0, (128.0, 128.0)
ELEVATION_DEG, ROLL_DEG, DISTANCE = 25.0, 4.0, 0.42


def machine():
    """Turntable frame to OpenCV camera axes, of a camera at (DISTANCE, 0, 0) that looks down, a little rolled."""
    looks_back = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    down, roll = Rotation.from_euler("x", -ELEVATION_DEG, degrees=True), Rotation.from_euler("z", ROLL_DEG, True)
    return roll.as_matrix() @ down.as_matrix() @ looks_back


def free_poses(angles_deg, scale=3.0, seed=0):
    """World-to-camera in a world of another orientation, place and scale; the world's points and the machine's."""
    rng = np.random.default_rng(seed)
    world = Rotation.random(random_state=rng).as_matrix()
    shift = rng.normal(size=3)
    poses = np.tile(np.eye(4), (len(angles_deg), 1, 1))
    for pose, angle in zip(poses, angles_deg, strict=True):
        turn = Rotation.from_euler("z", angle, True).as_matrix()
        pose[:3, :3] = machine() @ turn @ world.T
        # World point Y = scale * world X + shift; the camera's coordinates in the world's scale.
        pose[:3, 3] = -scale * machine() @ [DISTANCE, 0.0, 0.0] - pose[:3, :3] @ shift
    points = rng.normal(size=(5, 3)) * 0.05
    return poses, scale * points @ world.T + shift, points


@pytest.mark.parametrize(
    "angles_deg",
    [
        np.arange(0, 360, 18.0),
        -np.arange(0, 360, 18.0),
        np.linspace(0, 200, 15),
        np.linspace(0, 25, 6),
        np.arange(0, 360, 24.0) + np.random.default_rng(3).normal(0, 3, 15),
    ],
)
def test_exact_poses_give_the_exact_machine(angles_deg):
    poses, in_world, points = free_poses(angles_deg)
    fit, contradicts = turntable_from_poses(poses, in_world, *CAMERA)
    np.testing.assert_allclose(np.rad2deg(fit.angles_rad), angles_deg - angles_deg[0], atol=1e-6)
    turn = Rotation.from_euler("z", angles_deg[0], True).as_matrix()
    np.testing.assert_allclose(fit.camera_rotation, machine(), atol=1e-8)
    np.testing.assert_allclose(fit.points_3d, points @ turn.T / DISTANCE, atol=1e-8)
    assert not contradicts.any()


def test_frames_without_a_pose_are_left_out():
    angles_deg = np.arange(0, 360, 20.0)
    poses, in_world, _ = free_poses(angles_deg)
    poses[[0, 7]] = np.nan
    fit, contradicts = turntable_from_poses(poses, in_world, *CAMERA)
    assert not contradicts.any()
    np.testing.assert_array_equal(fit.frames, np.delete(np.arange(18), [0, 7]))
    np.testing.assert_allclose(np.rad2deg(fit.angles_rad), angles_deg[fit.frames] - 20.0, atol=1e-6)


def test_wrong_poses_are_found_and_do_no_harm():
    angles_deg = np.arange(0, 360, 18.0)
    poses, in_world, _ = free_poses(angles_deg)
    wrong = [2, 5, 6, 11, 13, 19]
    for k in wrong[:4]:
        poses[k, :3, :3] = Rotation.random(random_state=k).as_matrix() @ poses[k, :3, :3]
    for k in wrong[4:]:
        poses[k, :3, 3] += 0.3
    fit, contradicts = turntable_from_poses(poses, in_world, *CAMERA)
    np.testing.assert_array_equal(np.flatnonzero(contradicts), wrong)
    np.testing.assert_array_equal(fit.frames, np.flatnonzero(~contradicts))
    np.testing.assert_allclose(fit.camera_rotation, machine(), atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(fit.angles_rad), angles_deg[fit.frames], atol=1e-5)


def test_noise_averages_out():
    angles_deg = np.arange(0, 360, 6.0)
    poses, in_world, points = free_poses(angles_deg)
    rng = np.random.default_rng(1)
    for pose in poses:
        # As in structure from motion the object stays where it is in the image: rotation and place err together.
        turn = Rotation.from_rotvec(np.deg2rad(rng.normal(0, 0.5, 3))).as_matrix()
        centre = np.array([0.0, 0.0, 3.0 * DISTANCE])
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = turn @ (pose[:3, 3] - centre) + centre
    fit, contradicts = turntable_from_poses(poses, in_world, *CAMERA)
    assert not contradicts.any()
    off = Rotation.from_matrix(fit.camera_rotation @ machine().T).magnitude()
    assert np.rad2deg(off) < 0.4
    np.testing.assert_allclose(
        np.linalg.norm(fit.points_3d, axis=-1), np.linalg.norm(points, axis=-1) / DISTANCE, rtol=0.02
    )


def test_a_camera_that_stands_still_has_no_axis():
    poses, _, _ = free_poses(np.zeros(10))
    with pytest.raises(InputError, match="do not turn about one axis"):
        turntable_from_poses(poses, np.zeros((0, 3)), *CAMERA)


def test_two_poses_are_too_few():
    poses, _, _ = free_poses(np.array([0.0, 10.0, 20.0]))
    poses[1] = np.nan
    with pytest.raises(InputError, match="cannot fix"):
        turntable_from_poses(poses, np.zeros((0, 3)), *CAMERA)


@pytest.mark.parametrize("roll_deg", [0.0, 60.0, 89.5, 90.5, 120.0, -90.0, 180.0])
def test_in_pictures_that_lie_on_their_side_the_camera_looks_down(roll_deg):
    poses, _, points = free_poses(np.arange(0, 360, 18.0))
    roll = np.eye(4)
    roll[:3, :3] = Rotation.from_euler("z", roll_deg - ROLL_DEG, True).as_matrix()
    points[:, 2] -= 0.2
    in_camera = 3.0 * (points - [DISTANCE, 0.0, 0.0]) @ machine().T
    in_world = (in_camera - poses[0, :3, 3]) @ poses[0, :3, :3]
    found = upright(turntable_from_poses(roll @ poses, in_world, *CAMERA)[0])
    upside_down = roll_deg == 180.0
    assert (looks_up_deg(found) > 10.0) == upside_down
    sign = -1.0 if upside_down else 1.0
    np.testing.assert_allclose(found.points_3d, points * [1.0, sign, sign] / DISTANCE, atol=1e-8)
    np.testing.assert_allclose(np.rad2deg(found.angles_rad), sign * np.arange(0, 360, 18.0), atol=1e-6)


def test_a_camera_far_away_sees_the_same_of_the_turntable_reversed_in_depth():
    poses, points, _ = free_poses(np.arange(0, 360, 18.0))
    turntable, _ = turntable_from_poses(poses, points, *CAMERA)
    tracks = Tracks(*(a.ravel() for a in np.meshgrid(turntable.frames, turntable.points)), pixels=np.zeros((100, 2)))
    middle = np.array([0.0, 0.0, np.median(turntable.points_3d[:, 2])])
    for factor, alike_px in ((10.0, 12.0), (100.0, 1.2), (1000.0, 0.12)):
        small = (turntable.points_3d - middle) / factor + middle
        far = replace(turntable, focal_px=factor * turntable.focal_px, points_3d=small)
        turned = reversed_in_depth(far)
        np.testing.assert_allclose(turned.reproject(tracks), far.reproject(tracks), atol=alike_px)
        # It turns the other way.
        np.testing.assert_allclose(turned.angles_rad, -far.angles_rad)
        np.testing.assert_allclose(reversed_in_depth(turned).points_3d, far.points_3d, atol=1e-12)
