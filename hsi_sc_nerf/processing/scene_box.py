"""Axis-aligned boxes of the object and of everything that turns, from poses and masks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.dataset import Container
from hsi_sc_nerf.processing.voted_hull import VotedHull

OBJECT_MARGIN_M = 0.003
"""The object's box is widened by this: masks and poses are uncertain by a pixel or two."""
SCENE_MARGIN_M = 0.005
"""The box of everything that turns is widened by this."""
DISC_OVER_MARKERS = 1.1
"""Radius of the turntable's disc as a multiple of the outermost marker corner's distance from the axis."""
DISC_OVER_CONTAINER = 2.3
"""Diameter of the disc as a multiple of the container's, where no marker shows it; the simulator's is 205 mm under a
container of 90 mm."""


def object_box(hull: VotedHull, min_z_m: float | None = None) -> Float[np.ndarray, "2 3"]:
    """Minimum and maximum of the core of the masks' visual hull, object frame, metres.

    Args:
        hull: of the masks.
        min_z_m: height of the container's lid, below which the box does not reach; None if unknown.

    Raises:
        InputError: no point projects into the masks: masks and poses do not fit each other.

    Example:
        >>> dataset = open_packed("apple_01-data")
        >>> masks = np.stack([frame.mask() for frame in dataset.frames])
        >>> low_m, high_m = object_box(voted_hull(masks, dataset.camera_to_worlds, dataset.intrinsics))
    """
    if len(hull.core) == 0:
        raise InputError(
            "the foreground masks and the poses do not fit each other, so that no object is left in space; look "
            "at report/masks.png and report/poses.png."
        )
    low, high = hull.core.min(axis=0) - hull.sides_m / 2.0, hull.core.max(axis=0) + hull.sides_m / 2.0
    box = np.stack([low - OBJECT_MARGIN_M, high + OBJECT_MARGIN_M])
    if min_z_m is not None:
        box[0, 2] = max(box[0, 2], min_z_m)
    return box


def scene_box(
    object_box_m: Float[np.ndarray, "2 3"],
    marker_corners_m: dict[int, Float[np.ndarray, "4 3"]],
    container: Container | None,
    container_diameter_m: float | None = None,
) -> Float[np.ndarray, "2 3"]:
    """Minimum and maximum of everything that turns: object, container, markers and the disc under them.

    The disc is round, so the box is square about the axis. Its radius is taken to be (`assumed_disc` says which):

    - `DISC_OVER_MARKERS` times the distance of the outermost marker corner from the axis;
    - without markers, `DISC_OVER_CONTAINER` times the container's radius;
    - with neither, the object box's reach. It holds all that differs from the background.

    Args:
        object_box_m: minimum and maximum of the object's box.
        marker_corners_m: corners of the markers by their id; may be empty.
        container: where its size is known and it stands on z = 0.
        container_diameter_m: of a container whose height over the disc is not known, where lengths are metres.
    """
    corners = np.concatenate([np.zeros((1, 3)), *marker_corners_m.values()])
    diameter_m = container_diameter_m or 0.0 if container is None else container.diameter_m
    radii = [
        DISC_OVER_MARKERS * np.hypot(corners[:, 0], corners[:, 1]).max(),
        np.abs(object_box_m[:, :2]).max(),
        diameter_m / 2.0 if marker_corners_m else DISC_OVER_CONTAINER * diameter_m / 2.0,
    ]
    lowest = min(corners[:, 2].min(), object_box_m[0, 2])
    highest = max(corners[:, 2].max(), object_box_m[1, 2], 0.0 if container is None else container.height_m)
    reach = max(radii) + SCENE_MARGIN_M
    return np.array([[-reach, -reach, lowest - SCENE_MARGIN_M], [reach, reach, highest + SCENE_MARGIN_M]])


def assumed_disc(has_markers: bool, container_diameter_m: float | None) -> str | None:
    """What `scene_box` assumes of a disc that no marker shows, as the rest of a sentence; None with markers."""
    if has_markers:
        return None
    if container_diameter_m is None:
        return "nothing shows how far the disc reaches: what turns is taken to end where the masks' hull ends"
    diameter_mm = 1e3 * DISC_OVER_CONTAINER * container_diameter_m
    return (
        f"no marker shows how far the disc reaches: its diameter is taken to be {diameter_mm:.0f} mm, "
        f"{DISC_OVER_CONTAINER} times the container's"
    )
