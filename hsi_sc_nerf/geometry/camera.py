"""Rigid geometry of a turntable before a camera that stands still: pure functions on NumPy arrays.

Conventions (docs/architecture.md): camera-to-world in OpenGL axes with the object frame as the world, z along
the turntable's axis, metres; pixel coordinates start at the image's upper left corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Multiplying a camera-to-world pose by this on the right turns OpenCV axes (y down, looking along +z) into
# OpenGL axes (y up, looking along -z), and back.
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class PinholeIntrinsics:
    """A pinhole camera in pixels; ``cx``, ``cy`` count from the image's upper left corner."""

    w: int
    h: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The calibration matrix K for corner-origin pixel coordinates."""
        return np.array([[self.fl_x, 0.0, self.cx], [0.0, self.fl_y, self.cy], [0.0, 0.0, 1.0]])


def rotation_about_z(angle_deg: float) -> Float[np.ndarray, "4 4"]:
    """Homogeneous rotation by ``angle_deg`` about z, counter-clockwise seen from +z."""
    a = np.deg2rad(angle_deg)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    return pose


def look_at(eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Camera-to-world (OpenGL) of a camera at ``eye`` that looks at ``target`` with the image's up along +z.

    Raises:
        ValueError: the viewing direction is parallel to z, so "up" is undefined.
    """
    back = np.asarray(eye, float) - np.asarray(target, float)
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    length = np.linalg.norm(right)
    if length < 1e-9:
        raise ValueError("look_at: the viewing direction is parallel to the z axis")
    right = right / length
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(back, right), back, eye
    return pose


def turntable_camera_to_world(
    first_camera_to_world: Float[np.ndarray, "4 4"], angle_deg: float
) -> Float[np.ndarray, "4 4"]:
    """Camera-to-world in the object's frame after the object turned by ``angle_deg`` (counter-clockwise).

    Turning the object by +angle before a fixed camera gives the image that a camera turned by -angle about the
    same axis takes of a fixed object (paper, "simulated pose transformation").
    """
    return rotation_about_z(-angle_deg) @ first_camera_to_world


def project(
    points: Float[np.ndarray, "*n 3"], camera_to_world: Float[np.ndarray, "4 4"], intrinsics: PinholeIntrinsics
) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
    """Project object-frame points; returns pixel coordinates and the depth in front of the camera (metres)."""
    world_to_camera = np.linalg.inv(camera_to_world @ OPENCV_TO_OPENGL)
    in_camera = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = in_camera[..., 2]
    scale = np.array([intrinsics.fl_x, intrinsics.fl_y])
    centre = np.array([intrinsics.cx, intrinsics.cy])
    return in_camera[..., :2] / depth[..., None] * scale + centre, depth


def pixel_rays(
    intrinsics: PinholeIntrinsics, camera_to_world: Float[np.ndarray, "4 4"], pixels: Float[np.ndarray, "*n 2"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "*n 3"]]:
    """Origin and unit directions of the rays through pixel coordinates, in the object's frame."""
    in_camera = np.stack(
        [
            (pixels[..., 0] - intrinsics.cx) / intrinsics.fl_x,
            -(pixels[..., 1] - intrinsics.cy) / intrinsics.fl_y,
            -np.ones(pixels.shape[:-1]),
        ],
        axis=-1,
    )
    directions = in_camera @ camera_to_world[:3, :3].T
    return camera_to_world[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def rotation_angle_deg(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> float:
    """Angle between the rotations of two poses, degrees (accurate for tiny angles: from the chord, not acos)."""
    chord = np.linalg.norm(a[:3, :3] - b[:3, :3]) / (2.0 * np.sqrt(2.0))
    return float(np.rad2deg(2.0 * np.arcsin(min(1.0, chord))))
