"""What the coat of a glossy object mirrors of the scene behind it, at its limb.

At grazing incidence a mirrored ray hardly turns, so a coat shows there what is behind the object: the chamber, or the
support that the object stands on. A part of the limb's light is therefore the background's, and a model without this
takes it for a smaller object (docs/validation/surface.md).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

COAT_START = -2.0
"""Logit of the fraction that is mirrored at grazing incidence when training begins: an eighth."""
LEAST_DESCENT = 1e-6
"""Rays that descend less, per unit of length, do not end on the support."""


class Coat(nn.Module):
    """Adds what the coat mirrors of the chamber and of the support.

    The mirrored fraction of the light is Schlick's (1 - cos)^5 ("An Inexpensive BRDF Model for Physically-based
    Rendering", 1994) times what is mirrored at grazing incidence: 1 by a smooth coat, less by a rough one, nothing by
    a matte skin. Training learns that number, and the mean coefficients of the support, which has no coat itself.

    Args:
        lower: lower corner of the scene box, scene units.
        sides: lengths of its sides, scene units.
        base: height of the plane on which the object stands, scene units.
        channels: coefficients of a sample.

    Example:
        >>> coat = Coat(lower=-torch.ones(3), sides=2.0 * torch.ones(3), base=-0.4, channels=8)
        >>> coefficients, of_chamber = coat(coefficients, positions, origins, normals)
    """

    _lower: Tensor
    _sides: Tensor

    def __init__(self, lower: Float[Tensor, "3"], sides: Float[Tensor, "3"], base: float, channels: int) -> None:
        super().__init__()
        self.base = base
        self.register_buffer("_lower", lower.clone(), persistent=False)
        self.register_buffer("_sides", sides.clone(), persistent=False)
        self.grazing = nn.Parameter(torch.tensor(COAT_START))
        self.support = nn.Parameter(torch.zeros(channels))

    def forward(
        self,
        coefficients: Float[Tensor, "n channels"],
        positions: Float[Tensor, "n 3"],
        origins: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
    ) -> tuple[Float[Tensor, "n channels"], Float[Tensor, "n 1"]]:
        """Coefficients of points with what they mirror of the support, and the fraction of light of the chamber.

        Args:
            coefficients: coefficients of the points themselves.
            positions: positions of the points, scene units; they get no gradient.
            origins: origins of the rays that see the points, scene units.
            normals: outward unit normals of the points; 0 where there is none.
        """
        with torch.no_grad():
            along = functional.normalize(positions - origins, dim=-1)
            cosines = -(normals * along).sum(dim=-1, keepdim=True)
            has_coat = (positions[:, 2:] >= self.base) & (normals != 0.0).any(dim=-1, keepdim=True)
            schlick = torch.where(has_coat, (1.0 - cosines.clamp(0.0, 1.0)) ** 5, 0.0)
            on_support = self._ends_below(positions, along)
        mirrored = torch.sigmoid(self.grazing) * schlick
        of_support = mirrored * on_support
        return coefficients * (1.0 - mirrored) + of_support * self.support, mirrored - of_support

    def _ends_below(self, positions: Float[Tensor, "n 3"], along: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
        """1 for rays that leave the scene box through its bottom, which is the disc's plane; 0 for others."""
        drop = along[:, 2:].clamp(max=-LEAST_DESCENT)
        end = (positions + along * (self._lower[2] - positions[:, 2:]) / drop - self._lower) / self._sides
        inside = ((end >= 0.0) & (end <= 1.0))[:, :2].all(dim=-1, keepdim=True)
        return (inside & (along[:, 2:] < -LEAST_DESCENT)).to(positions)
