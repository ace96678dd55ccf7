"""Where rays cross a camera's image, as tensor operations."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics


def in_camera_frame(
    directions: Float[Tensor, "*rays 3"], rotations: Float[Tensor, "*rays 9"]
) -> Float[Tensor, "*rays 3"]:
    """Directions in the camera's axes, ``R^T d``; rotations are camera-to-world, row by row.

    A sum instead of a matrix product, which automatic mixed precision would compute with half the digits.
    """
    return (rotations.unflatten(-1, (3, 3)) * directions[..., :, None]).sum(dim=-2)


def image_coordinates(
    directions: Float[Tensor, "*rays 3"], intrinsics: PinholeIntrinsics, distortion: tuple[float, float, float, float]
) -> tuple[Float[Tensor, "*rays 2"], Bool[Tensor, "*rays"]]:
    """Pixel coordinates (x, y; from the image's corner) of directions in the camera's frame, OpenGL axes.

    Lens distortion is OpenCV's (k1, k2, p1, p2), a polynomial that holds within the image: coordinates of directions
    far outside it are meaningless.

    Returns:
        The coordinates, and which directions point forward; the coordinates of the others are meaningless.
    """
    forward = directions[..., 2] < 0.0
    depth = torch.where(forward, -directions[..., 2], 1.0)
    x, y = directions[..., 0] / depth, -directions[..., 1] / depth
    k1, k2, p1, p2 = distortion
    squared = x * x + y * y
    radial = 1.0 + squared * (k1 + squared * k2)
    distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
    distorted_y = y * radial + 2.0 * p2 * x * y + p1 * (squared + 2.0 * y * y)
    pixels = [intrinsics.fl_x * distorted_x + intrinsics.cx, intrinsics.fl_y * distorted_y + intrinsics.cy]
    return torch.stack(pixels, dim=-1), forward
