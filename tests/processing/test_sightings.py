"""Points of the hull of a known sphere, and what the frames show there."""

import numpy as np
import pytest
from capture_factory import INTRINSICS, SPHERE_CENTRE_M, SPHERE_RADIUS_M, sphere_mask, true_pose

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, pixel_rays
from hsi_sc_nerf.processing.sightings import COLOURS, MAX_INCIDENCE_DEG, colours_of, sightings
from hsi_sc_nerf.processing.voted_hull import voted_hull

LENS = PinholeIntrinsics(128, 128, 240.0, 240.0, 64.0, 64.0)

MISSING = 5  # the frame whose mask lacks its right half


def facing(pose):
    """Cosine of the angle of incidence at each pixel of the sphere; 0 beside it."""
    y, x = np.mgrid[: LENS.h, : LENS.w] + 0.5
    origin, directions = pixel_rays(LENS, pose, np.stack([x, y], axis=-1))
    towards = SPHERE_CENTRE_M - origin
    along = directions @ towards
    missed = np.maximum(towards @ towards - along**2, 0.0)
    return np.sqrt(np.maximum(1.0 - missed / SPHERE_RADIUS_M**2, 0.0))


@pytest.fixture(scope="module")
def seen():
    poses = np.stack([true_pose(angle) for angle in np.arange(0.0, 360.0, 15.0)])
    masks = np.stack([sphere_mask(pose, LENS) for pose in poses])
    images = [np.stack([facing(pose), np.full((LENS.h, LENS.w), 0.3)]) for pose in poses]
    hull = voted_hull(masks, poses, LENS)
    masks[MISSING, :, LENS.w // 2 :] = False
    return poses, sightings(images, masks, poses, LENS, np.zeros(4), hull)


def test_points_lie_on_the_sphere_with_its_normals(seen):
    _, found = seen
    outwards = found.positions_m - SPHERE_CENTRE_M
    radius_m = np.linalg.norm(outwards, axis=1)
    used = np.unique(found.point)
    assert np.median(radius_m[used]) == pytest.approx(SPHERE_RADIUS_M, abs=0.0015)
    angles = np.arccos((found.normals * outwards / radius_m[:, None]).sum(axis=1)[used].clip(-1.0, 1.0))
    assert np.rad2deg(np.median(angles)) < 12.0


def test_points_are_looked_up_where_the_camera_sees_them(seen):
    poses, found = seen
    incidence = found.normal[:, 2]
    assert incidence.min() > np.cos(np.deg2rad(MAX_INCIDENCE_DEG)) - 0.15
    # The picture shows the cosine of the angle of incidence, which the point's own normal has to give again.
    np.testing.assert_allclose(np.median(np.abs(found.reflectance[:, 0] - incidence)), 0.0, atol=0.05)
    np.testing.assert_allclose(found.reflectance[:, 1], 0.3, atol=1e-6)
    # No point behind the sphere is seen.
    outwards = found.positions_m[found.point] - SPHERE_CENTRE_M
    to_eye = poses[found.frame, :3, 3] - SPHERE_CENTRE_M
    assert ((outwards * to_eye).sum(axis=1) > 0.0).all()
    assert len(np.unique(found.frame)) == len(poses)


def test_points_beside_the_mask_are_left_out(seen):
    _, found = seen
    number = np.bincount(found.frame)
    assert number[MISSING] < 0.6 * number[MISSING - 1]


def test_colours_are_means_of_neighbouring_bins():
    bins = np.arange(24.0)[:, None, None] * np.ones((24, *[INTRINSICS.h // 8] * 2))
    assert colours_of(bins)[:, 0, 0].tolist() == [1.5, 5.5, 9.5, 13.5, 17.5, 21.5]
    assert len(colours_of(bins[:3])) == 3 < COLOURS
