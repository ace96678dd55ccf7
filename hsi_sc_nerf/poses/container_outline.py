"""The container's radius by its outline: the two upright edges that it shows in every frame.

Its diameter is known in metres, so that its radius in the poses' unit of length gives the scale without any marker.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter1d

from hsi_sc_nerf.poses.turntable import Turntable

# Radii that are tried, over that of most points; and how far the edges of one frame may lie from those of all.
_RADII = np.geomspace(0.4, 1.6, 400)
_MOST_POINTS_PERCENTILE = 90.0
_REACH = 0.08
# Edges are sought along this part of the container's height, from below; above, the object may overhang.
_HEIGHTS = np.linspace(0.15, 0.7, 24)
_SMOOTHING = 3.0
"""Standard deviation of the Gaussian over the radii."""
# Both edges change the brightness by this from one radius to the next, gray levels, but for so many places in a
# hundred; frames agree to this fraction of the radius.
_LEAST_SLOPE, _WEAKEST_PERCENTILE = 0.5, 20.0
_LARGEST_SPREAD = 0.02
# Blur, wear and the lid's rim, as a fraction of the radius.
_EDGE_SIGMA = 0.005


def container_radius(
    images: Sequence[UInt8[np.ndarray, "h w"]], turntable: Turntable, top: float, height_over_diameter: float
) -> tuple[float, float] | None:
    """Radius of the upright container about the axis in the turntable's unit, and its relative standard deviation.

    A container off the axis moves both edges to one side; the mean of both tells its radius.

    Args:
        images: gray, one per frame of the session.
        turntable: adjusted.
        top: height of the container's lid in the turntable frame.
        height_over_diameter: of the container.

    Returns:
        None where no two edges stand out in most frames, or they do not agree.
    """
    object_radius = np.percentile(np.linalg.norm(turntable.points_3d[:, :2], axis=1), _MOST_POINTS_PERCENTILE)
    radii = float(object_radius) * _RADII
    place = _edges_px(turntable, radii, top, height_over_diameter)
    pictures = np.stack([images[frame] for frame in turntable.frames]).astype(np.float32)
    together = _strengths(pictures.mean(axis=0), place).min(axis=0)
    best = int(np.argmax(together))
    if together[best] < _LEAST_SLOPE:
        return None
    strengths = np.stack([_strengths(picture, place) for picture in pictures])
    near = np.abs(np.log(radii / radii[best])) < _REACH
    peaks = np.argmax(strengths[..., near], axis=-1)
    found = radii[near][peaks].mean(axis=1)
    spread = float(np.median(np.abs(found / np.median(found) - 1.0)))
    if spread > _LARGEST_SPREAD:
        return None
    return float(np.median(found)), float(np.hypot(1.5 * spread / np.sqrt(len(found)), _EDGE_SIGMA))


def _edges_px(
    turntable: Turntable, radii: Float[np.ndarray, "r"], top: float, height_over_diameter: float
) -> Float[np.ndarray, "2 heights r 2"]:
    """Pixels of the left and the right edge of cylinders about the axis."""
    # Rays touch a cylinder where its radius is perpendicular to them.
    fraction = radii / turntable.distance
    x, y = radii * fraction, radii * np.sqrt(1.0 - fraction**2)
    z = top - np.outer(1.0 - _HEIGHTS, 2.0 * radii * height_over_diameter)
    edges = [np.stack(np.broadcast_arrays(x, side * y, z), axis=-1) for side in (-1.0, 1.0)]
    in_camera = (np.stack(edges) - [turntable.distance, 0.0, 0.0]) @ turntable.camera_rotation.T
    return turntable.focal_px * in_camera[..., :2] / in_camera[..., 2:] + turntable.centre_px


def _strengths(
    image: Float[np.ndarray, "h w"], place: Float[np.ndarray, "2 heights r 2"]
) -> Float[np.ndarray, "2 r"]:
    """How much the brightness changes from one radius to the next, at least in most places along each edge.

    An edge of the container goes all along its height, before the disc and before the wall; patterns of the wall do
    not. 0 outside of the image.
    """
    x, y = (place[..., k].astype(np.float32).reshape(-1, place.shape[2]) - np.float32(0.5) for k in (0, 1))
    shown = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    slopes = gaussian_filter1d(shown.reshape(place.shape[:3]), _SMOOTHING, axis=-1, order=1)
    return np.percentile(np.abs(np.nan_to_num(slopes)), _WEAKEST_PERCENTILE, axis=1)
