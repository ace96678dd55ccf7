"""Poses of a turntable from its markers: exact on exact corners, and close to the truth on rendered images."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from turntable_scene import MarkerScene

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import project, rotation_angle_deg
from hsi_sc_nerf.poses.adjust import Problem, Unknowns, adjust, reproject, whitening
from hsi_sc_nerf.poses.estimate import estimate_turntable_poses
from hsi_sc_nerf.poses.frame import camera_to_world, disc_height_m, on_disc
from hsi_sc_nerf.poses.initialise import Observations, initialise, linked_rows
from hsi_sc_nerf.poses.picture import draw_poses
from hsi_sc_nerf.poses.report import is_full_turn

SIDE_M = 0.03


def exact_observations(scene, noise_px=0.0, seed=0):
    """Corners of all markers that face the camera."""
    rng = np.random.default_rng(seed)
    rows = []
    for i, pose in enumerate(scene.camera_to_world):
        for marker, corners in scene.corners_m.items():
            normal = np.cross(corners[0] - corners[3], corners[2] - corners[3])
            view = pose[:3, 3] - corners.mean(0)
            if -normal @ view / np.linalg.norm(normal) / np.linalg.norm(view) > 0.25:
                pixels, _ = project(corners, pose, scene.intrinsics)
                rows.append((i, marker, pixels + noise_px * rng.normal(size=(4, 2))))
    frame, marker, corners = (np.array(column) for column in zip(*rows, strict=True))
    return Observations(frame, marker, corners, np.tile(np.eye(8) * 0.05**2, (len(frame), 1, 1)))


def solve(scene, observations):
    centre = (scene.size_px / 2, scene.size_px / 2)
    start = initialise(observations, centre, scene.size_px, SIDE_M)
    return adjust(start, observations, centre, SIDE_M, whitening(observations.covariance_px2), 3.0)


def pose_errors(found, truth):
    """Largest rotation error in degrees and largest error of the camera's place in millimetres."""
    rotation = max(rotation_angle_deg(a, b) for a, b in zip(found, truth, strict=True))
    return rotation, 1e3 * np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=-1).max()


@lru_cache(maxsize=8)
def estimated(**options):
    scene = MarkerScene(**options)
    return scene, estimate_turntable_poses(scene.render(), scene.names(), marker_side_m=SIDE_M, progress=False)


@pytest.mark.parametrize(
    "options",
    [
        {"frames": 12},
        {"frames": 20, "direction": -1, "jitter_deg": 1.0},
        {"frames": 18, "turn_deg": 200.0, "elevation_deg": 30.0},
        {"frames": 12, "fov_deg": 50.0, "distance_m": 0.3},
        {"frames": 24, "side_markers": 0},
    ],
)
def test_exact_corners_give_exact_poses(options):
    scene = MarkerScene(**options)
    turntable = solve(scene, exact_observations(scene))
    assert turntable.focal_px == pytest.approx(scene.intrinsics.fl_x, rel=1e-4)
    found = camera_to_world(turntable, disc_height_m(turntable, SIDE_M))
    rotation, position = pose_errors(found, scene.camera_to_world)
    assert rotation < 1e-2
    assert position < 1e-1
    turned = np.rad2deg(np.unwrap(turntable.angles_rad))
    np.testing.assert_allclose(turned, scene.angles_deg, atol=1e-2)


def test_first_guess_is_all_but_exact_on_exact_corners():
    scene = MarkerScene(frames=18, turn_deg=200.0)
    observations = exact_observations(scene)
    start = initialise(observations, (64.0, 64.0), scene.size_px, SIDE_M)
    error = reproject(start, observations, (64.0, 64.0), SIDE_M) - observations.corners_px
    assert np.abs(error).max() < 0.05


def test_noisy_corners_give_close_poses():
    scene = MarkerScene(frames=24)
    turntable = solve(scene, exact_observations(scene, noise_px=0.05))
    found = camera_to_world(turntable, disc_height_m(turntable, SIDE_M))
    rotation, position = pose_errors(found, scene.camera_to_world)
    assert rotation < 0.2
    assert position < 1.0


@pytest.mark.parametrize("unknowns", [Unknowns(), Unknowns(2), Unknowns(1, (0.02, 0.003))])
def test_derivatives_are_those_of_the_residuals(unknowns):
    scene = MarkerScene(frames=5)
    observations = exact_observations(scene, noise_px=0.5)
    start = initialise(observations, (64.0, 64.0), 128, SIDE_M)
    rng = np.random.default_rng(0)
    problem = Problem(start, observations, (64.0, 64.0), SIDE_M, rng.normal(size=(len(observations), 8, 8)), unknowns)
    here = problem.moved(start, 0.05 * rng.normal(size=problem.columns.size))
    columns, values = problem.rows(here)
    jacobian = np.zeros((len(observations), 8, problem.columns.size + 1))
    for row in range(len(observations)):
        jacobian[row, :, columns[row]] += values[row].T
    steps = 1e-6 * np.eye(problem.columns.size)
    numeric = np.stack(
        [
            (problem.residuals(problem.moved(here, d)) - problem.residuals(problem.moved(here, -d))) / 2e-6
            for d in steps
        ],
        axis=-1,
    )
    np.testing.assert_allclose(jacobian[..., :-1], numeric, atol=1e-5 * np.abs(numeric).max())
    # The normal equations are made of them, and of the motions' own spread.
    normal, gradient = problem.normal_equations(here, loss_scale=1e9)
    flat, residual = jacobian[..., :-1].reshape(-1, len(gradient)), problem.residuals(here).ravel()
    spread = np.zeros(len(gradient))
    if unknowns.motion_spread:
        spread[problem.columns.motion] = 1.0 / np.repeat(unknowns.motion_spread, (2, 3)) ** 2
    np.testing.assert_allclose(normal, flat.T @ flat + np.diag(spread), atol=1e-9 * np.abs(normal).max())
    own = np.zeros(len(gradient))
    own[problem.columns.motion] = problem.motions(here) * np.sqrt(spread[problem.columns.motion])
    np.testing.assert_allclose(gradient, flat.T @ residual + own, atol=1e-9 * np.abs(gradient).max())


def test_frames_without_a_shared_marker_are_not_linked():
    frame = np.array([0, 0, 1, 1, 2, 3, 4])
    marker = np.array([5, 6, 6, 7, 7, 8, 8])
    np.testing.assert_array_equal(linked_rows(frame, marker), [True] * 5 + [False] * 2)


@pytest.mark.parametrize(
    ("options", "largest_deg", "largest_mm"),
    [
        ({"size_px": 128, "frames": 18, "noise": 0.01}, 0.2, 0.7),
        ({"size_px": 128, "frames": 20, "direction": -1, "jitter_deg": 1.0, "drop": (5,), "blank": (9,)}, 0.2, 0.7),
        ({"size_px": 256, "frames": 12, "blur_px": 0.7, "noise": 0.01}, 0.1, 0.7),
        ({"size_px": 128, "frames": 24, "side_markers": 4, "disc_markers": 2}, 0.2, 1.0),
    ],
)
def test_rendered_session_is_posed(options, largest_deg, largest_mm):
    scene, poses = estimated(**options)
    blank = set(scene.blanked)
    np.testing.assert_array_equal(np.flatnonzero(~poses.used), sorted(blank))
    rotation, position = pose_errors(poses.camera_to_world[poses.used], scene.camera_to_world[poses.used])
    assert rotation < largest_deg
    assert position < largest_mm
    assert poses.intrinsics.fl_x == poses.intrinsics.fl_y == pytest.approx(scene.intrinsics.fl_x, rel=0.005)
    assert (poses.intrinsics.cx, poses.intrinsics.cy) == (scene.size_px / 2, scene.size_px / 2)
    np.testing.assert_allclose(poses.angles_deg[poses.used], scene.angles_deg[poses.used], atol=0.2)
    assert poses.dictionary == "DICT_5X5_50"
    for marker, corners in poses.marker_corners_m.items():
        np.testing.assert_allclose(corners, scene.corners_m[marker], atol=6e-4)


FULL = {"size_px": 128, "frames": 18, "noise": 0.01}
GAPS = {"size_px": 128, "frames": 20, "direction": -1, "jitter_deg": 1.0, "drop": (5,), "blank": (9,)}


def test_report_is_json_and_says_how_good_the_poses_are():
    _, poses = estimated(**FULL)
    report = json.loads(json.dumps(replace(poses, nominal_step_deg=20.0, nominal_direction="ccw").report()))
    assert report["warnings"] == []
    assert report["reprojection_error_px"]["overall"] < 0.2
    assert not report["reprojection_error_px"]["above_target"]
    assert report["direction"] == {"nominal": "ccw", "found": "ccw"}
    assert report["full_turn"]
    assert abs(report["loop_closure_deg"]) < 0.2
    assert report["steps_deg"]["median"] == pytest.approx(20.0, abs=0.1)
    assert report["camera_looks_down_deg"] == pytest.approx(17.0, abs=0.2)
    assert report["axis_tilt_in_image_deg"] == pytest.approx(0.0, abs=0.1)
    assert report["axis_tilt_to_disc_deg"] < 0.1
    assert report["disc_markers"] == list(range(6, 14))
    assert report["frames"]["used"] == 18


def test_report_warns_of_a_wrong_direction_and_of_left_out_frames():
    scene, poses = estimated(**GAPS)
    report = json.loads(json.dumps(replace(poses, nominal_step_deg=18.0, nominal_direction="ccw").report()))
    assert report["direction"] == {"nominal": "ccw", "found": "cw"}
    assert any("cw" in warning for warning in report["warnings"])
    left_out = scene.names()[next(iter(scene.blanked))]
    assert report["frames"]["dropped"] == {left_out: "no marker was found"}
    assert report["reprojection_error_px"]["frames"][left_out] is None
    # The frame that is missing shows as a step that the nominal angles do not have.
    assert report["steps_deg"]["largest_deviation_from_nominal"] > 15.0


def test_full_turn_is_told_from_a_partial_one():
    assert is_full_turn(np.arange(0, 360, 20.0))
    assert is_full_turn(-np.arange(0, 360, 10.0))
    assert not is_full_turn(np.linspace(0, 200, 20))


def test_disc_is_the_lowest_group_that_faces_up():
    scene = MarkerScene(frames=12)
    turntable = solve(scene, exact_observations(scene))
    np.testing.assert_array_equal(on_disc(turntable, SIDE_M), turntable.markers >= 6)


def test_without_disc_markers_the_origin_is_the_lowest_corner_and_said_so():
    scene, poses = estimated(size_px=160, frames=15, disc_markers=0)
    lowest = min(corners[:, 2].min() for corners in poses.marker_corners_m.values())
    assert lowest == pytest.approx(0.0, abs=1e-9)
    assert any("lowest marker corner" in warning for warning in poses.report()["warnings"])
    shifted = scene.camera_to_world.copy()
    shifted[:, 2, 3] -= min(corners[:, 2].min() for corners in list(scene.corners_m.values())[:6])
    rotation, position = pose_errors(poses.camera_to_world, shifted)
    assert rotation < 0.5
    assert position < 3.0


def test_frames_without_markers_are_refused_with_names_and_advice():
    noise = list(np.random.default_rng(0).integers(0, 255, (4, 64, 64)).astype(np.uint8))
    with pytest.raises(InputError, match=r"first \.\.\. last.*dictionary"):
        estimate_turntable_poses(noise, ["first", "b", "c", "last"], marker_side_m=SIDE_M, progress=False)
    scene = MarkerScene(frames=18)
    with pytest.raises(InputError, match="DICT_4X4_50"):
        estimate_turntable_poses(
            scene.render()[:3], scene.names()[:3], dictionary="DICT_4X4_50", marker_side_m=SIDE_M, progress=False
        )


def test_a_single_frame_is_refused():
    with pytest.raises(InputError, match="3 or more frames"):
        estimate_turntable_poses([np.zeros((8, 8), np.uint8)], ["only"], marker_side_m=SIDE_M, progress=False)


def test_a_camera_before_a_still_table_is_refused():
    scene = MarkerScene(frames=18, noise=0.01)
    still = [scene.render()[0]] * 4
    with pytest.raises(InputError, match="share"):
        estimate_turntable_poses(still, list("abcd"), marker_side_m=SIDE_M, progress=False)


def test_picture_is_drawn_whole(tmp_path):
    _, poses = estimated(**FULL)
    draw_poses(poses, tmp_path / "poses.png")
    assert (tmp_path / "poses.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["poses.png"]
