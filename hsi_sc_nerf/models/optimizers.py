"""Optimisers: Muon for the networks' weights, and steps that are skipped where they are not finite."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.engine.optimizers import OptimizerConfig, Optimizers
from torch import nn
from torch.cuda.amp.grad_scaler import GradScaler
from torch.nn import Parameter

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.training_watch import non_finite_names


def with_network_group(groups: Mapping[str, list[Parameter]], field: nn.Module) -> dict[str, list[Parameter]]:
    """Parameter groups whose ``fields`` gives the weights of linear layers to ``field_networks``; none is empty.

    Args:
        groups: of nerfacto.
        field: whose linear layers count.
    """
    weights = {id(layer.weight) for layer in field.modules() if isinstance(layer, nn.Linear)}
    of_networks = [parameter for parameter in groups["fields"] if id(parameter) in weights]
    others = [parameter for parameter in groups["fields"] if id(parameter) not in weights]
    divided = {**groups, "fields": others, "field_networks": of_networks}
    return {name: group for name, group in divided.items() if group}


@dataclass
class MuonOptimizerConfig(OptimizerConfig):
    """torch's Muon: the momentum of a weight matrix, with all its singular values made about 1, is the step.

    Small networks on top of a hash grid are learned in a third of the steps that Adam takes
    (docs/validation/reconstruction.md). K. Jordan et al., "Muon: An optimizer for hidden layers in neural networks",
    2024.
    """

    _target: type = torch.optim.Muon
    lr: float = 2e-2
    """Learning rate: the largest singular value of a step."""
    weight_decay: float = 0.0
    """Fraction of the weights that a step takes away, over the learning rate."""


class GuardedOptimizers(Optimizers):
    """nerfstudio's optimisers, which skip a step with a non-finite gradient.

    Attributes:
        skipped_groups: parameter groups whose gradient was not finite in the last step; empty after a good one.
    """

    skipped_groups: tuple[str, ...] = ()

    def __init__(self, config: dict[str, Any], param_groups: dict[str, list[Parameter]]) -> None:
        missing = param_groups.keys() - config.keys()
        if missing:
            raise InputError(
                f"the settings have no optimiser for {', '.join(sorted(missing))}, because they are of an older "
                "version; train anew."
            )
        super().__init__(config, param_groups)

    def fuse(self) -> None:
        """On a GPU: one pass of Adam over the hash grid's tables, in place of one for each of its operations."""
        for optimizer in self.optimizers.values():
            if isinstance(optimizer, torch.optim.Adam):
                for group in optimizer.param_groups:
                    group.update(fused=True, foreach=False)

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        """Step the optimisers of ``param_groups``, or none of them. A gradient scaler skips such steps itself."""
        if grad_scaler.is_enabled():
            super().optimizer_scaler_step_some(grad_scaler, param_groups)
            return
        gradients = {
            f"{group}/{i}": parameter.grad
            for group in param_groups
            for i, parameter in enumerate(self.parameters[group])
            if parameter.grad is not None
        }
        self.skipped_groups = tuple(dict.fromkeys(name.split("/")[0] for name in non_finite_names(gradients)))
        if not self.skipped_groups:
            super().optimizer_scaler_step_some(grad_scaler, param_groups)
