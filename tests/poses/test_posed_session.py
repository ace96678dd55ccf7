"""Stated standard deviations against the errors of made-up sessions, hidden errors included."""

from dataclasses import replace

import numpy as np
import pytest
from exact_turntable import marker_observations, marker_turntable, point_tracks, point_turntable, points_alone
from scipy.spatial.transform import Rotation
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.poses.bundle_adjustment import Adjusted, FreeParameters, Problem
from hsi_sc_nerf.poses.container_outline import ContainerOutline
from hsi_sc_nerf.poses.object_frame import disc_height
from hsi_sc_nerf.poses.posed_session import (
    _landmark_gradients,
    in_object_frame,
    pose_uncertainty,
    smooth_fields,
    with_hidden_errors,
)
from hsi_sc_nerf.poses.residuals import MarkerResiduals, PointResiduals
from hsi_sc_nerf.poses.track_adjustment import adjust_together, adjust_tracks

SEEDS = 12
NAMES = [f"f{i}" for i in range(12)]
UNMEASURED = {"reprojection_error_px": np.zeros(12), "overall_error_px": 0.0, "markers_per_frame": (3,) * 12}


def scores(adjusted, true):
    """Errors of focal length, size, rotation and position in standard deviations."""
    found, stated = adjusted.turntable, pose_uncertainty(adjusted, adjusted.covariance())
    poses, truth = found.camera_to_world(), true.camera_to_world()
    rotation = Rotation.from_matrix(poses[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2)).magnitude().max()
    found_z = true_z = 0.0
    landmarks = found.points_3d, true.points_3d[found.points]
    if len(true.markers):
        landmarks = found.marker_poses[:, :3, 3], true.marker_poses[:, :3, 3]
        found_z, true_z = (np.median(places[6:, 2]) if len(places) > 6 else 0.0 for places in landmarks)
    away = (poses - truth)[:, :3, 3]
    away[:, 2] = found_z - true_z
    position = np.linalg.norm(away, axis=1).max()
    found_size, true_size = (np.linalg.norm(places[:, :2]) for places in landmarks)
    return [
        np.log(found.focal_px / true.focal_px) / stated.focal,
        np.log(found_size / true_size) / stated.size,
        np.rad2deg(rotation) / stated.rotation_deg,
        position / stated.position_m,
    ]


def test_markers_that_are_shifted_together_are_covered():
    true, found = marker_turntable(MarkerScene(size_px=256, frames=12)), []
    for seed in range(SEEDS):
        seen = marker_observations(true, seed=seed)
        fields = smooth_fields(seen.corners_px.reshape(-1, 2))
        shift_px = fields @ (0.007 * np.random.default_rng(seed).normal(size=fields.shape[-1]))
        seen = replace(seen, corners_px=seen.corners_px + shift_px.reshape(-1, 4, 2))
        problem = Problem(MarkerResiduals(true, seen, 3.0))
        found.append(scores(with_hidden_errors(Adjusted(problem.minimise(true), problem)), true))
    found = np.abs(found)
    assert (found < 2.0).mean() > 0.9
    assert np.sqrt((found[:, :3] ** 2).mean()) > 0.4
    # Without the hidden errors too little is stated.
    bare = scores(Adjusted(problem.minimise(true), problem), true)
    assert np.abs(bare).max() > 2.0 * found[-1].max()


def test_a_scale_by_a_container_whose_markers_may_stand_off_is_stated_as_uncertain():
    true = marker_turntable(MarkerScene(size_px=256, frames=12))
    seen = marker_observations(true)
    adjusted = Adjusted(true, Problem(MarkerResiduals(true, seen, 3.0)))
    for known, source, least in (("marker_side_m", "markers", 0.0), ("container_diameter_m", "container", 0.014)):
        info = SessionInfo(container_height_m=0.07, **{known: 0.03})
        scale = in_object_frame(adjusted, seen, NAMES, (256, 256), info, **UNMEASURED).scale
        assert scale.source == source
        assert least <= scale.uncertainty < least + 0.005


@pytest.mark.parametrize(
    ("off_m", "by_foot"), [(0.002, False), (-0.02, False), (-0.07, True)], ids=["disc", "poor foot", "lid"]
)
def test_markers_on_the_disc_go_before_the_containers_foot(off_m, by_foot):
    """Markers that face up nearer to the lid than to the foot lie on the lid."""
    true = marker_turntable(MarkerScene(size_px=256, frames=12, side_markers=0))
    adjusted = Adjusted(true, Problem(MarkerResiduals(true, marker_observations(true), 3.0)))
    info, disc_m = SessionInfo(container_diameter_m=0.09, container_height_m=0.07), disc_height(true)

    def posed(outline):
        return in_object_frame(adjusted, None, NAMES, (256, 256), info, outline, **UNMEASURED)

    found, sure = (posed(ContainerOutline(0.045, 0.001, disc_m + off_m, sigma, 0.07)) for sigma in (0.003, 0.0))
    assert found.disc_by_container == by_foot
    markers_z_m = np.mean([*found.marker_corners_m.values()], axis=(0, 1))[2]
    assert markers_z_m == pytest.approx(-off_m if by_foot else 0.0, abs=1e-4)
    assert (found.uncertainty.position_m > sure.uncertainty.position_m) == by_foot


@pytest.mark.parametrize("markers", [False, True])
def test_features_that_creep_are_covered(markers):
    scene = MarkerScene(size_px=256, frames=18, disc_markers=1, side_markers=0)
    found = []
    for seed in range(4):
        true = point_turntable(marker_turntable(scene), 200, seed)
        seen = marker_observations(true, seed=seed) if markers else None
        alone = points_alone(true)
        true = true if markers else alone
        tracks = point_tracks(true, noise_px=0.05, seed=seed)
        # Every feature creeps its own way while it passes, and all creep along a little.
        rng = np.random.default_rng(seed)
        passed = np.sin(true.angles_rad[tracks.frame] + np.arctan2(*true.points_3d[tracks.point, 1::-1].T))
        own = 0.15 * rng.normal(size=(200, 2))[tracks.point] * passed[:, None]
        together = 0.1 * smooth_fields(tracks.pixels)[..., rng.integers(0, 18)]
        tracks = replace(tracks, pixels=tracks.pixels + own + together)
        adjusted, _ = adjust_together(adjust_tracks(alone, tracks), seen, FreeParameters(distance=markers))
        found.append(scores(adjusted, true)[0:3:2])
    assert (np.abs(found) < 2.0).mean() > 0.9


def test_points_that_err_together_in_their_frames_are_covered_by_their_scatter():
    """Each point is seen at a wrong place of its own, which turns as it passes: observations are not independent."""
    scene, found = MarkerScene(size_px=256, frames=18), []
    for seed in range(SEEDS):
        true = point_turntable(marker_turntable(scene), 150, seed)
        true = points_alone(true)
        tracks = point_tracks(true, noise_px=0.01, seed=seed)
        rng = np.random.default_rng(100 + seed)
        phase = 2.0 * true.angles_rad[tracks.frame] + rng.uniform(0.0, 2.0 * np.pi, 150)[tracks.point]
        offset_px = 0.1 * np.stack([np.cos(phase), np.sin(phase)], axis=-1)
        tracks = replace(tracks, pixels=tracks.pixels + offset_px)
        problem = Problem(PointResiduals(true, tracks, 1e3, 0.01), free=FreeParameters(distance=False))
        found.append(scores(Adjusted(problem.minimise(true), problem), true)[0:3:2])
    assert 0.6 < np.sqrt((np.array(found) ** 2).mean()) < 1.45


def test_an_angle_that_is_not_known_moves_its_camera_along_the_circle():
    true = marker_turntable(MarkerScene(size_px=256, frames=12))
    problem = Problem(MarkerResiduals(true, marker_observations(true), 3.0))
    covariance = np.zeros((problem.layout.motion_size,) * 2)
    column = problem.layout.angle[5]
    covariance[column, column] = 0.01**2
    stated = pose_uncertainty(Adjusted(true, problem), covariance)
    assert stated.rotation_deg == pytest.approx(np.rad2deg(0.01), rel=0.05)
    height = _landmark_gradients(Adjusted(true, problem))[0][column]
    assert stated.position_m == pytest.approx(0.01 * np.hypot(true.distance, height), rel=0.05)
