"""All markers of all frames: detection, refinement, and a second look where the adjusted turntable expects them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float, UInt8
from rich.progress import track
from scipy.optimize import minimize_scalar

from hsi_sc_nerf.poses.adjust import reproject
from hsi_sc_nerf.poses.fit import FittedMarker, fit_marker, quad_area
from hsi_sc_nerf.poses.frame import layout
from hsi_sc_nerf.poses.initialise import Observations, Rejected, Turntable
from hsi_sc_nerf.poses.markers import Detections, detect_markers

# Frames that are searched at the same time: OpenCV and NumPy let other threads work meanwhile.
_WORKERS = 2
# The camera's blur that is tried, standard deviation in pixels, and on how many markers.
_BLURS_PX = (0.0, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0, 4.0)
_MARKERS_TO_TELL_THE_BLUR = 10
_BLUR_TOLERANCE_PX = 0.02
# A frame has a blur of its own if its patterns leave this many times the share of the variance that others leave, and
# this share.
_OUT_OF_FOCUS_MEDIANS = 2.0
_LEAST_OUT_OF_FOCUS = 0.01
# A marker that the adjustment expects is looked for if it is seen at least this steeply (cosine to its normal).
_STEEPEST_COSINE = 0.1
_FARTHEST_FROM_EXPECTED_PX = 1.0


_T = TypeVar("_T")


@dataclass(frozen=True)
class Observed:
    """Markers of all frames, the blur that explains each frame best, and markers whose pattern was not fitted."""

    observations: Observations
    blur_px: Float[np.ndarray, "frames"]
    unexplained: tuple[Rejected, ...]


def observe(images: Sequence[UInt8[np.ndarray, "h w"]], dictionary: str, progress: bool) -> Observed:
    """Detect and refine the markers of every frame."""
    with ThreadPoolExecutor(_WORKERS) as pool:
        detections = _all(
            pool.map(lambda image: detect_markers(image, dictionary), images),
            "Finding markers",
            len(images),
            progress,
        )
        blur_px = np.full(len(images), find_blur(images, dictionary, detections))

        def refine(i: int) -> list[tuple[int, FittedMarker | None]]:
            image, found = images[i].astype(float), sorted(detections[i].items())
            return [(m, fit_marker(image, dictionary, m, corners, blur_px[i])) for m, corners in found]

        fitted = _all(pool.map(refine, range(len(images))), "Refining corners", len(images), progress)
    for i in _out_of_focus(fitted):
        blur_px[i] = find_blur(images[i : i + 1], dictionary, detections[i : i + 1])
        fitted[i] = refine(i)
    rows = [(i, m, fit) for i, found in enumerate(fitted) for m, fit in found if fit is not None]
    why = "its pattern does not explain the pixels: hidden, blurred or misread"
    unexplained = tuple(
        Rejected(i, m, None, why) for i, found in enumerate(fitted) for m, fit in found if fit is None
    )
    return Observed(_observations(rows), blur_px, unexplained)


def _out_of_focus(fitted: Sequence[Sequence[tuple[int, FittedMarker | None]]]) -> list[int]:
    """Frames whose patterns explain their pixels far worse than the other frames' do."""
    left = [[1.0 if fit is None else fit.unexplained for _, fit in found] for found in fitted]
    of_frame = np.array([np.median(shares) if shares else np.nan for shares in left])
    if np.isnan(of_frame).all():
        return []
    limit = max(_OUT_OF_FOCUS_MEDIANS * float(np.nanmedian(of_frame)), _LEAST_OUT_OF_FOCUS)
    return np.flatnonzero(of_frame > limit).tolist()


def find_blur(images: Sequence[UInt8[np.ndarray, "h w"]], dictionary: str, detections: Sequence[Detections]) -> float:
    """Standard deviation of the blur, in pixels, with which the largest markers' patterns fit their pixels best.

    Of the markers the median counts: a few may be hidden, or in frames that are blurred otherwise.
    """
    seen = [(i, m, c) for i, found in enumerate(detections) for m, c in sorted(found.items())]
    seen.sort(key=lambda s: -quad_area(s[2]))
    # Spread over the larger half: neighbours in size are often the same marker in neighbouring frames.
    seen = seen[: max(_MARKERS_TO_TELL_THE_BLUR, len(seen) // 2)]
    seen = seen[:: max(1, len(seen) // _MARKERS_TO_TELL_THE_BLUR)][:_MARKERS_TO_TELL_THE_BLUR]
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
    seen: Observations,
    centre_px: tuple[float, float],
    side_m: float,
    blur_px: Float[np.ndarray, "frames"],
) -> Observations:
    """Markers that were not detected, fitted where the turntable expects them, appended to the seen ones."""
    have = set(zip(seen.frame.tolist(), seen.marker.tolist(), strict=True))
    expected = [pair for pair in _facing(turntable, side_m) if pair not in have]
    if not expected:
        return seen
    frame, marker = np.array(expected).T
    blank = Observations(frame, marker, np.zeros((len(frame), 4, 2)), np.zeros((len(frame), 8, 8)))
    corners = reproject(turntable, blank, centre_px, side_m)

    def look(i: int, marker: int, start: Float[np.ndarray, "4 2"]) -> FittedMarker | None:
        image = images[i].astype(float)
        return fit_marker(image, dictionary, marker, start, blur_px[i], largest_shift_px=_FARTHEST_FROM_EXPECTED_PX)

    pairs = frame.tolist(), marker.tolist()
    with ThreadPoolExecutor(_WORKERS) as pool:
        fitted = list(pool.map(look, *pairs, corners))
    more = _observations([(i, m, fit) for i, m, fit in zip(*pairs, fitted, strict=True) if fit is not None])
    return Observations(
        *(np.concatenate([getattr(seen, k), getattr(more, k)]) for k in Observations.__dataclass_fields__)
    )


def _facing(turntable, side_m):
    """Pairs of frame and marker where the marker's front faces the camera."""
    centres = layout(turntable, side_m).mean(1)
    normals = turntable.marker_poses[:, :3, 2]
    pairs = []
    for frame, rotation, shift in zip(turntable.frames.tolist(), *turntable.motions(), strict=True):
        camera = ([turntable.distance_m, 0.0, 0.0] - shift) @ rotation
        view = camera - centres
        cosine = (view * normals).sum(-1) / np.linalg.norm(view, axis=-1)
        pairs += [(frame, int(m)) for m in turntable.markers[cosine > _STEEPEST_COSINE]]
    return pairs


def _all(work: Iterable[_T], what: str, total: int, progress: bool) -> list[_T]:
    return list(track(work, what, total=total, disable=not progress, transient=True))


def _observations(rows: list[tuple[int, int, FittedMarker]]) -> Observations:
    return Observations(
        np.array([i for i, _, _ in rows], dtype=int),
        np.array([m for _, m, _ in rows], dtype=int),
        np.array([f.corners_px for _, _, f in rows]).reshape(-1, 4, 2),
        np.array([f.covariance_px2 for _, _, f in rows]).reshape(-1, 8, 8),
    )
