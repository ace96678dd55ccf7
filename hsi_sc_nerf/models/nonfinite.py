"""Training steps with non-finite losses or gradients are skipped; too many in a row stop the run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor
from torch.cuda.amp.grad_scaler import GradScaler

MAX_SKIPPED_IN_A_ROW = 20
"""Skipped steps that end a run: single ones come from damaged values, so many from weights that are lost."""


class TrainingDivergedError(RuntimeError):
    """Too many steps in a row were not finite."""


def non_finite_names(values: Mapping[str, Tensor]) -> list[str]:
    """Names of the tensors that contain an infinity or a NaN."""
    if not values:
        return []
    # The sum of magnitudes is finite only if all elements are; one transfer from the GPU for all.
    sums = torch.stack(torch._foreach_norm([value.detach().float() for value in values.values()], 1))
    return [name for name, finite in zip(values, torch.isfinite(sums).tolist(), strict=True) if not finite]


class GuardedOptimizers(Optimizers):
    """nerfstudio's optimisers, which skip a step with a non-finite gradient.

    Attributes:
        skipped_groups: parameter groups whose gradient was not finite in the last step; empty after a good one.
    """

    skipped_groups: tuple[str, ...] = ()
    _scale: float = 1.0

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        """Step the optimisers of ``param_groups``, or none of them.

        With mixed precision, the gradient scaler skips steps and halves its scale, as designed while the scale is
        large. Once it is below 1, such a step counts as skipped, at the step after it.
        """
        if grad_scaler.is_enabled():
            scale = grad_scaler.get_scale()
            self.skipped_groups = tuple(param_groups) if scale < min(1.0, self._scale) else ()
            self._scale = scale
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


class NonFiniteGuard:
    """Counter of consecutive skipped steps."""

    in_a_row = 0

    def record(self, step: int, losses: Iterable[str], groups: Iterable[str]) -> str | None:
        """Record a step; returns a sentence to print if it was skipped, else None.

        Args:
            step: the step.
            losses: names of the loss terms that were not finite.
            groups: names of the parameter groups whose gradient was not finite.

        Raises:
            TrainingDivergedError: this was the last of `MAX_SKIPPED_IN_A_ROW`.
        """
        causes = [f"loss {name}" for name in losses] or [f"gradient of {name}" for name in groups]
        if not causes:
            self.in_a_row = 0
            return None
        self.in_a_row += 1
        sentence = f"step {step} skipped: {', '.join(causes)} not finite"
        if self.in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise TrainingDivergedError(
                f"{sentence}, the last of {self.in_a_row} in a row; lower the learning rate, or look for "
                "damaged frames"
            )
        return sentence
