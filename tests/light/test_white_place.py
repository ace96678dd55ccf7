"""Where the white reference was: on the turntable's axis, where the camera looks or as stated."""

import numpy as np
import pytest

from hsi_sc_nerf.geometry.camera import look_at
from hsi_sc_nerf.light.material import white_place

CENTRE = np.array([0.0, 0.0, 0.1])


def poses_looking_at(height_m, elevation_deg):
    elevation = np.deg2rad(elevation_deg)
    poses = []
    for azimuth in np.deg2rad(np.arange(0.0, 360.0, 40.0)):
        away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        aim = np.array([0.0, 0.0, height_m])
        poses.append(look_at(aim + 0.7 * away, aim))
    return np.array(poses)


def in_object_frame(place, poses):
    """Undo `white_place` with the first frame."""
    centre = poses[0, :3, :3].T @ (CENTRE - poses[0, :3, 3])
    return poses[0, :3, :3] @ (centre + place) + poses[0, :3, 3], centre


@pytest.mark.parametrize(("stated", "expected"), [(None, 0.04), (0.15, 0.15)])
def test_the_white_stood_where_the_camera_looks_or_as_stated(stated, expected):
    poses = poses_looking_at(0.04, 33.0)
    _, centre = in_object_frame(np.zeros(3), poses)
    found, _ = in_object_frame(white_place(centre, poses, stated), poses)
    np.testing.assert_allclose(found, [0.0, 0.0, expected], atol=1e-6)


def test_a_camera_above_the_table_leaves_the_white_at_the_object():
    poses = poses_looking_at(0.0, 85.0)
    _, centre = in_object_frame(np.zeros(3), poses)
    np.testing.assert_array_equal(white_place(centre, poses, None), 0.0)
