"""What the disc, the container and the scale are by the markers."""

from dataclasses import replace

import numpy as np
import pytest
from exact_turntable import SIDE_M, marker_turntable
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.poses.object_frame import container_diameter, lie_on_disc, scale_of

WALL_M = 2 * 0.0455
"""Diameter of the circle that the scene's upright markers touch."""
UNIT_M = 0.37


@pytest.fixture(scope="module")
def turntable():
    return marker_turntable(MarkerScene(size_px=64, frames=2))


def test_disc_is_the_lowest_group_that_faces_up(turntable):
    np.testing.assert_array_equal(lie_on_disc(turntable.corners()), turntable.markers >= 6)
    on_lid = turntable.marker_poses.copy()
    on_lid[-1, :3, 3] = [0.0, 0.0, on_lid[-1, 2, 3] + 0.07]
    for kept, on_disc in ((slice(None), range(6, 13)), ([*range(6), 13], [])):  # with and without markers on the disc
        poses = replace(turntable, markers=turntable.markers[kept], marker_poses=on_lid[kept])
        assert poses.markers[lie_on_disc(poses.corners())].tolist() == [*on_disc]


@pytest.mark.parametrize("shift_m", [0.0, 0.01])
def test_the_container_is_measured_by_its_markers(turntable, shift_m):
    poses = turntable.marker_poses.copy()
    poses[:, 0, 3] += shift_m
    turntable = replace(turntable, marker_poses=poses)
    assert container_diameter(turntable, 0.07) == pytest.approx(WALL_M, abs=1e-9)
    assert container_diameter(turntable.resized(1.7), None) == pytest.approx(1.7 * WALL_M, abs=1e-9)
    assert container_diameter(turntable, 0.02) is None


@pytest.mark.parametrize(
    ("info", "source"),
    [
        (SessionInfo(marker_side_m=SIDE_M, container_diameter_m=1.02 * WALL_M, camera_distance_m=1.0), "markers"),
        (SessionInfo(container_diameter_m=WALL_M, camera_distance_m=1.0), "container"),
        (SessionInfo(camera_distance_m=UNIT_M), "distance"),
    ],
)
def test_scale_comes_from_the_best_that_is_known(turntable, info, source):
    unscaled = turntable.resized(UNIT_M / turntable.distance if source == "distance" else 1.0).resized(1.0 / UNIT_M)
    assert scale_of(unscaled, info) == (source, pytest.approx(UNIT_M))
    assert scale_of(unscaled, SessionInfo()) == (None, 1.0)
    bare = replace(unscaled, markers=unscaled.markers[:0], marker_poses=unscaled.marker_poses[:0])
    assert scale_of(bare, replace(info, camera_distance_m=None)) == (None, 1.0)
