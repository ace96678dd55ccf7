"""The spectrum along one ray of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

if TYPE_CHECKING:
    from hsi_sc_nerf.models.spectral_model import SpectralModel


@dataclass(frozen=True, eq=False)
class PickedPoint:
    """What a ray meets."""

    position: Float[Tensor, "3"]
    """Where half of the ray is absorbed, scene units."""
    opacity: float
    spectrum: Float[Tensor, "bands"]
    """As the picture shows it: the background has the share that the object lets through."""


def pick(
    model: SpectralModel,
    origin: Float[Tensor, "3"],
    direction: Float[Tensor, "3"],
    metadata: dict[str, Float[Tensor, "1 ..."]],
) -> PickedPoint:
    """Render one ray in evaluation mode, and leave the model in the mode that it was in.

    Args:
        model: the model, which nobody else may train or render with meanwhile.
        origin: of the ray, scene units.
        direction: of the ray, of any length.
        metadata: what tells the model which frame the ray belongs to, if any.
    """
    unit = direction / direction.norm()
    rays = RayBundle(
        origins=origin[None],
        directions=unit[None],
        pixel_area=torch.ones(1, 1),
        camera_indices=torch.zeros(1, 1, dtype=torch.long),
        metadata={"directions_norm": torch.ones(1, 1), **metadata},
    )
    was_training = model.training
    model.eval()
    try:
        with torch.no_grad():
            outputs = model(rays.to(model.device))
    finally:
        model.train(was_training)
    depth, opacity, spectrum = (outputs[name][0].cpu() for name in ("depth", "accumulation", "spectral"))
    return PickedPoint(origin + unit * depth, float(opacity), spectrum)
