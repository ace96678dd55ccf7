"""A region of interest that somebody painted into frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.dataset import PackedFrame
from hsi_sc_nerf.surface.visibility import DepthMaps


def read_roi_masks(
    folder: Path, frames: Sequence[PackedFrame], shape: tuple[int, int]
) -> dict[int, Bool[np.ndarray, "lines samples"]]:
    """Painted masks by the index of their frame: pictures named as the frames' own masks, white in the region.

    Raises:
        InputError: the folder holds no picture of these frames, or one that cannot be read or has another size.
    """
    masks = {}
    for index, frame in enumerate(frames):
        path = folder / frame.mask_path.name
        if not path.is_file():
            continue
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if picture is None or picture.shape != shape:
            raise InputError(f"{path}: is no picture of {shape[1]} x {shape[0]} pixels; paint on a copy of the mask.")
        masks[index] = picture > 127
    if not masks:
        raise InputError(
            f"{folder}: holds no mask of a training frame; name the pictures like {frames[0].mask_path.name}."
        )
    return masks


def in_roi_masks(
    masks: Mapping[int, Bool[Tensor, "lines samples"]],
    maps: DepthMaps,
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
) -> Bool[Tensor, "n"]:
    """Points that lie in the region in every masked frame that sees them, and are seen in one.

    Args:
        masks: the region, by frame.
        maps: of all frames.
        points: in the unit of the depth maps.
        normals: unit vectors out of the surface.
    """
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    outside = inside.clone()
    for frame, mask in masks.items():
        view = maps.seen_in(frame, points, normals)
        white = mask[view.pixels[:, 1], view.pixels[:, 0]]
        inside |= view.visible & white
        outside |= view.visible & ~white
    return inside & ~outside
