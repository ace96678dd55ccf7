"""Density that depends on wavelength by groups of bands, for translucent objects (HS-NeRF's variant sigma_n).

Light of one wavelength may pass where light of another is stopped (Chen et al. 2024, "Hyperspectral Neural Radiance
Fields", arXiv 2403.14839). Each group of neighbouring bands has a density of its own and is composited with the
weights of that density. It needs a value in every band at each sample: coefficients of a basis that spans all groups
could not be composited group by group.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from torch import Tensor, nn

from hsi_sc_nerf.fields.spectral_field import SpectralField


def group_sizes(num_bands: int, num_groups: int) -> tuple[int, ...]:
    """How many neighbouring bands each group has: as even as can be.

    Raises:
        ValueError: there are no groups, or more than bands.
    """
    if not 1 <= num_groups <= num_bands:
        raise ValueError(f"{num_bands} bands cannot be divided into {num_groups} groups")
    return tuple(num_bands * (i + 1) // num_groups - num_bands * i // num_groups for i in range(num_groups))


def weights_of_depths(optical_depths: Float[Tensor, "*rays samples groups"]) -> Float[Tensor, "*rays samples groups"]:
    """Share of the light that each sample sends to the camera, from the samples' densities times lengths."""
    before = torch.cumsum(optical_depths, dim=-2)[..., :-1, :]
    reaching = torch.exp(-torch.cat([torch.zeros_like(optical_depths[..., :1, :]), before], dim=-2))
    return -torch.expm1(-optical_depths) * reaching


def composite_band_groups(
    channels: Float[Tensor, "*rays samples channels"], sizes: Sequence[int]
) -> tuple[Float[Tensor, "*rays bands"], Float[Tensor, "*rays bands"]]:
    """Composite every group of bands with its own density.

    Args:
        channels: of each sample, its spectrum and then its optical depth in each group (`BandGroupField`).
        sizes: bands of each group.

    Returns:
        Spectra of the rays, and in each band the share that the samples do not let through.
    """
    spectra, optical_depths = channels.split([sum(sizes), len(sizes)], dim=-1)
    weights = weights_of_depths(optical_depths)
    parts = zip(spectra.split(tuple(sizes), dim=-1), weights.split(1, dim=-1), strict=True)
    composited = torch.cat([torch.sum(weight * part, dim=-2) for part, weight in parts], dim=-1)
    opacities = weights.sum(dim=-2).split(1, dim=-1)
    by_band = [opacity.expand(*opacity.shape[:-1], size) for opacity, size in zip(opacities, sizes, strict=True)]
    return composited, torch.cat(by_band, dim=-1)


class BandGroupSum(nn.Module):
    """`composite_band_groups` in the place of nerfstudio's renderer of colours.

    Args:
        sizes: bands of each group.

    Attributes:
        background_color: as `WeightedSum.background_color`.
    """

    background_color = "black"

    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        self.sizes = tuple(sizes)

    def forward(
        self, rgb: Float[Tensor, "*rays samples channels"], weights: Float[Tensor, "*rays samples 1"]
    ) -> Float[Tensor, "*rays two_x_bands"]:
        """Spectra, then in each band what the samples do not let through; ``weights``, the mean's, are not used."""
        return torch.cat(composite_band_groups(rgb, self.sizes), dim=-1)


class BandGroupField(SpectralField):
    """A field with a density for each group of bands.

    What nerfstudio sees as the density is the mean of the groups': it guides the proposals and gives depth, normals
    and accumulation. After the spectrum's channels follow those of the optical depths, for `composite_band_groups`.

    Args:
        aabb: scene box, scene units.
        num_bands: bands of the spectra.
        num_groups: groups of neighbouring bands; with one, the field is a `SpectralField`.
        geo_feat_dim: features that the radiance head gets beside the groups' own.
        **field: everything else that `SpectralField` takes, without a start of coefficients.
    """

    group_sizes: tuple[int, ...]

    def __init__(
        self, aabb: Float[Tensor, "2 3"], num_bands: int, num_groups: int, geo_feat_dim: int = 15, **field
    ) -> None:
        super().__init__(aabb, num_bands, geo_feat_dim=geo_feat_dim + num_groups - 1, **field)
        self.group_sizes = group_sizes(num_bands, num_groups)

    def _log_density(self, hidden: Float[Tensor, "*bs hidden"]) -> Float[Tensor, "*bs 1"]:
        groups = hidden[..., : len(self.group_sizes)]
        return groups.logsumexp(dim=-1, keepdim=True) - math.log(groups.shape[-1])

    def get_density(self, ray_samples: RaySamples) -> tuple[Float[Tensor, "*bs 1"], Float[Tensor, "*bs geo"]]:
        """Mean density, and the groups' densities followed by the geometry features."""
        hidden, inside = self._hidden(ray_samples)
        densities = self._density(hidden[..., : len(self.group_sizes)], inside)
        return densities.mean(dim=-1, keepdim=True), torch.cat([densities, hidden[..., 1:]], dim=-1)

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Float[Tensor, "rays samples geo"] | None = None
    ) -> dict[FieldHeadNames, Tensor]:
        """Spectra followed by optical depths (and predicted normals) at samples along rays."""
        assert density_embedding is not None
        assert ray_samples.deltas is not None
        groups = len(self.group_sizes)
        outputs = super().get_outputs(ray_samples, density_embedding[..., groups:])
        depths = density_embedding[..., :groups] * ray_samples.deltas
        outputs[FieldHeadNames.RGB] = torch.cat([outputs[FieldHeadNames.RGB], depths], dim=-1)
        return outputs
