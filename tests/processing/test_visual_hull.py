"""The visual hull of a sphere's masks, what the cameras see of it, and the boxes of the object and all that turns."""

import numpy as np
import pytest
from capture_factory import INTRINSICS, SPHERE_CENTRE_M, SPHERE_RADIUS_M, sphere_mask, true_pose

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, project, turntable_camera_to_world
from hsi_sc_nerf.packed.dataset import Container
from hsi_sc_nerf.processing.visual_hull import (
    DISC_OVER_CONTAINER,
    DISC_OVER_MARKERS,
    OBJECT_MARGIN_M,
    SCENE_MARGIN_M,
    assumed_disc,
    object_box,
    scene_box,
    voted_hull,
)

LENS = PinholeIntrinsics(64, 64, 120.0, 120.0, 32.0, 32.0)
POSES = np.stack([true_pose(angle) for angle in np.arange(12) * 30.0])


def good_masks():
    return np.stack([sphere_mask(pose, LENS) for pose in POSES])


def overlap(a, b):
    return (a & b).sum(axis=(1, 2)) / (a | b).sum(axis=(1, 2))


def test_silhouettes_of_a_sphere_are_its_masks():
    masks = good_masks()
    assert overlap(voted_hull(masks, POSES, LENS).silhouettes, masks).min() > 0.92


def test_what_other_frames_contradict_is_trimmed_and_nothing_else():
    masks = good_masks()
    spoilt = masks.copy()
    y, x = np.nonzero(masks[3])
    spoilt[3, y.max() - 1 : y.max() + 9, x.min() : x.max()] = True
    assert (spoilt[3] & ~masks[3]).sum() > 50
    trimmed = voted_hull(spoilt, POSES, LENS).trim(spoilt)
    np.testing.assert_array_equal(np.delete(trimmed, 3, axis=0), np.delete(masks, 3, axis=0))
    assert (trimmed[3] >= masks[3]).all()
    assert (trimmed[3] & ~masks[3]).sum() < 0.4 * (spoilt[3] & ~masks[3]).sum()


CONTAINER = Container(diameter_m=0.09, height_m=0.07)
OUTWARDS = np.array([[-1.0], [1.0]])


def turn(count: int) -> np.ndarray:
    return np.stack([true_pose(angle) for angle in np.arange(count) * 360.0 / count])


@pytest.mark.slow
def test_object_box_of_a_sphere():
    poses = turn(24)
    intrinsics = PinholeIntrinsics(128, 128, 240.0, 240.0, 64.0, 64.0)
    masks = np.stack([sphere_mask(pose, intrinsics) for pose in poses])
    box = object_box(voted_hull(masks, poses, intrinsics)) - OBJECT_MARGIN_M * OUTWARDS
    truth = np.stack([SPHERE_CENTRE_M - SPHERE_RADIUS_M, SPHERE_CENTRE_M + SPHERE_RADIUS_M])
    outside = np.stack([truth[0] - box[0], box[1] - truth[1]])
    assert outside.min() > -0.001
    # From one height the hull keeps a cone above and below the sphere; around it, it is exact.
    assert outside[:, :2].max() < 0.005
    assert object_box(voted_hull(masks, poses, intrinsics), min_z_m=0.08)[0, 2] == 0.08


@pytest.mark.parametrize("count", [4, 6, 8])
def test_box_of_few_frames_holds_nothing_that_few_of_them_see(count):
    """Beyond the common field of view a voxel is in a few frames only, and in front of their masks by chance."""
    start = look_at([0.42, 0.0, 0.23], [0.0, 0.0, 0.06])
    poses = np.stack([turntable_camera_to_world(start, angle) for angle in np.arange(count) * 360.0 / count])
    intrinsics = PinholeIntrinsics(128, 128, 230.0, 230.0, 64.0, 64.0)
    masks = np.stack([sphere_mask(pose, intrinsics) for pose in poses])
    box = object_box(voted_hull(masks, poses, intrinsics))
    assert np.abs(box[:, :2]).max() < SPHERE_RADIUS_M + OBJECT_MARGIN_M + 0.02


@pytest.mark.slow
@pytest.mark.parametrize("empty", [[5], [0, 1, 2]])
def test_empty_masks_do_not_cut_the_object(empty):
    poses = turn(24)
    masks = np.stack([sphere_mask(pose) for pose in poses])
    box = object_box(voted_hull(masks, poses, INTRINSICS))
    masks[empty] = False
    assert np.abs(object_box(voted_hull(masks, poses, INTRINSICS)) - box).max() < 0.01


def test_box_keeps_a_part_thinner_than_a_voxel():
    poses = turn(12)
    stem = np.column_stack([np.zeros(200), np.zeros(200), np.linspace(0.1, 0.17, 200)])
    intrinsics = PinholeIntrinsics(160, 160, 300.0, 300.0, 80.0, 80.0)
    masks = np.stack([sphere_mask(pose, intrinsics) for pose in poses])
    for mask, pose in zip(masks, poses, strict=True):
        x, y = project(stem, pose, intrinsics)[0].astype(int).T
        mask[y, x] = True
    assert 0.17 <= object_box(voted_hull(masks, poses, intrinsics))[1, 2] - OBJECT_MARGIN_M < 0.18


def test_masks_that_do_not_fit_the_poses():
    poses = turn(6)
    masks = np.zeros((6, 48, 48), bool)
    with pytest.raises(InputError, match="do not fit each other"):
        object_box(voted_hull(masks, poses, INTRINSICS))


OBJECT = np.array([[-0.02, -0.02, 0.07], [0.02, 0.02, 0.2]])


def box_about_the_axis(reach, lowest, highest):
    return np.array([[-reach, -reach, lowest], [reach, reach, highest]]) + SCENE_MARGIN_M * OUTWARDS


def test_scene_box_holds_all_that_turns():
    corners = {3: np.array([[0.1, 0.0, 0.0], [0.12, 0.0, 0.0], [0.12, 0.02, 0.0], [0.1, 0.02, 0.0]])}
    disc = DISC_OVER_MARKERS * np.hypot(0.12, 0.02)
    np.testing.assert_allclose(scene_box(OBJECT, corners, CONTAINER), box_about_the_axis(disc, 0.0, 0.2))
    wide = np.array([[-0.3, -0.02, 0.07], [0.02, 0.02, 0.2]])
    np.testing.assert_allclose(scene_box(wide, corners, None), box_about_the_axis(0.3, 0.0, 0.2))


def test_without_markers_the_scene_box_holds_a_disc_as_wide_as_the_container_suggests():
    reach = DISC_OVER_CONTAINER * CONTAINER.diameter_m / 2.0
    assert reach > 0.205 / 2.0  # the simulator's disc
    expected = box_about_the_axis(reach, 0.0, 0.2)
    np.testing.assert_allclose(scene_box(OBJECT, {}, CONTAINER), expected)
    np.testing.assert_allclose(scene_box(OBJECT, {}, None, CONTAINER.diameter_m), expected)
    np.testing.assert_allclose(scene_box(OBJECT, {}, None), box_about_the_axis(0.02, 0.0, 0.2))
    assert assumed_disc(True, 0.09) is None
    assert "207 mm" in assumed_disc(False, 0.09)
    assert "masks' hull" in assumed_disc(False, None)
