"""Pixels on the object's outline by four rays over the area of each, in training and in rendered views.

The spectrum of such a pixel is the mean over its area. Trained on it by one ray, the field would mix the spectra of
the object and of what is behind it in the surface itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor

from hsi_sc_nerf.data.camera_rays import QUARTERS, rays_through_quarters
from hsi_sc_nerf.morphology import beside

_HALF = 0.5
"""Opacity above which a pixel shows the scene."""


def supersampled_view(
    render: Callable[[RayBundle], dict[str, Tensor]], camera: Cameras, base: float, obb_box: OrientedBox | None = None
) -> dict[str, Tensor]:
    """Outputs (lines, samples, ...) of a camera's view; pixels on the object's outline have means over their area.

    Args:
        render: outputs of rays, of which it has ``spectral``, ``rgb``, ``accumulation`` and ``depth``. Depths stay
            those of the pixels' centres.
        camera: of the view.
        base: height above which the scene is the object, scene units.
        obb_box: what nerfstudio renders alone.
    """
    rays = camera.generate_rays(camera_indices=0, keep_shape=True, obb_box=obb_box)
    outputs = render(rays)
    heights = (rays.origins + rays.directions * outputs["depth"])[..., 2]
    pixels = outline_pixels((heights > base) & (outputs["accumulation"][..., 0] > _HALF))
    if len(pixels) > 0:
        finer = render(rays_through_quarters(camera, pixels, obb_box))
        line, sample = pixels.to(heights.device).unbind(dim=-1)
        for name in ("spectral", "rgb", "accumulation"):
            outputs[name][line, sample] = finer[name].mean(dim=1)
    return outputs


def mean_over_pixels(of_rays: Float[Tensor, "rays channels"], pixels: int) -> Float[Tensor, "pixels channels"]:
    """What pixels show, of which the first have one ray and the last `QUARTERS`.

    Args:
        of_rays: what their rays show.
        pixels: how many there are.

    Example:
        >>> mean_over_pixels(torch.tensor([[5.0], [1.0], [2.0], [3.0], [4.0]]), pixels=2)
        tensor([[5.0000],
                [2.5000]])
    """
    quartered = _quartered(len(of_rays), pixels)
    if quartered == 0:
        return of_rays
    first = pixels - quartered
    return torch.cat([of_rays[:first], of_rays[first:].unflatten(0, (quartered, QUARTERS)).mean(dim=1)])


def parts_of_pixels(of_pixels: Float[Tensor, "pixels"], rays: int) -> Float[Tensor, "rays"]:
    """A value of each pixel, divided evenly among its rays; their order is that of `mean_over_pixels`."""
    quartered = _quartered(rays, len(of_pixels))
    if quartered == 0:
        return of_pixels
    first = len(of_pixels) - quartered
    parts = (of_pixels[first:, None] / QUARTERS).expand(-1, QUARTERS).flatten()
    return torch.cat([of_pixels[:first], parts])


def _quartered(rays: int, pixels: int) -> int:
    """How many of the pixels have `QUARTERS` rays."""
    return (rays - pixels) // (QUARTERS - 1)


def outline_pixels(shown: Bool[Tensor, "lines samples"]) -> Int[Tensor, "n 2"]:
    """Pixels (line, sample) that show the object beside others that do not, and the other way round."""
    mask = shown.numpy(force=True)
    return torch.from_numpy(np.argwhere(beside(mask, 1) | beside(~mask, 1)))
