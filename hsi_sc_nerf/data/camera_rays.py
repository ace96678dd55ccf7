"""Rays through pixels: one through the centre, or four through the quarters of a pixel on the object's outline.

Such a pixel shows the object and what is behind it, each by the area that it covers. One ray sees either.
"""

from __future__ import annotations

from functools import cached_property

import torch
from jaxtyping import Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor

QUARTERS = 4
"""Rays through a pixel that is supersampled."""
_LINES = 16
"""Lines of the image whose rays are computed at once: nerfstudio needs a kilobyte for a ray."""
_OFFSETS_PX = ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25))
"""Centres of the quarters (line, sample) beside the pixel's."""


class CameraRays:
    """Rays from a table; those through pixel centres equal nerfstudio's `RayGenerator`'s.

    All frames are of one camera: its rays are computed once and rotated by each frame's pose. nerfstudio takes away
    the lens distortion of every batch anew, in a thousand small operations.

    Args:
        cameras: cameras of the frames, on the device.
    """

    def __init__(self, cameras: Cameras) -> None:
        self._camera = cameras[:1]
        self._poses = cameras.camera_to_worlds.clone()
        self._metadata = {key: value.clone() for key, value in (cameras.metadata or {}).items()}
        self._centres = _table(self._camera.generate_rays(camera_indices=0), self._camera)

    @cached_property
    def _quarters(self) -> list[Tensor]:
        """As `_centres`, through the quarters: four times as large, and only training asks for it."""
        lines, samples = self._centres[0].shape[:2]
        pixels = torch.cartesian_prod(torch.arange(lines), torch.arange(samples)).view(lines, samples, 2)
        blocks = [_table(rays_through_quarters(self._camera, some), self._camera) for some in pixels.split(_LINES)]
        return [torch.cat(parts) for parts in zip(*blocks, strict=True)]

    def __call__(self, pixels: Int[Tensor, "count 3"], quartered: int = 0) -> RayBundle:
        """Rays of pixels (frame, line, sample).

        Args:
            pixels: the pixels, on any device.
            quartered: how many of them, the last, have `QUARTERS` rays each, one after the other.
        """
        frame, line, sample = pixels.to(self._poses.device).unbind(dim=-1)
        first = len(pixels) - quartered
        found = [table[line[:first], sample[:first]] for table in self._centres]
        if quartered > 0:
            four = (table[line[first:], sample[first:]].flatten(0, 1) for table in self._quarters)
            found = [torch.cat(both) for both in zip(found, four, strict=True)]
            frame = torch.cat([frame[:first], frame[first:, None].expand(-1, QUARTERS).flatten()])
        in_camera, areas, norms = found
        poses = self._poses[frame]
        # A sum, because a GPU may compute a matrix product with fewer digits.
        directions = (poses[:, :, :3] * in_camera[:, None]).sum(dim=-1)
        metadata = {key: value[frame] for key, value in self._metadata.items()}
        return RayBundle(
            origins=poses[:, :, 3],
            directions=directions,
            pixel_area=areas,
            camera_indices=frame[:, None],
            metadata={"directions_norm": norms, **metadata},
        )


def rays_through_quarters(
    cameras: Cameras, pixels: Int[Tensor, "*count 2"], obb_box: OrientedBox | None = None
) -> RayBundle:
    """Rays (*count, `QUARTERS`) of the first camera through the quarters of pixels (line, sample).

    Args:
        cameras: of the rays.
        pixels: any number of them, in any shape.
        obb_box: to which nerfstudio bounds the rays.
    """
    offsets_px = torch.tensor(_OFFSETS_PX, device=pixels.device)
    coords = (pixels[..., None, :] + 0.5 + offsets_px).to(cameras.device)
    return cameras.generate_rays(camera_indices=0, coords=coords, obb_box=obb_box)


def _table(rays: RayBundle, camera: Cameras) -> list[Tensor]:
    """Directions in the camera's frame, areas and norms of its rays."""
    assert rays.metadata is not None
    to_camera = camera.camera_to_worlds[0, :, :3]  # R^T d
    return [rays.directions @ to_camera, rays.pixel_area, rays.metadata["directions_norm"]]
