"""Spectra of a few places of a view: what was measured, how much it varies there, and what was rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from hsi_sc_nerf.packed.pixels import spread_over


@dataclass(frozen=True, eq=False)
class PlaceSpectra:
    """Spectra of the object's pixels within a circle.

    Attributes:
        line: of its centre.
        sample: of its centre.
        pixels: how many pixels of the object lie in it.
        measured: mean reflectance a band; NaN where a band was measured in none of the pixels.
        measured_sd: standard deviation over the pixels (one degree of freedom less), noise and texture together.
        rendered: mean reflectance of the same values in the rendering.
    """

    line: int
    sample: int
    pixels: int
    measured: Float[np.ndarray, "bands"]
    measured_sd: Float[np.ndarray, "bands"]
    rendered: Float[np.ndarray, "bands"]


def inner_places(mask: Bool[np.ndarray, "h w"], count: int, margin_px: int) -> list[tuple[int, int]]:
    """(line, sample) of places spread over the mask, ``margin_px`` inside its edge where it is wide enough."""
    padded = np.pad(mask.astype(np.uint8), 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    inside = mask & (depth >= min(margin_px, 0.8 * float(depth.max())))
    return [(line, sample) for _, line, sample in spread_over(inside[None], count).tolist()]


def place_spectra(
    measured: Float[np.ndarray, "h w bands"],
    rendered: Float[np.ndarray, "h w bands"],
    mask: Bool[np.ndarray, "h w"],
    places: Sequence[tuple[int, int]],
    radius_px: float,
    valid: Bool[np.ndarray, "h w bands"] | None = None,
) -> list[PlaceSpectra]:
    """Spectra of the object's pixels within a circle round each place; values that are not valid count nowhere."""
    lines, samples = np.indices(mask.shape)
    found = []
    for line, sample in places:
        inside = mask & ((lines - line) ** 2 + (samples - sample) ** 2 <= radius_px**2)
        here, there = measured[inside].astype(float), rendered[inside].astype(float)
        counts = np.ones_like(here, bool) if valid is None else valid[inside]
        of_band = counts.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean, mean_rendered = (np.where(counts, s, 0.0).sum(axis=0) / of_band for s in (here, there))
            squares = np.where(counts, (here - mean) ** 2, 0.0).sum(axis=0)
        sd = np.sqrt(squares / np.maximum(of_band - 1, 1)) + 0.0 * mean
        found.append(PlaceSpectra(line, sample, int(inside.sum()), mean, sd, mean_rendered))
    return found
