"""What a model takes from its dataset before it trains: spectral basis, grid, background, weights of the bands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hsi_sc_nerf.data.background_image import estimate_static_background
from hsi_sc_nerf.fields.grid_size import GridSize, grid_for_resolution
from hsi_sc_nerf.models.band_weights import inverse_variance_weights
from hsi_sc_nerf.models.camera_background import CameraBackground
from hsi_sc_nerf.models.compositing import ChamberSpectrum
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame

BackgroundKind = Literal["last-sample", "spectrum", "image", "learned-image"]


def chamber_background(
    kind: BackgroundKind, dataset: PackedDataset, frames: Sequence[PackedFrame]
) -> ChamberSpectrum | CameraBackground | None:
    """What stands behind the rays: None where nothing does ("last-sample").

    Args:
        kind: what it is taken to be.
        dataset: whose camera it stands still with.
        frames: training frames, from which its picture is taken.
    """
    if kind == "last-sample":
        return None
    spectrum = torch.from_numpy(dataset.background_reflectance).float()
    if kind == "spectrum":
        return ChamberSpectrum(spectrum)
    picture = estimate_static_background(dataset, frames)
    k1, k2, p1, p2 = dataset.distortion.tolist()
    return CameraBackground(
        torch.from_numpy(picture.image),
        cell_px=picture.cell_px,
        intrinsics=dataset.intrinsics,
        distortion=(k1, k2, p1, p2),
        spectrum=spectrum,
        learnable=kind == "learned-image",
    )


def field_grid(dataset: PackedDataset) -> GridSize:
    """The grid that resolves in the scene box what the camera does."""
    box = dataset.scene_box_m
    distance = np.linalg.norm(dataset.camera_to_worlds[:, :3, 3] - box.mean(axis=0), axis=1).mean()
    return grid_for_resolution(float((box[1] - box[0]).max()), float(distance) / dataset.intrinsics.fl_x)


def band_weights(dataset: PackedDataset) -> Float[Tensor, "bands"] | None:
    """How much each band counts, by how well it was measured; None where the session does not tell."""
    if dataset.typical_uncertainty is None:
        return None
    return torch.from_numpy(inverse_variance_weights(dataset.typical_uncertainty)).float()
