"""Adjustment over the machine's own numbers: derivatives, exact recovery, outliers, known angles from scratch."""

from dataclasses import replace

import numpy as np
import pytest
from exact_turntable import point_tracks, point_turntable
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.track_adjustment import adjust_either_depth, adjust_tracks, with_lost_frames
from hsi_sc_nerf.poses.turntable import Turntable
from hsi_sc_nerf.poses.turntable_from_poses import reversed_in_depth

FOCAL_PX = 460.0


def machine(angles_deg, points=150, seed=0, radial=(0.0, 0.0), elevation_deg=24.0):
    """A camera that looks down on patterns of an upright body, a little beside its axis and a little rolled."""
    c, s = np.cos(np.deg2rad(elevation_deg)), np.sin(np.deg2rad(elevation_deg))
    base = np.array([[0.0, 1.0, 0.0], [s, 0.0, -c], [-c, 0.0, -s]])
    rotation = Rotation.from_euler("xyz", [1.0, -2.0, 3.0], degrees=True).as_matrix() @ base
    turntable = Turntable(
        focal_px=FOCAL_PX,
        centre_px=(128.0, 128.0),
        radial=radial,
        camera_rotation=rotation,
        frames=np.arange(len(angles_deg)),
        angles_rad=np.deg2rad(np.asarray(angles_deg, float)),
    )
    return point_turntable(turntable, points, seed)


def disturbed(turntable, seed=2):
    """The turntable as structure from motion might leave it: degrees, percents and a wrong focal length."""
    rng = np.random.default_rng(seed)
    return replace(
        turntable,
        focal_px=0.75 * turntable.focal_px,
        camera_rotation=Rotation.from_rotvec(np.deg2rad([2.0, -1.5, 1.0])).as_matrix() @ turntable.camera_rotation,
        angles_rad=turntable.angles_rad + np.r_[0.0, rng.normal(0, 0.02, len(turntable.frames) - 1)],
        points_3d=turntable.points_3d + rng.normal(0, 0.01, turntable.points_3d.shape),
    )


def pose_error_deg(found, true):
    rows = np.searchsorted(true.frames, found.frames)
    a, b = found.camera_to_world()[:, :3, :3], true.camera_to_world()[rows][:, :3, :3]
    return np.rad2deg(Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b).magnitude().max())


@pytest.mark.parametrize("angles_deg", [np.arange(0, 360, 18.0), -np.arange(0, 200, 14.0)])
def test_exact_tracks_give_the_exact_machine(angles_deg):
    true = machine(angles_deg)
    found = adjust_tracks(disturbed(true), point_tracks(true))
    assert not found.outliers[np.bincount(point_tracks(true).point)[point_tracks(true).point] >= 3].any()
    assert found.turntable.focal_px == pytest.approx(FOCAL_PX, rel=1e-3)
    assert pose_error_deg(found.turntable, true) < 0.02
    assert found.turntable.frame_errors_px(found.tracks, len(angles_deg))[1] < 0.01


def narrow_machine(narrower=4.0):
    """The machine far away, before a longer lens: the images keep their size."""
    true = machine(np.arange(0, 360, 18.0), points=100)
    middle = np.array([0.0, 0.0, np.median(true.points_3d[:, 2])])
    height = np.array([0.0, 0.0, middle[2]])
    points_3d = (true.points_3d - middle) / narrower + height
    return replace(true, focal_px=narrower * true.focal_px, points_3d=points_3d)


@pytest.mark.slow
def test_a_turn_that_was_found_reversed_in_depth_is_set_right():
    """An adjustment does not lead from one to the other."""
    true = narrow_machine()
    start, tracks = disturbed(reversed_in_depth(true)), point_tracks(true, noise_px=0.1)
    assert pose_error_deg(adjust_tracks(start, tracks).turntable, true) > 90.0
    assert pose_error_deg(adjust_either_depth(start, tracks).turntable, true) < 2.0


def test_wrong_observations_are_left_out():
    true = machine(np.arange(0, 360, 18.0))
    tracks = point_tracks(true, noise_px=0.1)
    rng = np.random.default_rng(5)
    wrong = rng.choice(len(tracks), len(tracks) // 10, replace=False)
    pixels = tracks.pixels.copy()
    pixels[wrong] += rng.choice([-1.0, 1.0], (len(wrong), 2)) * rng.uniform(3, 30, (len(wrong), 2))
    found = adjust_tracks(disturbed(true), replace(tracks, pixels=pixels))
    assert found.outliers[wrong].all()
    assert found.outliers.mean() < 0.16
    assert pose_error_deg(found.turntable, true) < 0.3
    assert found.turntable.focal_px == pytest.approx(FOCAL_PX, rel=0.02)


def test_a_frame_with_too_few_points_is_left_out():
    true = machine(np.arange(0, 360, 20.0))
    tracks = point_tracks(true)
    rows = np.flatnonzero(tracks.frame == 4)
    keep = np.ones(len(tracks), bool)
    keep[rows[5:]] = False
    found = adjust_tracks(disturbed(true), tracks.select(keep))
    assert 4 not in found.turntable.frames
    assert found.outliers[tracks.frame[keep] == 4].all()
    assert np.isnan(found.turntable.frame_errors_px(found.tracks, 18)[0][4])
    assert len(found.turntable.frames) == 17


def test_held_angles_stay():
    true = machine(np.arange(0, 360, 18.0))
    start = replace(disturbed(true), angles_rad=true.angles_rad)
    found = adjust_tracks(start, point_tracks(true), free_angles=False)
    np.testing.assert_array_equal(found.turntable.angles_rad, true.angles_rad)
    assert found.turntable.focal_px == pytest.approx(FOCAL_PX, rel=1e-3)
    assert pose_error_deg(found.turntable, true) < 1e-3


def test_tracks_of_something_else_are_refused():
    true = machine(np.arange(0, 360, 30.0))
    few = point_tracks(true)
    with pytest.raises(InputError, match="too few points"):
        adjust_tracks(true, few.select(few.point < 5))


def test_lost_frames_come_back_at_their_angle():
    true = machine(-np.arange(0, 360, 18.0))
    tracks = point_tracks(true, noise_px=0.1)
    pixels = tracks.pixels.copy()
    pixels[np.flatnonzero(tracks.frame == 9)[::4]] += 20.0
    pixels[tracks.frame == 13] = np.random.default_rng(0).uniform(50, 200, ((tracks.frame == 13).sum(), 2))
    tracks = replace(tracks, pixels=pixels)
    some = np.isin(true.frames, [4, 9, 13, 19], invert=True)
    lost = replace(true, frames=true.frames[some], angles_rad=true.angles_rad[some])
    found = with_lost_frames(lost, tracks)
    np.testing.assert_array_equal(found.frames, np.delete(true.frames, 13))
    np.testing.assert_allclose(found.angles_rad, np.delete(true.angles_rad, 13), atol=2e-3)
