"""From what the samples along a ray emit to the spectrum of the ray."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


class SpectralRenderer(nn.Module):
    """Composite spectra, or coefficients of a spectral basis; nerfstudio's renderer takes three channels and clamps.

    Args:
        background: "none": the ray ends in black. "last-sample": the light that the samples let through has the
            spectrum of the last one, as in nerfacto.

    Attributes:
        background_color: read by nerfstudio's exporters of textures; their pictures of whole rays are opaque.
    """

    background_color = "black"

    def __init__(self, background: str = "none") -> None:
        super().__init__()
        self.background = background

    def forward(
        self, rgb: Float[Tensor, "*rays samples channels"], weights: Float[Tensor, "*rays samples 1"]
    ) -> Float[Tensor, "*rays channels"]:
        """Sum of the samples' channels (``rgb`` is nerfstudio's name for them), each with its weight."""
        if self.background == "none":
            return torch.sum(weights * rgb, dim=-2)
        transmitted = 1.0 - torch.sum(weights, dim=-2)
        return torch.sum(weights * rgb, dim=-2) + transmitted * rgb[..., -1, :]


class BasisDecoder(nn.Module):
    """Spectra from coefficients in a basis.

    Compositing and the basis are both linear: decoding composited coefficients once a ray equals compositing decoded
    spectra, with far fewer numbers a sample.

    Args:
        basis: one spectrum a column, linearly independent (`SpectralSubspace.scaled_basis`).
    """

    basis: Tensor

    def __init__(self, basis: Float[Tensor, "bands rank"]) -> None:
        super().__init__()
        self.register_buffer("basis", basis.clone())

    def forward(self, coefficients: Float[Tensor, "*rays rank"]) -> Float[Tensor, "*rays bands"]:
        """Spectra of (composited) coefficients."""
        return coefficients @ self.basis.T
