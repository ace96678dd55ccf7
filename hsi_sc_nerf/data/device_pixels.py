"""Training pixels and rays looked up in tables: of rays on any device, of pixels in GPU memory.

A GPU trains a step in a few milliseconds. Reading some thousand pixels from files takes longer, and every transfer
makes processor and GPU wait for each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Int
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE
from hsi_sc_nerf.packed.dataset import PackedFrame
from hsi_sc_nerf.packed.pixels import PARTLY_FREE, beside_foreground

MAX_MEMORY_FRACTION = 0.5
"""Cubes are kept on a GPU if they fill at most this fraction of its free memory."""


def fits_on_gpu(frames: Sequence[PackedFrame], device: torch.device) -> bool:
    """Whether the frames' cubes fit into the free memory of the device; False for a device that is no GPU."""
    if device.type != "cuda" or not frames:
        return False
    free_bytes, _ = torch.cuda.mem_get_info(device)
    return len(frames) * frames[0].cube().nbytes <= MAX_MEMORY_FRACTION * free_bytes


class DevicePixels:
    """Spectra and masks of single pixels.

    Args:
        frames: whose packed cubes are copied to the device, as 16-bit numbers.
        masks: foreground of each frame.
        device: device of the copies.
        has_flagged: whether the cubes have values that are no measurements.
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
        self._partly_covered = torch.from_numpy(beside_foreground(masks, 1)).to(device)
        # PyTorch supports few operations on unsigned 16-bit integers; int16 holds the same bits.
        self._counts = torch.empty((*masks.shape, frames[0].cube().shape[2]), dtype=torch.int16, device=device)
        for held, frame in zip(self._counts, frames, strict=True):
            held.copy_(torch.from_numpy(np.array(frame.cube()).view(np.int16)))
        # A GPU multiplies by the reciprocal of a Python number, which rounds differently.
        self._scale = torch.tensor(float(REFLECTANCE_SCALE), device=device)

    def __call__(self, indices: Int[Tensor, "count 3"]) -> dict[str, Tensor]:
        """What `PixelSampler.at` gives for pixels (frame, line, sample), as tensors on the device."""
        frame, line, sample = indices.unbind(dim=-1)
        counts = self._counts[frame, line, sample].int().bitwise_and_(0xFFFF)
        mask, partial = (table[frame, line, sample, None] for table in (self._masks, self._partly_covered))
        free = torch.where(partial, PARTLY_FREE, 1.0) * ~mask
        batch = {"indices": indices, "mask": mask, "free": free}
        if not self.has_flagged:
            return batch | {"spectral": counts.float() / self._scale}
        valid = counts != FLAGGED
        return batch | {"spectral": counts.float() / self._scale * valid, "valid": valid}


class CameraRays:
    """Rays through pixel centres, equal to those of nerfstudio's `RayGenerator`, from a table.

    All frames are of one camera: its rays are computed once and rotated by each frame's pose. nerfstudio takes away
    the lens distortion of every batch anew, in a thousand small operations.

    Args:
        cameras: cameras of the frames, on the device.
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
        # A sum, because a GPU may compute a matrix product with fewer digits.
        directions = (poses[:, :, :3] * self._in_camera[line, sample][:, None]).sum(dim=-1)
        metadata = {key: value[frame] for key, value in self._metadata.items()}
        return RayBundle(
            origins=poses[:, :, 3],
            directions=directions,
            pixel_area=self._areas[line, sample],
            camera_indices=frame[:, None],
            metadata={"directions_norm": self._norms[line, sample], **metadata},
        )
