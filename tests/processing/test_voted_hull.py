"""What the cameras see of the visual hull, and masks trimmed to it."""

import numpy as np
from capture_factory import sphere_mask, true_pose

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.processing.voted_hull import voted_hull

INTRINSICS = PinholeIntrinsics(64, 64, 120.0, 120.0, 32.0, 32.0)
POSES = np.stack([true_pose(angle) for angle in np.arange(12) * 30.0])


def good_masks():
    return np.stack([sphere_mask(pose, INTRINSICS) for pose in POSES])


def overlap(a, b):
    return (a & b).sum(axis=(1, 2)) / (a | b).sum(axis=(1, 2))


def test_silhouettes_of_a_sphere_are_its_masks():
    masks = good_masks()
    assert overlap(voted_hull(masks, POSES, INTRINSICS).silhouettes, masks).min() > 0.92


def test_what_other_frames_contradict_is_trimmed_and_nothing_else():
    masks = good_masks()
    spoilt = masks.copy()
    y, x = np.nonzero(masks[3])
    spoilt[3, y.max() - 1 : y.max() + 9, x.min() : x.max()] = True
    assert (spoilt[3] & ~masks[3]).sum() > 50
    trimmed = voted_hull(spoilt, POSES, INTRINSICS).trim(spoilt)
    np.testing.assert_array_equal(np.delete(trimmed, 3, axis=0), np.delete(masks, 3, axis=0))
    assert (trimmed[3] >= masks[3]).all()
    assert (trimmed[3] & ~masks[3]).sum() < 0.4 * (spoilt[3] & ~masks[3]).sum()
