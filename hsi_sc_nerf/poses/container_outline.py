"""The container by its outline: the two upright edges that it shows in every frame, and the arc of its foot.

Its diameter is known in metres, so that its radius in the poses' unit of length gives the scale without any marker;
its foot stands on the disc.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter1d

from hsi_sc_nerf.geometry.camera import cross_matrix
from hsi_sc_nerf.poses.turntable import Turntable, project
from hsi_sc_nerf.robust_scatter import robust_std

# Radii that are tried, over that of most points; and how far the edges of one frame may lie from those of all.
_RADII = (0.4, 1.6)
_MOST_POINTS_PERCENTILE, _LOWEST_POINTS_PERCENTILE = 90.0, 1.0
_REACH = 0.08
# Heights of the lid that are tried, over the lowest points, in heights of the container: an object curves under, so
# that its features end above the lid.
_LIDS = (-1.0, 0.1)
# Edges are sought along this part of the container's height, from below; above, the object may overhang. The foot is
# sought along this part of its circle, from the camera's side.
_HEIGHTS = np.linspace(0.15, 0.7, 24)
_AZIMUTHS = np.deg2rad(np.linspace(-60.0, 60.0, 24))
# From one tried radius or height to the next, and standard deviation of the Gaussian over them.
_STEP_PX, _SMOOTHING_PX = 0.2, 0.7
# Least gradient of the brightness at an edge, gray levels per pixel, and the percentage of its points that may have
# less; and largest spread of the frames' results, as a fraction of the radius.
_LEAST_GRADIENT, _WEAKEST_PERCENTILE = 2.0, 20.0
_LARGEST_SPREAD = 0.02
_ROUNDS = 3
# Radii or heights that are tried at least: wrong poses can leave an object of a pixel, or one that holds the camera.
_FEWEST_TRIED = 3
# Standard deviation of an edge's position, alike in all frames: it is somewhere in the pixel of the steepest change.
_EDGE_PX = 1.0 / np.sqrt(12.0)


@dataclass(frozen=True)
class ContainerOutline:
    """The container in the turntable's unit of length, with standard deviations."""

    radius: float
    radius_sigma: float
    """Standard deviation of the radius, as a fraction of it."""
    foot: float
    """Height of the container's foot, which stands on the disc, in the turntable frame."""
    foot_sigma: float
    height: float
    """Height of the lid over the foot, by the stated proportions."""


def container_outline(
    images: Sequence[UInt8[np.ndarray, "h w"]], turntable: Turntable, height_over_diameter: float
) -> ContainerOutline | None:
    """Radius and foot of the upright container about the axis.

    If the container is off the axis, both edges move to one side, so the radius is the mean of both.

    Returns:
        None where two edges and a foot do not stand out in most frames, or do not agree.
    """
    points = turntable.points_3d
    reach = float(np.percentile(np.linalg.norm(points[:, :2], axis=1), _MOST_POINTS_PERCENTILE))
    lowest = float(np.percentile(points[:, 2], _LOWEST_POINTS_PERCENTILE))
    pictures = np.stack([images[frame] for frame in turntable.frames]).astype(np.float32)
    mean, step = pictures.mean(axis=0), _STEP_PX * turntable.distance / turntable.focal_px
    radii = np.arange(_RADII[0] * reach, _RADII[1] * reach, step)
    heights = 2.0 * radii * height_over_diameter
    if len(radii) < _FEWEST_TRIED or radii[-1] >= turntable.distance:
        return None
    # Until the foot is found, the lid is where the points end.
    feet_of_radii = lowest - heights
    for _ in range(_ROUNDS):
        sides = _gradients(mean, turntable, _edges(radii, feet_of_radii, heights, turntable.distance)).min(axis=0)
        radius = float(radii[np.argmax(sides)])
        height = 2.0 * radius * height_over_diameter
        feet = np.arange(lowest + (_LIDS[0] - 1.0) * height, lowest + (_LIDS[1] - 1.0) * height, step)
        if len(feet) < _FEWEST_TRIED:
            return None
        arc = _gradients(mean, turntable, _arcs(radius, feet))[0]
        foot = float(feet[np.argmax(arc)])
        feet_of_radii = np.full(len(radii), foot)
        if min(sides.max(), arc.max()) < _LEAST_GRADIENT:
            return None
    radii, feet = (tried[np.abs(tried - at) < _REACH * radius] for tried, at in ((radii, radius), (feet, foot)))
    if min(len(radii), len(feet)) < _FEWEST_TRIED:
        return None
    edges, arcs = _edges(radii, np.full(len(radii), foot), height, turntable.distance), _arcs(radius, feet)
    found = np.empty((len(pictures), 2))
    for row, picture in zip(found, pictures, strict=True):
        sides, (arc,) = _gradients(picture, turntable, edges), _gradients(picture, turntable, arcs)
        row[:] = np.mean([_peak(radii, side) for side in sides]), _peak(feet, arc)
    radius, foot = np.median(found, axis=0).tolist()
    scatter = robust_std(found - [radius, foot], axis=0)
    if scatter[0] > _LARGEST_SPREAD * radius:
        return None
    # What a pixel is, in the turntable's unit, across the line of sight; the foot is seen from above.
    looks = turntable.camera_rotation[2]
    depth = float(looks @ [-turntable.distance, 0.0, foot])
    edge = _EDGE_PX * depth / turntable.focal_px
    in_image = np.hypot(*turntable.camera_rotation[:2, 2])  # length of the axis' unit vector
    errors = np.hypot(scatter / np.sqrt(len(found)), [edge, edge / in_image])
    # A higher container is nearer to a camera that looks down, and appears wider.
    nearer = looks[2] / depth * errors[1]
    height = 2.0 * radius * height_over_diameter
    return ContainerOutline(radius, float(np.hypot(errors[0] / radius, nearer)), foot, float(errors[1]), height)


def radius_by_camera(outline: ContainerOutline, turntable: Turntable) -> Float[np.ndarray, "5"]:
    """Derivatives of the log of the radius by the camera (as in ``Jacobian.camera``), the edges' pixels being fixed.

    The radius is the distance of the axis from the rays through the edges: d |y| / sqrt(x^2 + y^2) of a ray's
    direction (x, y, z).
    """
    fraction = outline.radius / turntable.distance
    found = np.zeros(5)
    for side in (-1.0, 1.0):
        edge = [outline.radius * fraction, side * outline.radius * np.sqrt(1.0 - fraction**2), outline.foot]
        ray = turntable.camera_rotation @ (np.array(edge) - [turntable.distance, 0.0, 0.0])
        ray /= ray[2]
        changes = np.stack([[-ray[0], -ray[1], 0.0], *cross_matrix(ray).T]) @ turntable.camera_rotation
        x, y, _ = turntable.camera_rotation.T @ ray
        found += 0.5 * np.append(changes @ [-x, x * x / y, 0.0] / (x * x + y * y), 1.0)
    return found


def _edges(radii, feet, heights, distance) -> Float[np.ndarray, "2 heights r 3"]:
    """Points of the left and the right edge of cylinders about the axis, each with its foot and height."""
    # Rays touch a cylinder where its radius is perpendicular to them.
    fraction = radii / distance
    x, y = radii * fraction, radii * np.sqrt(1.0 - fraction**2)
    z = feet + _HEIGHTS[:, None] * heights
    return np.stack([np.stack(np.broadcast_arrays(x, side * y, z), axis=-1) for side in (-1.0, 1.0)])


def _arcs(radius: float, feet: Float[np.ndarray, "z"]) -> Float[np.ndarray, "1 azimuths z 3"]:
    """Points of circles about the axis on the camera's side."""
    x, y = (radius * part(_AZIMUTHS)[:, None] for part in (np.cos, np.sin))
    return np.stack(np.broadcast_arrays(x, y, feet), axis=-1)[None]


def _gradients(
    image: Float[np.ndarray, "h w"], turntable: Turntable, points: Float[np.ndarray, "k points n 3"]
) -> Float[np.ndarray, "k n"]:
    """Gradient of the brightness across each of n lines, which most of its points reach; 0 outside of the image.

    An edge of the container extends over its whole height, in front of the disc and of the wall. Patterns on the wall
    do not.
    """
    unturned = replace(turntable, angles_rad=np.zeros(1), motion=None)
    every = points.reshape(-1, 3)
    pixels = project(unturned, np.zeros(len(every), int), every).pixels.reshape(*points.shape[:-1], 2)
    x, y = (pixels[..., k].astype(np.float32).reshape(-1, points.shape[2]) - np.float32(0.5) for k in (0, 1))
    shown = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    step_px = np.linalg.norm(np.diff(pixels, axis=2), axis=-1).mean()
    change = gaussian_filter1d(shown.reshape(points.shape[:3]), _SMOOTHING_PX / step_px, axis=-1, order=1) / step_px
    return np.percentile(np.abs(np.nan_to_num(change)), _WEAKEST_PERCENTILE, axis=1)


def _peak(tried: Float[np.ndarray, "n"], gradients: Float[np.ndarray, "n"]) -> float:
    """The radius or height of the largest gradient, between those that were tried, by a parabola."""
    k = int(np.clip(np.argmax(gradients), 1, len(gradients) - 2))
    before, at, after = gradients[k - 1 : k + 2]
    bend = before - 2.0 * at + after
    return float(tried[k] + (tried[1] - tried[0]) * (0.5 * (before - after) / bend if bend < 0.0 else 0.0))
