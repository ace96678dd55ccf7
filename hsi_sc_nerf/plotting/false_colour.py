"""Pictures of numbers: colours with a stated range, and the spectral angle between a rendering and a frame."""

from __future__ import annotations

import matplotlib
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics
from hsi_sc_nerf.geometry.ray_projection import image_coordinates, in_camera_frame

INDEX_COLOURS = "viridis"
ANGLE_COLOURS = "magma"
ANGLE_DRAWN_RAD = (0.0, 0.2)
"""Spectral angles at the two ends of the colours; twice ENVI's threshold for another material is white."""
ERROR_DRAWN = (0.0, 0.1)
"""Root mean squared errors of reflectance over the bands at the two ends of the colours."""
BLANK = (0.25, 0.25, 0.25)
"""Colour of what has no value."""


def coloured(
    values: Float[Tensor, "*shape"], drawn_range: tuple[float, float], colours: str
) -> Float[Tensor, "*shape 3"]:
    """Values as colours of a matplotlib colour map, beyond its ends as at them; ``BLANK`` where they are NaN."""
    low, high = drawn_range
    table = torch.as_tensor(matplotlib.colormaps[colours](np.arange(256))[:, :3]).to(values)
    missing = values.isnan()
    place = ((values - low) / (high - low)).clamp(0.0, 1.0).masked_fill(missing, 0.0)
    return torch.where(missing[..., None], table.new_tensor(BLANK), table[(place * 256.0).long().clamp_max(255)])


def frame_pixels(
    directions: Float[Tensor, "*rays 3"],
    rotation: Float[Tensor, "3 3"],
    intrinsics: PinholeIntrinsics,
    distortion: tuple[float, float, float, float],
) -> tuple[Int[Tensor, "*rays 2"], Bool[Tensor, "*rays"]]:
    """The pixels (line, sample) of a frame that rays from its camera's centre pass through, and which rays do.

    Args:
        directions: in the world.
        rotation: the frame's camera-to-world rotation, OpenGL axes.
        intrinsics: of the frame.
        distortion: k1, k2, p1, p2 (OpenCV).
    """
    turned = in_camera_frame(directions, rotation.reshape(9).expand(*directions.shape[:-1], 9))
    places, forward = image_coordinates(turned, intrinsics, distortion)
    pixels = places.flip(-1).floor().long()
    size = pixels.new_tensor([intrinsics.h, intrinsics.w])
    return pixels, forward & ((pixels >= 0) & (pixels < size)).all(dim=-1)


def angle_to_measured(
    rendered: Float[Tensor, "h w bands"],
    measured: Float[Tensor, "n bands"],
    valid: Bool[Tensor, "n bands"],
    seen: Bool[Tensor, "h w"],
) -> Float[Tensor, "h w"]:
    """Spectral angle (radians) between a rendering and what was measured of the ``seen`` pixels, in their order.

    NaN elsewhere, and where too few bands are valid.
    """
    angles = torch.full(seen.shape, torch.nan, dtype=torch.float32, device=rendered.device)
    angles[seen] = spectral_angle_map(rendered[seen][:, None], measured[:, None], valid[:, None])[:, 0]
    return angles
