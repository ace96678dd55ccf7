"""A ball seen from far away: a camera sees the half that faces it."""

from __future__ import annotations

import numpy as np
import trimesh

from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.evaluation.visible_surface import views_of_points
from hsi_sc_nerf.poses.geometry import PinholeIntrinsics, look_at, turntable_camera_to_world

BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
POINTS = sample_surface(BALL.vertices, BALL.faces, 5000)
DISTANCE_M = 2.0
CAMERA = look_at(np.array([DISTANCE_M, 0.0, 0.0]), np.zeros(3))
LENS = PinholeIntrinsics(w=100, h=100, fl_x=1000.0, fl_y=1000.0, cx=50.0, cy=50.0)


def test_a_camera_sees_the_side_that_faces_it():
    seen = views_of_points(POINTS, BALL.vertices, BALL.faces, [CAMERA], LENS) == 1
    horizon_m = 0.04**2 / DISTANCE_M
    clear = np.abs(POINTS[:, 0] - horizon_m) > 0.004  # facets and clearance blur the rim
    np.testing.assert_array_equal(seen[clear], (POINTS[:, 0] > horizon_m)[clear])


def test_views_are_counted_and_the_underside_of_a_turning_object_is_never_seen():
    above = look_at(np.array([1.4, 0.0, 1.4]), np.zeros(3))
    poses = [turntable_camera_to_world(above, angle) for angle in range(0, 360, 10)]
    views = views_of_points(POINTS, BALL.vertices, BALL.faces, poses, LENS)
    lowest, highest = POINTS[:, 2] < -0.034, POINTS[:, 2] > 0.034
    assert (views[lowest] == 0).all()
    assert (views[highest] == len(poses)).all()
    # From 45 degrees above, the sine of the lowest latitude seen is that of -45 degrees.
    assert abs((views > 0).mean() - (1 + np.sqrt(0.5)) / 2) < 0.02


def test_what_is_outside_the_picture_is_not_seen():
    narrow = PinholeIntrinsics(w=20, h=100, fl_x=1000.0, fl_y=1000.0, cx=10.0, cy=50.0)
    seen = views_of_points(POINTS, BALL.vertices, BALL.faces, [CAMERA], narrow) == 1
    assert seen.any()
    assert np.abs(POINTS[seen, 1]).max() < 0.0205
