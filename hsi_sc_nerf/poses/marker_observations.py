"""Markers of all frames: detection, refinement, and a second search where the adjusted turntable expects them.

A frame may have several pictures (``SessionPictures``). The best one is searched, and the others where it shows few
markers.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import minimize_scalar

from hsi_sc_nerf.poses.marker_detection import Detections, detect_markers
from hsi_sc_nerf.poses.marker_fit import FittedMarker, fit_marker, quad_area
from hsi_sc_nerf.poses.result import RejectedMarker
from hsi_sc_nerf.poses.session_pictures import FramePictures, SessionPictures
from hsi_sc_nerf.poses.turntable import MarkerObservations, Turntable

# Frames that are searched at the same time: OpenCV and NumPy let other threads work meanwhile.
_WORKERS = 2
# The camera's blur that is tried, standard deviation in pixels, and on how many markers.
_BLURS_PX = (0.0, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0, 4.0)
_MARKERS_FOR_BLUR = 10
_BLUR_TOLERANCE_PX = 0.02
# A frame gets its own blur if its fits leave this many times the fraction of the variance that others leave, and this
# fraction.
_OUT_OF_FOCUS_MEDIANS = 2.0
_LEAST_OUT_OF_FOCUS = 0.01
# With fewer markers in its best picture, a frame's other pictures are searched too. Where more are seen, the adjusted
# turntable predicts the rest.
_FEW_MARKERS = 4
# An expected marker is searched for if its front faces the camera at least this much (cosine to its normal).
_STEEPEST_COSINE = 0.1
_FARTHEST_FROM_EXPECTED_PX = 1.0


@dataclass(frozen=True)
class Observed:
    """Markers of all frames, the blur of each frame's best picture, and markers whose pattern was not fitted."""

    observations: MarkerObservations
    blur_px: Float[np.ndarray, "frames"]
    unexplained: tuple[RejectedMarker, ...]


def observe_markers(images: Sequence[UInt8[np.ndarray, "h w"]], dictionary: str) -> Observed:
    """Detect and refine the markers of every frame."""
    session = SessionPictures.of(images)
    frames = session.frames
    with ThreadPoolExecutor(_WORKERS) as pool:
        detections = list(pool.map(lambda frame: _detect(frame, dictionary), frames))
        # A lens's blur depends on the wavelength: each picture has a blur of its own.
        names = sorted({name for found in detections for name in found})
        of_name = {name: [found.get(name, {}) for found in detections] for name in names}
        typical = {name: find_blur(session.named(name), dictionary, seen) for name, seen in of_name.items()}
        blurs_px = [{frame.ranking[0]: 0.0, **typical} for frame in frames]

        def refine(i: int) -> list[tuple[int, FittedMarker | None]]:
            fitted: dict[int, FittedMarker | None] = {}
            for name, found in detections[i].items():
                image = frames[i].picture(name).astype(float)
                for marker, corners in sorted(found.items()):
                    if fitted.get(marker) is None:
                        fitted[marker] = fit_marker(image, dictionary, marker, corners, blurs_px[i][name])
            return sorted(fitted.items())

        fitted = list(pool.map(refine, range(len(frames))))
    for i in _out_of_focus(fitted):
        for name, found in detections[i].items():
            blurs_px[i][name] = find_blur([frames[i].picture(name)], dictionary, [found])
        fitted[i] = refine(i)
    rows = [(i, m, fit) for i, found in enumerate(fitted) for m, fit in found if fit is not None]
    why = "hidden, blurred or misread, for the pattern does not explain the pixels"
    unexplained = tuple(
        RejectedMarker(i, m, None, why) for i, found in enumerate(fitted) for m, fit in found if fit is None
    )
    of_best = np.array([blur[frame.ranking[0]] for blur, frame in zip(blurs_px, frames, strict=True)])
    return Observed(_observations(rows), of_best, unexplained)


def _detect(frame: FramePictures, dictionary: str) -> dict[str, Detections]:
    """Markers by the picture's name, best picture first; the other pictures only where it shows few."""
    found: dict[str, Detections] = {}
    for name in frame.ranking:
        found[name] = detect_markers(frame.picture(name), dictionary)
        if len(found) == 1 and len(found[name]) >= _FEW_MARKERS:
            break
    return {name: seen for name, seen in found.items() if seen}


def _out_of_focus(fitted: Sequence[Sequence[tuple[int, FittedMarker | None]]]) -> list[int]:
    """Frames whose patterns explain their pixels far worse than the other frames' do."""
    left = [[1.0 if fit is None else fit.unexplained for _, fit in found] for found in fitted]
    of_frame = np.array([np.median(fractions) if fractions else np.nan for fractions in left])
    if np.isnan(of_frame).all():
        return []
    limit = max(_OUT_OF_FOCUS_MEDIANS * float(np.nanmedian(of_frame)), _LEAST_OUT_OF_FOCUS)
    return np.flatnonzero(of_frame > limit).tolist()


def find_blur(images: Sequence[UInt8[np.ndarray, "h w"]], dictionary: str, detections: Sequence[Detections]) -> float:
    """Standard deviation of the blur, in pixels, with which the largest markers' patterns fit their pixels best.

    The median over the markers is minimised: a few may be hidden, or in frames with another blur.
    """
    seen = [(i, m, c) for i, found in enumerate(detections) for m, c in sorted(found.items())]
    seen.sort(key=lambda s: -quad_area(s[2]))
    # Spread over the larger half: neighbours in size are often the same marker in neighbouring frames.
    seen = seen[: max(_MARKERS_FOR_BLUR, len(seen) // 2)]
    seen = seen[:: max(1, len(seen) // _MARKERS_FOR_BLUR)][:_MARKERS_FOR_BLUR]
    if not seen:
        return 0.0

    def unexplained(blur_px: float, i: int, marker: int, corners: Float[np.ndarray, "4 2"]) -> float:
        fitted = fit_marker(images[i].astype(float), dictionary, marker, corners, blur_px)
        return 1.0 if fitted is None else fitted.unexplained

    def left(blur_px: float) -> float:
        with ThreadPoolExecutor(_WORKERS) as pool:
            return float(np.median(list(pool.map(lambda s: unexplained(blur_px, *s), seen))))

    tried = [left(_BLURS_PX[0])]
    while len(tried) < len(_BLURS_PX) and (len(tried) < 3 or tried[-1] <= tried[-2]):
        tried.append(left(_BLURS_PX[len(tried)]))
    k = int(np.argmin(tried))
    if not 0 < k < len(tried) - 1:
        return _BLURS_PX[k]
    bracket = (_BLURS_PX[k - 1], _BLURS_PX[k + 1])
    return float(minimize_scalar(left, bounds=bracket, method="bounded", options={"xatol": _BLUR_TOLERANCE_PX}).x)


def observe_expected(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    dictionary: str,
    turntable: Turntable,
    seen: MarkerObservations,
    blur_px: Float[np.ndarray, "frames"],
) -> MarkerObservations:
    """Markers that were not detected, fitted where the turntable expects them, appended to the seen ones.

    Args:
        images: images of all frames; of ``SessionPictures`` the best ones.
    """
    have = set(zip(seen.frame.tolist(), seen.marker.tolist(), strict=True))
    missing = [pair for pair in _facing(turntable) if pair not in have]
    if not missing:
        return seen
    frame, marker = np.array(missing).T
    blank = MarkerObservations(frame, marker, np.zeros((len(frame), 4, 2)), np.zeros((len(frame), 8, 8)))

    def fit(pair: tuple[int, int], corners_px: Float[np.ndarray, "4 2"]) -> FittedMarker | None:
        i, marker = pair
        image, blur = images[i].astype(float), float(blur_px[i])
        return fit_marker(image, dictionary, marker, corners_px, blur, _FARTHEST_FROM_EXPECTED_PX)

    with ThreadPoolExecutor(_WORKERS) as pool:
        fitted = zip(missing, pool.map(fit, missing, turntable.reproject(blank)), strict=True)
        return seen.append(_observations([(*pair, found) for pair, found in fitted if found is not None]))


def _facing(turntable: Turntable) -> list[tuple[int, int]]:
    """Pairs of frame and marker where the marker's front faces the camera."""
    centres, normals = turntable.marker_poses[:, :3, 3], turntable.marker_poses[:, :3, 2]
    view = turntable.camera_positions()[:, None] - centres
    cosine = (view * normals).sum(-1) / np.linalg.norm(view, axis=-1)
    frame, marker = np.nonzero(cosine > _STEEPEST_COSINE)
    return list(zip(turntable.frames[frame].tolist(), turntable.markers[marker].tolist(), strict=True))


def _observations(rows: list[tuple[int, int, FittedMarker]]) -> MarkerObservations:
    return MarkerObservations(
        np.array([i for i, _, _ in rows], dtype=int),
        np.array([m for _, m, _ in rows], dtype=int),
        np.array([f.corners_px for _, _, f in rows]).reshape(-1, 4, 2),
        np.array([f.covariance_px2 for _, _, f in rows]).reshape(-1, 8, 8),
    )
