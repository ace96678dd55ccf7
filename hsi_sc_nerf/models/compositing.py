"""From samples along a ray to its spectrum: weighted sums, and the basis that coefficients are decoded with."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


class SpectralRenderer(nn.Module):
    """Composite spectra, or coefficients of a spectral basis; nerfstudio's renderer takes three channels and clamps.

    Args:
        last_sample_behind: the light that the samples let through has the spectrum of the last one, as in nerfacto;
            otherwise the ray ends in black.

    Attributes:
        background_color: read by nerfstudio's exporters of textures; their pictures of whole rays are opaque.
    """

    background_color = "black"

    def __init__(self, last_sample_behind: bool = False) -> None:
        super().__init__()
        self.last_sample_behind = last_sample_behind

    def forward(
        self, rgb: Float[Tensor, "*rays samples channels"], weights: Float[Tensor, "*rays samples 1"]
    ) -> Float[Tensor, "*rays channels"]:
        """Sum of the samples' channels (``rgb`` is nerfstudio's name for them), each with its weight."""
        composited = torch.sum(weights * rgb, dim=-2)
        if not self.last_sample_behind:
            return composited
        return composited + (1.0 - torch.sum(weights, dim=-2)) * rgb[..., -1, :]


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
