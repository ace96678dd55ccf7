"""The spectrum of the white tarp: steps 1 to 5 of the paper's Algorithm 1, a function each.

The spatial steps (ROI, deviation, mask) use the tarp's counts as they are; dark counts, where there is a dark cube,
are taken off its mean spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf.data.calibration.config import CalibrationConfig
from hsi_sc_nerf.data.calibration.reflectance import dark_counts
from hsi_sc_nerf.data.regions import ellipse_close_open, largest_component
from hsi_sc_nerf.data.session import Capture
from hsi_sc_nerf.errors import InputError


@dataclass(frozen=True, eq=False)
class WhiteReference:
    """The tarp's spectrum and how it was found.

    Attributes:
        roi: x0, y0, x1, y1 of the coarse region, pixels.
        deviation: D(x, y) inside the coarse region (relative, not negative).
        mask: the refined region inside the coarse one.
        measured: mean counts over the refined region, dark counts taken off, before smoothing.
        spectrum: the same after smoothing: what reflectance 1 counts in each band.
    """

    roi: tuple[int, int, int, int]
    deviation: Float[np.ndarray, "y x"]
    mask: Bool[np.ndarray, "y x"]
    measured: Float[np.ndarray, "bands"]
    spectrum: Float[np.ndarray, "bands"]


def find_coarse_roi(
    brightness: Num[np.ndarray, "lines samples"], threshold: float = 0.5
) -> tuple[int, int, int, int] | None:
    """Bounding box (x0, y0, x1, y1) of the largest region above ``threshold`` times the 99th percentile.

    Returns None where nothing is brighter than zero.
    """
    reference = np.percentile(brightness, 99.0)
    if not reference > 0.0:
        return None
    y, x = np.nonzero(largest_component(brightness >= threshold * reference))
    return int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1


def deviation_map(white: Num[np.ndarray, "y x bands"]) -> Float[np.ndarray, "y x"]:
    """Step 2: D(x, y), the mean over bands of |I - mu| / mu, with mu the mean spectrum of the region.

    The mean of ratios, as printed (the released code divides means). A band without any counts has no ratio and
    is left out; without any counts at all D is infinite.
    """
    mean = white.mean(axis=(0, 1), dtype=np.float64)
    lit = mean > 0.0
    if not lit.any():
        return np.full(white.shape[:2], np.inf)
    # Line by line: the ratios of a whole tarp would take gigabytes.
    return np.stack([np.abs(line[:, lit] / mean[lit] - 1.0).mean(axis=-1) for line in white])


def white_mask(deviation: Float[np.ndarray, "y x"], *, percentile: float, kernel_px: int) -> Bool[np.ndarray, "y x"]:
    """Step 3: pixels up to the percentile of D; closing, opening, the largest connected component."""
    kept = deviation <= np.percentile(deviation, percentile)
    return largest_component(ellipse_close_open(kept, close_px=kernel_px, open_px=kernel_px))


def smooth_spectrum(
    spectrum: Float[np.ndarray, "bands"], wavelengths_nm: Float[np.ndarray, "bands"], window: int, max_nm: float
) -> Float[np.ndarray, "bands"]:
    """Step 5: moving average over ``window`` bands (odd), whose window shrinks symmetrically towards the ends.

    It also shrinks where it would span more than ``max_nm`` between the centres of its outermost bands. A symmetrical
    window leaves constant and linear spectra as they are in every band; the outermost bands are not smoothed.
    """
    smoothed = np.empty(len(spectrum))
    for i in range(len(spectrum)):
        reach = min(window // 2, i, len(spectrum) - 1 - i)
        while reach and abs(wavelengths_nm[i + reach] - wavelengths_nm[i - reach]) > max_nm:
            reach -= 1
        smoothed[i] = spectrum[i - reach : i + reach + 1].mean()
    return smoothed


def white_reference(capture: Capture, config: CalibrationConfig) -> WhiteReference:
    """Steps 1 to 5 on the capture of the white tarp.

    Raises:
        InputError: a ROI outside the image, a tarp with no usable region, or a white spectrum that is not above
            dark in a band.
    """
    header = capture.cube.header_path
    counts = capture.cube.read()
    brightness = counts.mean(axis=-1, dtype=np.float64)
    roi = config.roi or find_coarse_roi(brightness, config.roi_brightness)
    if roi is None:
        raise InputError(f"{header}: the tarp has no usable region, because the image is dark; take it again.")
    lines, samples, _ = counts.shape
    x0, y0, x1, y1 = roi
    if not (0 <= x0 < x1 <= samples and 0 <= y0 < y1 <= lines):
        raise InputError(
            f"{header}: the given region x0 y0 x1 y1 = {roi} is not inside its {samples} x {lines} pixels; "
            "correct --calibration.roi."
        )
    inside = counts[y0:y1, x0:x1]
    deviation = deviation_map(inside)
    kernel_px = max(config.morphology_min_px, min(inside.shape[:2]) // config.morphology_fraction)
    mask = white_mask(deviation, percentile=config.percentile, kernel_px=kernel_px)
    if not mask.any() or not deviation[mask].mean() <= config.max_deviation:
        raise InputError(
            f"{header}: the tarp has no usable region, because no part of it is evenly bright; take it again or give "
            "its place with --calibration.roi."
        )
    measured = inside[mask].mean(axis=0, dtype=np.float64)
    dark = dark_counts(None if capture.dark is None else capture.dark.read(), samples)
    if dark is not None:
        per_sample = np.broadcast_to(dark[0], (samples, len(measured)))[x0:x1]
        measured -= np.average(per_sample, axis=0, weights=mask.sum(axis=0))
    unlit: Int[np.ndarray, "unlit"] = np.flatnonzero(~(measured > 0.0))
    if len(unlit):
        raise InputError(
            f"{header}: the white spectrum is {'zero' if dark is None else 'not above the dark counts'} at "
            f"{capture.cube.wavelengths_nm[unlit[0]]:.2f} nm ({len(unlit)} such bands); take the tarp again with "
            "more light or leave these bands out of the export."
        )
    smoothed = smooth_spectrum(measured, capture.cube.wavelengths_nm, config.smoothing_bands, config.smoothing_max_nm)
    return WhiteReference(roi, deviation, mask, measured, smoothed)
