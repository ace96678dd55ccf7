"""Measurements of elements: which frames see them, and the reflectance there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.geometry.mesh import ray_scene
from hsi_sc_nerf.geometry.ray_projection import image_coordinates
from hsi_sc_nerf.light.elements import Elements
from hsi_sc_nerf.light.views import Views

LARGEST_INCIDENCE_DEG, LARGEST_INCIDENCE_OF_SUPPORT_DEG = 70.0, 80.0
"""More oblique pixels also hold what lies beside. The lid is seen obliquely by every camera."""

SMALLEST = 1e-3
"""Reflectance that noise does not exceed."""
MISPLACED_PX = 0.3
"""Poses, surface and interpolation are uncertain by this part of a pixel."""

Pixels = Callable[[int, Int[np.ndarray, "n"], Int[np.ndarray, "n"]], Float[np.ndarray, "n bands"]]
"""Reflectance of pixels of a frame, given by line and sample; NaN where nothing was measured."""


def observe(
    elements: Elements,
    camera_to_world: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    distortion: tuple[float, float, float, float],
    masks: Bool[np.ndarray, "frames lines samples"],
    pixels: Pixels,
    lift_m: float,
) -> Views:
    """What frames measure of the elements that they see, interpolated between four pixels.

    All four pixels are the object's, or none is.

    Args:
        elements: on the object and its support.
        camera_to_world: poses, OpenGL axes, metres.
        intrinsics: of the camera.
        distortion: k1, k2, p1, p2 (OpenCV).
        masks: pixels of the object.
        pixels: reads reflectance.
        lift_m: lines of sight begin so far outside of the surface.
    """
    scene = ray_scene(elements.occluders.vertices, elements.occluders.triangles)
    starts = elements.positions + lift_m * elements.normals
    least = np.where(elements.on_object, LARGEST_INCIDENCE_DEG, LARGEST_INCIDENCE_OF_SUPPORT_DEG)
    least = np.cos(np.deg2rad(least))
    found: list[tuple[np.ndarray, ...]] = []
    for frame, pose in enumerate(camera_to_world):
        sight = pose[:3, 3] - elements.positions
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        in_camera = torch.from_numpy((elements.positions - pose[:3, 3]) @ pose[:3, :3])
        xy, forward = image_coordinates(in_camera, intrinsics, distortion)
        # Pixel centres lie at half numbers.
        corner = np.floor(xy.numpy() - 0.5)
        inside = (corner >= 0.0).all(axis=1) & (corner < [intrinsics.w - 1, intrinsics.h - 1]).all(axis=1)
        seen = np.flatnonzero((np.einsum("nk,nk->n", elements.normals, sight) > least) & inside & forward.numpy())
        rays = np.concatenate([starts[seen], sight[seen]], axis=1, dtype=np.float32)
        seen = seen[~scene.test_occlusions(rays).numpy()]
        sample, line = corner[seen].astype(int).T
        part = xy.numpy()[seen] - 0.5 - corner[seen]
        value, of_object, across, along = 0.0, [], 0.0, 0.0
        for down in (0, 1):
            for right in (0, 1):
                share_across, share_along = np.abs(1 - right - part[:, 0]), np.abs(1 - down - part[:, 1])
                pixel = pixels(frame, line + down, sample + right)
                value = value + (share_across * share_along)[:, None] * pixel
                across = across + (2 * right - 1) * share_along * pixel.mean(axis=1)
                along = along + (2 * down - 1) * share_across * pixel.mean(axis=1)
                of_object.append(masks[frame, line + down, sample + right])
        on = elements.on_object[seen]
        whole = np.where(on, np.all(of_object, axis=0), ~np.any(of_object, axis=0))
        whole &= np.isfinite(np.asarray(value)).all(axis=1)
        value = np.asarray(value)[whole]
        std = MISPLACED_PX * np.hypot(across, along)[whole] / np.maximum(value.mean(axis=1), SMALLEST)
        found.append((seen[whole], np.full(len(value), frame), value, std))
    element, frames, reflectance, std = (np.concatenate(column) for column in zip(*found, strict=True))
    return Views(element, frames, reflectance, elements.on_object[element], std)
