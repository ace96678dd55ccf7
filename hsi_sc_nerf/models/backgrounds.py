"""What a ray sees where the object lets light through: the chamber, which stands still with the camera.

The object turns before a fixed camera, so the chamber behind it is at the same pixels of every frame. In the object's
frame, in which the field lives, the chamber moves with the camera, and no field of the object can represent it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from hsi_sc_nerf.data.background_image import background_cell_px, estimate_static_background
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, image_coordinates, in_camera_frame
from hsi_sc_nerf.packed.dataset import PackedDataset, PackedFrame


def make_background(
    dataset: PackedDataset, frames: Sequence[PackedFrame], *, picture: bool, from_checkpoint: bool = False
) -> Background:
    """The background of a dataset.

    Args:
        dataset: camera, and the chamber's median spectrum.
        frames: training frames, from which the picture of the chamber is taken.
        picture: whether there is one; otherwise the background is the median spectrum.
        from_checkpoint: a checkpoint replaces the picture, which is not looked for; only its size is right.
    """
    spectrum = torch.from_numpy(dataset.background_reflectance).float()
    image, cell_px = None, 1
    if picture and from_checkpoint:
        cell_px = background_cell_px(dataset)
        cells = (-(-side_px // cell_px) for side_px in (dataset.intrinsics.h, dataset.intrinsics.w))
        image = np.zeros((*cells, len(spectrum)), np.float32)
    elif picture:
        image, cell_px = estimate_static_background(dataset, frames)
    k1, k2, p1, p2 = dataset.distortion.tolist()
    return Background(
        spectrum, None if image is None else torch.from_numpy(image), cell_px, dataset.intrinsics, (k1, k2, p1, p2)
    )


class Background(nn.Module):
    """A picture of the chamber, looked up by the rays' directions in the camera's frame, or one spectrum.

    Args:
        spectrum: reflectance behind rays without a camera (a viewer's), those that point backwards, and all rays
            where there is no picture.
        image: reflectance; None for none.
        cell_px: side of the picture's cells, pixels of the camera's image.
        intrinsics: intrinsics of the camera.
        distortion: k1, k2, p1, p2 (OpenCV).
    """

    image: Tensor | None
    spectrum: Tensor

    def __init__(
        self,
        spectrum: Float[Tensor, "bands"],
        image: Float[Tensor, "lines samples bands"] | None,
        cell_px: float,
        intrinsics: PinholeIntrinsics,
        distortion: tuple[float, float, float, float],
    ) -> None:
        super().__init__()
        self.cell_px = cell_px
        self.intrinsics = intrinsics
        self.distortion = distortion
        self.register_buffer("image", image)
        self.register_buffer("spectrum", spectrum)

    def forward(
        self, directions: Float[Tensor, "*rays 3"], rotations: Float[Tensor, "*rays 9"] | None
    ) -> Float[Tensor, "*rays bands"]:
        """Reflectance of the chamber behind rays.

        Args:
            directions: directions of the rays as measured, before the pose refinement.
            rotations: camera-to-world rotations as measured, row by row; None for rays without a camera.
        """
        if rotations is None or self.image is None:
            return self.spectrum.expand(*directions.shape[:-1], -1)
        pixels, forward = image_coordinates(in_camera_frame(directions, rotations), self.intrinsics, self.distortion)
        return torch.where(forward[..., None], interpolate_image(self.image, pixels / self.cell_px), self.spectrum)


def interpolate_image(
    image: Float[Tensor, "lines samples bands"], positions: Float[Tensor, "*rays 2"]
) -> Float[Tensor, "*rays bands"]:
    """Spectra of an image at positions (x, y; cells from its corner), bilinear between the cells' centres.

    Beyond the centres of the outermost cells, the image is continued by their values.
    """
    lines, samples, bands = image.shape
    # grid_sample counts from -1 to 1 from border to border.
    x, y = positions.reshape(1, 1, -1, 2).unbind(dim=-1)
    grid = torch.stack([2.0 * x / samples - 1.0, 2.0 * y / lines - 1.0], dim=-1)
    spectra = functional.grid_sample(
        image.permute(2, 0, 1)[None], grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return spectra[0, :, 0].T.reshape(*positions.shape[:-1], bands)
