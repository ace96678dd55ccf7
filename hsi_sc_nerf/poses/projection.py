"""Where a turntable's markers appear in the images, and how that changes with everything that may be unknown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hsi_sc_nerf.poses.initialise import Turntable, square_corners


@dataclass(frozen=True)
class Projection:
    """Corners of markers in frames (n rows of 4), and what their derivatives need."""

    pixels: Float[np.ndarray, "n 4 2"]
    on_object: Float[np.ndarray, "n 4 3"]
    """Corners relative to their marker's centre, in the object's axes."""
    turned: Float[np.ndarray, "n 4 3"]
    """Corners after turn and tilt, before the shift of a wobbling table: in the room's axes, about its origin."""
    motion: Float[np.ndarray, "n 3 3"]
    """The frame's rotation from the object to the room."""
    in_camera: Float[np.ndarray, "n 4 3"]
    flat: Float[np.ndarray, "n 4 2"]
    """``in_camera`` over its depth."""


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the corners (x0, y0, x1, ...), px a unit of each unknown."""

    camera: Float[np.ndarray, "n 8 5"]
    """By the log of the focal length, a small rotation of the camera (3, rad), the log of its distance."""
    radial: Float[np.ndarray, "n 8 2"]
    """By k1 and k2."""
    angle: Float[np.ndarray, "n 8"]
    """By the frame's angle, rad."""
    motion: Float[np.ndarray, "n 8 5"]
    """By the frame's tilt (2, rad) and shift (3, m)."""
    marker: Float[np.ndarray, "n 8 6"]
    """By a small rotation of the marker in the object's axes (3, rad) and its shift (3, m)."""
    size: Float[np.ndarray, "n 8"]
    """By the log of the marker's side."""


def project_corners(
    turntable: Turntable,
    frame: Int[np.ndarray, "n"],
    marker: Int[np.ndarray, "n"],
    centre_px: tuple[float, float],
    side_m: float,
) -> Projection:
    """Corners of markers (rows of ``turntable.markers``) in frames (rows of ``turntable.frames``).

    Lens distortion is OpenCV's radial one: a direction (x, y, 1) appears at (1 + k1 r^2 + k2 r^4) (x, y).
    """
    rotations, shifts = turntable.motions()
    on_object = np.einsum("mij,kj->mki", turntable.marker_poses[:, :3, :3], square_corners(side_m))
    points = (on_object + turntable.marker_poses[:, None, :3, 3])[marker]
    turned = points @ np.swapaxes(rotations[frame], -1, -2)
    in_room = turned + shifts[frame][:, None] - [turntable.distance_m, 0.0, 0.0]
    in_camera = in_room @ turntable.camera_rotation.T
    flat = in_camera[..., :2] / in_camera[..., 2:]
    k1, k2 = turntable.radial
    squared = (flat**2).sum(-1, keepdims=True)
    pixels = turntable.focal_px * (1.0 + squared * (k1 + k2 * squared)) * flat + np.asarray(centre_px)
    return Projection(pixels, on_object[marker], turned, rotations[frame], in_camera, flat)


def corner_slopes(
    turntable: Turntable,
    frame: Int[np.ndarray, "n"],
    projection: Projection,
    centre_px: tuple[float, float],
) -> Slopes:
    """Derivatives of ``project_corners``."""
    flat, n = projection.flat, len(projection.flat)
    k1, k2 = turntable.radial
    squared = (flat**2).sum(-1)[..., None, None]
    by_flat = turntable.focal_px * (
        (1.0 + squared * (k1 + k2 * squared)) * np.eye(2)
        + (2.0 * k1 + 4.0 * k2 * squared) * flat[..., :, None] * flat[..., None, :]
    )
    depth = projection.in_camera[..., 2, None, None]
    flat_by_point = np.concatenate([np.broadcast_to(np.eye(2), (n, 4, 2, 2)), -flat[..., None]], axis=-1) / depth
    by_point = by_flat @ flat_by_point
    by_room = by_point @ turntable.camera_rotation
    camera = np.concatenate(
        [
            (projection.pixels - np.asarray(centre_px))[..., None],
            by_point @ -cross_matrix(projection.in_camera),
            -turntable.distance_m * by_room[..., :1],
        ],
        -1,
    )
    radial = (
        turntable.focal_px
        * flat[..., None]
        * np.concatenate([squared[..., 0], squared[..., 0] ** 2], -1)[..., None, :]
    )
    to_object = by_room @ projection.motion[:, None]
    # The frame's own vertical, which tilts with the table, carries the turn.
    about_axis = np.cross(projection.motion[:, None, :, 2], projection.turned)
    tilts = turntable.tilts_rad if turntable.tilts_rad is not None else np.zeros((len(turntable.frames), 2))
    level = np.concatenate([tilts, np.zeros((len(tilts), 1))], axis=-1)
    tilt = by_room @ -cross_matrix(projection.turned) @ _left_jacobian(level)[frame][:, None, :, :2]
    return Slopes(
        camera=camera.reshape(n, 8, 5),
        radial=radial.reshape(n, 8, 2),
        angle=np.einsum("nkij,nkj->nki", by_room, about_axis).reshape(n, 8),
        motion=np.concatenate([tilt, by_room], -1).reshape(n, 8, 5),
        marker=np.concatenate([to_object @ -cross_matrix(projection.on_object), to_object], -1).reshape(n, 8, 6),
        size=np.einsum("nkij,nkj->nki", to_object, projection.on_object).reshape(n, 8),
    )


def cross_matrix(v: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Matrices [v]x with [v]x w = v x w."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 2, 1], matrix[..., 0, 2], matrix[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return matrix - np.swapaxes(matrix, -1, -2)


def _left_jacobian(rotvec):
    """d(exp(w) s) = -[exp(w) s]x J(w) dw: the left Jacobian of SO(3)."""
    angle = np.linalg.norm(rotvec, axis=-1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = cross_matrix(rotvec)
    return np.eye(3) + a * cross + b * (cross @ cross)
