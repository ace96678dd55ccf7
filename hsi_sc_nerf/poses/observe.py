"""All markers of all frames: detection, refinement, and a second look where the adjusted turntable expects them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from rich.progress import track
from scipy.optimize import minimize_scalar

from hsi_sc_nerf.poses.adjust import reproject
from hsi_sc_nerf.poses.fit import FittedMarker, fit_marker, quad_area
from hsi_sc_nerf.poses.frame import layout
from hsi_sc_nerf.poses.initialise import Observations, Turntable
from hsi_sc_nerf.poses.markers import Detections, detect_markers

# The camera's blur that is tried, standard deviation in pixels, and on how many markers.
_BLURS_PX = (0.0, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.7)
_MARKERS_TO_TELL_THE_BLUR = 10
_BLUR_TOLERANCE_PX = 0.02
# A marker that the adjustment expects is looked for if it is seen at least this steeply (cosine to its normal).
_STEEPEST_COSINE = 0.1
_FARTHEST_FROM_EXPECTED_PX = 1.0


def observe(
    images: Sequence[UInt8[np.ndarray, "h w"]], dictionary: str, progress: bool
) -> tuple[Observations, float]:
    """Detect and refine the markers of every frame; also returns the blur that explains them best, in pixels."""
    detections = [
        detect_markers(image, dictionary)
        for image in track(images, "Finding markers", disable=not progress, transient=True)
    ]
    blur_px = find_blur(images, dictionary, detections)
    rows = []
    for i, found in enumerate(track(detections, "Refining corners", disable=not progress, transient=True)):
        image = images[i].astype(float)
        for marker, corners in sorted(found.items()):
            fitted = fit_marker(image, dictionary, marker, corners, blur_px)
            if fitted is not None:
                rows.append((i, marker, fitted))
    return _observations(rows), blur_px


def find_blur(images: Sequence[UInt8[np.ndarray, "h w"]], dictionary: str, detections: Sequence[Detections]) -> float:
    """Standard deviation of the blur, in pixels, with which the largest markers' patterns fit their pixels best."""
    seen = [(i, m, c) for i, found in enumerate(detections) for m, c in sorted(found.items())]
    seen.sort(key=lambda s: -quad_area(s[2]))
    # Spread over the larger half: neighbours in size are often the same marker in neighbouring frames.
    seen = seen[: max(_MARKERS_TO_TELL_THE_BLUR, len(seen) // 2)]
    seen = seen[:: max(1, len(seen) // _MARKERS_TO_TELL_THE_BLUR)][:_MARKERS_TO_TELL_THE_BLUR]
    if not seen:
        return 0.0

    def left(blur_px: float) -> float:
        fits = [fit_marker(images[i].astype(float), dictionary, m, c, blur_px) for i, m, c in seen]
        return float(np.mean([1.0 if f is None else f.unexplained for f in fits]))

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
    seen: Observations,
    centre_px: tuple[float, float],
    side_m: float,
    blur_px: float,
) -> Observations:
    """Markers that were not detected, fitted where the turntable expects them, appended to the seen ones."""
    have = set(zip(seen.frame.tolist(), seen.marker.tolist(), strict=True))
    expected = [pair for pair in _facing(turntable, side_m) if pair not in have]
    if not expected:
        return seen
    frame, marker = np.array(expected).T
    blank = Observations(frame, marker, np.zeros((len(frame), 4, 2)), np.zeros((len(frame), 8, 8)))
    corners = reproject(turntable, blank, centre_px, side_m)
    rows = []
    for i, m, start in zip(frame.tolist(), marker.tolist(), corners, strict=True):
        fitted = fit_marker(
            images[i].astype(float), dictionary, m, start, blur_px, largest_shift_px=_FARTHEST_FROM_EXPECTED_PX
        )
        if fitted is not None:
            rows.append((i, m, fitted))
    more = _observations(rows)
    return Observations(
        *(np.concatenate([getattr(seen, k), getattr(more, k)]) for k in Observations.__dataclass_fields__)
    )


def _facing(turntable, side_m):
    """Pairs of frame and marker where the marker's front faces the camera."""
    centres = layout(turntable, side_m).mean(1)
    normals = turntable.marker_poses[:, :3, 2]
    pairs = []
    for frame, angle in zip(turntable.frames.tolist(), turntable.angles_rad, strict=True):
        camera = turntable.distance_m * np.array([np.cos(angle), -np.sin(angle), 0.0])
        view = camera - centres
        cosine = (view * normals).sum(-1) / np.linalg.norm(view, axis=-1)
        pairs += [(frame, int(m)) for m in turntable.markers[cosine > _STEEPEST_COSINE]]
    return pairs


def _observations(rows: list[tuple[int, int, FittedMarker]]) -> Observations:
    return Observations(
        np.array([i for i, _, _ in rows], dtype=int),
        np.array([m for _, m, _ in rows], dtype=int),
        np.array([f.corners_px for _, _, f in rows]).reshape(-1, 4, 2),
        np.array([f.covariance_px2 for _, _, f in rows]).reshape(-1, 8, 8),
    )
