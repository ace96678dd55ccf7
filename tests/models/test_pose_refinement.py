"""What each mode of pose refinement does to rays, and what it can recover from them."""

import numpy as np
import pytest
import torch
from nerfstudio.cameras.lie_groups import exp_map_SE3
from nerfstudio.cameras.rays import RayBundle
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.data.dataparser import CAMERA_ROTATION, FRAME_INDEX, pinhole_cameras
from hsi_sc_nerf.geometry.camera import (
    PinholeIntrinsics,
    look_at,
    rotation_about_z,
    rotation_angle_deg,
    turntable_camera_to_world,
)
from hsi_sc_nerf.models.pose_refinement import (
    PoseRefinement,
    PoseRefinementConfig,
    TurntableRefinement,
    held_out_interpolation,
    visible_twists,
)

AXIS_ORIGIN = np.array([0.0, 0.0, -0.4])
FIRST = look_at(np.array([2.0, 0.3, 0.9]), np.array([0.0, 0.0, 0.1]))
TRAIN = [0, 1, 3, 5]
LEARNING_MODES = ["turntable", "free-discarded"]
MODES = ["off", *LEARNING_MODES]


def rigid(axis_angle_deg, shift=(0.0, 0.0, 0.0)):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(axis_angle_deg, degrees=True).as_matrix()
    pose[:3, 3] = shift
    return pose


def session(num_frames=8):
    return np.stack([turntable_camera_to_world(FIRST, 360.0 / num_frames * i) for i in range(num_frames)])


def wobbling_session(num_frames=12, tilt_deg=0.2):
    """The object's motion of frame i is Tilt_i Rot(z, angle_i), so that poses differ by more than turns about z."""
    tilts = np.random.default_rng(5).normal(scale=tilt_deg, size=(num_frames, 3)) * [1.0, 1.0, 0.0]
    motions = [rigid(tilt) @ rotation_about_z(360.0 / num_frames * i) for i, tilt in enumerate(tilts)]
    return np.stack([np.linalg.inv(motion) @ FIRST for motion in motions])


def rays_of(poses, frame):
    lens = PinholeIntrinsics(16, 16, 50.0, 50.0, 8.0, 8.0)
    cameras = pinhole_cameras(poses[[frame]], lens, np.zeros(4), np.array([frame]))
    return cameras.generate_rays(camera_indices=0, keep_shape=True)


def refinement(poses, train, mode="turntable", refine=False):
    return PoseRefinementConfig(mode=mode).setup(
        refine=refine,
        camera_to_world=poses[0],
        frame_indices=np.array(train),
        num_frames=len(poses),
        axis_origin=AXIS_ORIGIN,
    )


def learn_something(learned, size=0.05):
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in learned.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * size)
    return learned


@pytest.mark.parametrize(("refine", "kind"), [(False, PoseRefinement), (True, TurntableRefinement)])
def test_by_default_the_models_effects_decide(refine, kind):
    assert type(refinement(session(), TRAIN, PoseRefinementConfig().mode, refine)) is kind


def test_twists_that_change_no_image_are_left_out():
    pose = session()[0]
    pose[:3, 3] -= AXIS_ORIGIN
    basis = visible_twists(pose)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)
    # A small turn about z, shift along z, or growth of the scene, as a twist on the right.
    shift, growth = np.eye(4), pose.copy()
    shift[2, 3] = 1e-6
    growth[:3, 3] *= 1 + 1e-6
    for changed in (rotation_about_z(1e-4) @ pose, shift @ pose, growth):
        relative = np.linalg.inv(pose) @ changed
        w = np.array([relative[2, 1], relative[0, 2], relative[1, 0]])
        twist = np.concatenate([relative[:3, 3], w])
        assert np.linalg.norm(basis.T @ twist) < 1e-3 * np.linalg.norm(twist)


def test_held_out_frames_take_their_neighbours_corrections():
    matrix = held_out_interpolation(np.array([0, 2, 3]), 5)
    np.testing.assert_allclose(matrix @ [1.0, 3.0, -1.0], [1.0, 2.0, 3.0, -1.0, -1.0])


@pytest.mark.parametrize("mode", MODES)
def test_nothing_learned_changes_nothing(mode):
    poses = session()
    rays, reference = rays_of(poses, 3), rays_of(poses, 3)
    learned = refinement(poses, TRAIN, mode)
    learned.apply_to_raybundle(rays)
    torch.testing.assert_close(rays.origins, reference.origins)
    torch.testing.assert_close(rays.directions, reference.directions)
    pose = torch.from_numpy(poses[[3]]).float()
    torch.testing.assert_close(learned.corrected(torch.tensor([3]), pose), pose)


@pytest.mark.parametrize("wobbles", [False, True])
@pytest.mark.parametrize("frame", [3, 4])
def test_corrections_equal_the_corrected_cameras_rays(frame, wobbles):
    """Frame 3 is a training frame, frame 4 is held out; the formula holds for any pose."""
    poses = wobbling_session() if wobbles else session()
    learned = learn_something(refinement(poses, [0, 1, 2, 3, 5, 6, 7]))

    delta = learned.angle_corrections()[frame].item()
    twist = np.eye(4)
    twist[:3] = exp_map_SE3(learned.twist()[None])[0].detach().numpy()
    corrected = poses.copy()
    shifted = poses[frame].copy()
    shifted[:3, 3] -= AXIS_ORIGIN
    corrected[frame] = rotation_about_z(-np.rad2deg(delta)) @ shifted @ twist
    corrected[frame, :3, 3] += AXIS_ORIGIN
    assert_moves_like(learned, poses, corrected, frame)


@pytest.mark.parametrize("mode", LEARNING_MODES)
def test_mixed_precision_does_not_move_rays(mode):
    poses = session()
    learned = refinement(poses, TRAIN, mode)
    learn_something(learned)
    full, mixed = rays_of(poses, 3), rays_of(poses, 3)
    learned.apply_to_raybundle(full)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        learned.apply_to_raybundle(mixed)
    torch.testing.assert_close(mixed.directions, full.directions, rtol=0, atol=1e-6)
    torch.testing.assert_close(mixed.origins, full.origins, rtol=0, atol=1e-6)


def assert_moves_like(learned, poses, corrected, frame):
    rays = rays_of(poses, frame)
    learned.apply_to_raybundle(rays)
    expected = rays_of(corrected, frame)
    torch.testing.assert_close(rays.origins, expected.origins, atol=1e-5, rtol=0)
    torch.testing.assert_close(rays.directions, expected.directions, atol=1e-5, rtol=0)
    refined = learned.corrected(torch.tensor([frame]), torch.from_numpy(poses[[frame]]).float()).detach().numpy()
    np.testing.assert_allclose(refined, corrected[[frame]], atol=1e-5)


def moved_by(learned, poses, frame):
    rays = rays_of(poses, frame)
    before = rays.origins.clone()
    learned.apply_to_raybundle(rays)
    return rays, (rays.origins - before).abs().max().item()


def test_frozen_corrections_are_kept_but_get_no_gradient():
    poses = session()
    learned = learn_something(refinement(poses, TRAIN))
    assert moved_by(learned, poses, 3)[0].origins.requires_grad
    learned.freeze(True)
    for frame in (3, 4):
        rays, moved = moved_by(learned, poses, frame)
        assert not rays.origins.requires_grad
        assert moved > 0.01
    losses = {}
    learned.get_loss_dict(losses)
    assert losses == {}
    learned.freeze(False)
    assert moved_by(learned, poses, 3)[0].origins.requires_grad


def test_discarded_corrections_are_a_turn_and_a_shift_of_a_training_view_and_end_with_the_stage():
    poses = session()
    learned = learn_something(refinement(poses, TRAIN, "free-discarded"))
    shift, turn = np.split(learned.pose_adjustment[2].detach().numpy(), 2)
    corrected = poses.copy()
    corrected[3, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ poses[3, :3, :3]
    corrected[3, :3, 3] += shift
    assert_moves_like(learned, poses, corrected, 3)
    assert moved_by(learned, poses, 4)[1] == 0.0  # held out
    learned.freeze(False)
    assert moved_by(learned, poses, 3)[1] > 0.01
    learned.freeze(True)
    assert moved_by(learned, poses, 3)[1] == 0.0


def test_what_is_off_has_no_parameters():
    learned = refinement(session(), TRAIN, "off")
    groups, losses, metrics = {}, {}, {}
    learned.get_param_groups(groups)
    learned.get_loss_dict(losses)
    learned.get_metrics_dict(metrics)
    assert list(learned.parameters()) == []
    assert (groups, losses, metrics) == ({}, {}, {})
    assert learned.frozen


@pytest.mark.parametrize("mode", LEARNING_MODES)
def test_penalties_hold_the_corrections_near_zero(mode):
    learned = refinement(session(), TRAIN, mode)
    sizes = []
    for size in (0.0, 0.01, 0.05):
        losses = {}
        learn_something(learned, size).get_loss_dict(losses)
        sizes.append(losses["camera_opt_regularizer"].item())
    assert sizes[0] == 0.0
    assert sizes[0] < sizes[1] < sizes[2]


@pytest.mark.parametrize("mode", MODES)
def test_a_viewers_rays_pass_untouched(mode):
    poses = session()
    learned = learn_something(refinement(poses, TRAIN, mode))
    rays = rays_of(poses, 3)
    del rays.metadata[FRAME_INDEX]
    before = rays.origins.clone()
    learned.apply_to_raybundle(rays)
    torch.testing.assert_close(rays.origins, before)


def recover(true_poses, given_poses):
    """Refine given poses until the rays through the same points of the object meet: a scene of points alone."""
    frames = np.arange(len(true_poses))
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (15, 3))
    seen = points - true_poses[:, None, :3, 3]
    in_camera = np.einsum("fji,fpj->fpi", true_poses[:, :3, :3], seen / np.linalg.norm(seen, axis=-1, keepdims=True))
    directions = torch.from_numpy(np.einsum("fij,fpj->fpi", given_poses[:, :3, :3], in_camera))
    origins = torch.from_numpy(np.broadcast_to(given_poses[:, None, :3, 3], directions.shape).copy())
    rotations = torch.from_numpy(given_poses[:, :3, :3].reshape(-1, 1, 9)).expand(-1, len(points), -1)
    indices = torch.from_numpy(frames)[:, None, None].expand(-1, len(points), 1).double()

    learned = refinement(given_poses, frames).double()
    optimiser = torch.optim.LBFGS(
        learned.parameters(),
        max_iter=60,
        tolerance_grad=1e-12,
        tolerance_change=1e-15,
        line_search_fn="strong_wolfe",
    )

    def misfit():
        optimiser.zero_grad()
        rays = RayBundle(
            origins=origins,
            directions=directions,
            pixel_area=torch.ones_like(indices),
            metadata={FRAME_INDEX: indices, CAMERA_ROTATION: rotations},
        )
        learned.apply_to_raybundle(rays)
        # Each point where its rays come nearest to each other, and how far they pass from it.
        across = torch.eye(3).double() - rays.directions[..., :, None] * rays.directions[..., None, :]
        met = torch.linalg.solve(across.sum(0), torch.einsum("fpij,fpj->pi", across, rays.origins))
        loss = 100 * torch.einsum("fpij,fpj->fpi", across, rays.origins - met).square().sum()
        loss.backward()
        return loss

    optimiser.step(misfit)
    return learned.corrected(torch.from_numpy(frames), torch.from_numpy(given_poses)).detach().numpy(), learned


def pose_errors(true_poses, poses):
    """Largest errors of the poses relative to the first frame's, up to scale: degrees, fraction of the distance."""
    true_motion, motion = np.linalg.inv(true_poses[0]) @ true_poses[1:], np.linalg.inv(poses[0]) @ poses[1:]
    scale = np.linalg.norm(true_motion[:, :3, 3]) / np.linalg.norm(motion[:, :3, 3])
    shifts = np.linalg.norm(true_motion[:, :3, 3] - scale * motion[:, :3, 3], axis=1)
    turns = [rotation_angle_deg(a, b) for a, b in zip(true_motion, motion, strict=True)]
    return max(turns), shifts.max() / np.linalg.norm(true_poses[0, :3, 3])


@pytest.mark.slow
@pytest.mark.parametrize("wobbles", [False, True])
def test_errors_of_the_axis_and_the_angles_are_recovered(wobbles):
    """An axis that stands elsewhere and leans elsewhere is a camera moved before it; each frame's angle is its own.

    Where the table wobbles, each frame keeps its tilt; what no image shows without wobble (a turn about the axis)
    then shows a little, and is left: hence 0.02 degrees.
    """
    true_poses = wobbling_session() if wobbles else session(12)
    axis_error = rigid((0.5, -0.4, 0.3), shift=(0.004, -0.008, 0.006))
    camera_error = np.linalg.inv(FIRST) @ axis_error @ FIRST
    angle_errors_deg = np.random.default_rng(3).normal(scale=0.4, size=len(true_poses))
    given = np.stack(
        [rotation_about_z(e) @ pose @ camera_error for e, pose in zip(angle_errors_deg, true_poses, strict=True)]
    )
    given_turn, given_shift = pose_errors(true_poses, given)
    assert given_turn > 0.5
    assert given_shift > 0.005

    refined, learned = recover(true_poses, given)
    turn, shift = pose_errors(true_poses, refined)
    assert turn < 0.02
    assert shift < 5e-4
    angles = np.rad2deg(learned.angle_corrections().detach().numpy())
    np.testing.assert_allclose(angles, angle_errors_deg - angle_errors_deg.mean(), atol=0.02)
