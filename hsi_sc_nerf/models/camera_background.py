"""The chamber behind the turntable: a picture that stands still in the camera's frame, looked up by rays.

The object turns and the camera does not, so that what the object lets through is at the same place of every frame.
In the object's frame, in which the field lives, it goes round with the camera: no field of the object can hold it.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from hsi_sc_nerf.poses.geometry import PinholeIntrinsics

CORRECTION_CELLS = 32
"""Cells of a learned correction along the picture's longer side. A step of Adam visits every value, hit by a ray or
not: on one core 40 ms for 128 x 128 cells of 204 bands, 1 ms for 32 x 32."""
_LOGIT_MARGIN = 1e-3
"""Reflectance of a learned background keeps this far from 0 and 1, where a sigmoid has no slope."""


def in_camera_frame(
    directions: Float[Tensor, "*rays 3"], rotations: Float[Tensor, "*rays 9"]
) -> Float[Tensor, "*rays 3"]:
    """Directions in the camera's axes, ``R^T d``; rotations are camera-to-world, row by row.

    A sum, not a product of matrices: automatic mixed precision would halve the latter's digits, and with them the
    picture's sharpness.
    """
    return (rotations.unflatten(-1, (3, 3)) * directions[..., :, None]).sum(dim=-2)


def image_coordinates(
    directions: Float[Tensor, "*rays 3"], intrinsics: PinholeIntrinsics, distortion: tuple[float, float, float, float]
) -> tuple[Float[Tensor, "*rays 2"], Bool[Tensor, "*rays"]]:
    """Pixel coordinates (x, y; from the image's corner) of directions in the camera's frame, OpenGL axes.

    Lens distortion is OpenCV's (k1, k2, p1, p2). It is a polynomial that holds within the image; directions far
    outside it may land anywhere.

    Returns:
        The coordinates, and which directions look forward; the coordinates of the others mean nothing.
    """
    forward = directions[..., 2] < 0.0
    depth = torch.where(forward, -directions[..., 2], 1.0)
    x, y = directions[..., 0] / depth, -directions[..., 1] / depth
    k1, k2, p1, p2 = distortion
    squared = x * x + y * y
    radial = 1.0 + squared * (k1 + squared * k2)
    distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
    distorted_y = y * radial + 2.0 * p2 * x * y + p1 * (squared + 2.0 * y * y)
    pixels = [intrinsics.fl_x * distorted_x + intrinsics.cx, intrinsics.fl_y * distorted_y + intrinsics.cy]
    return torch.stack(pixels, dim=-1), forward


def bilinear(
    image: Float[Tensor, "lines samples bands"], places: Float[Tensor, "*rays 2"]
) -> Float[Tensor, "*rays bands"]:
    """Spectra of an image at places (x, y) in cells from its corner, bilinear between the cells' centres.

    Beyond the centres of the outermost cells it goes on as it is there.
    """
    lines, samples, bands = image.shape
    # grid_sample counts from -1 to 1 from border to border.
    x, y = places.reshape(1, 1, -1, 2).unbind(dim=-1)
    grid = torch.stack([2.0 * x / samples - 1.0, 2.0 * y / lines - 1.0], dim=-1)
    spectra = functional.grid_sample(
        image.permute(2, 0, 1)[None], grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return spectra[0, :, 0].T.reshape(*places.shape[:-1], bands)


class CameraBackground(nn.Module):
    """The chamber's spectrum behind a ray, from the ray's direction in the camera's frame.

    A learned background is the sigmoid of the picture's logit plus a coarser correction (`CORRECTION_CELLS`), which
    starts at 0: it stays within 0 and 1, begins as the picture, and keeps the picture's detail.

    Args:
        image: the chamber's picture, reflectance.
        cell_px: side of the picture's cells, pixels of the camera's image.
        intrinsics: of the camera.
        distortion: k1, k2, p1, p2 (OpenCV).
        spectrum: what rays see that belong to no camera before the turntable (a viewer's), or look backwards.
        learnable: whether there is a correction to learn.
    """

    image: Tensor
    spectrum: Tensor

    def __init__(
        self,
        image: Float[Tensor, "lines samples bands"],
        cell_px: float,
        intrinsics: PinholeIntrinsics,
        distortion: tuple[float, float, float, float],
        spectrum: Float[Tensor, "bands"],
        learnable: bool = False,
    ) -> None:
        super().__init__()
        self.cell_px = cell_px
        self.intrinsics = intrinsics
        self.distortion = distortion
        self.register_buffer("image", image)
        self.register_buffer("spectrum", spectrum)
        self.correction: nn.Parameter | None = None
        if learnable:
            lines, samples, bands = image.shape
            self._cells_per_correction = max(1.0, max(lines, samples) / CORRECTION_CELLS)
            size = (-(-side // self._cells_per_correction) for side in (lines, samples))
            self.correction = nn.Parameter(torch.zeros(*map(int, size), bands))

    def forward(
        self, directions: Float[Tensor, "*rays 3"], rotations: Float[Tensor, "*rays 9"] | None
    ) -> Float[Tensor, "*rays bands"]:
        """Reflectance of the chamber behind rays.

        Args:
            directions: of the rays, as measured: before any refinement of the poses has turned them.
            rotations: camera-to-world rotations of the rays as measured, row by row; None for rays that carry none.
        """
        if rotations is None:
            return self.spectrum.expand(*directions.shape[:-1], -1)
        pixels, forward = image_coordinates(in_camera_frame(directions, rotations), self.intrinsics, self.distortion)
        places = pixels / self.cell_px
        spectra = bilinear(self.image, places)
        if self.correction is not None:
            logit = torch.logit(spectra, eps=_LOGIT_MARGIN)
            spectra = torch.sigmoid(logit + bilinear(self.correction, places / self._cells_per_correction))
        return torch.where(forward[..., None], spectra, self.spectrum)
