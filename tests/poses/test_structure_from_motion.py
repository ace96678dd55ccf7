"""Poses without markers on small pictures of a patterned ball before a patterned wall, with known truth."""

import sys
import tempfile
from functools import lru_cache

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, pixel_rays, turntable_camera_to_world
from hsi_sc_nerf.poses.structure_from_motion import (
    moving_pixels,
    neighbour_pairs,
    require_space,
    structure_from_motion,
)
from hsi_sc_nerf.poses.track_adjustment import adjust_tracks
from hsi_sc_nerf.poses.turntable_from_poses import turntable_from_poses

SIZE_PX, FRAMES, RADIUS_M = 180, 20, 0.055
INTRINSICS = PinholeIntrinsics(SIZE_PX, SIZE_PX, 300.0, 300.0, SIZE_PX / 2, SIZE_PX / 2)
FIRST = look_at(np.array([0.26, 0.0, 0.12]), np.array([0.0, 0.004, 0.0]))
STEPS_DEG = np.arange(FRAMES) * -18.0


def patterns(shape, blob_px, seed):
    """Blobs of random brightness, 0 to 1, that join at the left and right borders."""
    noise = np.random.default_rng(seed).normal(size=shape).astype(np.float32)
    soft = cv2.GaussianBlur(np.tile(noise, 3), (0, 0), blob_px)[:, shape[1] : 2 * shape[1]]
    return 0.5 + 0.5 * np.tanh(1.2 * soft / soft.std())


@lru_cache(maxsize=4)
def session(texture=True, wall=True, noise=0.0, drift=0.0):
    """Gray images of the ball, its truth's poses and which pixels it covers."""
    skin = patterns((400, 800), 5.0, 0) if texture else np.full((400, 800), 0.5, np.float32)
    room = patterns((SIZE_PX, SIZE_PX), 3.0, 1) if wall else np.full((SIZE_PX, SIZE_PX), 0.9, np.float32)
    rng = np.random.default_rng(2)
    over = 3
    grid = (np.stack(np.meshgrid(*[np.arange(SIZE_PX * over)] * 2), -1) + 0.5) / over
    images, poses = [], []
    for i, angle in enumerate(STEPS_DEG):
        pose = turntable_camera_to_world(FIRST, angle)
        eye, rays = pixel_rays(INTRINSICS, pose, grid)
        along = -(rays @ eye)
        inside = along**2 - eye @ eye + RADIUS_M**2
        hit = eye + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
        column = ((np.arctan2(hit[..., 1], hit[..., 0]) / (2 * np.pi)) % 1 * 800).astype(np.float32)
        row = ((0.5 - np.arcsin(np.clip(hit[..., 2] / RADIUS_M, -1, 1)) / np.pi) * 400).astype(np.float32)
        ball = 0.15 + 0.5 * cv2.remap(skin, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        fine = np.where(inside > 0, ball, np.kron(room, np.ones((over, over))))
        image = cv2.resize(fine.astype(np.float32), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)
        image = 0.9 * image * (1 + drift * i / FRAMES) + noise * rng.normal(size=image.shape)
        images.append(np.clip(np.rint(image * 255), 0, 255).astype(np.uint8))
        poses.append(pose)
    covered = cv2.resize((inside > 0).astype(np.float32), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)
    return images, np.stack(poses), covered


def names():
    return [f"ball_{i:02d}" for i in range(FRAMES)]


def errors(found, truth):
    """Largest rotation error in degrees, and of the camera's place in metres, in the truth's world.

    Features know neither the scale nor where the first frame's axis starts: the distance and a turn of both worlds.
    """
    poses, true = found.camera_to_world(), truth[found.frames]
    rotations = Rotation.from_matrix(true[:, :3, :3]) * Rotation.from_matrix(poses[:, :3, :3]).inv()
    turn = rotations.mean()
    rotation = np.rad2deg((rotations * turn.inv()).magnitude().max())
    centres = turn.apply(poses[:, :3, 3])
    scale = np.linalg.norm(true[0, :2, 3])
    off = scale * centres - true[:, :3, 3]
    return rotation, np.linalg.norm(off - off.mean(axis=0), axis=-1).max()


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "drift"), [(0.0, 0.0), (0.02, -0.05)])
def test_what_moves_is_told_from_a_patterned_wall(noise, drift):
    images, _, covered = session(noise=noise, drift=drift)
    moving = moving_pixels(images)
    assert moving[covered == 1].mean() > 0.95
    far = cv2.dilate(covered, np.ones((13, 13))) == 0
    assert moving[far].mean() < 0.003


@pytest.mark.slow
def test_what_moves_is_told_from_a_black_wall():
    images, _, covered = session()
    stand = np.arange(SIZE_PX)[:, None] > 0.93 * SIZE_PX  # which stands still and gives the noise
    images = [np.where((covered > 0) | stand, image, 0).astype(np.uint8) for image in images]
    assert np.median(images) == 0.0
    moving = moving_pixels(images)
    assert moving[covered == 1].mean() > 0.95
    assert moving[cv2.dilate(covered, np.ones((13, 13))) == 0].mean() < 0.003
    assert not moving_pixels([np.zeros_like(images[0])] * 3).any()


@pytest.mark.slow
def test_a_disk_without_space_is_named(tmp_path, monkeypatch):
    images, _, _ = session()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    with pytest.raises(InputError, match=r"none: .*TMPDIR"):
        structure_from_motion(images, names())
    with pytest.raises(OSError, match="MB are free"):
        require_space(tmp_path, 10**18)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no limit of the size of files")
def test_files_that_cannot_be_written_are_no_lack_of_texture(tmp_path, monkeypatch):
    import resource

    images, _, _ = session()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(InputError, match="TMPDIR"):
            structure_from_motion(images, names())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.slow
def test_a_ball_before_a_patterned_wall_is_posed(tmp_path, monkeypatch):
    images, truth, _ = session()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    free = structure_from_motion(images, names())
    assert list(tmp_path.iterdir()) == []
    assert free.used.all()
    start, _ = turntable_from_poses(free.world_to_camera, free.points_3d, free.focal_px, free.centre_px)
    found = adjust_tracks(start, free.tracks)
    rotation_deg, place_m = errors(found.turntable, truth)
    assert rotation_deg < 0.3
    assert place_m < 0.0015
    assert found.turntable.focal_px == pytest.approx(INTRINSICS.fl_x, rel=0.02)
    assert found.turntable.frame_errors_px(found.tracks, FRAMES)[1] < 0.5
    np.testing.assert_allclose(np.rad2deg(found.turntable.angles_rad), STEPS_DEG, atol=0.3)


@pytest.mark.slow
def test_the_same_images_give_the_same_poses():
    images, _, _ = session()
    some = images[:6], names()[:6]
    one, two = structure_from_motion(*some), structure_from_motion(*some)
    np.testing.assert_array_equal(one.world_to_camera, two.world_to_camera)


@pytest.mark.slow
def test_a_ball_without_patterns_is_refused():
    images, _, _ = session(texture=False, noise=0.01)
    with pytest.raises(InputError, match=r"nothing moves|too little texture"):
        structure_from_motion(images, names())


def test_last_and_first_frame_are_neighbours():
    pairs = neighbour_pairs(60)
    assert len(pairs) == 60 * 12
    assert (0, 59) in pairs
    assert (0, 12) in pairs
    assert (0, 13) not in pairs
    assert len(neighbour_pairs(8)) == 8 * 3
