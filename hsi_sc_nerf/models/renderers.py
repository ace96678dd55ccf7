"""From what the samples along a ray emit to the spectrum of the ray.

Symbols: a sample of optical depth ``density * length`` has opacity ``1 - exp(-depth)`` and the weight that reaches
the camera, ``opacity * exp(-sum of the depths before it)``. The weights of a ray sum to its accumulation, at most 1.
"""

from __future__ import annotations

from collections.abc import Sequence

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


class BandGroupRenderer(nn.Module):
    """`composite_band_groups` in place of `SpectralRenderer`, for a `BandGroupField`.

    Args:
        sizes: bands of each group.

    Attributes:
        background_color: as `SpectralRenderer.background_color`.
    """

    background_color = "black"

    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        self.sizes = tuple(sizes)

    def forward(
        self, rgb: Float[Tensor, "*rays samples channels"], weights: Float[Tensor, "*rays samples 1"]
    ) -> Float[Tensor, "*rays two_x_bands"]:
        """Spectra, followed by the accumulation of each band; ``weights`` (of the mean density) are not used."""
        return torch.cat(composite_band_groups(rgb, self.sizes), dim=-1)


def composite_band_groups(
    channels: Float[Tensor, "*rays samples channels"], sizes: Sequence[int]
) -> tuple[Float[Tensor, "*rays bands"], Float[Tensor, "*rays bands"]]:
    """Composite every group of bands with its own density.

    Args:
        channels: of each sample, its spectrum and then its optical depth in each group (`BandGroupField`).
        sizes: bands of each group.

    Returns:
        Spectra of the rays, and their accumulation in each band.
    """
    spectra, optical_depths = channels.split([sum(sizes), len(sizes)], dim=-1)
    weights = weights_of_depths(optical_depths)
    groups = zip(spectra.split(tuple(sizes), dim=-1), weights.split(1, dim=-1), strict=True)
    composited = torch.cat([torch.sum(weight * spectrum, dim=-2) for spectrum, weight in groups], dim=-1)
    opacities = weights.sum(dim=-2).split(1, dim=-1)
    by_band = [opacity.expand(*opacity.shape[:-1], size) for opacity, size in zip(opacities, sizes, strict=True)]
    return composited, torch.cat(by_band, dim=-1)


def weights_of_depths(optical_depths: Float[Tensor, "*rays samples groups"]) -> Float[Tensor, "*rays samples groups"]:
    """Weights of the samples along rays from their optical depths."""
    before = torch.cumsum(optical_depths, dim=-2)[..., :-1, :]
    transmittance = torch.exp(-torch.cat([torch.zeros_like(optical_depths[..., :1, :]), before], dim=-2))
    return -torch.expm1(-optical_depths) * transmittance
