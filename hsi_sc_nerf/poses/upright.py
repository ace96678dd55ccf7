"""Which way up the files' images are, by the markers that lie on the turntable's disc.

Seen obliquely, a square that lies flat is shortened along the axis' direction in the image, and all such squares by
nearly the same ratio, whichever way they are turned. What is farther up in an upright image is farther away: the
squares there are smaller. Neither needs a focal length.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from hsi_sc_nerf.poses.marker_detection import detect_markers, find_dictionary

# Flat squares agree in the tilt of their normals from the line of sight to so many degrees: perspective spreads them.
_ALIKE_DEG = 12.0
_FEWEST_ALIKE = 4
# Sizes must fall upwards by so many standard errors.
_LEAST_T = 4.0
# Neither a turntable seen from its side nor one seen from above shows a direction.
_TILT_RANGE_DEG = (10.0, 85.0)
# The camera's roll may add so much to a quarter turn.
_LARGEST_ROLL_DEG = 30.0


def image_rotation_from_markers(
    images: Sequence[UInt8[np.ndarray, "h w"]], dictionary: str | None = None
) -> int | None:
    """Rotation of the files' images from upright, counter-clockwise: 0, 90, 180 or 270 degrees.

    Args:
        images: of some frames, as they are in the files; more than one at different angles of the turn.
        dictionary: of the markers, as OpenCV calls it; found if it is not given.

    Returns:
        None where too few markers lie on the disc, or they do not agree.

    Example:
        >>> image_rotation_from_markers([np.rot90(image) for image in upright_images])
        90
    """
    dictionary = dictionary or find_dictionary(images)
    if dictionary is None:
        return None
    seen = [
        (frame, marker, corners)
        for frame, image in enumerate(images)
        for marker, corners in detect_markers(image, dictionary).items()
    ]
    if len(seen) < _FEWEST_ALIKE:
        return None
    frame, marker = (np.array([sighting[k] for sighting in seen]) for k in (0, 1))
    return rotation_from_corners(frame, marker, np.stack([corners for _, _, corners in seen]))


def rotation_from_corners(
    frame: Int[np.ndarray, "n"], marker: Int[np.ndarray, "n"], corners_px: Float[np.ndarray, "n 4 2"]
) -> int | None:
    """As ``image_rotation_from_markers``, by the markers' corners.

    Args:
        frame: of each sighting.
        marker: its id.
        corners_px: its corners, x to the right, y down.
    """
    # Edges of the parallelogram nearest to the quadrilateral.
    right = (corners_px[:, 1] + corners_px[:, 2] - corners_px[:, 0] - corners_px[:, 3]) / 2.0
    down = (corners_px[:, 2] + corners_px[:, 3] - corners_px[:, 0] - corners_px[:, 1]) / 2.0
    axes, sizes, _ = np.linalg.svd(np.stack([right, down], axis=-1))
    short = axes[:, :, 1]
    tilt_deg = np.rad2deg(np.arccos(np.clip(sizes[:, 1] / sizes[:, 0], 0.0, 1.0)))
    # A direction without a sign, as long as the tilt.
    doubled = tilt_deg[:, None] * np.stack([short[:, 0] ** 2 - short[:, 1] ** 2, 2.0 * short[:, 0] * short[:, 1]], -1)
    alike = np.linalg.norm(doubled[:, None] - doubled[None], axis=-1) < _ALIKE_DEG
    best, up_px = 0, None
    for seed in np.flatnonzero((tilt_deg > _TILT_RANGE_DEG[0]) & (tilt_deg < _TILT_RANGE_DEG[1])):
        group = alike[seed]
        if group.sum() > best and _lie_in_one_plane(frame[group], marker[group]):
            found = _upwards(short[seed], corners_px[group].mean(axis=1), sizes[group].prod(axis=1))
            if found is not None:
                best, up_px = int(group.sum()), found
    if up_px is None:
        return None
    rotation_deg = np.rad2deg(np.arctan2(-up_px[1], up_px[0])) - 90.0
    nearest = 90 * round(rotation_deg / 90.0)
    return nearest % 360 if abs(rotation_deg - nearest) <= _LARGEST_ROLL_DEG else None


def _lie_in_one_plane(frame: Int[np.ndarray, "n"], marker: Int[np.ndarray, "n"]) -> bool:
    """Whether several frames or markers show it: two markers round a container are never alike in one frame."""
    return len(frame) >= _FEWEST_ALIKE and len(np.unique(marker)) > 1 and bool(np.bincount(frame).max() > 1)


def _upwards(
    short: Float[np.ndarray, "2"], centres_px: Float[np.ndarray, "n 2"], areas_px2: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "2"] | None:
    """The end of the line ``short`` towards which the squares become smaller; None where that is not clear."""
    along = (centres_px - centres_px.mean(axis=0)) @ short
    # Areas in a plane go with the third power of a linear function of the place.
    size = np.cbrt(areas_px2)
    size = size - size.mean()
    spread = float(along @ along)
    slope = float(along @ size) / max(spread, 1e-12)
    error = np.sqrt(float(((size - slope * along) ** 2).sum()) / (len(size) - 2) / max(spread, 1e-12))
    return None if abs(slope) < _LEAST_T * error else -np.sign(slope) * short
