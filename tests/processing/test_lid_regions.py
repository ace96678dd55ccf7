"""Pixels above the container's lid, and those of its middle."""

import cv2
import numpy as np
import pytest
from capture_factory import INTRINSICS, true_pose

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, pixel_rays, project
from hsi_sc_nerf.packed.dataset import Container
from hsi_sc_nerf.processing.lid_regions import above_lid, lid_middle

NO_DISTORTION = np.zeros(4)
CONTAINER = Container(diameter_m=0.09, height_m=0.07)


@pytest.mark.parametrize("height", [0.25, 0.05])
def test_above_lid_agrees_with_marching_along_the_rays(height):
    pose = look_at([0.35, 0.1, height], [0.0, 0.0, 0.08])
    intrinsics = PinholeIntrinsics(24, 24, 35.0, 35.0, 12.0, 12.0)
    x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(24) + 0.5)
    origin, directions = pixel_rays(intrinsics, pose, np.stack([x, y], axis=-1))
    expected, blocked = np.zeros((2, 24, 24), bool)
    radius = CONTAINER.diameter_m / 2
    for t in np.arange(0.0, 0.8, 0.0005):
        points = origin + t * directions
        distance = np.hypot(points[..., 0], points[..., 1])
        above, inside = points[..., 2] > CONTAINER.height_m, points[..., 2] > 0.0
        expected |= (distance < 1.2 * radius) & above & ~blocked
        blocked |= (distance < radius) & inside & ~above
    result = above_lid(intrinsics, NO_DISTORTION, pose, CONTAINER, overhang=1.2)
    assert 0.1 < expected.mean() < 0.9
    assert (result != expected).sum() <= 3


def test_above_lid_undoes_lens_distortion():
    pose = true_pose(0.0)
    distortion = np.array([2.0, 0.0, 0.03, 0.0])
    straight = above_lid(INTRINSICS, NO_DISTORTION, pose, CONTAINER, overhang=1.2)
    bent = above_lid(INTRINSICS, distortion, pose, CONTAINER, overhang=1.2)
    y, x = np.mgrid[0 : INTRINSICS.h, 0 : INTRINSICS.w]
    rays = np.stack(
        [(x + 0.5 - INTRINSICS.cx) / INTRINSICS.fl_x, (y + 0.5 - INTRINSICS.cy) / INTRINSICS.fl_y, np.ones(x.shape)],
        -1,
    )
    moved = cv2.projectPoints(rays.reshape(-1, 3), np.zeros(3), np.zeros(3), INTRINSICS.matrix(), distortion)[0]
    column, row = np.clip(moved.reshape(*x.shape, 2).astype(int), 0, INTRINSICS.w - 1).transpose(2, 0, 1)
    central = np.hypot(x - INTRINSICS.cx, y - INTRINSICS.cy) < 20
    disagree = (bent[row, column] != straight)[central].mean()
    assert disagree < 0.02
    assert (bent != straight)[central].mean() > 2 * disagree


def test_the_middle_of_the_lid_is_in_the_middle_of_what_may_be_the_objects():
    pose = true_pose(0.0)
    middle = lid_middle(INTRINSICS, pose, CONTAINER)
    (centre,), _ = project(np.array([[0.0, 0.0, CONTAINER.height_m]]), pose, INTRINSICS)
    row, column = np.nonzero(middle)
    assert np.hypot(column.mean() + 0.5 - centre[0], row.mean() + 0.5 - centre[1]) < 0.5
    radius_px = INTRINSICS.fl_x * 0.3 * CONTAINER.diameter_m / 2 / np.linalg.norm(pose[:3, 3] - [0, 0, 0.07])
    assert np.ptp(column) + 1 == pytest.approx(2 * radius_px, abs=1.5)
    assert (middle & above_lid(INTRINSICS, NO_DISTORTION, pose, CONTAINER, overhang=1.2)).sum() == middle.sum()
