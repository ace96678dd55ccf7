"""The chamber behind the turntable: its median spectrum, and whether an image of it is a better background.

An image is better if the chamber is stationary and uneven. Pixels that show the turntable's disc or the container are
left out, because these turn with the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf import paper
from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.morphology import dilate
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame
from hsi_sc_nerf.processing.view_changes import Change, change_of, colours_of

MAX_FRAMES = 16
"""Frames that are compared, evenly spread over the session."""
MAX_SIDE = 64
"""Pixels that are compared along the image's longer side."""
OUTLINE_PX = 3
"""Pixels within this of the object or the turntable are left out."""
FEWEST_OTHERS = 2
"""A pixel is compared if more than this many other frames show the chamber there."""
FEWEST_PIXELS = 16
TRIMMED = 0.02
"""Fraction of the pixels that is left out: those least like the chamber's spectrum, such as a stem on the axis that
the masks miss."""
_BORDER_FRACTION = 1 / 32


def background_pixels(
    dataset: PackedDataset,
    bins: Sequence[Float[np.ndarray, "bins h w"]],
    masks: Bool[np.ndarray, "frames h w"],
) -> tuple[Float[np.ndarray, "chosen pixels colours"], Bool[np.ndarray, "chosen pixels"]]:
    """Reflectance of the same pixels in some frames, and which of them show the chamber."""
    step = -(-max(masks.shape[1:]) // MAX_SIDE)
    spectra, free = [], []
    count = min(len(masks), MAX_FRAMES)
    for index in (int((i + 0.5) * len(masks) / count) for i in range(count)):
        turning = masks[index] | turntable_silhouette(dataset, dataset.frames[index].camera_to_world)
        free.append(~dilate(turning, 2 * OUTLINE_PX + 1)[::step, ::step].ravel())
        colours = colours_of(bins[index][:, ::step, ::step])
        spectra.append(colours.reshape(len(colours), -1).T)
    return np.stack(spectra), np.stack(free)


def gain_of_background_image(
    spectra: Float[np.ndarray, "frames pixels colours"], free: Bool[np.ndarray, "frames pixels"]
) -> Change | None:
    """How much better an image of the chamber predicts a frame than its median spectrum, RMS reflectance.

    The image is the median of the other frames at each pixel. The gain is 0 if the chamber is even or moves, and None
    if too little of it is visible.
    """
    shown = np.where(free[..., None], spectra, np.nan)
    known = free & (free.sum(axis=0) > FEWEST_OTHERS)
    frames = np.flatnonzero(known.sum(axis=1) >= FEWEST_PIXELS)
    if len(frames) < FEWEST_OTHERS + 1:
        return None
    spectrum = np.nanmedian(shown.reshape(-1, shown.shape[-1]), axis=0)
    # 0 where no frame shows the chamber, which is in no frame's pixels.
    unlike = np.nan_to_num(((shown - spectrum) ** 2).mean(axis=-1)).max(axis=0)
    known &= unlike <= np.quantile(unlike[free.any(axis=0)], 1.0 - TRIMMED)
    gains = []
    for frame in frames:
        pixels = known[frame]
        image = np.nanmedian(np.delete(shown[:, pixels], frame, axis=0), axis=0)
        measured = shown[frame, pixels]
        gains.append(float(((measured - spectrum) ** 2 - (measured - image) ** 2).mean()))
    return change_of(gains, known[frames].sum(axis=1))


def turntable_silhouette(
    dataset: PackedDataset, camera_to_world: Float[np.ndarray, "4 4"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels of a camera that show the turntable's disc or the container (`turntable_cylinders`)."""
    silhouette = np.zeros((dataset.intrinsics.h, dataset.intrinsics.w), np.uint8)
    for points in turntable_cylinders(dataset):
        pixels, _ = project(points, camera_to_world, dataset.intrinsics, dataset.distortion)
        # OpenCV draws in coordinates whose origin is the first pixel's centre.
        cv2.fillConvexPoly(silhouette, cv2.convexHull(np.rint(pixels - 0.5).astype(np.int32)), 1)
    return silhouette > 0


def turntable_cylinders(dataset: PackedDataset) -> list[Float[np.ndarray, "points 3"]]:
    """Points on the rims of upright cylinders that hold the disc and the container, object frame, metres.

    Where the container's size is not known, one cylinder holds everything below the object. Flat markers around the
    container stand off its wall at their corners, so its cylinder is the one around that prism.
    """
    reach = np.abs(dataset.scene_box_m[:, :2]).max()
    lowest, container = dataset.scene_box_m[0, 2], dataset.container
    if container is None:
        return [_rims(reach, lowest, dataset.object_box_m[0, 2])]
    prism_radius = container.diameter_m / 2.0 / np.cos(np.pi / paper.CONTAINER_MARKERS)
    return [_rims(reach, lowest, 0.0), _rims(prism_radius, 0.0, container.height_m)]


def _rims(radius_m: float, low_m: float, high_m: float) -> Float[np.ndarray, "points 3"]:
    angle = 2.0 * np.pi * np.arange(64) / 64
    circle = radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([np.insert(circle, 2, height, axis=1) for height in (low_m, high_m)])


def background_spectrum(
    frames: Sequence[PackedFrame], masks: Bool[np.ndarray, "frames h w"]
) -> Float[np.ndarray, "bands"]:
    """Median over frames of `border_spectrum`; 0 in a band that no frame measured there."""
    spectra = np.stack([border_spectrum(frame.cube_path, mask) for frame, mask in zip(frames, masks, strict=True)])
    measured = np.isfinite(spectra).any(axis=0)
    background = np.zeros(spectra.shape[1])
    background[measured] = np.nanmedian(spectra[:, measured], axis=0)
    return background


def border_spectrum(cube_path: Path, mask: Bool[np.ndarray, "lines samples"]) -> Float[np.ndarray, "bands"]:
    """Median of what is measured on the image's border outside of the mask; nan in a band without any value."""
    lines, samples = mask.shape
    width = max(1, round(_BORDER_FRACTION * min(lines, samples)))
    border = ~mask
    border[width : lines - width, width : samples - width] = False
    counts = open_cube(cube_path).memmap()[border]
    # Flagged values are the largest number.
    return median_of_smallest(counts, (counts != FLAGGED).sum(axis=0)) / REFLECTANCE_SCALE


def median_of_smallest(
    values: Num[np.ndarray, "n *shape"], number: Int[np.ndarray, "*shape"]
) -> Float[np.ndarray, "*shape"]:
    """Median along the first axis of the ``number`` smallest values; nan where the number is 0."""
    if len(values) == 0:
        return np.full(values.shape[1:], np.nan)
    ordered = np.sort(values, axis=0)
    middle = [np.take_along_axis(ordered, np.maximum(number - odd, 0)[None] // 2, axis=0)[0] for odd in (0, 1)]
    # An even number has two middle values; of an odd number both are the same.
    return np.where(number > 0, 0.5 * (middle[0].astype(np.float64) + middle[1]), np.nan)
