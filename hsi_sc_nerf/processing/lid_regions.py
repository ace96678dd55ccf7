"""Pixels that may show the object, above the container's lid, and those that see the middle of an empty lid."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, image_of, pixel_rays
from hsi_sc_nerf.packed.dataset import Container

LID_MIDDLE = 0.3
"""Radius of the middle of the container's lid, of the lid's."""


def above_lid(
    intrinsics: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"],
    camera_to_world: Float[np.ndarray, "4 4"],
    container: Container,
    overhang: float,
) -> Bool[np.ndarray, "h w"]:
    """Pixels whose rays pass through the space above the container's lid before they meet the container.

    Args:
        distortion: k1, k2, p1, p2 (OpenCV).
        camera_to_world: pose in the object frame, OpenGL axes, metres.
        container: upright cylinder about the z axis, from z = 0 up.
        overhang: the space above the lid is a cylinder of this multiple of the container's radius.
    """
    x, y = np.meshgrid(np.arange(intrinsics.w) + 0.5, np.arange(intrinsics.h) + 0.5)
    pixels = np.stack([x, y], axis=-1)
    if np.any(distortion):
        matrix = intrinsics.matrix()
        pixels = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, distortion, P=matrix).reshape(pixels.shape)
    origin, directions = pixel_rays(intrinsics, camera_to_world, pixels)
    radius, height = container.diameter_m / 2.0, container.height_m
    above, above_end = _cylinder_interval(origin, directions, overhang * radius, height, np.inf)
    solid, solid_end = _cylinder_interval(origin, directions, radius, 0.0, height)
    return (above < above_end) & ~((solid < solid_end) & (solid <= above))


def lid_middle(
    intrinsics: PinholeIntrinsics, camera_to_world: Float[np.ndarray, "4 4"], container: Container
) -> Bool[np.ndarray, "h w"]:
    """Pixels that see the middle of the empty lid, `LID_MIDDLE` of its radius; lens distortion is neglected.

    What stands on the axis hides them, and no wall is seen there.
    """
    ticks = np.linspace(-1.0, 1.0, 41) * LID_MIDDLE * container.diameter_m / 2.0
    x, y = (coordinate.ravel() for coordinate in np.meshgrid(ticks, ticks))
    points = np.stack([x, y, np.full_like(x, container.height_m)], axis=-1)[np.hypot(x, y) <= ticks[-1]]
    return image_of(points, camera_to_world, intrinsics)


def _cylinder_interval(
    origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "h w 3"], radius: float, low: float, high: float
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Ray parameters, 0 or more, between which x² + y² <= radius² and low <= z <= high; begin > end for a miss."""
    a = np.maximum(np.sum(directions[..., :2] ** 2, axis=-1), 1e-18)
    b = np.sum(directions[..., :2] * origin[:2], axis=-1)
    discriminant = b**2 - a * (np.sum(origin[:2] ** 2) - radius**2)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    slope = np.where(np.abs(directions[..., 2]) < 1e-12, 1e-12, directions[..., 2])
    first, second = (low - origin[2]) / slope, (high - origin[2]) / slope
    begin = np.maximum(np.maximum((-b - root) / a, np.minimum(first, second)), 0.0)
    end = np.minimum((-b + root) / a, np.maximum(first, second))
    return np.where(discriminant > 0.0, begin, np.inf), end
