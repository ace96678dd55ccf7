"""Let torch's safe loader read nerfstudio's checkpoints."""

from __future__ import annotations

import numpy as np
import torch


def allow_nerfstudio_checkpoints() -> None:
    """Name the NumPy types that nerfstudio 1.1.5 puts into its checkpoints as safe.

    Since torch 2.6 ``torch.load`` refuses what it does not know, and ns-eval, ns-export and ns-viewer fail on
    nerfstudio's own files. Allowing these few types keeps the safe loader on.
    """
    torch.serialization.add_safe_globals(
        [np._core.multiarray.scalar, np.dtype, *(type(np.dtype(t)) for t in (np.float32, np.float64, np.int64))]
    )
