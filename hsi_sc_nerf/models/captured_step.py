"""A training step's forward and backward pass as one CUDA graph.

A step is some thousand small operations. Launching them one by one from Python takes longer than the GPU needs to do
them (docs/validation/reconstruction.md). Captured once, they are launched together: same operations, same random
numbers, other rays.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor
from torch.nn import Parameter

if TYPE_CHECKING:
    from hsi_sc_nerf.models.spectral_model import SpectralModel

Result = tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]
"""Loss, its terms, metrics."""
_Captured = tuple[torch.cuda.CUDAGraph, Result, tuple[Tensor | None, ...]]
"""A graph, and where its result and the gradients lie: they hold until a graph is launched again."""
_WARM_UP_PASSES = 3
"""Passes before a capture: libraries set themselves up in the first ones."""


def forward_pass(model: SpectralModel, rays: RayBundle, batch: Mapping[str, Tensor]) -> Result:
    """Loss, terms and metrics of a batch, without any transfer between host and device."""
    # nerfstudio makes some tensors on the host to bring them to the device: these are made there.
    with torch.device(model.device):
        outputs = model(rays)
        metrics = model.get_metrics_dict(outputs, dict(batch))
        losses = model.get_loss_dict(outputs, dict(batch), metrics)
        return functools.reduce(torch.add, losses.values()), losses, metrics


class CapturedSteps:
    """Steps by all that makes one step launch other operations than another.

    Args:
        model: in training.
        parameters: all that may have a gradient.
    """

    def __init__(self, model: SpectralModel, parameters: Sequence[Parameter]) -> None:
        self._model, self._parameters = model, tuple(parameters)
        self._steps: dict[Hashable, _Captured] = {}
        self._inputs: dict[int, dict[str, Tensor]] = {}
        self._pool: Any = None
        self._anneal = torch.ones((), device=model.device)

    def __call__(
        self, kind: Hashable, rays: RayBundle, batch: Mapping[str, Tensor], seed: Callable[[], object]
    ) -> Result:
        """One forward and backward pass; gradients are set, not added to what was there.

        Args:
            kind: what else the step's operations depend on: stage, frozen parameters. Not the annealing of the
                proposals, which is handed over by its value.
            rays: rays of the batch, all of them with the same parts in every call; stages may differ in their number.
            batch: tensors on the device, likewise.
            seed: draws the step's random numbers anew; called before each pass.
        """
        inputs = self._loaded(rays, batch)
        sampler = self._model.proposals
        proposals_learn = False
        if sampler is not None:
            anneal, counter = sampler._anneal, sampler._steps_since_update
            # As the sampler will say itself, in the steps that are not captured.
            proposals_learn = counter > sampler.update_sched(sampler._step) or sampler._step < 10
            self._anneal.fill_(float(anneal))
        kind = (kind, proposals_learn, len(rays))
        if kind not in self._steps:
            self._steps[kind] = self._capture(inputs, seed)
        if sampler is not None:
            sampler._anneal, sampler._steps_since_update = anneal, 0 if proposals_learn else counter
        graph, result, gradients = self._steps[kind]
        seed()
        graph.replay()
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        return result

    def _loaded(self, rays: RayBundle, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The inputs of the graphs of this many rays, with these values."""
        new = {f"rays/{name}": getattr(rays, name) for name in ("origins", "directions", "pixel_area")}
        new["rays/camera_indices"] = rays.camera_indices
        new |= {f"metadata/{name}": value for name, value in rays.metadata.items()}
        new |= {f"batch/{name}": value for name, value in batch.items()}
        if len(rays) not in self._inputs:
            self._inputs[len(rays)] = {name: value.to(self._model.device, copy=True) for name, value in new.items()}
        inputs = self._inputs[len(rays)]
        for name, value in new.items():
            inputs[name].copy_(value, non_blocking=True)
        return inputs

    def _pass(self, inputs: Mapping[str, Tensor]) -> Result:
        """Forward and backward pass; gradients are left in the parameters."""
        parts: dict[str, dict[str, Tensor]] = {"rays": {}, "metadata": {}, "batch": {}}
        for name, value in inputs.items():
            kind, _, key = name.partition("/")
            parts[kind][key] = value
        for parameter in self._parameters:
            parameter.grad = None
        rays = RayBundle(**parts["rays"], metadata=parts["metadata"])
        loss, losses, metrics = forward_pass(self._model, rays, parts["batch"])
        loss.backward()
        detached = ({name: value.detach() for name, value in values.items()} for values in (losses, metrics))
        return (loss.detach(), *detached)  # type: ignore[return-value]

    def _capture(self, inputs: Mapping[str, Tensor], seed: Callable[[], object]) -> _Captured:
        sampler = self._model.proposals
        counter = 0
        if sampler is not None:
            sampler._anneal = self._anneal  # type: ignore[assignment]
            counter = sampler._steps_since_update

        def rewind() -> None:
            """Let the proposals learn in each pass, or in none."""
            if sampler is not None:
                sampler._steps_since_update = counter

        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(_WARM_UP_PASSES):
                rewind()
                seed()
                self._pass(inputs)
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        rewind()
        with torch.cuda.graph(graph, pool=self._pool):
            result = self._pass(inputs)
        self._pool = self._pool or graph.pool()
        return graph, result, tuple(parameter.grad for parameter in self._parameters)
