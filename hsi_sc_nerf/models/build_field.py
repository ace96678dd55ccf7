"""The spectral field of a run: its hash grid, its head, how its spectra depend on the view, and its proposals."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.field_components.spatial_distortions import SceneContraction
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler, UniformSampler
from nerfstudio.models.nerfacto import NerfactoModelConfig
from torch import Tensor

from hsi_sc_nerf.fields.camera_shading import CameraShading
from hsi_sc_nerf.fields.coat import Coat
from hsi_sc_nerf.fields.hash_grid import GridSize
from hsi_sc_nerf.fields.occupancy_grid import OccupancyGrid
from hsi_sc_nerf.fields.spectral_field import SpectralField, SpectralProposalField
from hsi_sc_nerf.processing.spectral_subspace import SpectralSubspace


def build_field(
    config: NerfactoModelConfig,
    num_bands: int,
    grid: GridSize | None,
    aabb: Float[Tensor, "2 3"],
    num_images: int,
    *,
    view_dependent: bool,
    contraction: SceneContraction | None,
    subspace: SpectralSubspace | None,
    occupancy: OccupancyGrid | None,
    turntable: dict[str, Any],
    base: float,
) -> SpectralField:
    """The spectral field, with nerfacto's settings where no other is given.

    Args:
        config: configuration of the model.
        num_bands: bands of the spectra.
        grid: size of the hash grid; None for that of the settings.
        aabb: the scene box, scene units.
        num_images: training frames.
        view_dependent: whether spectra depend on the view: by shading where there are normals and a basis, else by
            the viewing direction.
        contraction: contraction of unbounded space; None for a box.
        subspace: whose coefficients the head emits; None for the direct head.
        occupancy: gives the normals; None where proposal networks place the samples.
        turntable: axis and pose of a camera, as the data parser gives them for the pose refinement.
        base: height of the plane on which the object stands, scene units.
    """
    options: dict[str, Any] = {
        "num_levels": config.num_levels,
        "max_res": config.max_res,
        "log2_hashmap_size": config.log2_hashmap_size,
    }
    if grid is not None:
        options = {"num_levels": grid.levels, "max_res": grid.finest, "log2_hashmap_size": grid.log2_table}
    if subspace is not None:
        options["coefficient_start"] = torch.from_numpy(subspace.mean_coefficients)
    if view_dependent and subspace is not None and occupancy is not None:
        shape: tuple[int, int, int] = tuple(occupancy.opacity.shape)  # type: ignore[assignment]
        camera, axis = (torch.from_numpy(np.asarray(turntable[key])) for key in ("camera_to_world", "axis_origin"))
        rank = len(subspace.mean_coefficients)
        options["shading"] = CameraShading(shape, occupancy.lower, occupancy.cell, rank, camera, axis, base)
        options["coat"] = Coat(occupancy.lower, torch.tensor(shape) * occupancy.cell, base, rank)
    return SpectralField(
        aabb,
        num_bands=num_bands,
        view_dependent=view_dependent and "shading" not in options,
        skip_unseen=config.num_proposal_iterations == 0,
        rises=occupancy is not None,
        spatial_distortion=contraction,
        hidden_dim=config.hidden_dim,
        base_res=config.base_res,
        features_per_level=config.features_per_level,
        hidden_dim_color=config.hidden_dim_color,
        num_images=num_images,
        use_pred_normals=config.predict_normals,
        use_average_appearance_embedding=config.use_average_appearance_embedding,
        appearance_embedding_dim=config.appearance_embed_dim if config.use_appearance_embedding else 0,
        average_init_density=config.average_init_density,
        implementation=config.implementation,
        **options,
    )


def build_proposals(
    config: NerfactoModelConfig, aabb: Float[Tensor, "2 3"], contraction: SceneContraction | None
) -> tuple[list[SpectralProposalField], ProposalNetworkSampler]:
    """A network for each round of proposals, and the sampler, as nerfacto builds them."""
    arguments = config.proposal_net_args_list
    rounds = config.num_proposal_iterations
    networks = [
        SpectralProposalField(
            aabb,
            **arguments[min(i, len(arguments) - 1)],
            spatial_distortion=contraction,
            average_init_density=config.average_init_density,
            implementation=config.implementation,
        )
        for i in range(rounds)
    ]

    def update_schedule(step: int) -> float:
        rise = step / max(1, config.proposal_warmup) * config.proposal_update_every
        return float(np.clip(rise, 1, config.proposal_update_every))

    uniform = config.proposal_initial_sampler == "uniform"
    sampler = ProposalNetworkSampler(
        num_nerf_samples_per_ray=config.num_nerf_samples_per_ray,
        num_proposal_samples_per_ray=config.num_proposal_samples_per_ray,
        num_proposal_network_iterations=rounds,
        single_jitter=config.use_single_jitter,
        update_sched=update_schedule,
        initial_sampler=UniformSampler(single_jitter=config.use_single_jitter) if uniform else None,
    )
    return networks, sampler
