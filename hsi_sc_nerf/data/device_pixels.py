"""Training pixels looked up in GPU memory.

A GPU trains a step in a few milliseconds. Reading some thousand pixels from files takes longer, and every transfer
makes processor and GPU wait for each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from hsi_sc_nerf.morphology import beside
from hsi_sc_nerf.packed.cube import FLAGGED, REFLECTANCE_SCALE
from hsi_sc_nerf.packed.dataset import PackedFrame

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
        self._partly_covered = torch.from_numpy(np.stack([beside(mask, 1) for mask in masks])).to(device)
        # PyTorch supports few operations on unsigned 16-bit integers; int16 holds the same bits.
        self._counts = torch.empty((*masks.shape, frames[0].cube().shape[2]), dtype=torch.int16, device=device)
        for held, frame in zip(self._counts, frames, strict=True):
            held.copy_(torch.from_numpy(frame.cube().astype(np.uint16).view(np.int16)))
        # A GPU multiplies by the reciprocal of a Python number, which rounds differently.
        self._scale = torch.tensor(float(REFLECTANCE_SCALE), device=device)

    def __call__(self, indices: Int[Tensor, "count 3"]) -> dict[str, Tensor]:
        """What `PixelSampler.at` gives for pixels (frame, line, sample), as tensors on the device."""
        frame, line, sample = indices.unbind(dim=-1)
        counts = self._counts[frame, line, sample].int().bitwise_and_(0xFFFF)
        mask, partial = (table[frame, line, sample, None] for table in (self._masks, self._partly_covered))
        batch = {"indices": indices, "mask": mask, "free": ~(mask | partial)}
        if not self.has_flagged:
            return batch | {"spectral": counts.float() / self._scale}
        valid = counts != FLAGGED
        return batch | {"spectral": counts.float() / self._scale * valid, "valid": valid}
