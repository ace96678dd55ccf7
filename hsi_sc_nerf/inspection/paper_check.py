"""Is reflectance of the right size? The markers' paper tells: it is white, whatever the object is."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.calibration.white_source import exposure_ratio, read_panel
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.findings import Finding, Level
from hsi_sc_nerf.inspection.quicklook import PICTURE_NM, Quicklook
from hsi_sc_nerf.poses.marker_detection import Detections
from hsi_sc_nerf.spectra import nearest_bands

PAPER_PERCENTILE = 85.0
"""About half of a marker is white, some of it blurred with black."""
LEAST_SIDE_PX = 10.0
"""Of smaller markers no pixel shows paper alone."""
USUAL, POSSIBLE = (0.3, 1.15), (0.1, 2.0)
"""Ranges of the paper's reflectance: paper that lies before lamps from above has 0.4 to 1, in shade less."""


def check_paper(session: Session, quicklooks: Sequence[Quicklook], detections: Sequence[Detections]) -> list[Finding]:
    """The finding ``paper`` where the session's white is a tarp and its markers are large enough.

    Args:
        session: the session.
        quicklooks: of its frames.
        detections: markers of each frame.
    """
    if session.white is None or not session.has_counts:
        return []
    panel = 1.0
    if session.panel_reflectance_path is not None:
        of_panel = read_panel(session.panel_reflectance_path, session.wavelengths_nm)
        panel = float(of_panel[nearest_bands(session.wavelengths_nm, PICTURE_NM)].mean())
    found = []
    for frame, quicklook, seen in zip(session.frames, quicklooks, detections, strict=True):
        picture = panel * exposure_ratio(session.white, frame) * quicklook.picture.mean(axis=-1)
        found += [
            paper_brightness(picture, corners)
            for corners in seen.values()
            if np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).min() >= LEAST_SIDE_PX
        ]
    if not found:
        return []
    paper = float(np.median(found))
    values = {"reflectance": paper, "markers": len(found)}
    text = f"the markers' white paper has a reflectance of {paper:.2g}"
    if USUAL[0] <= paper <= USUAL[1]:
        return [Finding("paper", "green", f"Paper: {text}.", values)]
    level: Level = "amber" if POSSIBLE[0] <= paper <= POSSIBLE[1] else "red"
    sentence = (
        f"{session.path}: {text}, so that all reflectances are probably too {'low' if paper < 1.0 else 'high'}; "
        "check that the white is white (else name its panel_reflectance), in the frames' light, and of the "
        "integration time that its header states."
    )
    return [Finding("paper", level, sentence, values)]


def paper_brightness(picture: Float[np.ndarray, "h w"], corners_px: Float[np.ndarray, "4 2"]) -> float:
    """Brightness of a marker's white cells."""
    inside = np.zeros(picture.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.floor(corners_px).astype(np.int32), 1)
    return float(np.percentile(picture[inside > 0], PAPER_PERCENTILE))
