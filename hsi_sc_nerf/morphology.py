"""Regions of an image: morphology, connected components and outlines of boolean masks."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage


def ellipse_close_open(
    mask: Bool[np.ndarray, "lines samples"], *, close_px: int, open_px: int
) -> Bool[np.ndarray, "lines samples"]:
    """Morphological closing, then opening, each with an ellipse of the given diameter (below 2 it is skipped)."""
    # cv2.morphologyEx does not mirror the ellipse between the two halves, which moves masks where its size is even.
    for (first, second), size in (((cv2.dilate, cv2.erode), close_px), ((cv2.erode, cv2.dilate), open_px)):
        if size >= 2:
            ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
            once = first(mask.astype(np.uint8), ellipse)
            mask = second(once, ellipse[::-1, ::-1].copy(), anchor=((size - 1) // 2,) * 2) > 0
    return mask


def dilate(mask: Bool[np.ndarray, "lines samples"], size_px: int) -> Bool[np.ndarray, "lines samples"]:
    """Dilation with an ellipse of the given diameter (odd)."""
    ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size_px, size_px))
    return cv2.dilate(mask.astype(np.uint8), ellipse) > 0


def beside(mask: Bool[np.ndarray, "lines samples"], width_px: int) -> Bool[np.ndarray, "lines samples"]:
    """Pixels outside the mask within about ``width_px`` of it; with 1, those that share a side with it."""
    return dilate(mask, 2 * width_px + 1) & ~mask


def touching(
    mask: Bool[np.ndarray, "lines samples"], other: Bool[np.ndarray, "lines samples"], min_area_px: int = 1
) -> Bool[np.ndarray, "lines samples"]:
    """The mask's 8-connected components of at least ``min_area_px`` pixels that share a pixel with ``other``."""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = np.flatnonzero(statistics[:, cv2.CC_STAT_AREA] >= min_area_px)
    return mask & np.isin(labels, np.intersect1d(labels[mask & other], large))


def largest_component(mask: Bool[np.ndarray, "lines samples"]) -> Bool[np.ndarray, "lines samples"]:
    """The largest 8-connected component; an empty mask stays empty."""
    return (components(mask) or [np.zeros_like(mask)])[0]


def components(
    mask: Bool[np.ndarray, "lines samples"], least: float = 1.0
) -> list[Bool[np.ndarray, "lines samples"]]:
    """The 8-connected components, the largest first, whose area is at least ``least`` times the largest's."""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = statistics[1:, cv2.CC_STAT_AREA]
    order = np.argsort(-areas, kind="stable")
    return [labels == 1 + label for label in order if areas[label] >= least * areas[order[0]]]


def fill_holes(mask: Bool[np.ndarray, "lines samples"]) -> Bool[np.ndarray, "lines samples"]:
    """The mask with its holes filled."""
    return ndimage.binary_fill_holes(mask)


def draw_outline(
    image: UInt8[np.ndarray, "lines samples 3"], mask: Bool[np.ndarray, "lines samples"]
) -> UInt8[np.ndarray, "lines samples 3"]:
    """A copy of the image with the mask's outline drawn over it in magenta."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.ascontiguousarray(image).copy(), contours, -1, (255, 0, 200), 1)
