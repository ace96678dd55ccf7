"""What becomes of the samples along a ray: one spectrum, or coefficients of one."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


class WeightedSum(nn.Module):
    """Composite what the field emits, spectra or coefficients, and nothing behind it.

    Takes the place of nerfstudio's renderer of colours, which clamps and knows colours of backgrounds only.

    Attributes:
        background_color: nerfstudio's exporters of textures ask for it; pictures of whole rays are opaque.
    """

    background_color = "black"

    def forward(
        self, rgb: Float[Tensor, "*rays samples channels"], weights: Float[Tensor, "*rays samples 1"]
    ) -> Float[Tensor, "*rays channels"]:
        """Sum of the samples' channels, each with its weight."""
        return torch.sum(weights * rgb, dim=-2)


class ChamberSpectrum(nn.Module):
    """One spectrum of the chamber behind every ray.

    Args:
        spectrum: reflectance.
    """

    spectrum: Tensor

    def __init__(self, spectrum: Float[Tensor, "bands"]) -> None:
        super().__init__()
        self.register_buffer("spectrum", spectrum)

    def forward(
        self, directions: Float[Tensor, "*rays 3"], rotations: Float[Tensor, "*rays 9"] | None
    ) -> Float[Tensor, "*rays bands"]:
        """The spectrum, for every ray."""
        return self.spectrum.expand(*directions.shape[:-1], -1)


class SumBeforeLastSample(WeightedSum):
    """Composite spectra before the last sample's, as nerfacto does where nothing is known of the background.

    nerfstudio's own renderer takes three channels for this.
    """

    def forward(
        self, rgb: Float[Tensor, "*rays samples bands"], weights: Float[Tensor, "*rays samples 1"]
    ) -> Float[Tensor, "*rays bands"]:
        """Sum of the samples' spectra, and for what they let through that of the last sample."""
        through = 1.0 - torch.sum(weights, dim=-2)
        return super().forward(rgb, weights) + through * rgb[..., -1, :]
