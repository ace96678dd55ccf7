"""Where a ray meets the surface of a density field."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def opacity_crossing_depth(
    edges: Float[Tensor, "rays samples_and_1"], densities: Float[Tensor, "rays samples"], level: float
) -> Float[Tensor, "rays"]:
    """Depth at which the opacity collected along each ray first reaches ``level``.

    The density is constant between edges, so within an interval the optical depth grows linearly and the crossing is
    exact. A ray that never reaches the level gets its last edge.

    Args:
        edges: depths that bound the samples, ascending.
        densities: density in each interval, per unit of depth, not negative.
        level: opacity, in (0, 1).
    """
    optical = torch.cumsum(densities * edges.diff(dim=-1), dim=-1)
    optical = torch.cat([torch.zeros_like(optical[:, :1]), optical], dim=-1)
    wanted = -math.log1p(-level)
    after = (optical < wanted).sum(dim=-1, keepdim=True).clamp(1, densities.shape[-1])
    before = after - 1
    collected = optical.gather(1, before)
    share = (wanted - collected) / (optical.gather(1, after) - collected).clamp_min(1e-12)
    near, far = edges.gather(1, before), edges.gather(1, after)
    return (near + share.clamp(0.0, 1.0) * (far - near))[:, 0]
