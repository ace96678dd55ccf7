"""Turns and the upright direction of made-up machines, by the corners of their markers."""

import numpy as np
import pytest
from exact_turntable import marker_observations, marker_turntable
from inspection_session import SIZE_PX as SESSION_PX
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.inspection.marker_checks import Markers, find_markers, turn_and_rotation_deg
from hsi_sc_nerf.inspection.quicklook import quicklooks_of
from hsi_sc_nerf.poses.marker_fit import fit_marker

SIZE_PX = 256


def detections(noise_px: float = 0.3, rotation_deg: float = 0.0, **options) -> tuple[MarkerScene, list[dict]]:
    """Corners of the markers that face the camera, in images that are turned counter-clockwise."""
    scene = MarkerScene(size_px=SIZE_PX, **options)
    seen = marker_observations(marker_turntable(scene), noise_px)
    angle = np.deg2rad(rotation_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])  # y points down
    found: list[dict] = [{} for _ in scene.angles_deg]
    for frame, marker, corners in zip(seen.frame, seen.marker, seen.corners_px, strict=True):
        found[frame][int(marker)] = (corners - SIZE_PX / 2) @ turn + SIZE_PX / 2
    return scene, found


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("distance_m", [0.45, 2.0])
def test_angles_come_back(direction, distance_m):
    fov_deg = 31.0 * 0.45 / distance_m
    scene, found = detections(
        0.1, frames=18, direction=direction, jitter_deg=2.0, distance_m=distance_m, fov_deg=fov_deg
    )
    angles_deg, _ = turn_and_rotation_deg(found, (SIZE_PX, SIZE_PX))
    error_deg = angles_deg - scene.angles_deg
    assert np.abs(error_deg - error_deg.mean()).max() < 0.5


@pytest.mark.parametrize("elevation_deg", [12.0, 60.0])
@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
@pytest.mark.parametrize(
    "options",
    [{"turn_deg": 40.0}, {"side_markers": 0, "disc_markers": 5}, {"side_markers": 12, "disc_markers": 4}],
)
def test_the_rotation_is_found_at_many_views_with_a_rolled_camera(elevation_deg, rotation_deg, options):
    _, found = detections(frames=4, elevation_deg=elevation_deg, rotation_deg=rotation_deg + 8.0, **options)
    assert turn_and_rotation_deg(found, (SIZE_PX, SIZE_PX))[1] == rotation_deg


def test_a_view_from_the_side_or_of_a_small_turn_tells_no_direction():
    for view in ({"elevation_deg": 0.0, "disc_markers": 0}, {"turn_deg": 10.0}):
        _, found = detections(frames=6, **view)
        assert turn_and_rotation_deg(found, (SIZE_PX, SIZE_PX))[1] is None


def test_a_frame_that_shares_no_marker_has_no_angle():
    _, found = detections(frames=12)
    found[4] = {}
    found[5] = {marker + 100: corners for marker, corners in found[5].items()}
    angles_deg, _ = turn_and_rotation_deg(found, (SIZE_PX, SIZE_PX))
    assert np.flatnonzero(np.isnan(angles_deg)).tolist() == [4, 5]
    assert np.isnan(turn_and_rotation_deg([{}, {}], (SIZE_PX, SIZE_PX))[0]).all()


@pytest.mark.parametrize(
    ("angles_deg", "usual_deg"),
    [
        ([0, 30, 60, 120, 120, 150, 180], 30.0),
        ([0, 60, 120, 180, 120, 60, 0], None),
        ([0, 100, 95, 300, 20, 210, 215], None),
        ([0, np.nan, np.nan, np.nan, 120, 150, np.nan], None),
        ([np.nan] * 7, None),
    ],
)
def test_a_usual_step_is_one_that_many_frames_share(angles_deg, usual_deg):
    found = Markers("DICT_5X5_50", [{}] * 7, np.array(angles_deg, float), 0, 20.0, 0.1)
    assert found.usual_step_deg == usual_deg


def test_the_stated_error_of_corners_is_their_distance_from_the_truth(good):
    session = open_session(good)
    quicklooks = quicklooks_of(session)
    markers = find_markers(session, quicklooks)
    scene = MarkerScene(size_px=SESSION_PX, frames=len(quicklooks), target_height_m=0.08)
    errors_px = []
    for quicklook, seen, pose in zip(quicklooks, markers.detections, scene.camera_to_world, strict=True):
        for marker, corners in seen.items():
            fit = fit_marker(quicklook.gray.astype(float), "DICT_5X5_50", marker, corners)
            if fit is not None:
                true_px, _ = project(scene.corners_m[marker], pose, scene.intrinsics)
                errors_px.append(fit.corners_px - true_px)
    assert len(errors_px) > 20
    assert markers.corner_error_px == pytest.approx(np.sqrt(np.mean(np.square(errors_px))), rel=0.5)
