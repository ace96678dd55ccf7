"""Nerfacto's proposal networks and the sampler that learns from them where to place the samples."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from nerfstudio.field_components.spatial_distortions import SceneContraction
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler, UniformSampler
from nerfstudio.models.nerfacto import NerfactoModelConfig
from torch import Tensor

from hsi_sc_nerf.fields.spectral_field import SpectralProposalField


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
