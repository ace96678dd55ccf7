"""Finding ArUco markers in small images, and the dictionary that they come from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.session_pictures import GRAY, SessionPictures

Detections: TypeAlias = dict[int, Float[np.ndarray, "4 2"]]
"""Marker id to its corners in pixels (corner origin), clockwise from the upper left one of the marker's pattern."""

# Markers are searched for at several magnifications, up to this length of the longer side: the adaptive threshold
# has fixed windows, and no single magnification finds both upright and foreshortened markers.
_LARGEST_SIDE_PX = 1024
_MAGNIFICATIONS = (1, 2, 4, 8)

# The largest dictionary of each family, then its smaller parts: a part holds the first ids of the family.
_FAMILIES: dict[str, tuple[str, ...]] = {
    **{f"DICT_{n}X{n}_1000": tuple(f"DICT_{n}X{n}_{ids}" for ids in (50, 100, 250, 1000)) for n in (5, 4, 6, 7)},
    **{f"DICT_ARUCO_{name}": (f"DICT_ARUCO_{name}",) for name in ("ORIGINAL", "MIP_36h12")},
    **{f"DICT_APRILTAG_{name}": (f"DICT_APRILTAG_{name}",) for name in ("36h11", "36h10", "25h9", "16h5")},
}
_FRAMES_FOR_DICTIONARY = 8
# With this many of its markers in a frame, no other family needs to be tried.
_CLEAR_MARKERS_PER_FRAME = 2


def dictionary_by_name(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's predefined dictionary of that name, such as ``DICT_5X5_50``.

    Raises:
        InputError: OpenCV has no dictionary of that name.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if number is None:
        raise InputError(
            f"marker dictionary {name!r} is not one of OpenCV's; give its name there, such as DICT_5X5_50"
        )
    return cv2.aruco.getPredefinedDictionary(number)


@lru_cache(maxsize=256)
def marker_pattern(dictionary: str, marker: int) -> UInt8[np.ndarray, "cells cells"]:
    """The marker's cells with its black border, 0 black and 1 white, one number a cell."""
    book = dictionary_by_name(dictionary)
    return cv2.aruco.generateImageMarker(book, marker, book.markerSize + 2) // 255


def detect_markers(image: UInt8[np.ndarray, "h w"], dictionary: str) -> Detections:
    """Markers seen at any of several magnifications of the image.

    Their corners are good to about half a pixel, which ``fit_marker`` refines. Some markers are misread, which it
    rejects.
    """
    detector = _detector(dictionary)
    found: Detections = {}
    for magnification in _MAGNIFICATIONS:
        if magnification > 1 and max(image.shape) * magnification > _LARGEST_SIDE_PX:
            break
        enlarged = image
        if magnification > 1:
            enlarged = cv2.resize(image, None, fx=magnification, fy=magnification, interpolation=cv2.INTER_LANCZOS4)
        corners, ids, _ = detector.detectMarkers(enlarged)
        if ids is None:
            continue
        for marker, quad in zip(ids.ravel(), corners, strict=True):
            # OpenCV's (0, 0) is the first pixel's centre; ours is its corner, at every magnification.
            found[int(marker)] = (quad.reshape(4, 2).astype(float) + 0.5) / magnification
    return found


def find_dictionary(images: Sequence[UInt8[np.ndarray, "h w"]]) -> str | None:
    """The dictionary whose markers are seen most often in a few of the frames; None if there are none.

    The smallest dictionary of a family that holds the ids is taken: it tolerates the most misread cells. If the
    frames' best pictures show no marker, the broad mean is searched too: sharp edges need not be those of ink.
    """
    session = SessionPictures.of(images)
    take = np.unique(np.linspace(0, len(session) - 1, _FRAMES_FOR_DICTIONARY).astype(int)).tolist()
    found = _most_seen_dictionary([session[i] for i in take])
    if found is None and any(session.frames[i].ranking[0] != GRAY for i in take):
        grays = session.named(GRAY)
        found = _most_seen_dictionary([grays[i] for i in take])
    return found


def _most_seen_dictionary(images: Sequence[UInt8[np.ndarray, "h w"]]) -> str | None:
    best, best_score = None, 0
    for family, parts in _FAMILIES.items():
        seen = Counter(marker for image in images for marker in detect_markers(image, family))
        # A misreading rarely repeats, a marker of a turntable does.
        steady = {marker: n for marker, n in seen.items() if n > 1} if len(images) > 2 else dict(seen)
        score = sum(steady.values())
        if score > best_score:
            best_score = score
            largest = max(steady)
            best = next(p for p in parts if largest < dictionary_by_name(p).bytesList.shape[0])
        if score >= _CLEAR_MARKERS_PER_FRAME * len(images):
            break
    return best


@lru_cache(maxsize=32)
def _detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(dictionary_by_name(dictionary), parameters)
