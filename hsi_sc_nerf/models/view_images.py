"""Pictures of a held-out view, for the viewer, TensorBoard and the renders of ``ns-eval``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from nerfstudio.utils import colormaps
from torch import Tensor

from hsi_sc_nerf.evaluation.spectral_metrics import spectral_angle_map, squared_error_map
from hsi_sc_nerf.plotting import ANGLE_DRAWN_RAD, ERROR_DRAWN


def view_images(
    outputs: Mapping[str, Tensor],
    truth: Float[Tensor, "h w bands"],
    valid: Bool[Tensor, "h w bands"] | None,
    rgb_bands: Sequence[int],
) -> dict[str, Float[Tensor, "h w_or_2w 3"]]:
    """The view as measured and as rendered side by side, its errors, and its geometry.

    Args:
        outputs: the model's ``spectral``, ``accumulation`` and ``depth``, on the device of ``truth``.
        truth: measured reflectance.
        valid: which of its values are measurements; None for all.
        rgb_bands: indices of the bands that are shown as red, green and blue.

    Returns:
        ``img`` (measured left, rendered right), ``spectral_angle``, ``error`` (root mean square over the bands),
        ``accumulation`` and ``depth``, each in [0, 1].
    """
    rendered, rgb = outputs["spectral"], list(rgb_bands)
    angle = spectral_angle_map(rendered, truth, valid).nan_to_num()[..., None] / ANGLE_DRAWN_RAD[1]
    error = squared_error_map(rendered, truth, valid).nan_to_num().sqrt()[..., None] / ERROR_DRAWN[1]
    return {
        "img": torch.cat([truth[..., rgb], rendered[..., rgb]], dim=1).clamp(0.0, 1.0),
        "spectral_angle": colormaps.apply_colormap(angle.clamp(0.0, 1.0)),
        "error": colormaps.apply_colormap(error.float().clamp(0.0, 1.0)),
        "accumulation": colormaps.apply_colormap(outputs["accumulation"]),
        "depth": colormaps.apply_depth_colormap(outputs["depth"], accumulation=outputs["accumulation"]),
    }
