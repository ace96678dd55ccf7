"""The scale of poses from features, by the markers that are seen all the same."""

import pytest
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.poses.object_frame import scale_by_markers

UNIT_M = 0.37
"""Length of the unit that features leave lengths in."""
WALL_M = 2 * 0.0455
"""Diameter of the circle that the scene's upright markers touch."""


def corners():
    return {marker: places / UNIT_M for marker, places in MarkerScene(size_px=64, frames=2).corners_m.items()}


def side_m():
    first = next(iter(MarkerScene(size_px=64, frames=2).corners_m.values()))
    return float(((first[0] - first[1]) ** 2).sum() ** 0.5)


def test_the_markers_side_gives_the_scale_and_the_container_is_measured_against_it():
    info = SessionInfo(marker_side_m=side_m(), container_diameter_m=1.02 * WALL_M, container_height_m=0.07)
    scale, metres = scale_by_markers(corners(), 0.0, info)
    assert metres == pytest.approx(UNIT_M)
    assert scale.source == "markers"
    assert scale.measured_container_diameter_m == pytest.approx(WALL_M)
    assert scale.disagreement_percent == pytest.approx(100 * (1 / 1.02 - 1))


def test_without_the_side_the_container_gives_the_scale():
    scale, metres = scale_by_markers(corners(), 0.0, SessionInfo(container_diameter_m=WALL_M))
    assert metres == pytest.approx(UNIT_M)
    assert scale.source == "container"
    assert scale.marker_side_m == pytest.approx(side_m())


def test_with_neither_there_is_the_cameras_distance_or_nothing():
    assert scale_by_markers(corners(), 0.0, SessionInfo(camera_distance_m=0.4)) == (None, 0.4)
    assert scale_by_markers({}, 0.0, SessionInfo(marker_side_m=0.03)) == (None, 1.0)
