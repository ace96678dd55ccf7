"""nerfstudio's cameras from poses and a lens, with what the model wants to know of each ray's camera.

nerfstudio imports this module while its own data managers are still being imported: it must not import them.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.cameras import Cameras, CameraType

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics

FRAME_INDEX = "frame_index"
"""Camera metadata: which frame of the session a ray belongs to."""
CAMERA_ROTATION = "camera_rotation"
"""Camera metadata: the nine elements of the camera-to-world rotation of a ray, row by row."""


def pinhole_cameras(
    poses: Float[np.ndarray, "n 4 4"],
    lens: PinholeIntrinsics,
    distortion: Float[np.ndarray, "4"],
    frames: Int[np.ndarray, "n"] | None = None,
) -> Cameras:
    """Cameras at poses in scene units.

    Args:
        poses: camera-to-world, OpenGL axes.
        lens: of all of them.
        distortion: k1, k2, p1, p2 (OpenCV).
        frames: indices of the session's frames that were taken there, whose poses the model refines; None where there
            are none, and the model takes the poses as they are.
    """
    k1, k2, p1, p2 = distortion
    metadata = {CAMERA_ROTATION: torch.from_numpy(poses[:, :3, :3].reshape(-1, 9)).float()}
    if frames is not None:
        metadata[FRAME_INDEX] = torch.from_numpy(frames)[:, None].float()
    return Cameras(
        camera_to_worlds=torch.from_numpy(poses[:, :3]).float(),
        fx=lens.fl_x,
        fy=lens.fl_y,
        cx=lens.cx,
        cy=lens.cy,
        width=lens.w,
        height=lens.h,
        distortion_params=torch.tensor([k1, k2, 0.0, 0.0, p1, p2]).float() if np.any(distortion) else None,
        camera_type=CameraType.PERSPECTIVE,
        metadata=metadata,
    )
