"""Adjustment over the machine's own numbers: derivatives, exact recovery, outliers, known angles from scratch."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.late_frames import with_late_frames
from hsi_sc_nerf.poses.track_adjust import TrackAdjustConfig, _moved, _slopes, adjust_tracks, split_half_error_deg
from hsi_sc_nerf.poses.tracks import TrackedTurntable, Tracks, project, reproject
from hsi_sc_nerf.poses.turntable_from_angles import turntable_from_angles

SIZE_PX = 256
FOCAL_PX = 460.0


def machine(angles_deg, points=150, seed=0, radial=(0.0, 0.0), centre_px=(128.0, 128.0), elevation_deg=24.0):
    """A camera that looks down on patterns of an upright body, a little beside its axis and a little rolled."""
    rng = np.random.default_rng(seed)
    c, s = np.cos(np.deg2rad(elevation_deg)), np.sin(np.deg2rad(elevation_deg))
    base = np.array([[0.0, 1.0, 0.0], [s, 0.0, -c], [-c, 0.0, -s]])
    rotation = Rotation.from_euler("xyz", [1.0, -2.0, 3.0], degrees=True).as_matrix() @ base
    azimuth, height = rng.uniform(0, 2 * np.pi, points), rng.uniform(-0.6, -0.25, points)
    radius = rng.uniform(0.1, 0.16, points)
    places = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], -1)
    angles = np.deg2rad(np.asarray(angles_deg, float))
    rows = np.arange(len(angles)), np.arange(points)
    return TrackedTurntable(FOCAL_PX, centre_px, radial, rotation, rows[0], angles, rows[1], places)


def sightings(turntable, noise_px=0.0, seed=1):
    """Tracks of the points in the frames where they face the camera."""
    turn = Rotation.from_rotvec(np.outer(turntable.angles_rad, [0, 0, 1])).as_matrix()
    in_room = np.einsum("fij,pj->fpi", turn, turntable.places)
    frame, point = np.nonzero(in_room[..., 0] > 0.03)
    pixels = project(turntable, frame, point)[0]
    return Tracks(frame, point, pixels + noise_px * np.random.default_rng(seed).normal(size=pixels.shape))


def disturbed(turntable, seed=2):
    """The turntable as structure from motion might leave it: degrees, percents and a wrong focal length."""
    rng = np.random.default_rng(seed)
    return replace(
        turntable,
        focal_px=0.75 * turntable.focal_px,
        camera_rotation=Rotation.from_rotvec(np.deg2rad([2.0, -1.5, 1.0])).as_matrix() @ turntable.camera_rotation,
        angles_rad=turntable.angles_rad + np.r_[0.0, rng.normal(0, 0.02, len(turntable.frames) - 1)],
        places=turntable.places + rng.normal(0, 0.01, turntable.places.shape),
    )


def pose_error_deg(found, true):
    rows = np.searchsorted(true.frames, found.frames)
    a, b = found.camera_to_world()[:, :3, :3], true.camera_to_world()[rows][:, :3, :3]
    return np.rad2deg(Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b).magnitude().max())


@pytest.mark.parametrize(
    ("angles_deg", "config"),
    [
        (np.arange(0, 360, 18.0), TrackAdjustConfig()),
        (-np.arange(0, 200, 14.0), TrackAdjustConfig()),
        (np.arange(0, 360, 18.0), TrackAdjustConfig(radial_terms=1, free_principal_point=True)),
    ],
)
def test_exact_tracks_give_the_exact_machine(angles_deg, config):
    special = {"radial": (-0.1, 0.0), "centre_px": (130.0, 125.0)} if config.radial_terms else {}
    true = machine(angles_deg, **special)
    start = disturbed(true)
    start = replace(start, radial=(0.0, 0.0), centre_px=(128.0, 128.0))
    found = adjust_tracks(start, sightings(true), config)
    assert not found.outliers[np.bincount(sightings(true).point)[sightings(true).point] >= 3].any()
    assert found.turntable.focal_px == pytest.approx(FOCAL_PX, rel=1e-3)
    assert pose_error_deg(found.turntable, true) < 0.02
    assert found.overall_error_px < 0.01
    np.testing.assert_allclose(found.turntable.centre_px, true.centre_px, atol=0.5)


def test_derivatives_are_those_of_the_projection():
    true = machine(np.arange(0, 100, 20.0), points=12, radial=(-0.1, 0.05))
    tracks = sightings(true)
    config = TrackAdjustConfig(radial_terms=2, free_principal_point=True)
    frame, point = true.rows(tracks)
    shared, by_angle, by_point = _slopes(true, frame, point, config)
    still = np.zeros_like(true.places)
    unknowns = shared.shape[2] + len(true.frames) - 1
    for k in range(unknowns):
        step = 1e-6 * np.eye(unknowns)[k]
        numeric = (
            reproject(_moved(true, step, still, config), tracks)
            - reproject(_moved(true, -step, still, config), tracks)
        ) / 2e-6
        if k < shared.shape[2]:
            expected = shared[:, :, k]
        else:
            expected = by_angle * (frame == k - shared.shape[2] + 1)[:, None]
        np.testing.assert_allclose(numeric, expected, atol=1e-4 * np.abs(numeric).max())
    for k in range(3):
        moved = np.broadcast_to(1e-6 * np.eye(3)[k], still.shape)
        nothing = np.zeros(unknowns)
        numeric = (
            reproject(_moved(true, nothing, moved, config), tracks)
            - reproject(_moved(true, nothing, -moved, config), tracks)
        ) / 2e-6
        np.testing.assert_allclose(numeric, by_point[:, :, k], atol=1e-4 * np.abs(numeric).max())


def test_wrong_sightings_are_thrown_out():
    true = machine(np.arange(0, 360, 18.0))
    tracks = sightings(true, noise_px=0.1)
    rng = np.random.default_rng(5)
    wrong = rng.choice(len(tracks), len(tracks) // 10, replace=False)
    pixels = tracks.pixels.copy()
    pixels[wrong] += rng.choice([-1.0, 1.0], (len(wrong), 2)) * rng.uniform(3, 30, (len(wrong), 2))
    found = adjust_tracks(disturbed(true), replace(tracks, pixels=pixels))
    assert found.outliers[wrong].all()
    assert found.outliers.mean() < 0.16
    assert pose_error_deg(found.turntable, true) < 0.3
    assert found.turntable.focal_px == pytest.approx(FOCAL_PX, rel=0.02)
    assert found.focal_sigma is not None
    assert 0.0005 < found.focal_sigma < 0.02


def test_a_frame_with_too_few_points_is_left_out():
    true = machine(np.arange(0, 360, 20.0))
    tracks = sightings(true)
    rows = np.flatnonzero(tracks.frame == 4)
    keep = np.ones(len(tracks), bool)
    keep[rows[5:]] = False
    found = adjust_tracks(disturbed(true), tracks.select(keep))
    assert 4 not in found.turntable.frames
    assert found.outliers[tracks.frame[keep] == 4].all()
    assert len(found.frame_errors_px()) == len(found.turntable.frames) == 17


def test_given_angles_and_focal_length_stay():
    true = machine(np.arange(0, 360, 18.0))
    start = replace(disturbed(true), angles_rad=true.angles_rad, focal_px=FOCAL_PX)
    found = adjust_tracks(start, sightings(true), TrackAdjustConfig(free_angles=False, free_focal=False))
    np.testing.assert_array_equal(found.turntable.angles_rad, true.angles_rad)
    assert found.turntable.focal_px == FOCAL_PX
    assert found.focal_sigma is None
    assert pose_error_deg(found.turntable, true) < 1e-3


@pytest.mark.parametrize(("sign", "elevation_deg"), [(1.0, 2.0), (-1.0, 55.0)])
def test_known_angles_give_the_camera_from_scratch(sign, elevation_deg):
    true = machine(sign * np.arange(0, 360, 18.0), elevation_deg=elevation_deg)
    tracks = sightings(true, noise_px=0.2)
    # The operator knows the steps, not which way round.
    start = turntable_from_angles(
        tracks, true.frames, np.abs(true.angles_rad), (SIZE_PX, SIZE_PX), direction_known=False
    )
    np.testing.assert_allclose(start.angles_rad, true.angles_rad)
    found = adjust_tracks(start, tracks, TrackAdjustConfig(free_angles=False))
    assert pose_error_deg(found.turntable, true) < 0.3
    assert found.turntable.focal_px == pytest.approx(FOCAL_PX, rel=0.02)


def test_tracks_of_something_else_are_refused():
    true = machine(np.arange(0, 360, 30.0))
    few = sightings(true)
    with pytest.raises(InputError, match="too few points"):
        adjust_tracks(true, few.select(few.point < 5))


def test_halves_of_the_points_tell_the_error():
    true = machine(np.arange(0, 360, 18.0), points=400)
    errors, told = [], []
    for noise_px in (0.05, 0.5):
        found = adjust_tracks(true, sightings(true, noise_px=noise_px))
        errors.append(pose_error_deg(found.turntable, true))
        told.append(split_half_error_deg(found))
    assert told[0] < 0.1 < told[1]
    assert 0.2 < told[1] / errors[1] < 5.0


def test_lost_frames_come_back_at_their_angle():
    true = machine(-np.arange(0, 360, 18.0))
    tracks = sightings(true, noise_px=0.1)
    pixels = tracks.pixels.copy()
    pixels[np.flatnonzero(tracks.frame == 9)[::4]] += 20.0
    pixels[tracks.frame == 13] = np.random.default_rng(0).uniform(50, 200, ((tracks.frame == 13).sum(), 2))
    tracks = replace(tracks, pixels=pixels)
    some = np.isin(true.frames, [4, 9, 13, 19], invert=True)
    lost = replace(true, frames=true.frames[some], angles_rad=true.angles_rad[some])
    found = with_late_frames(lost, tracks)
    np.testing.assert_array_equal(found.frames, np.delete(true.frames, 13))
    np.testing.assert_allclose(found.angles_rad, np.delete(true.angles_rad, 13), atol=2e-3)
