"""Training pixels from memory of the device: cubes, masks and rays stay there, and a batch is looked up in them.

A GPU takes a few milliseconds for a step. Reading some thousand pixels from files takes longer than that, and every
transfer makes the two wait for each other: here a batch is the places of its pixels, and all else is on the device.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from hsi_sc_nerf.data.packed import PackedFrame
from hsi_sc_nerf.data.packed_cube import FLAGGED, REFLECTANCE_SCALE

SHARE_OF_FREE_MEMORY = 0.5
"""Cubes are kept on a GPU where they take no more than this of what is free there."""


def fits_on_gpu(frames: Sequence[PackedFrame], device: torch.device) -> bool:
    """Whether frames' cubes can be kept on the device; never where that is no GPU."""
    if device.type != "cuda" or not frames:
        return False
    free_bytes, _ = torch.cuda.mem_get_info(device)
    return len(frames) * frames[0].cube().nbytes <= SHARE_OF_FREE_MEMORY * free_bytes


class DevicePixels:
    """Spectra and masks of single pixels.

    Args:
        frames: whose packed cubes are copied to the device, as 16-bit numbers.
        masks: foreground of each frame.
        device: where to.
        has_flagged: whether the cubes hold values that are no measurements.
    """

    def __init__(
        self,
        frames: Sequence[PackedFrame],
        masks: Bool[np.ndarray, "frames lines samples"],
        device: torch.device | str,
        *,
        has_flagged: bool,
    ) -> None:
        self.has_flagged = has_flagged
        self._masks = torch.from_numpy(masks).to(device)
        # PyTorch can hardly compute with unsigned 16-bit numbers: these are the same bits.
        self._counts = torch.empty((*masks.shape, frames[0].cube().shape[2]), dtype=torch.int16, device=device)
        for held, frame in zip(self._counts, frames, strict=True):
            held.copy_(torch.from_numpy(np.array(frame.cube()).view(np.int16)))
        # A number would be multiplied by its reciprocal on a GPU, which rounds otherwise.
        self._scale = torch.tensor(float(REFLECTANCE_SCALE), device=device)

    def __call__(self, indices: Int[Tensor, "count 3"]) -> dict[str, Tensor]:
        """What `PixelSampler.at` gives for pixels (frame, line, sample), as tensors on the device."""
        frame, line, sample = indices.unbind(dim=-1)
        counts = self._counts[frame, line, sample].int().bitwise_and_(0xFFFF)
        batch = {"indices": indices, "mask": self._masks[frame, line, sample, None]}
        if not self.has_flagged:
            return batch | {"spectral": counts.float() / self._scale}
        valid = counts != FLAGGED
        return batch | {"spectral": counts.float() / self._scale * valid, "valid": valid}


class CameraRays:
    """Rays through the centres of pixels, as nerfstudio's `RayGenerator` makes them, from a table.

    All frames were taken by one camera: its rays are computed once, and turned by each frame's pose.

    Args:
        cameras: of the frames, on the device.
    """

    def __init__(self, cameras: Cameras) -> None:
        first = cameras.generate_rays(camera_indices=0)
        assert first.metadata is not None
        self._poses = cameras.camera_to_worlds.clone()
        self._metadata = {key: value.clone() for key, value in (cameras.metadata or {}).items()}
        self._in_camera = first.directions @ self._poses[0, :, :3]  # R^T d
        self._areas, self._norms = first.pixel_area, first.metadata["directions_norm"]

    def __call__(self, indices: Int[Tensor, "count 3"]) -> RayBundle:
        """Rays of pixels (frame, line, sample)."""
        frame, line, sample = indices.unbind(dim=-1)
        poses = self._poses[frame]
        # A sum, not a product of matrices, which a GPU may round to fewer digits.
        directions = (poses[:, :, :3] * self._in_camera[line, sample][:, None]).sum(dim=-1)
        metadata = {key: value[frame] for key, value in self._metadata.items()}
        return RayBundle(
            origins=poses[:, :, 3],
            directions=directions,
            pixel_area=self._areas[line, sample],
            camera_indices=frame[:, None],
            metadata={"directions_norm": self._norms[line, sample], **metadata},
        )
