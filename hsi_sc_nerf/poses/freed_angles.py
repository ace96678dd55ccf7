"""Where COLMAP's mapping fails: poses from features that start at the turntable's nominal angles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.poses.from_features import FeatureConfig, Images, Known, poses_by_angles
from hsi_sc_nerf.poses.result import TurntablePoses


def poses_by_freed_angles(
    images: Images,
    names: Sequence[str],
    angles_deg: Float[np.ndarray, "n"],
    known: Known,
    config: FeatureConfig,
) -> TurntablePoses:
    """Poses from features alone; the angles that are given are where each frame's angle starts, no more.

    A turntable whose steps are uneven by a degree is within reach; steps that are wrong by more let the features
    contradict the angles, and nothing is guessed.

    Args:
        images: one gray image a frame.
        names: the frames' names.
        angles_deg: of each frame, relative to the first; positive counter-clockwise where the direction is known.
        known: what else is known.
        config: settings.

    Raises:
        InputError: too little texture, or features that contradict the angles.
    """
    return poses_by_angles(images, names, angles_deg, known, config, free_angles=True)
