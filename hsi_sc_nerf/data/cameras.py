"""nerfstudio cameras from poses and intrinsics, with metadata that the model reads from each ray.

nerfstudio imports this module while its own data managers are still being imported: it must not import them.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras, CameraType

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics

FRAME_INDEX = "frame_index"
"""Camera metadata: index of the session's frame that a ray belongs to."""
CAMERA_ROTATION = "camera_rotation"
"""Camera metadata: the nine elements of the camera-to-world rotation of a ray, row by row."""


def pinhole_cameras(
    poses: Float[np.ndarray, "n 4 4"],
    intrinsics: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"],
    frames: Int[np.ndarray, "n"] | None = None,
) -> Cameras:
    """Cameras at poses in scene units.

    Args:
        poses: camera-to-world, OpenGL axes.
        intrinsics: of all cameras.
        distortion: k1, k2, p1, p2 (OpenCV).
        frames: indices of the session's frames that were taken at these poses, which the model refines; None for
            poses that belong to no frame and are not refined.
    """
    k1, k2, p1, p2 = distortion
    metadata = {CAMERA_ROTATION: torch.from_numpy(poses[:, :3, :3].reshape(-1, 9)).float()}
    if frames is not None:
        metadata[FRAME_INDEX] = torch.from_numpy(frames)[:, None].float()
    return Cameras(
        camera_to_worlds=torch.from_numpy(poses[:, :3]).float(),
        fx=intrinsics.fl_x,
        fy=intrinsics.fl_y,
        cx=intrinsics.cx,
        cy=intrinsics.cy,
        width=intrinsics.w,
        height=intrinsics.h,
        distortion_params=torch.tensor([k1, k2, 0.0, 0.0, p1, p2]).float() if np.any(distortion) else None,
        camera_type=CameraType.PERSPECTIVE,
        metadata=metadata,
    )
