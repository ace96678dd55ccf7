"""Corners of ArUco markers as OpenCV finds them in small images."""

import cv2
import numpy as np


def detected_corners(
    image: np.ndarray, enlarge: int = 2, dictionary: int = cv2.aruco.DICT_5X5_50
) -> dict[int, np.ndarray]:
    """Corners (4, 2) in corner-origin pixels of an ``image`` (h, w) in [0, 1], by the marker's number."""
    enlarged = cv2.resize(image.astype(np.float32), None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary), parameters)
    corners, numbers, _ = detector.detectMarkers(np.clip(enlarged * 255, 0, 255).astype(np.uint8))
    return {int(n): (c[0] + 0.5) / enlarge for n, c in zip(numbers.ravel(), corners, strict=True)}
