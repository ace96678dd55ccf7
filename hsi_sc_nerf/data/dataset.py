"""nerfstudio dataset: pseudo-RGB and mask as every method expects them, and the reflectance cube beside them."""

from __future__ import annotations

import numpy as np
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset

from hsi_sc_nerf.data.packed import REFLECTANCE_SCALE, PackedFrame


class SpectralDataset(InputDataset):
    """Frames of a packed dataset; an item holds ``spectral`` (lines, samples, bands) beside ``image``, ``mask``."""

    @property
    def frames(self) -> list[PackedFrame]:
        """The frames, in the cameras' order."""
        return self._dataparser_outputs.metadata["frames"]

    def get_metadata(self, data: dict) -> dict:
        """The reflectance cube of the item."""
        counts = self.frames[data["image_idx"]].cube()
        return {"spectral": torch.from_numpy(counts.astype(np.float32)).div_(REFLECTANCE_SCALE)}
