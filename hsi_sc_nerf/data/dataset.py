"""nerfstudio dataset: pseudo-RGB and mask as every method expects them, and the reflectance cube beside them."""

from __future__ import annotations

import torch
from nerfstudio.data.datasets.base_dataset import InputDataset

from hsi_sc_nerf.packed.cube import unpack, unpack_unflagged
from hsi_sc_nerf.packed.dataset import PackedFrame


class SpectralDataset(InputDataset):
    """Frames of a packed dataset.

    An item holds ``spectral`` (lines, samples, bands) beside ``image`` and ``mask`` and, where the dataset has
    flagged values, ``valid`` (likewise, bool): which of them were measured.
    """

    @property
    def frames(self) -> list[PackedFrame]:
        """The frames, in the cameras' order."""
        return self._dataparser_outputs.metadata["frames"]

    @property
    def has_flagged(self) -> bool:
        """Whether some of the dataset's values are no measurements."""
        return self._dataparser_outputs.metadata["flagged_values"] > 0

    def get_metadata(self, data: dict) -> dict:
        """The reflectance cube of the item."""
        counts = self.frames[data["image_idx"]].cube()
        if not self.has_flagged:
            return {"spectral": torch.from_numpy(unpack_unflagged(counts))}
        reflectance, valid = unpack(counts)
        return {"spectral": torch.from_numpy(reflectance), "valid": torch.from_numpy(valid)}
