"""Poses of a turntable from its markers: exact on exact corners, and close to the truth on rendered images."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from exact_turntable import (
    SIDE_M,
    adjusted,
    in_object_frame,
    marker_observations,
    marker_turntable,
    pose_errors,
    started,
)
from PIL import Image, ImageColor
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.plotting import COLOURS
from hsi_sc_nerf.poses.marker_poses import poses_from_markers
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.report import angle_words, check_poses, draw_poses, pose_report
from hsi_sc_nerf.poses.result import is_full_turn

INFO = SessionInfo(marker_side_m=SIDE_M)
FEW_MARKERS = {"size_px": 128, "frames": 24, "side_markers": 4, "disc_markers": 2}


@lru_cache(maxsize=8)
def estimated(**options):
    scene = MarkerScene(**options)
    return scene, find_poses(scene.render(), scene.names(), INFO)


@pytest.mark.slow
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
    seen = marker_observations(marker_turntable(scene), 0.0)
    turntable = adjusted(started(scene, seen), seen)
    assert turntable.focal_px == pytest.approx(scene.intrinsics.fl_x, rel=1e-4)
    rotation, position = pose_errors(in_object_frame(turntable), scene.camera_to_world)
    assert rotation < 1e-2
    assert position < 1e-1
    turned = np.rad2deg(np.unwrap(turntable.angles_rad))
    np.testing.assert_allclose(turned, scene.angles_deg, atol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "largest_deg", "largest_mm"),
    [
        ({"size_px": 128, "frames": 20, "direction": -1, "jitter_deg": 1.0, "drop": (5,), "blank": (9,)}, 0.2, 0.7),
        ({"size_px": 256, "frames": 12, "blur_px": 0.7, "noise": 0.01}, 0.1, 0.7),
        (FEW_MARKERS, 0.2, 1.0),
    ],
)
def test_rendered_session_is_posed(options, largest_deg, largest_mm):
    scene, poses = estimated(**options)
    assert (poses.method, poses.metric) == ("markers", True)  # by themselves
    np.testing.assert_array_equal(np.flatnonzero(~poses.used), sorted(scene.blanked))
    rotation, position = pose_errors(poses.camera_to_world[poses.used], scene.camera_to_world[poses.used])
    assert rotation < largest_deg
    assert position < largest_mm
    assert poses.intrinsics.fl_x == poses.intrinsics.fl_y == pytest.approx(scene.intrinsics.fl_x, rel=0.005)
    assert (poses.intrinsics.cx, poses.intrinsics.cy) == (scene.size_px / 2, scene.size_px / 2)
    np.testing.assert_allclose(poses.angles_deg[poses.used], scene.angles_deg[poses.used], atol=0.2)
    assert poses.dictionary == "DICT_5X5_50"
    assert poses.disc_markers == tuple(range(scene.side_markers, scene.side_markers + scene.disc_markers))
    for marker, corners in poses.marker_corners_m.items():
        np.testing.assert_allclose(corners, scene.corners_m[marker], atol=6e-4)


SMALL = {"size_px": 128, "frames": 9, "direction": -1, "jitter_deg": 1.0, "drop": (4,), "blank": (7,), "noise": 0.01}


@pytest.mark.slow
def test_report_is_json_and_says_how_good_the_poses_are(tmp_path):
    scene, poses = estimated(**SMALL)
    info = SessionInfo(nominal_step_deg=40.0, direction="ccw")
    findings = check_poses(poses, info)
    report = json.loads(json.dumps(pose_report(poses, info, findings)))
    assert [f.name for f in findings if f.level == "red"] == ["poses-direction"]
    assert report["reprojection_error_px"]["overall"] < 0.2
    assert report["direction"] == {"nominal": "ccw", "found": "cw"}
    assert report["camera_looks_down_deg"] == pytest.approx(17.0, abs=0.2)
    assert report["axis_tilt_in_image_deg"] == pytest.approx(0.0, abs=0.1)
    assert report["axis_tilt_to_disc_deg"] < 0.1
    assert report["disc_markers"] == list(range(6, 14))
    assert report["frames"]["used"] == 7
    left_out = scene.names()[next(iter(scene.blanked))]
    assert report["frames"]["dropped"] == {left_out: "no marker was found"}
    assert report["reprojection_error_px"]["frames"][left_out] is None
    # The frame that is missing shows as a step that the nominal angles do not have.
    assert report["steps_deg"]["largest_deviation_from_nominal"] > 30.0
    draw_poses(poses, report, tmp_path / "poses.png")
    assert [path.name for path in tmp_path.iterdir()] == ["poses.png"]
    assert (tmp_path / "poses.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_picture_of_poses_has_axes_where_no_frame_is_left_out(tmp_path):
    _, poses = estimated(**FEW_MARKERS)
    assert poses.used.all()
    draw_poses(poses, pose_report(poses, SessionInfo(), []), tmp_path / "poses.png")
    picture = np.array(Image.open(tmp_path / "poses.png").convert("RGB"))
    drawn = np.flatnonzero((picture == ImageColor.getrgb(COLOURS[0])).all(axis=-1).any(axis=1))
    assert len(drawn) > 0.3 * len(picture)  # bars and points fill the height


def test_an_angle_that_rounds_to_zero_has_no_sign():
    assert [angle_words(angle) for angle in (-0.001, -0.0, 0.004, -1.234)] == ["0.00°", "0.00°", "0.00°", "-1.23°"]


def test_full_turn_is_told_from_a_partial_one():
    assert is_full_turn(np.arange(0, 360, 20.0))
    assert is_full_turn(-np.arange(0, 360, 10.0))
    assert not is_full_turn(np.linspace(0, 200, 20))


@pytest.mark.slow
@pytest.mark.parametrize("elevation_deg", [17.0, -4.0])  # above the markers, and below their middle
def test_without_disc_markers_the_origin_is_the_lowest_corner_and_said_so(elevation_deg):
    scene, poses = estimated(size_px=160, frames=15, disc_markers=0, elevation_deg=elevation_deg)
    lowest = min(corners[:, 2].min() for corners in poses.marker_corners_m.values())
    assert lowest == pytest.approx(0.0, abs=1e-9)
    assert [finding.name for finding in poses.findings] == ["poses-origin"]
    shifted = scene.camera_to_world.copy()
    shifted[:, 2, 3] -= min(corners[:, 2].min() for corners in list(scene.corners_m.values())[:6])
    rotation, position = pose_errors(poses.camera_to_world, shifted)
    assert rotation < 0.5
    assert position < 3.0


@pytest.mark.slow
def test_frames_without_markers_are_refused_with_names_and_advice():
    noise = list(np.random.default_rng(0).integers(0, 255, (4, 64, 64)).astype(np.uint8))
    with pytest.raises(InputError, match=r"first \.\.\. last.*dictionary"):
        poses_from_markers(noise, ["first", "b", "c", "last"], INFO)
    scene, other = MarkerScene(frames=3, turn_deg=60.0), replace(INFO, marker_dictionary="DICT_4X4_50")
    with pytest.raises(InputError, match="DICT_4X4_50"):
        poses_from_markers(scene.render(), scene.names(), other)
