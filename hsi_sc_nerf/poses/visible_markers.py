"""Markers before a camera whose poses are known but for the scale: where they are, and how long their sides are."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, pixel_rays
from hsi_sc_nerf.poses.initialise import Observations

# A marker that is seen in fewer frames, or whose rays do not come from different sides, has no certain place.
_FEWEST_FRAMES = 2
_LEAST_SPREAD = 1e-3


def marker_corners(
    observations: Observations, camera_to_world: Float[np.ndarray, "n 4 4"], intrinsics: PinholeIntrinsics
) -> dict[int, Float[np.ndarray, "4 3"]]:
    """Corners of each marker where the rays from all its frames come nearest to each other.

    Args:
        observations: of markers that turn with the object; their frames are rows of ``camera_to_world``.
        camera_to_world: nan where a frame has no pose.
        intrinsics: of the camera, without lens distortion.
    """
    posed = np.isfinite(camera_to_world).all(axis=(1, 2))
    corners = {}
    for marker in np.unique(observations.marker).tolist():
        rows = np.flatnonzero((observations.marker == marker) & posed[observations.frame])
        if len(rows) < _FEWEST_FRAMES:
            continue
        matrix, vector = np.zeros((4, 3, 3)), np.zeros((4, 3))
        for row in rows:
            pose = camera_to_world[observations.frame[row]]
            origin, directions = pixel_rays(intrinsics, pose, observations.corners_px[row])
            across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
            matrix += across
            vector += across @ origin
        if np.linalg.eigvalsh(matrix)[:, 0].min() > _LEAST_SPREAD * len(rows):
            corners[marker] = np.linalg.solve(matrix, vector[..., None])[..., 0]
    return corners


def side_lengths(corners: dict[int, Float[np.ndarray, "4 3"]]) -> dict[int, float]:
    """Mean length of each marker's four sides."""
    return {m: float(np.linalg.norm(c - np.roll(c, 1, axis=0), axis=-1).mean()) for m, c in corners.items()}
