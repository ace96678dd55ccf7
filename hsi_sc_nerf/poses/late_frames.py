"""Frames that structure from motion lost or got wrong: one angle each, from points whose places are known by now."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from hsi_sc_nerf.poses.tracks import TrackedTurntable, Tracks, project

_STEP_DEG = 1.0
# A point supports an angle if it is seen this near to where the machine puts it; farther counts no more.
_NEAR_PX = 2.0
_FEWEST_POINTS = 8
_NEAR_SHARE = 0.5


def with_late_frames(turntable: TrackedTurntable, tracks: Tracks) -> TrackedTurntable:
    """The turntable with those further frames of the tracks whose points all but agree on an angle.

    All angles are tried, for a turntable may have stopped or jumped. ``adjust_tracks`` makes them precise.
    """
    known = np.isin(tracks.point, turntable.points)
    frames, angles = turntable.frames, turntable.angles_rad
    for frame in np.setdiff1d(tracks.frame[known], turntable.frames):
        angle = _angle_of(turntable, tracks.select(known & (tracks.frame == frame)))
        if angle is not None:
            at = int(np.searchsorted(frames, frame))
            frames, angles = np.insert(frames, at, frame), np.insert(angles, at, angle)
    # Angles run on from frame to frame.
    return replace(turntable, frames=frames, angles_rad=angles[0] + np.unwrap(angles - angles[0]))


def _angle_of(turntable, seen):
    """The angle at which the points of one frame are seen nearest to where they should be; None without agreement."""
    if len(seen) < _FEWEST_POINTS:
        return None
    point = np.searchsorted(turntable.points, seen.point)

    def distances_px(angles_rad):
        machine = replace(turntable, angles_rad=np.atleast_1d(angles_rad))
        frame = np.repeat(np.arange(len(machine.angles_rad)), len(point))
        pixels = project(machine, frame, np.tile(point, len(machine.angles_rad)))[0].reshape(-1, len(point), 2)
        return np.linalg.norm(pixels - seen.pixels, axis=-1)

    def cost(angles_rad, reach_px):
        return np.minimum(distances_px(angles_rad), reach_px).mean(axis=1)

    grid = np.deg2rad(np.arange(0.0, 360.0, _STEP_DEG))
    # A step of the grid moves a point by several pixels: the rough search must see that far.
    rough = grid[np.argmin(cost(grid, 10.0 * _NEAR_PX))]
    step = np.deg2rad(_STEP_DEG)
    fine = rough + step * np.linspace(-1.0, 1.0, 41)
    rough = fine[np.argmin(cost(fine, _NEAR_PX))]
    found = minimize_scalar(
        lambda angle: float(cost(angle, _NEAR_PX)[0]), bounds=(rough - step / 20, rough + step / 20), method="bounded"
    )
    near = float((distances_px(found.x)[0] < _NEAR_PX).mean())
    return float(found.x) if near >= _NEAR_SHARE else None
