"""The chain of steps between neighbouring frames: what it adds up to on made-up tracks."""

from dataclasses import replace

import numpy as np
import pytest

from hsi_sc_nerf.poses.track_adjustment import AdjustedTracks
from hsi_sc_nerf.poses.turntable import Tracks, Turntable, project

FRAMES, REACH = 24, 3
LOOKS_DOWN = np.deg2rad(20.0)
C, S = np.cos(LOOKS_DOWN), np.sin(LOOKS_DOWN)


def creeping(creep_deg, noise_px=0.0, last_frame_sees=True):
    """Points of which each is seen in a few frames about its own, and creeps on by ``creep_deg`` a frame."""
    rng = np.random.default_rng(0)
    points = 10 * FRAMES
    azimuth = np.repeat(np.arange(FRAMES), 10)
    radius, height = rng.uniform(0.05, 0.1, points), rng.uniform(-0.45, -0.3, points)
    angles = np.linspace(0.0, 2.0 * np.pi, FRAMES, endpoint=False)
    about = -angles[azimuth] + rng.uniform(-0.1, 0.1, points)
    turntable = Turntable(
        focal_px=400.0,
        centre_px=(128.0, 128.0),
        camera_rotation=np.array([[0.0, 1.0, 0.0], [S, 0.0, -C], [-C, 0.0, -S]]),
        frames=np.arange(FRAMES),
        angles_rad=angles,
        points=np.arange(points),
        points_3d=np.stack([radius * np.cos(about), radius * np.sin(about), height], axis=-1),
    )
    apart = np.tile(np.arange(-REACH, REACH + 1), points)
    point = np.repeat(np.arange(points), 2 * REACH + 1)
    frame = (azimuth[point] + apart) % FRAMES
    if not last_frame_sees:
        keep = ~((frame == FRAMES - 1) & (azimuth[point] < FRAMES // 2))
        keep &= ~((frame == 0) & (azimuth[point] >= FRAMES // 2))
        apart, point, frame = apart[keep], point[keep], frame[keep]
    # Another angle for each row: as if each was a frame of its own.
    rows = np.arange(len(frame))
    turned = replace(turntable, frames=rows, angles_rad=angles[frame] + np.deg2rad(creep_deg) * apart)
    pixels = project(turned, rows, turntable.points_3d[point]).pixels
    tracks = Tracks(frame, point, pixels + noise_px * rng.normal(size=pixels.shape))
    return AdjustedTracks(turntable, tracks, np.zeros(len(frame), bool))


@pytest.mark.parametrize("creep_deg", [0.0, 0.02, -0.05])
def test_steps_that_creep_do_not_close_the_loop(creep_deg):
    assert creeping(creep_deg).loop_closure_deg() == pytest.approx(FRAMES * creep_deg, rel=2e-2, abs=1e-9)


def test_noise_alone_leaves_little():
    assert abs(creeping(0.0, noise_px=0.02).loop_closure_deg()) < 0.3


def test_frames_that_share_no_point_tell_nothing():
    assert creeping(0.0, last_frame_sees=False).loop_closure_deg() is None
