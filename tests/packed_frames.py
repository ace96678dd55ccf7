"""A frame of a packed dataset whose files lie where `process` puts them."""

from pathlib import Path

import numpy as np

from hsi_sc_nerf.packed.dataset import PackedFrame


def packed_frame(root: Path, capture: str, camera_to_world: np.ndarray | None = None, **known) -> PackedFrame:
    """The files need not be there."""
    return PackedFrame(
        capture=capture,
        image_path=root / "images" / f"{capture}.png",
        mask_path=root / "masks" / f"{capture}.png",
        cube_path=root / "cubes" / f"{capture}.hdr",
        flags_path=root / "flags" / f"{capture}.png",
        camera_to_world=np.eye(4) if camera_to_world is None else camera_to_world,
        **{"angle_deg": 0.0, "reprojection_error_px": None, **known},
    )
