"""The model: nerfacto with a spectrum instead of a colour, and the chamber as the background."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
import tyro
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.field_components.spatial_distortions import SceneContraction
from nerfstudio.model_components.losses import distortion_loss, interlevel_loss
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler
from nerfstudio.model_components.renderers import AccumulationRenderer, DepthRenderer, NormalsRenderer
from nerfstudio.model_components.scene_colliders import AABBBoxCollider, NearFarCollider
from nerfstudio.model_components.shaders import NormalsShader
from nerfstudio.models.base_model import Model
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig
from torch import Tensor, nn

from hsi_sc_nerf import paper
from hsi_sc_nerf.data.datamanager import FROM_CHECKPOINT
from hsi_sc_nerf.data.dataparser import CAMERA_ROTATION
from hsi_sc_nerf.errors import InputError, one_sentence
from hsi_sc_nerf.evaluation.spectral_metrics import metrics_of_regions, spectral_angle_mapper, spectral_rmse
from hsi_sc_nerf.fields.camera_shading import REFRESH_EVERY
from hsi_sc_nerf.fields.hash_grid import grid_for_dataset
from hsi_sc_nerf.fields.occupancy_grid import OccupancyGrid
from hsi_sc_nerf.fields.spectral_field import SpectralField
from hsi_sc_nerf.models.backgrounds import make_background
from hsi_sc_nerf.models.build_field import build_field, build_proposals
from hsi_sc_nerf.models.chosen_effects import chosen_effects, require_effects
from hsi_sc_nerf.models.compositing import BasisDecoder, SpectralRenderer
from hsi_sc_nerf.models.density_losses import FREE_SPACE_WEIGHT, SUPPORT_SOFTNESS_M, mean_distortion, mean_free_space
from hsi_sc_nerf.models.losses import angle_loss, angular_loss, hsi_loss
from hsi_sc_nerf.models.occupancy_sampler import OccupancySampler, build_occupancy
from hsi_sc_nerf.models.optimizers import with_network_group
from hsi_sc_nerf.models.pose_refinement import PoseRefinement, PoseRefinementConfig
from hsi_sc_nerf.models.supersampling import mean_over_pixels, supersampled_view
from hsi_sc_nerf.models.view_images import view_images
from hsi_sc_nerf.numerics import safe_log10
from hsi_sc_nerf.packed.dataset import PackedDataset
from hsi_sc_nerf.processing.spectral_subspace import training_subspace

METRIC_STRIDE = 8
"""The metrics of a batch are those of every so many of its rays: they are drawn, and nothing learns from them."""


@dataclass
class SpectralModelConfig(NerfactoModelConfig):
    """Configuration of the spectral model; defaults that differ from nerfacto's are those of a turntable scene."""

    _target: type = field(default_factory=lambda: SpectralModel)
    head: Literal["direct", "basis"] = "basis"
    """Output of the field at a sample. direct: the reflectance in every band. basis: a few coefficients in a basis of
    spectra that is found in the training pixels; they are decoded to all bands once a pixel."""
    basis_size: int | None = None
    """Spectra in the basis of the head "basis". None: as many as stand out of the noise, at most 16."""
    effects: str = "auto"
    """Effects that the model simulates, joined by commas. view_dependence: a point's spectrum depends on its turn to
    the camera and the lamps, which stand still. still_chamber: the background is a picture of the chamber, taken from
    the frames, instead of its median spectrum. pose_refinement: training moves the poses. none: no effect. auto: the
    effects that the dataset shows (docs/validation/effects.md)."""
    background: Literal["chamber", "last-sample"] = "chamber"
    """Spectrum of the light that the object lets through. chamber: the chamber's. last-sample: that of the last
    sample of the ray, as in nerfacto."""
    supersample_outline: bool = True
    """Four rays for a pixel on the object's outline, which shows the object and what is behind it, instead of one."""
    angular_loss: Literal["cosine", "angle"] = "angle"
    """Loss of the spectral angle. cosine: one minus its cosine (the paper), whose gradient vanishes at small angles.
    angle: the angle in radians, whose weight has to be about ten times smaller."""
    angular_loss_mult: float = 0.03
    """Weight of the spectral angle's loss."""
    hsi_loss_mult: float = paper.HSI_LOSS_WEIGHT
    """Weight of the reflectance errors over pixels and bands."""
    distortion_loss_mult: float = 0.001
    """Weight of the distortion loss, which concentrates the density along a ray. Distances are scene units, or with
    proposal networks fractions of the ray (docs/notes/dead_ends.md)."""
    predict_normals: bool = False
    """Predict normals, as the paper does. Steps take half again as long; a cloud's normals are not these."""
    near_plane: float = 0.01
    """Least distance of samples from the camera, scene units."""
    disable_scene_contraction: bool = True
    """True: the scene is the box of everything that turns. False: an unbounded scene whose rays end at the far plane,
    to be combined with the data parser's --scene cameras."""
    proposal_initial_sampler: Literal["piecewise", "uniform"] = "uniform"
    """Spacing of the first samples; uniform suits rays that are bounded by the box."""
    num_proposal_iterations: int = 0
    """Proposal networks that place the samples, as in nerfacto. 0: an occupancy grid that begins as the visual hull
    of the masks places them; it needs the scene to be a box."""
    num_nerf_samples_per_ray: int = 32
    """Samples a ray for the spectral field; a stage may train with fewer."""
    match_resolution: bool = True
    """Size the field's hash grid by what a pixel resolves. False: by num-levels, max-res and log2-hashmap-size."""
    average_init_density: float = 0.1
    """Density of an untrained field. With an occupancy grid, training begins solid inside the masks' hull instead."""
    use_appearance_embedding: bool = False
    """Learn an appearance of each view. Calibrated reflectance under fixed lamps needs none."""
    implementation: Literal["tcnn", "torch"] = "torch"
    """Networks and grids. "torch" works with and without a GPU."""
    eval_num_rays_per_chunk: int = 2048
    """Rays rendered at a time."""
    camera_optimizer: PoseRefinementConfig = field(default_factory=PoseRefinementConfig)
    """Refinement of the measured poses."""
    # Nerfacto's settings that change nothing here: the command line neither shows nor takes them.
    enable_collider: tyro.conf.Fixed[bool] = False
    collider_params: tyro.conf.Fixed[dict[str, float] | None] = None
    loss_coefficients: tyro.conf.Fixed[dict[str, float]] = field(default_factory=dict)
    prompt: tyro.conf.Fixed[str | None] = None
    background_color: tyro.conf.Fixed[Literal["random", "last_sample", "black", "white"]] = "last_sample"
    hidden_dim_transient: tyro.conf.Fixed[int] = 64
    use_same_proposal_network: tyro.conf.Fixed[bool] = False

    def __post_init__(self) -> None:
        with one_sentence():
            require_effects(self.effects)
            if self.num_proposal_iterations == 0 and not self.disable_scene_contraction:
                raise InputError(
                    "an occupancy grid needs a box; take --pipeline.model.num-proposal-iterations 2 with "
                    "--pipeline.model.disable-scene-contraction False."
                )
            if self.basis_size is not None and self.basis_size < 1:
                raise InputError("--pipeline.model.basis-size must be at least 1.")
            if self.background == "last-sample" and (self.head == "basis" or self.num_proposal_iterations == 0):
                raise InputError(
                    "--pipeline.model.background last-sample needs values in all bands behind the object; take "
                    "--pipeline.model.head direct and --pipeline.model.num-proposal-iterations 2 with it."
                )


class SpectralModel(NerfactoModel):
    """Nerfacto whose field emits a spectrum (paper, section "Model Formulation").

    It adds the output ``spectral`` (reflectance, a value a band) to nerfacto's; ``rgb`` is three of its bands. Its
    attribute ``effects`` names those that it simulates (`MODEL_EFFECTS`).
    """

    config: SpectralModelConfig
    field: SpectralField
    camera_optimizer: PoseRefinement
    decoder: nn.Module
    proposal_sampler: ProposalNetworkSampler | OccupancySampler  # type: ignore[assignment]
    renderer_rgb: nn.Module  # type: ignore[assignment]

    def populate_modules(self) -> None:
        """Build the modules.

        Nerfacto's own method is not called: it builds LPIPS, which downloads AlexNet and means nothing for spectra.
        """
        Model.populate_modules(self)
        config, metadata = self.config, self.kwargs["metadata"]
        dataset: PackedDataset = metadata["dataset"]
        self.effects = chosen_effects(config.effects, dataset)
        self.wavelengths_nm = dataset.wavelengths_nm
        self.rgb_bands: list[int] = metadata["rgb_bands"]
        from_checkpoint: bool = metadata.get(FROM_CHECKPOINT, False)
        subspace, self.decoder = None, nn.Identity()
        if config.head == "basis":
            subspace = training_subspace(dataset, metadata["frames"], config.basis_size)
            self.decoder = BasisDecoder(torch.from_numpy(subspace.scaled_basis).float())
        contraction = None if config.disable_scene_contraction else SceneContraction(order=float("inf"))
        self.proposal_networks, self.density_fns = nn.ModuleList(), []
        if config.num_proposal_iterations > 0:
            networks, self.proposal_sampler = build_proposals(config, self.scene_box.aabb, contraction)
            self.proposal_networks.extend(networks)
            self.density_fns = [network.density_fn for network in networks]
        else:
            grid = build_occupancy(dataset, metadata["frames"], self.scene_box.aabb, from_checkpoint)
            self.proposal_sampler = OccupancySampler(grid, config.num_nerf_samples_per_ray, config.predict_normals)
        base, top = metadata["object_box"][:, 2].tolist()
        softness = SUPPORT_SOFTNESS_M * (top - base) / float(dataset.object_box_m[1, 2] - dataset.object_box_m[0, 2])
        self.support_height = None if dataset.container is None else base + softness
        self.object_base = base + softness / 2.0
        self.field = build_field(
            config,
            len(dataset.wavelengths_nm),
            grid_for_dataset(dataset) if config.match_resolution else None,
            self.scene_box.aabb,
            self.num_train_data,
            view_dependent="view_dependence" in self.effects,
            contraction=contraction,
            subspace=subspace,
            occupancy=self.occupancy,
            turntable=metadata["turntable"],
            base=base,
        )
        refine = "pose_refinement" in self.effects
        self.camera_optimizer = config.camera_optimizer.setup(refine=refine, **metadata["turntable"])
        if contraction is None:
            self.collider = AABBBoxCollider(self.scene_box, near_plane=config.near_plane)  # type: ignore[assignment]
        else:
            self.collider = NearFarCollider(config.near_plane, config.far_plane)  # type: ignore[assignment]
        picture = "still_chamber" in self.effects
        self.background = (
            None
            if config.background == "last-sample"
            else make_background(dataset, metadata["frames"], picture=picture, from_checkpoint=from_checkpoint)
        )
        self.renderer_rgb = SpectralRenderer(last_sample_behind=self.background is None)
        self.renderer_accumulation = AccumulationRenderer()
        self.renderer_depth = DepthRenderer(method="median")
        self.renderer_expected_depth = DepthRenderer(method="expected")
        self.renderer_normals = NormalsRenderer()
        self.normals_shader = NormalsShader()
        self.step = 0

    @property
    def occupancy(self) -> OccupancyGrid | None:
        """The grid that places the samples; None where proposal networks do."""
        return self.proposal_sampler.grid if isinstance(self.proposal_sampler, OccupancySampler) else None

    @property
    def proposals(self) -> ProposalNetworkSampler | None:
        """The sampler with proposal networks; None where an occupancy grid places the samples."""
        return self.proposal_sampler if isinstance(self.proposal_sampler, ProposalNetworkSampler) else None

    def prepare_step(self, step: int) -> None:
        """Bring occupancy grid and normals up to date before a step of training; at first, the field begins solid."""
        if self.occupancy is None:
            return
        if step == 0 and next(self.field.parameters()).requires_grad:  # not if the first stage freezes the field
            self.field.start_solid(self.occupancy.random_points)
            self.occupancy.refresh_all(self.field.density_fn)
        self.occupancy.refresh(self.field.density_fn, step, self.field.rise_length)
        if self.field.shading is not None and step % REFRESH_EVERY == 0:
            self.field.shading.refresh(self.occupancy.opacity)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Nerfacto's groups, with one for the weights of the field's networks, and without those that are empty."""
        return with_network_group(super().get_param_groups(), self.field)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Nerfacto's callbacks, which are those of the proposals."""
        return [] if self.proposals is None else super().get_training_callbacks(training_callback_attributes)

    def background_spectrum(self, ray_bundle: RayBundle) -> Float[Tensor, "*rays bands"]:
        """Reflectance of the chamber behind rays as measured, before the pose refinement; 0 without a background."""
        if self.background is None:
            return torch.zeros(*ray_bundle.shape, len(self.wavelengths_nm), device=self.device)
        return self.background(ray_bundle.directions, ray_bundle.metadata.get(CAMERA_ROTATION))

    def get_outputs(self, ray_bundle: RayBundle) -> dict:  # type: ignore[override]
        """Nerfacto's outputs and the spectrum; held-out views are corrected like training views."""
        background = None if self.background is None else self.background_spectrum(ray_bundle)
        if not self.training:
            self.camera_optimizer.apply_to_raybundle(ray_bundle)
        outputs = self._of_all_rays(super().get_outputs(ray_bundle), ray_bundle)
        coefficients, from_behind = outputs["rgb"], 1.0 - outputs["accumulation"]
        if self.field.coat is not None:
            coefficients, mirrored = coefficients[..., :-1], coefficients[..., -1:]
            from_behind = from_behind + mirrored
        spectral = self.decoder(coefficients)
        if background is not None:
            spectral = spectral + background * from_behind
        # Coefficients of a basis may decode to slightly negative reflectance.
        outputs["spectral"] = spectral if self.training else spectral.clamp_min(0.0)
        # An index of numbers would be a transfer to the device, for which that has to wait.
        outputs["rgb"] = torch.stack([outputs["spectral"][..., band] for band in self.rgb_bands], dim=-1)
        return outputs

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """nerfstudio's, with the object's outline supersampled."""
        if not self.config.supersample_outline:
            return super().get_outputs_for_camera(camera, obb_box)
        return supersampled_view(self.get_outputs_for_camera_ray_bundle, camera, self.object_base, obb_box)

    @torch.no_grad()
    def depth_and_opacity(self, ray_bundle: RayBundle) -> tuple[Float[Tensor, "rays 1"], Float[Tensor, "rays 1"]]:
        """Outputs ``depth`` and ``accumulation`` of measured rays in evaluation, without rendering a spectrum."""
        rays = self.collider(ray_bundle)  # type: ignore[misc]
        self.camera_optimizer.apply_to_raybundle(rays)
        samples = self.proposal_sampler(rays, density_fns=self.density_fns)[0]
        weights = samples.get_weights(self.field.get_density(samples)[0])
        depth, opacity = self.renderer_depth(weights, samples), self.renderer_accumulation(weights)
        outputs = self._of_all_rays({"depth": depth, "accumulation": opacity}, rays)
        return outputs["depth"], outputs["accumulation"]

    def _of_all_rays(self, outputs: dict, rays: RayBundle) -> dict:
        """Outputs of all rays from those of the sampled ones."""
        sampler = self.proposal_sampler
        return sampler.of_all_rays(outputs, rays) if isinstance(sampler, OccupancySampler) else outputs

    def _measured(self, batch: dict) -> tuple[Tensor, Tensor | None]:
        """Measured reflectance, and which of its values are measurements (None for all)."""
        valid = batch.get("valid")
        return batch["spectral"].to(self.device), None if valid is None else valid.to(self.device)

    def get_metrics_dict(self, outputs: dict, batch: dict) -> dict[str, Tensor]:
        """SAM, RMSE and PSNR of some of the batch's rays, distortion, size of the pose corrections."""
        with torch.no_grad():
            target, valid = self._measured(batch)
            some = slice(None, None, METRIC_STRIDE)
            # The metrics take images: the batch is one of a single line.
            spectral = mean_over_pixels(outputs["spectral"], len(target))
            images = (spectral[None, some], target[None, some])
            some_valid = None if valid is None else valid[None, some]
            metrics = {"sam": spectral_angle_mapper(*images, valid=some_valid)}
            metrics["rmse"] = spectral_rmse(*images, valid=some_valid)
            metrics["psnr"] = -20.0 * safe_log10(metrics["rmse"])
        if self.training:
            if isinstance(self.proposal_sampler, OccupancySampler):
                metrics["distortion"] = mean_distortion(self.proposal_sampler, outputs, len(target))
            else:
                metrics["distortion"] = distortion_loss(outputs["weights_list"], outputs["ray_samples_list"])
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def get_loss_dict(self, outputs: dict, batch: dict, metrics_dict: dict | None = None) -> dict[str, Tensor]:
        """The paper's composite loss (section "Loss Function"); a term of weight zero is not computed."""
        config = self.config
        target, valid = self._measured(batch)
        spectral = mean_over_pixels(outputs["spectral"], len(target))
        losses = {}
        if config.hsi_loss_mult > 0:
            losses["hsi_loss"] = config.hsi_loss_mult * hsi_loss(spectral, target, valid=valid)
        if config.angular_loss_mult > 0:
            loss = angular_loss if config.angular_loss == "cosine" else angle_loss
            losses["angular_loss"] = config.angular_loss_mult * loss(spectral, target, valid=valid)
        if not self.training:
            return losses
        assert metrics_dict is not None
        if not isinstance(self.proposal_sampler, OccupancySampler):
            interlevel = interlevel_loss(outputs["weights_list"], outputs["ray_samples_list"])
            losses["interlevel_loss"] = config.interlevel_loss_mult * interlevel
        elif self.support_height is not None:
            free = batch["free"].to(self.device)[:, 0]
            mean = mean_free_space(self.proposal_sampler, outputs, free, self.support_height)
            losses["free_space_loss"] = FREE_SPACE_WEIGHT * mean
        losses["distortion_loss"] = config.distortion_loss_mult * metrics_dict["distortion"]
        if config.predict_normals:
            losses["orientation_loss"] = config.orientation_loss_mult * outputs["rendered_orientation_loss"].mean()
            losses["pred_normal_loss"] = config.pred_normal_loss_mult * outputs["rendered_pred_normal_loss"].mean()
        self.camera_optimizer.get_loss_dict(losses)
        return losses

    def get_image_metrics_and_images(self, outputs: dict, batch: dict) -> tuple[dict[str, float], dict[str, Tensor]]:
        """The paper's metrics of a held-out view, masked to the foreground and (``full_``) over the whole frame."""
        truth, valid = self._measured(batch)
        outputs = {name: image.to(self.device) for name, image in outputs.items()}
        regions = {"": batch["mask"][..., 0].bool(), "full_": None}
        metrics = metrics_of_regions(outputs["spectral"], truth, regions, valid)
        return metrics, view_images(outputs, truth, valid, self.rgb_bands)
