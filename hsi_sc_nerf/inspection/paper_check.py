"""Checks of the reflectance on the markers: their paper and ink have a known range, whatever the object is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.calibration.white_source import WhiteSource, white_source
from hsi_sc_nerf.capture.session import Session
from hsi_sc_nerf.findings import Finding, Level, judged
from hsi_sc_nerf.inspection.quicklook import Quicklook
from hsi_sc_nerf.poses.marker_detection import Detections

PAPER_PERCENTILE = 85.0
"""About half of a marker is white, some of it blurred with black."""
LEAST_SIDE_PX = 10.0
"""In smaller markers, no pixel shows paper alone."""
USUAL, POSSIBLE = (0.3, 1.15), (0.1, 2.0)
"""Ranges of the paper's reflectance: 0.4 to 1 under lamps from above, less in shade."""
INK_PERCENTILE, BLACKEST_MARKERS = 2.0, 25.0
"""Blur brightens black cells, most of all single ones and those of small markers."""
VEIL_AMBER, VEIL_RED = 0.15, 0.2
"""Brightness of the ink relative to the paper; 0.04 to 0.1 for printed black."""


def check_paper(
    session: Session,
    quicklooks: Sequence[Quicklook],
    detections: Sequence[Detections],
    source: Literal["auto"] | WhiteSource = "auto",
) -> list[Finding]:
    """The findings ``paper``, where the session's white is a tarp, and ``veil``, where markers are large enough.

    Args:
        quicklooks: quicklooks of its frames.
        detections: markers of each frame.
        source: where the white is.
    """
    if not session.has_counts:
        return []
    found = []
    for quicklook, seen in zip(quicklooks, detections, strict=True):
        picture = quicklook.picture.mean(axis=-1)
        found += [
            ink_and_paper(picture, corners)
            for corners in seen.values()
            if np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).min() >= LEAST_SIDE_PX
        ]
    if not found:
        return []
    ink, paper = np.array(found).T
    is_tarp = white_source(session, source) == "tarp"
    of_paper = [] if not is_tarp else [_of_paper(session, float(np.median(paper)), len(found))]
    # In few and distant markers, blur matters more than stray light.
    if len(found) < len(session.frames):
        return of_paper
    ratio = float(np.percentile(ink / np.maximum(paper, 1e-6), BLACKEST_MARKERS))
    return [*of_paper, _veil(session, ratio, len(found))]


def _of_paper(session: Session, paper: float, markers: int) -> Finding:
    values = {"reflectance": paper, "markers": markers}
    text = f"the markers' white paper has a reflectance of {paper:.2g}"
    if USUAL[0] <= paper <= USUAL[1]:
        return Finding("paper", "green", f"Paper: {text}.", values)
    level: Level = "amber" if POSSIBLE[0] <= paper <= POSSIBLE[1] else "red"
    sentence = (
        f"{session.path}: {text}, so all reflectances are probably too {'low' if paper < 1.0 else 'high'}; check "
        "that the white is white (otherwise give its panel_reflectance), that it was taken under the frames' light, "
        "and that its header states the right integration time."
    )
    return Finding("paper", level, sentence, values)


def _veil(session: Session, ink: float, markers: int) -> Finding:
    sentence = f"{session.path}: the markers' black is {100.0 * ink:.0f} % as bright as their white"
    advice = (
        "stray light lies over the frames and adds to every reflectance (a lamp in view, a dirty lens or window, an "
        "open chamber), unless the print is grey or blurred; shade the lens, or print the markers again"
    )
    finding = judged("veil", ink, (VEIL_AMBER, VEIL_RED), sentence, advice)
    return replace(finding, values={**finding.values, "markers": markers})


def ink_and_paper(picture: Float[np.ndarray, "h w"], corners_px: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "2"]:
    """Brightness of a marker's black and of its white cells."""
    inside = np.zeros(picture.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.floor(corners_px).astype(np.int32), 1)
    return np.percentile(picture[inside > 0], [INK_PERCENTILE, PAPER_PERCENTILE])
