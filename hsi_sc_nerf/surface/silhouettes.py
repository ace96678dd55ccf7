"""The object lies within its silhouettes in all frames (the visual hull, Laurentini 1994).

A point of the object falls on the object in every frame, seen or hidden by the object itself. What floats before the
chamber, or lies on the container, does so only in frames where the object happens to be before or behind it.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from hsi_sc_nerf.surface.visibility import DepthMaps

MIN_SHARE = 0.8
"""Of the frames in whose picture a point lies, so many must show it on the object: a few masks may be wrong."""
SLACK_PX = 2
"""Masks reach this much further here than they do: rims are uncertain by a pixel or two."""


def silhouettes(masks: Bool[Tensor, "frames lines samples"]) -> Bool[Tensor, "frames lines samples"]:
    """The object's masks, wider by `SLACK_PX`."""
    size = 2 * SLACK_PX + 1
    return torch.cat([functional.max_pool2d(mask[None].float(), size, 1, SLACK_PX) > 0.0 for mask in masks])


def within_silhouettes(
    maps: DepthMaps, outlines: Bool[Tensor, "frames lines samples"], points: Float[Tensor, "n 3"]
) -> Bool[Tensor, "n"]:
    """Points that fall on the object in nearly all frames.

    Args:
        maps: of all frames.
        outlines: `silhouettes` of the object in them.
        points: in the unit of the depth maps.
    """
    pictures, on_object = (torch.zeros(len(points), device=points.device) for _ in range(2))
    for frame, outline in enumerate(outlines):
        inside, pixels = maps.pixels_of(frame, points)
        pictures += inside
        on_object += inside & outline[pixels[:, 1], pixels[:, 0]]
    return on_object >= MIN_SHARE * pictures
