"""Optimisers: Muon for the networks' weights, and steps that are skipped where they are not finite."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.engine.optimizers import OptimizerConfig, Optimizers
from torch import Tensor, nn
from torch.cuda.amp.grad_scaler import GradScaler
from torch.nn import Parameter

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.training_watch import non_finite_names

NEWTON_SCHULZ = 3.4445, -4.7750, 2.0315
"""Coefficients of an odd polynomial of degree 5 that takes small singular values to about 1 quickly (Jordan)."""
NEWTON_SCHULZ_STEPS = 5


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
    """Settings of `Muon`. Small networks on a hash grid need a third of Adam's steps (docs/notes/dead_ends.md)."""

    _target: type = field(default_factory=lambda: Muon)
    lr: float = 2e-2
    """Learning rate: the largest singular value of a step."""


class Muon(torch.optim.Optimizer):
    """The momentum of a weight matrix, with all its singular values made about 1, is the step.

    K. Jordan et al., "Muon: An optimizer for hidden layers in neural networks", 2024. ``torch.optim.Muon`` does so in
    bfloat16, which is slow on a processor (docs/notes/dead_ends.md).

    Args:
        params: weight matrices.
        lr: largest singular value of a step of a matrix that is not higher than wide.
        eps: added to a matrix's norm.
        momentum: fraction of the mean gradient that a step keeps; with Nesterov's look ahead.
    """

    def __init__(self, params: Iterable[Parameter], lr: float, eps: float = 1e-8, momentum: float = 0.95) -> None:
        super().__init__(params, {"lr": lr, "eps": eps, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Change the weights that have a gradient."""
        for group in self.param_groups:
            for weights in group["params"]:
                if weights.grad is None:
                    continue
                state = self.state[weights]
                if not state:
                    state["mean_gradient"] = torch.zeros_like(weights)
                mean = state["mean_gradient"].lerp_(weights.grad, 1.0 - group["momentum"])
                ahead = weights.grad.lerp(mean, group["momentum"])
                rows, columns = weights.shape
                rate = group["lr"] * max(1.0, rows / columns) ** 0.5
                weights.add_(with_alike_singular_values(ahead, group["eps"]), alpha=-rate)


def with_alike_singular_values(matrix: Float[Tensor, "rows columns"], eps: float) -> Float[Tensor, "rows columns"]:
    """The matrix with its own singular vectors, and singular values between 0.7 and 1.2, by Newton-Schulz steps.

    Singular values below a hundredth of the matrix's norm come out smaller.
    """
    upright = matrix.shape[0] > matrix.shape[1]
    flat = matrix.T if upright else matrix
    flat = flat / (flat.norm() + eps)
    first, third, fifth = NEWTON_SCHULZ
    for _ in range(NEWTON_SCHULZ_STEPS):
        gram = flat @ flat.T
        flat = torch.addmm(flat, torch.addmm(gram, gram, gram, beta=third, alpha=fifth), flat, beta=first)
    return flat.T if upright else flat


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
        # Adam passes once over the hash grid's tables, not once for each of its operations.
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

    def scale_learning_rates(self, factor: Callable[[str], float]) -> dict[str, float]:
        """Set each group's learning rate to that of its settings times its factor; gives the rates."""
        rates = {name: self.config[name]["optimizer"].lr * factor(name) for name in self.optimizers}
        for name, optimizer in self.optimizers.items():
            for group in optimizer.param_groups:
                group["lr"] = rates[name]
        return rates

    def restore(self, states: Mapping[str, Any], path: Path) -> None:
        """Load the states of a checkpoint.

        Raises:
            InputError: it has other parameter groups.
        """
        different = set(states) ^ set(self.optimizers)
        if different:
            raise InputError(
                f"{path}: was made with other parameter groups ({', '.join(sorted(different))}); take the settings "
                "of the config.yml beside it."
            )
        self.load_optimizers(dict(states))
