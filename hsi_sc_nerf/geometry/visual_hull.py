"""The visual hull: the points that project into the object's mask in every frame that has them in its image.

A. Laurentini, "The visual hull concept for silhouette-based image understanding", IEEE TPAMI 16, 1994.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, pixels_of

MIN_VIEWS_FRACTION = 2.0 / 3.0
"""A point of the hull lies in the image of this fraction of the frames: too few masks carve what lies far behind the
object or beside the camera."""
MAX_MISSED_FRACTION = 0.05
"""A point of the hull may lie outside the mask in this fraction of all frames: one wrong mask or pose must not cut a
piece off the object."""
_FIRST_STEP = 6


def visual_hull(
    points: Float[np.ndarray, "n 3"],
    masks: Bool[np.ndarray, "frames h w"],
    camera_to_worlds: Float[np.ndarray, "frames 4 4"],
    intrinsics: PinholeIntrinsics,
    max_missed_fraction: float = MAX_MISSED_FRACTION,
) -> Float[np.ndarray, "kept 3"]:
    """The points that most frames see (`MIN_VIEWS_FRACTION`) and few outside the mask.

    Lens distortion is neglected.

    Args:
        points: in the object frame, metres.
        masks: true on the object.
        camera_to_worlds: poses, OpenGL axes.
        max_missed_fraction: fraction of all frames that may have a point of the hull outside of their mask.

    Example:
        >>> ticks = np.linspace(-0.1, 0.1, 48)
        >>> centres = np.stack(np.meshgrid(ticks, ticks, ticks), axis=-1).reshape(-1, 3)
        >>> hull = visual_hull(centres, masks, camera_to_worlds, intrinsics)
    """
    max_missed = int(max_missed_fraction * len(masks) + 1e-9)
    # A few frames rule out most points, before all frames test the rest.
    for step in (_FIRST_STEP, 1):

        def pixels_in(frame: int, points: Float[np.ndarray, "n 3"], step: int = step) -> tuple[Any, Any]:
            return pixels_of(points, camera_to_worlds[frame * step], intrinsics)

        in_image, in_mask = silhouette_counts(points, masks[::step], pixels_in)
        keep = in_image - in_mask <= max_missed
        points, in_image = points[keep], in_image[keep]
    return points[in_image >= MIN_VIEWS_FRACTION * len(masks) - 1e-9]


def silhouette_counts(points: Any, masks: Iterable[Any], pixels_of: Callable[[int, Any], Any]) -> tuple[Any, Any]:
    """Count the frames that have each point in their image, and those that have it in the object's mask.

    Occlusion is ignored. Takes NumPy arrays or tensors and returns two counts (n) of the same kind.

    Args:
        points: (n, 3), in the unit that ``pixels_of`` takes.
        masks: of each frame (lines, samples), true on the object.
        pixels_of: of a frame's index and points, which points lie in the image (n), and their pixels (n, 2) as
            (sample, line), (0, 0) where they do not.
    """
    in_image: Any = 0
    in_mask: Any = 0
    for index, mask in enumerate(masks):
        inside, pixels = pixels_of(index, points)
        in_image = in_image + inside
        in_mask = in_mask + (inside & mask[pixels[:, 1], pixels[:, 0]])
    return in_image, in_mask
