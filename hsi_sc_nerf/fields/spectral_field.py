"""Nerfacto's field with a spectrum instead of a colour, and the proposals.

The paper (section "Model Formulation") follows the variant C1, sigma_0 of HS-NeRF (Chen et al. 2024, "Hyperspectral
Neural Radiance Fields", arXiv 2403.14839): one density for all wavelengths, and a radiance of n channels that depends
on position and viewing direction. Radiance is calibrated reflectance, so each channel ends in a sigmoid; or the
channels are coefficients of a spectral basis, linear so that they can be composited before they are decoded. The
latter depend on the normal in the camera's frame instead of the viewing direction (`CameraShading`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.field_components.activations import trunc_exp
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.mlp import MLP
from nerfstudio.field_components.spatial_distortions import SpatialDistortion
from nerfstudio.fields.base_field import get_normalized_directions
from nerfstudio.fields.density_fields import HashMLPDensityField
from nerfstudio.fields.nerfacto_field import NerfactoField
from torch import Tensor, nn

from hsi_sc_nerf.fields.camera_shading import CameraShading
from hsi_sc_nerf.fields.coat import Coat
from hsi_sc_nerf.fields.hash_grid import FusedHashEncoding, fuse_hash_encodings
from hsi_sc_nerf.fields.surface_opacity import opaque_density

BRIGHTNESS_GAIN = 0.5
"""Gain of the first coefficient of a spectral basis. Without it, brightness is learned faster than the density, and
the surface is worse; with a tenth of it, errors fall later and hollows stay closed (docs/notes/dead_ends.md)."""

START_DENSITIES = (40.0, 0.5)
"""Densities (per scene unit) that training begins with inside of what is taken to be solid, and outside."""
START_STEPS, START_POINTS = 80, 8192
LARGEST_LOG_DENSITY = 60.0
"""Solid at any length of a sample. Beyond 88 the exponential is infinite, and not a number outside the box."""
NIL_WEIGHT = 1e-4
"""Samples of a smaller weight get no spectrum without a GPU: most lie behind the surface or before it."""


class SpectralField(NerfactoField):
    """Nerfacto's field whose radiance head has a channel for each band, or for each coefficient of a spectral basis.

    Args:
        aabb: scene box, scene units; it bounds the field unless a ``spatial_distortion`` is given.
        num_bands: bands of the spectra, the channels of the direct head.
        coefficient_start: coefficients of the mean spectrum in a basis (`SpectralSubspace.mean_coefficients`): the
            head has a linear channel for each and begins near these values. None: the direct head, whose channels
            end in a sigmoid.
        view_dependent: whether the head sees the viewing direction.
        shading: shading of the coefficients, by the normal in the camera's frame; None for none.
        coat: what shaded coefficients mirror; given if ``shading`` is.
        hidden_dim_color: width of the radiance head.
        num_layers_color: layers of the radiance head.
        skip_unseen: give samples of nil weight no spectrum, unless on a GPU.
        rises: let rises of the density be opaque; how much, `rise_length` says.
        **nerfacto: other arguments of `NerfactoField`.

    Attributes:
        rise_length: as in `opaque_density`, scene units; 0 in a new field.

    Example:
        >>> box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        >>> field = SpectralField(box, num_bands=204, num_images=54, implementation="torch")
        >>> field.density_fn(torch.zeros(1024, 48, 3)).shape
        torch.Size([1024, 48, 1])
    """

    rise_length: Tensor

    def __init__(
        self,
        aabb: Float[Tensor, "2 3"],
        num_bands: int,
        coefficient_start: Float[Tensor, "rank"] | None = None,
        view_dependent: bool = True,
        shading: CameraShading | None = None,
        coat: Coat | None = None,
        hidden_dim_color: int = 64,
        num_layers_color: int = 3,
        skip_unseen: bool = False,
        rises: bool = False,
        **nerfacto,
    ) -> None:
        super().__init__(aabb, hidden_dim_color=hidden_dim_color, num_layers_color=num_layers_color, **nerfacto)
        self.view_dependent, self.shading, self.coat = view_dependent, shading, coat
        self.skip_unseen, self.rises = skip_unseen, rises
        self.register_buffer("rise_length", torch.zeros(()))  # kept with the weights, which mean nothing without it
        direction_channels = self.direction_encoding.get_out_dim() if view_dependent else 0
        self.mlp_head = MLP(
            in_dim=direction_channels + self.geo_feat_dim + self.appearance_embedding_dim,
            num_layers=num_layers_color,
            layer_width=hidden_dim_color,
            out_dim=num_bands if coefficient_start is None else len(coefficient_start),
            activation=nn.ReLU(),
            out_activation=nn.Sigmoid() if coefficient_start is None else None,
            implementation="torch",
        )
        if coefficient_start is not None:
            gain = CoefficientGain(len(coefficient_start))
            self.mlp_head.out_activation = gain
            last = self.mlp_head.layers[-1]
            assert isinstance(last, nn.Linear)
            with torch.no_grad():
                last.bias.copy_(coefficient_start / gain.gains)
        fuse_hash_encodings(self)
        for module in self.modules():
            if isinstance(module, nn.ReLU):
                module.inplace = True  # the same numbers, in 3 % less time a step without a GPU

    def get_density(self, ray_samples: RaySamples) -> tuple[Float[Tensor, "*bs 1"], Float[Tensor, "*bs geo"]]:
        """Density (along rays with the opacity of its rises) and geometry features.

        Positions carry a gradient only where normals are needed.
        """
        positions = ray_samples.frustums.get_positions()
        if self.use_pred_normals and torch.is_grad_enabled() and not positions.requires_grad:
            positions.requires_grad_()
        # Normals are gradients in the scene. nerfacto's are gradients in the grid, skewed where that is not a cube.
        self._sample_locations = positions  # type: ignore[assignment]
        in_grid, inside = _zeroed_outside(grid_positions(positions, self.aabb, self.spatial_distortion))
        hidden = self.mlp_base(in_grid.view(-1, 3))
        hidden = hidden.view(*ray_samples.frustums.shape, hidden.shape[-1])
        # The logarithm of the density up to a constant; normals are its gradients.
        self._density_before_activation = hidden[..., :1]
        density = density_of(hidden[..., :1], inside, self.average_init_density)
        if self.rises and ray_samples.deltas is not None:  # density_fn's samples lie on no ray
            density = opaque_density(density[..., 0], ray_samples.deltas[..., 0], self.rise_length)[..., None]
        self.last_density = density.detach()
        return density, hidden[..., 1:]

    def _seen(self, ray_samples: RaySamples) -> Int[Tensor, "seen"] | None:
        """Samples (flat) with a weight worth a spectrum; None for all. A GPU is faster with shapes that are fixed."""
        if not self.skip_unseen or ray_samples.frustums.directions.device.type != "cpu":
            return None
        return (ray_samples.get_weights(self.last_density) > NIL_WEIGHT).flatten().nonzero()[:, 0]

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Float[Tensor, "rays samples geo"] | None = None
    ) -> dict[FieldHeadNames, Tensor]:
        """Spectra or coefficients (and predicted normals) at samples along rays.

        With a coat, one more channel is the fraction of light that is mirrored from the chamber behind the object.
        """
        assert density_embedding is not None
        outputs: dict[FieldHeadNames, Tensor] = {}
        if self.use_pred_normals:
            positions = self.position_encoding(ray_samples.frustums.get_positions())
            hidden = self.mlp_pred_normals(torch.cat([positions, density_embedding], dim=-1))
            outputs[FieldHeadNames.PRED_NORMALS] = self.field_head_pred_normals(hidden)
        seen = self._seen(ray_samples)
        samples = ray_samples.frustums.shape

        def of_samples(values: Float[Tensor, "*bs channels"]) -> Float[Tensor, "seen channels"]:
            """Values of the samples that are seen, from those of samples or (a sample long) of rays."""
            if seen is None:
                return values.expand(*samples, -1)
            if values.shape[-2] == 1:
                return values.flatten(0, -2)[seen // samples[-1]]
            return values.flatten(0, -2)[seen]

        inputs = [of_samples(density_embedding)]
        if self.view_dependent:
            # Encoded once a ray, not at every sample as in nerfacto, which saves time without a GPU.
            directions = get_normalized_directions(ray_samples.frustums.directions[..., :1, :])
            inputs.insert(0, of_samples(self.direction_encoding(directions)))
        if self.embedding_appearance is not None:
            inputs.append(of_samples(self._appearance(ray_samples).expand(*samples, -1)))
        # tiny-cuda-nn's encodings are in half precision, the head's weights are not.
        spectra = self.mlp_head(torch.cat(inputs, dim=-1).to(ray_samples.frustums.directions))
        if self.shading is not None:
            assert self._sample_locations is not None
            assert self.coat is not None
            points = (self._sample_locations.detach(), ray_samples.frustums.origins[..., :1, :].detach())
            positions, origins = (of_samples(point).reshape(-1, 3) for point in points)
            normals = self.shading.normals(positions)
            shaded = self.shading(spectra.flatten(0, -2), positions, origins, normals)
            coated = self.coat(shaded, positions, origins, self.shading.open_normals(positions, origins, normals))
            spectra = torch.cat(coated, dim=-1).view(*spectra.shape[:-1], spectra.shape[-1] + 1)
        if seen is not None:
            nothing = spectra.new_zeros(math.prod(samples), spectra.shape[-1])
            spectra = nothing.index_copy(0, seen, spectra).view(*samples, -1)
        outputs[FieldHeadNames.RGB] = spectra
        return outputs

    def _appearance(self, ray_samples: RaySamples) -> Float[Tensor, "#rays #samples embedding"]:
        """Embedding of the training view; in evaluation the average embedding or zeros, as in nerfacto."""
        assert self.embedding_appearance is not None
        assert ray_samples.camera_indices is not None
        if self.training:
            return self.embedding_appearance(ray_samples.camera_indices[..., 0])
        average = self.embedding_appearance.mean(dim=0)
        return average if self.use_average_appearance_embedding else torch.zeros_like(average)

    def start_solid(
        self, draw: Callable[[int], tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]], steps: int = START_STEPS
    ) -> None:
        """Teach the density where the scene is taken to be solid, before the first step of training.

        Args:
            draw: gives random points in scene units, and whether they lie in what is solid.
            steps: steps of gradient descent.
        """
        optimizer = torch.optim.Adam(self.mlp_base.parameters(), lr=1e-2, eps=1e-15)
        solid, thin = (math.log(density / self.average_init_density) for density in START_DENSITIES)
        for _ in range(steps):
            points, is_solid = draw(START_POINTS)
            hidden = self.mlp_base(grid_positions(points, self.aabb, self.spatial_distortion))[..., 0]
            loss = (hidden - torch.where(is_solid, solid, thin)).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        optimizer.zero_grad()

    @torch.no_grad()
    def shrink_grid(self, fraction: float) -> None:
        """Shrink the features of the hash grid by a fraction of themselves: weight decay apart from the loss.

        As Zip-NeRF's decay of its grid (Barron et al. 2023, arXiv 2304.06706), without Adam's normalisation of it.
        """
        for encoding in self.mlp_base.modules():
            if fraction > 0.0 and isinstance(encoding, FusedHashEncoding):
                encoding.hash_table.mul_(1.0 - min(fraction, 1.0))

    def density_gradient(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Gradient of the log density at points in scene units; its negative points out of the surface."""
        with torch.enable_grad():
            positions = positions.detach().requires_grad_()
            hidden = self.mlp_base(grid_positions(positions, self.aabb, self.spatial_distortion))
            (gradient,) = torch.autograd.grad(hidden[..., 0].sum(), positions)
        return gradient


class SpectralProposalField(HashMLPDensityField):
    """Nerfacto's proposal density with the fused hash grid.

    Positions are detached, so that the poses are refined by the spectral field alone.
    """

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        fuse_hash_encodings(self)

    def get_density(self, ray_samples: RaySamples) -> tuple[Float[Tensor, "*bs 1"], None]:  # type: ignore[override]
        """Density at the samples."""
        positions = ray_samples.frustums.get_positions().detach()
        positions, inside = _zeroed_outside(grid_positions(positions, self.aabb, self.spatial_distortion))
        before_activation = self.mlp_base(positions.view(-1, 3)).view(*ray_samples.frustums.shape, -1)
        return density_of(before_activation, inside, self.average_init_density), None


class CoefficientGain(nn.Module):
    """Output layer of a basis head: the first coefficient, a spectrum's brightness, is learned more slowly.

    Args:
        rank: number of coefficients.
    """

    gains: Tensor

    def __init__(self, rank: int) -> None:
        super().__init__()
        gains = torch.ones(rank)
        gains[0] = BRIGHTNESS_GAIN
        self.register_buffer("gains", gains)  # kept with the weights, which mean nothing with other gains

    def forward(self, raw: Float[Tensor, "*samples rank"]) -> Float[Tensor, "*samples rank"]:
        """Coefficients from the outputs of the network."""
        return raw * self.gains


def density_of(
    raw: Float[Tensor, "*samples 1"], inside: Float[Tensor, "*samples 1"], average: float
) -> Float[Tensor, "*samples 1"]:
    """Density per scene unit from a network's output, finite for any that is a number: ``average * exp(raw)``.

    Args:
        raw: logarithm of the density over ``average``; its gradient is cut at exp(15), and 0 above
            `LARGEST_LOG_DENSITY`.
        inside: 1 where the density is learned, 0 where it is 0; its type is that of the result.
        average: density of a new field.
    """
    return average * trunc_exp(raw.to(inside).clamp(max=LARGEST_LOG_DENSITY)) * inside


def grid_positions(
    positions: Float[Tensor, "*bs 3"], aabb: Float[Tensor, "2 3"], spatial_distortion: SpatialDistortion | None
) -> Float[Tensor, "*bs 3"]:
    """Scene positions in the hash grid's unit cube, which holds the scene box or, with a distortion, all of space.

    Args:
        positions: scene units.
        aabb: scene box, mapped to the unit cube.
        spatial_distortion: into a ball or cube of radius 2, as nerfstudio's `SceneContraction`; None for the box.
    """
    if spatial_distortion is None:
        return SceneBox.get_normalized_positions(positions, aabb)
    return (spatial_distortion(positions) + 2.0) / 4.0


def _zeroed_outside(positions: Float[Tensor, "*bs 3"]) -> tuple[Float[Tensor, "*bs 3"], Float[Tensor, "*bs 1"]]:
    """Grid positions, 0 outside the unit cube, and 1 inside it, 0 outside."""
    inside = ((positions > 0.0) & (positions < 1.0)).all(dim=-1, keepdim=True)
    return positions * inside, inside.to(positions)
