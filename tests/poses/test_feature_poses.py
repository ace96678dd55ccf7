"""Prior knowledge beside features: an earlier camera, known angles, markers."""

from dataclasses import replace

import numpy as np
import pytest
from exact_turntable import marker_observations, marker_turntable, point_tracks, point_turntable, points_alone
from scipy.spatial.transform import Rotation
from turntable_scene import MarkerScene

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, PinholeIntrinsics
from hsi_sc_nerf.poses.bundle_adjustment import FreeParameters
from hsi_sc_nerf.poses.feature_poses import KnownCamera, check_camera, poses_from_sfm, prior_of_angles
from hsi_sc_nerf.poses.structure_from_motion import FreePoses
from hsi_sc_nerf.poses.track_adjustment import adjust_together, adjust_tracks, with_markers


@pytest.fixture(scope="module")
def session():
    """A turntable with a few markers, and features that are biased as by a focal length that is 1.5 % too short."""
    scene = MarkerScene(size_px=256, frames=18, disc_markers=2, side_markers=0)
    true = point_turntable(marker_turntable(scene), 200)
    biased = replace(true, focal_px=0.985 * true.focal_px, distance=0.985 * true.distance)
    tracks = point_tracks(true)
    noise = np.random.default_rng(0).normal(0.0, 0.05, tracks.pixels.shape)
    tracks = replace(tracks, pixels=biased.reproject(tracks) + noise)
    alone = points_alone(true)
    found = adjust_tracks(alone, tracks)
    assert found.turntable.focal_px < 0.995 * true.focal_px
    return scene, true, found


def known_camera(scene, zoom=1.0):
    lens = scene.intrinsics
    lens = PinholeIntrinsics(lens.w, lens.h, zoom * lens.fl_x, zoom * lens.fl_y, lens.cx, lens.cy)
    return KnownCamera(lens, (0.0, 0.0, 0.0, 0.0), scene.first_camera_to_world.copy())


def test_two_markers_outweigh_biased_features(session):
    _, true, found = session
    adjusted, markers = adjust_together(found, marker_observations(true), FreeParameters())
    assert len(markers) > 10
    scale = true.side / adjusted.turntable.side
    assert adjusted.turntable.focal_px == pytest.approx(true.focal_px, rel=0.005)
    assert scale * adjusted.turntable.distance == pytest.approx(true.distance, rel=0.005)


def test_an_earlier_camera_holds_and_is_contradicted_where_it_zoomed(session):
    scene, true, found = session
    for zoom, levels in ((1.2, ["red"]), (1.0, [])):
        free = FreeParameters(known_focal=(zoom * true.focal_px, 0.002))
        adjusted, _ = adjust_together(found, None, free)
        assert adjusted.turntable.focal_px == pytest.approx(zoom * true.focal_px, rel=0.004)
        assert [finding.level for finding in check_camera(adjusted, found, known_camera(scene, zoom))] == levels
    leaning = known_camera(scene, zoom)
    leaning.camera_to_world[:3, :3] = leaning.camera_to_world[:3, :3] @ Rotation.from_euler("z", 0.3).as_matrix()
    assert [finding.level for finding in check_camera(adjusted, found, leaning)] == ["red"]


def by_features(true, tracks, roll_deg=0.0, *, images=None, info=None, **known):
    """Poses from free poses and tracks that COLMAP would find of a turntable, in rolled pictures."""
    roll = Rotation.from_euler("z", roll_deg, True).as_matrix()
    poses = np.linalg.inv(true.camera_to_world() @ OPENCV_TO_OPENGL)
    poses[:, :3] = roll @ poses[:, :3]
    pixels = (tracks.pixels - true.centre_px) @ roll[:2, :2].T + true.centre_px
    free = FreePoses(poses, true.focal_px, true.centre_px, true.points_3d, replace(tracks, pixels=pixels))
    images = images or [np.zeros((256, 256), np.uint8)] * len(poses)
    info = info or SessionInfo(marker_dictionary="DICT_4X4_50")
    return poses_from_sfm(images, [f"f{i}" for i in range(len(poses))], info, free=free, **known)


@pytest.mark.slow
@pytest.mark.parametrize("shown", [True, False])
def test_the_outline_gives_the_scale_beside_markers_of_unknown_side(session, shown):
    scene, true, _ = session
    points_3d = true.points_3d.copy()
    points_3d[:, 2] += 0.07 - scene.first_camera_to_world[2, 3] - np.percentile(points_3d[:, 2], 1.0)
    true, images = replace(points_alone(true), points_3d=points_3d / true.distance), scene.render()
    size = {"container_diameter_m": 0.09, "container_height_m": 0.07} if shown else {}
    info = SessionInfo(marker_dictionary="DICT_5X5_50", **size)
    poses = by_features(true, point_tracks(true, noise_px=0.05), images=images, info=info)
    assert len(poses.disc_markers) == 2
    told = [finding.sentence for finding in poses.findings if finding.name == "poses-no-scale"]
    if shown:
        assert (poses.scale.source, told) == ("outline", [])
        assert np.hypot(*poses.camera_to_world[0, :2, 3]) == pytest.approx(
            scene.first_camera_to_world[0, 3], rel=0.02
        )
        # The disc is where its markers are, not where the container's foot is seen.
        assert not poses.disc_by_container
        assert np.mean([*poses.marker_corners_m.values()], axis=(0, 1))[2] == pytest.approx(0.0, abs=1e-6)
    else:
        assert "container" in told[0]
        assert "show markers" not in told[0]


@pytest.mark.slow
@pytest.mark.parametrize(("roll_deg", "upside_down"), [(120.0, False), (180.0, True)])
def test_the_object_stands_on_its_feet_unless_pictures_are_upside_down(session, roll_deg, upside_down):
    _, true, _ = session
    true = points_alone(true)
    poses = by_features(true, point_tracks(true, noise_px=0.05), roll_deg)
    assert (poses.camera_to_world[0, 2, 3] > 0.0) != upside_down
    np.testing.assert_allclose(
        poses.angles_deg, (-1.0 if upside_down else 1.0) * np.rad2deg(true.angles_rad), atol=0.5
    )
    assert ("poses-upright" in {finding.name for finding in poses.findings}) == upside_down


def test_markers_seen_through_a_distorted_lens_are_placed(session):
    _, true, _ = session
    true = replace(true, radial=(-0.3, 0.1))
    bare = replace(true, markers=true.markers[:0], marker_poses=true.marker_poses[:0])
    found = with_markers(bare, marker_observations(true, noise_px=0.0))
    assert found.side == pytest.approx(true.side, rel=1e-6)
    np.testing.assert_allclose(found.marker_poses, true.marker_poses, atol=1e-6)


@pytest.mark.slow
def test_an_earlier_camera_keeps_its_distortion(session):
    scene, true, _ = session
    true = replace(points_alone(true), radial=(-0.1, 0.02))
    camera = replace(known_camera(scene), distortion=(*true.radial, 0.0, 0.0))
    poses = by_features(true, point_tracks(true, noise_px=0.02), camera=camera)
    assert poses.distortion == camera.distortion
    assert poses.camera_given
    np.testing.assert_allclose(poses.angles_deg, np.rad2deg(true.angles_rad), atol=0.1)
    assert poses.reprojection_error_px.max() < 0.05
    # Nothing else gives the scale.
    assert [finding.name for finding in poses.findings] == ["poses-given", "poses-origin"]


@pytest.mark.slow
def test_the_stated_error_is_that_of_the_poses_which_a_wrong_camera_spoils(session):
    scene, true, _ = session
    true = points_alone(true)
    alone, spoilt = (
        by_features(true, point_tracks(true, noise_px=0.05), camera=camera)
        for camera in (None, known_camera(scene, 1.3))
    )
    assert spoilt.overall_error_px > 3.0 * alone.overall_error_px


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_known_angles_are_trusted_as_far_as_they_are_even(session, sign):
    _, true, found = session
    known, sigma = prior_of_angles(found.turntable, sign * true.angles_rad)
    np.testing.assert_allclose(known, found.turntable.angles_rad, atol=0.01)
    assert sigma < 0.003
    uneven = true.angles_rad + np.tile([0.02, -0.02], len(true.angles_rad) // 2)
    assert prior_of_angles(found.turntable, uneven)[1] == pytest.approx(0.02, rel=0.1)


def test_of_known_angles_none_is_held_for_exact():
    """A first frame that stopped off its mark does not turn all others."""
    true = point_turntable(marker_turntable(MarkerScene(size_px=256, frames=18)), 200)
    true = points_alone(true)
    off_rad = np.zeros(18)
    off_rad[0] = 0.01
    known = (true.angles_rad + off_rad - off_rad[0], 0.002)
    found = adjust_tracks(true, point_tracks(true, noise_px=0.3))
    adjusted, _ = adjust_together(found, None, FreeParameters(known_angles=known))
    away_rad = adjusted.turntable.angles_rad - true.angles_rad
    assert np.abs(away_rad - away_rad[0])[1:].max() < 0.005
