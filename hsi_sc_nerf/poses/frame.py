"""From the adjusted machine to the object frame, and the figures that tell how good it is."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, rotation_about_z
from hsi_sc_nerf.poses.adjust import angle_slopes
from hsi_sc_nerf.poses.initialise import Observations, Turntable, square_corners
from hsi_sc_nerf.poses.loop_closure import chained_turn_deg

# A marker lies on the disc if it faces up to this cosine and its centre is this near the lowest such marker's,
# in marker sides.
_FACES_UP_COSINE = 0.97
_COPLANAR_SIDES = 0.2


def layout(turntable: Turntable, side_m: float) -> Float[np.ndarray, "m 4 3"]:
    """Corners of the markers in the turntable's frame, at the angle 0."""
    rotations, shifts = turntable.marker_poses[:, :3, :3], turntable.marker_poses[:, None, :3, 3]
    return np.einsum("mij,kj->mki", rotations, square_corners(side_m)) + shifts


def on_disc(turntable: Turntable, side_m: float) -> Bool[np.ndarray, "m"]:
    """Which of the turntable's markers lie on the disc."""
    return lie_on_disc(layout(turntable, side_m))


def lie_on_disc(corners: Float[np.ndarray, "m 4 3"]) -> Bool[np.ndarray, "m"]:
    """Which markers lie on the disc: the lowest group that faces up along z, the axis, and shares one height.

    Args:
        corners: of each marker, in any unit, clockwise seen from its front.
    """
    right, down = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    normal = np.cross(down, right)
    up = normal[:, 2] > _FACES_UP_COSINE * np.linalg.norm(normal, axis=-1)
    if not up.any():
        return up
    height = corners[..., 2].mean(axis=1)
    side = np.linalg.norm(right, axis=-1).mean()
    return up & (height < height[up].min() + _COPLANAR_SIDES * side)


def disc_height_m(turntable: Turntable, side_m: float) -> float:
    """Height of the disc in the turntable's frame; without markers on a disc that of the lowest marker corner."""
    corners = layout(turntable, side_m)
    flat = lie_on_disc(corners)
    return float(np.median(corners[flat, :, 2].mean(-1)) if flat.any() else corners[..., 2].min())


def disc_tilt_deg(turntable: Turntable, side_m: float) -> float | None:
    """Angle between the axis and the normal of the plane through the disc's markers; None below three markers."""
    corners = layout(turntable, side_m)
    flat = lie_on_disc(corners)
    if flat.sum() < 3:
        return None
    points = corners[flat].reshape(-1, 3)
    normal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    return float(np.rad2deg(np.arctan2(np.hypot(normal[0], normal[1]), abs(normal[2]))))


def camera_to_world(turntable: Turntable, disc_m: float) -> Float[np.ndarray, "f 4 4"]:
    """Camera-to-world in the object frame (OpenGL axes): z = 0 on the disc, x towards the first frame's camera."""
    in_room = np.eye(4)
    in_room[:3, :3] = turntable.camera_rotation.T
    in_room[:3, 3] = [turntable.distance_m, 0.0, 0.0]
    to_room = np.tile(np.eye(4), (len(turntable.frames), 1, 1))
    to_room[:, :3, :3], to_room[:, :3, 3] = turntable.motions()
    to_object = rotation_about_z(-first_azimuth_deg(turntable))
    to_object[2, 3] = -disc_m
    return to_object @ np.linalg.inv(to_room) @ in_room @ OPENCV_TO_OPENGL


def first_azimuth_deg(turntable: Turntable) -> float:
    """Azimuth of the first frame's camera in the turntable's frame: not 0 only where the table wobbles."""
    rotations, shifts = turntable.motions()
    camera = ([turntable.distance_m, 0.0, 0.0] - shifts[0]) @ rotations[0]
    return float(np.rad2deg(np.arctan2(camera[1], camera[0])))


def loop_closure_deg(
    turntable: Turntable,
    observations: Observations,
    residual_px: Float[np.ndarray, "n 4 2"],
    weights: Float[np.ndarray, "n 8 8"],
    centre_px: tuple[float, float],
    side_m: float,
) -> float | None:
    """What is left of a full turn after adding up the steps between neighbouring frames, the last to the first too.

    Each step is measured from the markers that its two frames share alone, so errors add up as they do in any chain,
    unlike the adjusted angles, which close by construction. None where two neighbours share no marker.
    """
    slopes = np.einsum("nij,nj->ni", weights, angle_slopes(turntable, observations, centre_px, side_m))
    residual = np.einsum("nij,nj->ni", weights, residual_px.reshape(-1, 8))
    return chained_turn_deg(turntable.frames, observations.frame, observations.marker, slopes, residual)
