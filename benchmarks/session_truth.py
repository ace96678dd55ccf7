"""What is known of a path-traced or a simulated session."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hsi_sc_nerf.simulate.truth import load_truth


@dataclass(frozen=True)
class SessionTruth:
    """Of a path-traced or a simulated session."""

    poses: dict[str, np.ndarray]
    focal_px: float
    wavelengths_nm: np.ndarray
    drift: dict[str, np.ndarray]
    """Light of the lamps in each band, by capture."""
    coverage: Callable[[str], np.ndarray]
    """Fraction of each pixel (h, w) that the object covers, of a capture."""

    @classmethod
    def of(cls, session: Path) -> SessionTruth:
        """Read the truth beside a session."""
        masks = session / "truth" / "masks.npz"
        if masks.is_file():
            values = json.loads((session / "truth" / "truth.json").read_text(encoding="utf-8"))
            coverage = dict(np.load(masks))
            return cls(
                {frame["capture"]: np.array(frame["camera_to_world"]) for frame in values["frames"]},
                values["intrinsics"]["fl_x"],
                np.array(values["wavelengths_nm"]),
                {frame["capture"]: np.array(frame["drift"]) for frame in values["frames"]},
                lambda capture: coverage[capture],
            )
        truth = load_truth(session)
        # Without lamps that change there are no factors.
        even = np.ones(len(truth.wavelengths_nm))
        lamps = {
            name: np.prod([even, *(f[0, 0] for f in truth.light(name).illumination)], axis=0)
            for name in truth.captures
        }
        poses = dict(zip(truth.captures, truth.camera_to_world, strict=True))
        return cls(poses, truth.intrinsics.fl_x, truth.wavelengths_nm, lamps, truth.object_coverage)
