"""Turntables in the adjustment's terms, and exact or noisy observations of their markers and points."""

from dataclasses import replace

import numpy as np

from hsi_sc_nerf.geometry.camera import rotation_angle_deg
from hsi_sc_nerf.poses.bundle_adjustment import Problem
from hsi_sc_nerf.poses.marker_initialisation import initialise
from hsi_sc_nerf.poses.object_frame import disc_height, to_object_frame
from hsi_sc_nerf.poses.residuals import MarkerResiduals
from hsi_sc_nerf.poses.turntable import MarkerObservations, Tracks, Turntable, project, rotations_about_z

SIDE_M, NOISE_PX = 0.03, 0.03


def marker_turntable(scene, **changes):
    """The machine of a ``MarkerScene``."""
    pose_in_object = scene.first_camera_to_world
    camera_m = pose_in_object[:3, 3]
    markers = np.array(sorted(scene.corners_m))
    poses = np.tile(np.eye(4), (len(markers), 1, 1))
    for marker_pose, marker in zip(poses, markers, strict=True):
        corners = scene.corners_m[marker]
        x, y = corners[1] - corners[0], corners[0] - corners[3]
        axes = np.stack([x / np.linalg.norm(x), y / np.linalg.norm(y)], axis=-1)
        marker_pose[:3, :3] = np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])])
        marker_pose[:3, 3] = corners.mean(0) - [0.0, 0.0, camera_m[2]]
    turntable = Turntable(
        focal_px=scene.intrinsics.fl_x,
        centre_px=(scene.size_px / 2, scene.size_px / 2),
        camera_rotation=(pose_in_object @ np.diag([1.0, -1.0, -1.0, 1.0]))[:3, :3].T,
        distance=float(np.hypot(camera_m[0], camera_m[1])),
        frames=np.arange(len(scene.angles_deg)),
        angles_rad=np.deg2rad(scene.angles_deg),
        side=SIDE_M,
        markers=markers,
        marker_poses=poses,
    )
    return replace(turntable, **changes)


def marker_observations(turntable, noise_px=NOISE_PX, seed=0, least_cosine=0.25):
    """Noisy corners of all markers that face the camera; their covariance is that of ``NOISE_PX``."""
    rng = np.random.default_rng(seed)
    normals, centres = turntable.marker_poses[:, :3, 2], turntable.marker_poses[:, :3, 3]
    pairs = []
    for frame, camera in enumerate(turntable.camera_positions()):
        view = camera - centres
        facing = (view * normals).sum(-1) / np.linalg.norm(view, axis=-1) > least_cosine
        pairs += [(frame, marker) for marker in turntable.markers[facing]]
    frame, marker = np.array(pairs).T
    covariance = np.tile(np.eye(8) * NOISE_PX**2, (len(frame), 1, 1))
    blank = MarkerObservations(frame, marker, np.zeros((len(frame), 4, 2)), covariance)
    corners = turntable.reproject(blank)
    return replace(blank, corners_px=corners + noise_px * rng.normal(size=corners.shape))


def started(scene, seen):
    """The initial turntable of a ``MarkerScene`` whose markers are seen."""
    return initialise(seen, (scene.size_px / 2, scene.size_px / 2), scene.size_px, SIDE_M)


def adjusted(start, seen):
    """The turntable adjusted to its markers."""
    return Problem(MarkerResiduals(start, seen, 3.0)).minimise(start)


def in_object_frame(turntable):
    """Its poses in the object frame, whose origin is on the disc."""
    return to_object_frame(turntable, disc_height(turntable)) @ turntable.camera_to_world()


def point_turntable(turntable, points, seed=0):
    """The turntable with points on an upright body about its axis, in fractions of the distance."""
    rng = np.random.default_rng(seed)
    azimuth, height = rng.uniform(0, 2 * np.pi, points), rng.uniform(-0.6, -0.25, points)
    radius = rng.uniform(0.1, 0.16, points)
    points_3d = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], -1) * turntable.distance
    return replace(turntable, points=np.arange(points), points_3d=points_3d)


def points_alone(turntable):
    """The turntable without markers, in distances of the camera, as features leave it."""
    return replace(
        turntable.resized(1.0 / turntable.distance),
        markers=turntable.markers[:0],
        marker_poses=turntable.marker_poses[:0],
    )


def pose_errors(found, truth):
    """Largest rotation error in degrees and largest error of the camera's place in millimetres."""
    away_m = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=-1)
    return rotation_angle_deg(found, truth).max(), 1e3 * away_m.max()


def point_tracks(turntable, noise_px=0.0, seed=1):
    """Tracks of the points in the frames where they face the camera."""
    in_room = np.einsum("fij,pj->fpi", rotations_about_z(turntable.angles_rad), turntable.points_3d)
    frame, point = np.nonzero(in_room[..., 0] > 0.03 * turntable.distance)
    pixels = project(turntable, frame, turntable.points_3d[point]).pixels
    return Tracks(frame, point, pixels + noise_px * np.random.default_rng(seed).normal(size=pixels.shape))
