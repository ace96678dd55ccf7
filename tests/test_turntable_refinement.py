import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.lie_groups import exp_map_SE3

from hsi_sc_nerf.models.turntable_refinement import (
    CAMERA_ROTATION,
    FRAME_INDEX,
    TurntableRefinementConfig,
    gauge_free_basis,
    held_out_interpolation,
)
from hsi_sc_nerf.poses.geometry import look_at, rotation_about_z, turntable_camera_to_world

AXIS_ORIGIN = np.array([0.0, 0.0, -0.4])


def session(num_frames=8):
    first = look_at(np.array([2.0, 0.3, 0.9]), np.array([0.0, 0.0, 0.1]))
    return np.stack([turntable_camera_to_world(first, 360.0 / num_frames * i) for i in range(num_frames)])


def cameras(poses, frames):
    rotations = poses[frames, :3, :3].reshape(-1, 9)
    return Cameras(
        camera_to_worlds=torch.from_numpy(poses[frames, :3]).float(),
        fx=50.0,
        fy=50.0,
        cx=8.0,
        cy=8.0,
        width=16,
        height=16,
        camera_type=CameraType.PERSPECTIVE,
        metadata={
            FRAME_INDEX: torch.tensor(frames)[:, None].float(),
            CAMERA_ROTATION: torch.from_numpy(rotations).float(),
        },
    )


def refinement(poses, train):
    return TurntableRefinementConfig().setup(
        num_cameras=len(train),
        device="cpu",
        camera_to_world=poses[0],
        frame_indices=np.array(train),
        num_frames=len(poses),
        axis_origin=AXIS_ORIGIN,
    )


def test_gauge_twists_are_projected_out():
    poses = session()
    pose = poses[0].copy()
    pose[:3, 3] -= AXIS_ORIGIN
    basis = gauge_free_basis(pose)
    np.testing.assert_allclose(basis.T @ basis, np.eye(4), atol=1e-12)
    # A small turn about z or shift along z, applied on the left, as a twist on the right.
    shift = np.eye(4)
    shift[2, 3] = 1e-6
    for change in (rotation_about_z(1e-4), shift):
        relative = np.linalg.inv(pose) @ change @ pose
        w = np.array([relative[2, 1], relative[0, 2], relative[1, 0]])
        twist = np.concatenate([relative[:3, 3], w])
        assert np.linalg.norm(basis.T @ twist) < 1e-3 * np.linalg.norm(twist)


def test_held_out_frames_take_their_neighbours_angles():
    matrix = held_out_interpolation(np.array([0, 2, 3]), 5)
    np.testing.assert_allclose(matrix @ [1.0, 3.0, -1.0], [1.0, 2.0, 3.0, -1.0, -1.0])


def test_nothing_learned_changes_nothing():
    poses = session()
    views = cameras(poses, [1, 3])
    rays, reference = (views.generate_rays(camera_indices=1, keep_shape=True) for _ in range(2))
    refinement(poses, [0, 1, 3, 5]).apply_to_raybundle(rays)
    torch.testing.assert_close(rays.origins, reference.origins)
    torch.testing.assert_close(rays.directions, reference.directions)


@pytest.mark.parametrize("frame", [3, 4])
def test_corrections_equal_the_corrected_cameras_rays(frame):
    """Frame 3 is a training frame, frame 4 is held out."""
    poses = session()
    train = [0, 1, 2, 3, 5, 6, 7]
    learned = refinement(poses, train)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        learned.camera_twist.copy_(torch.randn(4, generator=generator) * 0.05)
        learned.frame_angles.copy_(torch.randn(len(train), generator=generator) * 0.05)

    delta = learned.angle_corrections()[frame].item()
    twist = np.eye(4)
    twist[:3] = exp_map_SE3((learned.gauge_basis @ learned.camera_twist)[None])[0].detach().numpy()
    corrected = poses.copy()
    shifted = poses[frame].copy()
    shifted[:3, 3] -= AXIS_ORIGIN
    corrected[frame] = rotation_about_z(-np.rad2deg(delta)) @ shifted @ twist
    corrected[frame, :3, 3] += AXIS_ORIGIN

    rays = cameras(poses, [frame]).generate_rays(camera_indices=0, keep_shape=True)
    learned.apply_to_raybundle(rays)
    expected = cameras(corrected, [frame]).generate_rays(camera_indices=0, keep_shape=True)
    torch.testing.assert_close(rays.origins, expected.origins, atol=1e-5, rtol=0)
    torch.testing.assert_close(rays.directions, expected.directions, atol=1e-5, rtol=0)


def test_frozen_corrections_are_kept_but_get_no_gradient():
    poses = session()
    learned = refinement(poses, [0, 1, 3, 5])
    with torch.no_grad():
        learned.camera_twist.fill_(0.05)
    learned.frozen = True
    rays = cameras(poses, [3]).generate_rays(camera_indices=0, keep_shape=True)
    before = rays.origins.clone()
    learned.apply_to_raybundle(rays)
    assert not rays.origins.requires_grad
    assert (rays.origins - before).abs().max() > 0.01


def test_a_viewers_rays_pass_untouched():
    poses = session()
    learned = refinement(poses, [0, 1, 3, 5])
    with torch.no_grad():
        learned.camera_twist.fill_(0.05)
    rays = cameras(poses, [3]).generate_rays(camera_indices=0, keep_shape=True)
    del rays.metadata[FRAME_INDEX]
    before = rays.origins.clone()
    learned.apply_to_raybundle(rays)
    torch.testing.assert_close(rays.origins, before)
