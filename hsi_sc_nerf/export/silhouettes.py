"""The object lies within its silhouettes in all frames (the visual hull, Laurentini 1994).

A point of the object falls on the object in every frame, seen or hidden by the object itself. What floats before the
chamber, or lies on the container, does so only in frames where the object happens to be before or behind it.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from hsi_sc_nerf.export.visibility import DepthMaps

MIN_SHARE = 0.8
"""Of the frames in whose picture a point lies, so many must show it on the object: a few masks may be wrong."""
SLACK_PX = 2
"""Masks reach this much further here than they do: rims are uncertain by a pixel or two."""


def within_silhouettes(maps: DepthMaps, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Points that fall on the object in nearly all frames.

    Args:
        maps: whose masks are the object's silhouettes.
        points: in the unit of the depth maps.
    """
    pictures, on_object = (torch.zeros(len(points), device=points.device) for _ in range(2))
    for frame, mask in enumerate(maps.masks):
        inside, pixels = maps.pixels_of(frame, points)
        wider = functional.max_pool2d(mask[None].float(), 2 * SLACK_PX + 1, stride=1, padding=SLACK_PX)[0] > 0.0
        pictures += inside
        on_object += inside & wider[pixels[:, 1], pixels[:, 0]]
    return on_object >= MIN_SHARE * pictures
