"""The model: nerfacto with a spectrum a ray, before the chamber that stands still behind the turntable."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.field_components.spatial_distortions import SceneContraction
from nerfstudio.model_components.losses import distortion_loss, interlevel_loss
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler, UniformSampler
from nerfstudio.model_components.renderers import AccumulationRenderer, DepthRenderer, NormalsRenderer
from nerfstudio.model_components.scene_colliders import AABBBoxCollider, NearFarCollider
from nerfstudio.model_components.shaders import NormalsShader
from nerfstudio.models.base_model import Model
from nerfstudio.models.nerfacto import NerfactoModel
from nerfstudio.utils import colormaps
from torch import Tensor, nn

from hsi_sc_nerf.data.cameras import CAMERA_ROTATION
from hsi_sc_nerf.data.packed import PackedDataset
from hsi_sc_nerf.data.spectral_subspace import SpectralSubspace
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.fields.band_groups import BandGroupField, BandGroupSum
from hsi_sc_nerf.fields.basis_decoder import BasisDecoder
from hsi_sc_nerf.fields.spectral_field import SpectralField, SpectralProposalField
from hsi_sc_nerf.models.compositing import SumBeforeLastSample, WeightedSum
from hsi_sc_nerf.models.from_dataset import band_weights, chamber_background, field_grid, training_subspace
from hsi_sc_nerf.models.losses import angle_loss, angular_loss, charbonnier_loss, hsi_loss
from hsi_sc_nerf.models.metrics import (
    spectral_angle_map,
    spectral_angle_mapper,
    spectral_metrics,
    spectral_rmse,
    squared_error_map,
)
from hsi_sc_nerf.models.pose_refinement import PoseRefinement
from hsi_sc_nerf.models.spectral_config import SpectralModelConfig
from hsi_sc_nerf.numerics import safe_log10
from hsi_sc_nerf.viewer.panel import SpectralPanel
from hsi_sc_nerf.viewer.pictures import ANGLE_DRAWN_RAD, ERROR_DRAWN


class SpectralModel(NerfactoModel):
    """Nerfacto whose field emits a spectrum (paper, section "Model Formulation").

    Outputs of a ray: ``spectral`` (bands) beside nerfacto's own, with ``rgb`` a pseudo-RGB of three bands.
    """

    config: SpectralModelConfig
    field: SpectralField
    camera_optimizer: PoseRefinement
    subspace: SpectralSubspace | None
    decoder: nn.Module
    renderer_rgb: nn.Module  # type: ignore[assignment]
    band_weights: Tensor | None

    def populate_modules(self) -> None:
        """Build the modules.

        Nerfacto's own method is not called: it builds LPIPS, which downloads AlexNet and means nothing for spectra.
        """
        Model.populate_modules(self)
        config, metadata = self.config, self.kwargs["metadata"]
        dataset: PackedDataset = metadata["dataset"]
        self.wavelengths_nm = dataset.wavelengths_nm
        self.rgb_bands: list[int] = metadata["rgb_bands"]
        self.subspace, self.decoder = None, nn.Identity()
        if config.head == "basis":
            self.subspace = training_subspace(dataset, metadata["frames"], config.basis_rank)
            basis = torch.from_numpy(self.subspace.scaled_basis).float()
            self.decoder = BasisDecoder(basis, learnable=config.learn_basis)
        contraction = None if config.disable_scene_contraction else SceneContraction(order=float("inf"))
        own: dict[str, Any] = {
            "num_levels": config.num_levels,
            "max_res": config.max_res,
            "log2_hashmap_size": config.log2_hashmap_size,
        }
        if config.match_resolution:
            grid = field_grid(dataset)
            own = {"num_levels": grid.levels, "max_res": grid.finest, "log2_hashmap_size": grid.log2_table}
        if self.subspace is not None:
            own["coefficient_start"] = torch.from_numpy(self.subspace.mean_coefficients)
        if config.density_groups > len(self.wavelengths_nm):
            raise InputError(
                f"--pipeline.model.density-groups is {config.density_groups}, but the dataset has "
                f"{len(self.wavelengths_nm)} bands; take fewer groups."
            )
        if config.density_groups > 1:
            own["num_groups"] = config.density_groups
        self.field = (SpectralField if config.density_groups == 1 else BandGroupField)(
            self.scene_box.aabb,
            num_bands=len(self.wavelengths_nm),
            view_dependent=config.view_dependent,
            spatial_distortion=contraction,
            hidden_dim=config.hidden_dim,
            base_res=config.base_res,
            features_per_level=config.features_per_level,
            hidden_dim_color=config.hidden_dim_color,
            num_images=self.num_train_data,
            use_pred_normals=config.predict_normals,
            use_average_appearance_embedding=config.use_average_appearance_embedding,
            appearance_embedding_dim=config.appearance_embed_dim if config.use_appearance_embedding else 0,
            average_init_density=config.average_init_density,
            implementation=config.implementation,
            **own,
        )
        self._build_proposals(contraction)
        self.camera_optimizer = config.camera_optimizer.setup(
            num_cameras=self.num_train_data, device="cpu", **metadata["turntable"]
        )
        if contraction is None:
            self.collider = AABBBoxCollider(self.scene_box, near_plane=config.near_plane)  # type: ignore[assignment]
        else:
            self.collider = NearFarCollider(config.near_plane, config.far_plane)  # type: ignore[assignment]
        self.background = chamber_background(config.background, dataset, metadata["frames"])
        self.register_buffer("band_weights", band_weights(dataset) if config.weigh_bands else None, persistent=False)

        if isinstance(self.field, BandGroupField):
            self.renderer_rgb = BandGroupSum(self.field.group_sizes)
        elif self.background is None:
            self.renderer_rgb = SumBeforeLastSample()
        else:
            self.renderer_rgb = WeightedSum()
        self.renderer_accumulation = AccumulationRenderer()
        self.renderer_depth = DepthRenderer(method="median")
        self.renderer_expected_depth = DepthRenderer(method="expected")
        self.renderer_normals = NormalsRenderer()
        self.normals_shader = NormalsShader()
        self.panel = SpectralPanel(self.wavelengths_nm, self.num_train_data)
        self.step = 0

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Nerfacto's groups; the basis and the background, where they learn, have rates of their own."""
        groups = super().get_param_groups()
        for name, module in (("basis", self.decoder), ("background", self.background)):
            parameters = [] if module is None else list(module.parameters())
            if parameters:
                groups[name] = parameters
        return groups

    def _build_proposals(self, contraction: SceneContraction | None) -> None:
        """Proposal networks and the sampler that uses them, as in nerfacto."""
        config = self.config
        arguments = config.proposal_net_args_list
        networks = [
            SpectralProposalField(
                self.scene_box.aabb,
                **arguments[min(i, len(arguments) - 1)],
                spatial_distortion=contraction,
                average_init_density=config.average_init_density,
                implementation=config.implementation,
            )
            for i in range(1 if config.use_same_proposal_network else config.num_proposal_iterations)
        ]
        self.proposal_networks = torch.nn.ModuleList(networks)
        rounds = config.num_proposal_iterations
        self.density_fns = [networks[min(i, len(networks) - 1)].density_fn for i in range(rounds)]

        def update_schedule(step: int) -> float:
            rise = step / max(1, config.proposal_warmup) * config.proposal_update_every
            return float(np.clip(rise, 1, config.proposal_update_every))

        uniform = config.proposal_initial_sampler == "uniform"
        self.proposal_sampler = ProposalNetworkSampler(
            num_nerf_samples_per_ray=config.num_nerf_samples_per_ray,
            num_proposal_samples_per_ray=config.num_proposal_samples_per_ray,
            num_proposal_network_iterations=rounds,
            single_jitter=config.use_single_jitter,
            update_sched=update_schedule,
            initial_sampler=UniformSampler(single_jitter=config.use_single_jitter) if uniform else None,
        )

    def spectra_behind(self, ray_bundle: RayBundle) -> Float[Tensor, "*rays bands"]:
        """The chamber's reflectance behind rays as measured, before a refinement of the poses has moved them."""
        if self.background is None:
            return torch.zeros(*ray_bundle.shape, len(self.wavelengths_nm), device=self.device)
        return self.background(ray_bundle.directions, ray_bundle.metadata.get(CAMERA_ROTATION))

    def get_outputs(self, ray_bundle: RayBundle) -> dict:  # type: ignore[override]
        """Nerfacto's outputs with the spectrum; held-out views are corrected like training views."""
        behind = None if self.background is None else self.spectra_behind(ray_bundle)
        if not self.training:
            self.camera_optimizer.apply_to_raybundle(ray_bundle)
        outputs = super().get_outputs(ray_bundle)
        spectral, opacity = self.decoder(outputs["rgb"]), outputs["accumulation"]
        if isinstance(self.field, BandGroupField):
            spectral, opacity = spectral.chunk(2, dim=-1)
        if behind is not None:
            spectral = spectral + behind * (1.0 - opacity)
        # A basis can go below black by a little.
        outputs["spectral"] = spectral if self.training else spectral.clamp_min(0.0)
        # An index of numbers would be a transfer to the device, for which that has to wait.
        outputs["rgb"] = torch.stack([outputs["spectral"][..., band] for band in self.rgb_bands], dim=-1)
        return outputs

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """A rendered camera; a viewer's with the pictures that its controls ask for."""
        return self.panel.render(camera, partial(super().get_outputs_for_camera, obb_box=obb_box))

    def _measured(self, batch: dict) -> tuple[Tensor, Tensor | None]:
        """Reflectance, and which values of it are measurements where not all are."""
        valid = batch.get("valid")
        return batch["spectral"].to(self.device), None if valid is None else valid.to(self.device)

    def get_metrics_dict(self, outputs: dict, batch: dict) -> dict[str, Tensor]:
        """SAM, RMSE and PSNR of the batch over all bands, distortion, size of the pose corrections."""
        with torch.no_grad():
            target, valid = self._measured(batch)
            # As a picture of one line.
            line = outputs["spectral"][None], target[None], None, None if valid is None else valid[None]
            metrics = {"sam": spectral_angle_mapper(*line), "rmse": spectral_rmse(*line)}
            metrics["psnr"] = -20.0 * safe_log10(metrics["rmse"])
        if self.training:
            metrics["distortion"] = distortion_loss(outputs["weights_list"], outputs["ray_samples_list"])
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def get_loss_dict(self, outputs: dict, batch: dict, metrics_dict: dict | None = None) -> dict[str, Tensor]:
        """The paper's composite loss (section "Loss Function"); a term of weight zero is not computed."""
        config = self.config
        target, valid = self._measured(batch)
        losses = {}
        if config.hsi_loss_mult > 0:
            errors = hsi_loss if config.hsi_loss == "squared" else charbonnier_loss
            value = errors(outputs["spectral"], target, valid=valid, band_weights=self.band_weights)
            losses["hsi_loss"] = config.hsi_loss_mult * value
        if config.angular_loss_mult > 0:
            angles = angular_loss if config.angular_loss == "cosine" else angle_loss
            value = angles(outputs["spectral"], target, valid=valid, band_weights=self.band_weights)
            losses["angular_loss"] = config.angular_loss_mult * value
        if not self.training:
            return losses
        assert metrics_dict is not None
        losses["interlevel_loss"] = config.interlevel_loss_mult * interlevel_loss(
            outputs["weights_list"], outputs["ray_samples_list"]
        )
        losses["distortion_loss"] = config.distortion_loss_mult * metrics_dict["distortion"]
        if config.predict_normals:
            losses["orientation_loss"] = config.orientation_loss_mult * outputs["rendered_orientation_loss"].mean()
            losses["pred_normal_loss"] = config.pred_normal_loss_mult * outputs["rendered_pred_normal_loss"].mean()
        self.camera_optimizer.get_loss_dict(losses)
        return losses

    def get_image_metrics_and_images(self, outputs: dict, batch: dict) -> tuple[dict[str, float], dict[str, Tensor]]:
        """The paper's metrics of a held-out view, masked to the foreground and (``full_``) over the whole frame."""
        truth, valid = self._measured(batch)
        rendered = outputs["spectral"].to(self.device)
        mask = batch["mask"].to(self.device)[..., 0].bool()
        metrics = spectral_metrics(rendered, truth, mask, valid)
        metrics |= {f"full_{name}": value for name, value in spectral_metrics(rendered, truth, None, valid).items()}

        angle = spectral_angle_map(rendered, truth, valid).nan_to_num()[..., None] / ANGLE_DRAWN_RAD[1]
        error = squared_error_map(rendered, truth, valid).nan_to_num().sqrt()[..., None] / ERROR_DRAWN[1]
        images = {
            "img": torch.cat([truth[..., self.rgb_bands], rendered[..., self.rgb_bands]], dim=1).clamp(0.0, 1.0),
            "spectral_angle": colormaps.apply_colormap(angle.clamp(0.0, 1.0)),
            "error": colormaps.apply_colormap(error.float().clamp(0.0, 1.0)),
            "accumulation": colormaps.apply_colormap(outputs["accumulation"]),
            "depth": colormaps.apply_depth_colormap(outputs["depth"], accumulation=outputs["accumulation"]),
        }
        return metrics, images
