"""Which way to poses a session supports, and that all ways end in the same form."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from exact_turntable import pose_errors

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, rotation_about_z
from hsi_sc_nerf.poses.feature_poses import KnownCamera, poses_from_sfm
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.report import check_poses, describe_poses, pose_report
from hsi_sc_nerf.poses.result import Scale
from hsi_sc_nerf.poses.structure_from_motion import structure_from_motion
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.spectra import bands_within, to_8_bit

SIZE_PX, FRAMES = 224, 20


@pytest.fixture(scope="module")
def pear():
    """Gray images, names, true poses and intrinsics of a pear with markers."""
    simulation = Simulation(override(load_scene("pear"), size_px=SIZE_PX, frames=FRAMES, bands=4, effects=[]))
    inside = bands_within(simulation.wavelengths_nm, (450.0, 700.0))
    dark = float(simulation.scene.sensor.dark_level)
    white = simulation.white().counts[SIZE_PX // 2, SIZE_PX // 2, inside] - dark
    images = [
        to_8_bit(((simulation.frame(i).counts[..., inside] - dark) / white).mean(axis=-1)) for i in range(FRAMES)
    ]
    return images, list(simulation.captures), simulation.camera_to_world, simulation.intrinsics


@pytest.fixture(scope="module")
def free(pear):
    """Poses of the pear by half of its features, which are matched once for all tests."""
    images, names, *_ = pear
    found = structure_from_motion(images, names)
    return replace(found, tracks=found.tracks.select(found.tracks.point % 2 == 0))


def pear_info(**values):
    side_m = load_scene("pear").markers.side_m
    return replace(SessionInfo(marker_side_m=side_m, nominal_step_deg=360.0 / FRAMES, direction="ccw"), **values)


@pytest.mark.slow
def test_markers_help_features(pear, free):
    images, names, truth, intrinsics = pear
    poses = find_poses(images, names, pear_info(), "colmap", from_sfm=partial(poses_from_sfm, free=free))
    assert (poses.method, poses.metric) == ("colmap", True)
    assert poses.used.all()
    rotation_deg, place_mm = pose_errors(poses.camera_to_world, truth)
    assert rotation_deg < 0.2
    assert place_mm < 1.0
    assert poses.intrinsics.fl_x == pytest.approx(intrinsics.fl_x, rel=5e-3)
    assert len(poses.disc_markers) == load_scene("pear").markers.on_disc
    disc = np.concatenate([poses.marker_corners_m[m] for m in poses.disc_markers])
    assert np.abs(disc[:, 2]).max() < 1e-3


@pytest.mark.slow
def test_without_markers_and_a_known_distance_there_is_no_scale(pear, free):
    images, names, truth, _ = pear
    # The session's markers are of another dictionary.
    by_hand = pear_info(
        marker_side_m=None,
        marker_dictionary="DICT_7X7_50",
        camera_distance_m=float(np.linalg.norm(truth[0, :2, 3])),
    )
    unknown = replace(by_hand, camera_distance_m=None)
    options = {"method": "angles", "from_sfm": partial(poses_from_sfm, free=free)}
    metric, unscaled = (find_poses(images, names, info, **options) for info in (by_hand, unknown))
    assert metric.method == "angles"
    np.testing.assert_allclose(metric.angles_deg, np.arange(FRAMES) * 360.0 / FRAMES, atol=1e-6)
    assert metric.metric
    assert not unscaled.metric
    assert "poses-no-scale" in {finding.name for finding in unscaled.findings}
    assert "poses-no-scale" not in {finding.name for finding in metric.findings}
    for poses, distance in ((metric, by_hand.camera_distance_m), (unscaled, 1.0)):
        assert np.linalg.norm(poses.camera_to_world[0, :2, 3]) == pytest.approx(distance, rel=1e-6)


def fails(*_, **__):
    raise InputError("it fails.")


CAMERA = KnownCamera(
    PinholeIntrinsics(64, 48, 100.0, 100.0, 32.0, 24.0),
    (0.01, 0.0, 0.0, 0.0),
    look_at([0.4, 0.0, 0.2], [0, 0, 0.06]),
    "ccw",
)
BLANK = [np.zeros((48, 64), np.uint8)] * 4
STEPS = SessionInfo(nominal_step_deg=90.0)


def test_auto_says_why_not():
    poses = find_poses(BLANK, list("abcd"), STEPS, camera=CAMERA, from_sfm=fails)
    assert poses.method == "angles"
    assert poses.chosen.startswith("by known angles (not by markers: nothing gives the scale")
    assert poses.chosen.endswith("; nor by features (COLMAP): it fails)")
    with pytest.raises(InputError, match=r"markers: nothing gives the scale.*; features \(COLMAP\): it fails"):
        find_poses(BLANK, list("abcd"), STEPS, from_sfm=fails)


@pytest.mark.parametrize(
    ("given", "turned"),
    [
        ((10.0, 20.0, 35.0, 90.0), (0.0, 10.0, 25.0, 80.0)),
        ((270.0, 300.0, 330.0, 0.0), (0.0, 30.0, 60.0, 90.0)),
        ((60.0, 30.0, 0.0, 330.0), (0.0, 30.0, 60.0, 90.0)),
        ((0.0, -6.0, -12.0, -18.0), (0.0, 6.0, 12.0, 18.0)),
        ((0.0, 180.0, 90.0, 270.0), (0.0, 180.0, 90.0, 270.0)),
        ((0.0, 200.0, 400.0, 600.0), (0.0, 200.0, 400.0, 600.0)),
    ],
)
@pytest.mark.parametrize(
    ("told", "before", "sign"), [("ccw", None, 1.0), ("cw", "ccw", -1.0), (None, "ccw", 1.0), (None, "cw", -1.0)]
)
def test_an_earlier_camera_and_known_angles_are_enough(given, turned, told, before, sign):
    """The scale may start again and count down."""
    info = SessionInfo(frame_angles_deg=given, direction=told)
    poses = find_poses(BLANK, list("abcd"), info, "angles", camera=replace(CAMERA, direction=before))
    np.testing.assert_allclose(poses.angles_deg, sign * np.array(turned))
    for pose, angle in zip(poses.camera_to_world, poses.angles_deg, strict=True):
        np.testing.assert_allclose(pose, rotation_about_z(-angle) @ CAMERA.camera_to_world, atol=1e-12)
    assert poses.distortion == CAMERA.distortion
    assert pose_report(poses, info)["reprojection_error_px"]["overall"] is None
    assert [finding.name for finding in check_poses(poses, info)] == ["poses-given"]


@pytest.mark.parametrize(("distance_m", "names"), [(None, ["poses-given", "poses-no-scale"]), (0.4, ["poses-given"])])
def test_an_earlier_camera_without_a_scale_gives_none(distance_m, names):
    unit = CAMERA.camera_to_world.copy()
    unit[:3, 3] /= 0.4
    camera, info = replace(CAMERA, camera_to_world=unit, metric=False), replace(STEPS, camera_distance_m=distance_m)
    poses = find_poses(BLANK, list("abcd"), info, "angles", camera=camera)
    assert (poses.metric, [finding.name for finding in poses.findings]) == (distance_m is not None, names)
    np.testing.assert_allclose(poses.camera_to_world[0], CAMERA.camera_to_world if distance_m else unit, atol=1e-12)
    assert (camera.distance_m, CAMERA.distance_m) == (None, pytest.approx(0.4))


def test_nominal_steps_count_captures_that_are_left_out():
    places = (0, 1, 3, 4)
    poses = find_poses(
        BLANK, list("abcd"), replace(STEPS, nominal_step_deg=60.0), "angles", camera=CAMERA, places=places
    )
    np.testing.assert_allclose(poses.angles_deg, [0.0, 60.0, 180.0, 240.0])
    seen = {}
    find_poses(
        BLANK, list("abcd"), STEPS, "colmap", places=places, from_sfm=lambda *_, **given: seen.update(given) or poses
    )
    assert seen["places"] == places


@pytest.mark.parametrize(
    ("info", "direction", "side_px", "message"),
    [
        (SessionInfo(), "ccw", 48, "the angles are not known"),
        (SessionInfo(frame_angles_deg=(0.0, 1.0)), "ccw", 48, "2 frame angles"),
        (STEPS, None, 48, r"which way the turntable turns is not known.*give direction"),
        (replace(STEPS, image_rotation_deg=90), "ccw", 48, "by 90 degrees from upright, those of .* by 270"),
        (STEPS, "ccw", 10, "64 x 10 pixels, but the camera of the earlier session had 64 x 48"),
    ],
)
def test_angles_that_do_not_do_with_a_camera_are_refused(info, direction, side_px, message):
    images, camera = (
        [image[:side_px] for image in BLANK],
        replace(CAMERA, direction=direction, image_rotation_deg=270),
    )
    with pytest.raises(InputError, match=message):
        find_poses(images, list("abcd"), info, "angles", camera=camera)


def test_a_camera_that_no_one_has_is_not_believed():
    poses = find_poses(BLANK, list("abcd"), STEPS, "angles", camera=CAMERA)
    for focal_px, believed in ((100.0, True), (5000.0, False), (10.0, False)):
        found = replace(poses, intrinsics=replace(CAMERA.intrinsics, fl_x=focal_px, fl_y=focal_px))
        options = {"method": "colmap", "from_sfm": lambda *_, found=found, **__: found}
        if believed:
            assert find_poses(BLANK, list("abcd"), SessionInfo(), **options).intrinsics.fl_x == focal_px
            continue
        with pytest.raises(InputError, match="too few"):
            find_poses(BLANK, list("abcd"), SessionInfo(), **options)


def test_the_figures_in_words():
    poses = find_poses(BLANK, list("abcd"), STEPS, "angles", camera=CAMERA)
    words = ", ".join(describe_poses(poses, pose_report(poses, STEPS)))
    assert words.startswith("4 of 4 frames, one axis, axis leans ")
    assert words.endswith("scale as given")
    scale = Scale("markers", 0.03, 0.002, {}, {}, 0.09, 0.092)
    worse = replace(poses, overall_error_px=1.2, loop_closure_deg=-0.25, disc_tilt_deg=0.5, scale=scale)
    words = ", ".join(describe_poses(worse, pose_report(worse, STEPS)))
    for part in ("error 1.20 px", "closes to 0.250°", "0.50° to the disc", "markers ± 0.20 %"):
        assert part in words
