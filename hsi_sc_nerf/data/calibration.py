"""White-reference calibration: the paper's Algorithm 1, one function a step.

Dark counts, where there is a dark cube, are taken off the object's and the tarp's counts before the one is
divided by the other. The spatial steps (ROI, deviation, mask) use the tarp's counts as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf import paper
from hsi_sc_nerf.data.regions import ellipse_close_open, largest_component
from hsi_sc_nerf.data.session import Capture
from hsi_sc_nerf.errors import InputError


@dataclass(frozen=True)
class CalibrationConfig:
    """Settings of the white-reference calibration; the defaults are the paper's."""

    roi: tuple[int, int, int, int] | None = None
    """Where the white tarp is in its image: x0 y0 x1 y1 in pixels, x1 and y1 excluded. Found by itself if not
    given."""
    percentile: float = paper.WHITE_PERCENTILE
    """How much of the tarp is kept: the share (in percent) of its pixels that deviate least from its mean."""
    morphology_min_px: int = paper.WHITE_MORPHOLOGY_MIN_PX
    """Smallest diameter of the ellipse that closes and opens the tarp's mask, pixels."""
    morphology_fraction: int = paper.WHITE_MORPHOLOGY_FRACTION
    """The ellipse's diameter is the tarp's shorter side divided by this, where that is larger."""
    smoothing_bands: int = paper.WHITE_SMOOTHING_BANDS
    """Width of the moving average along the white spectrum, bands; 1 leaves the spectrum as measured."""
    smoothing_max_nm: float = 15.0
    """The moving average spans no more than this, nm: five bands of a camera with few, broad bands would smooth the
    lamp's own spectrum away. The paper's five bands span 12 nm."""
    bounds: tuple[float, float] = paper.REFLECTANCE_BOUNDS
    """Reflectance is clipped to these."""
    roi_brightness: float = 0.5
    """The tarp is looked for where the image is brighter than this share of its brightest part."""
    max_deviation: float = 0.5
    """A tarp whose kept pixels deviate from their mean by more than this (relative) is refused."""


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


def dark_counts(
    dark: Num[np.ndarray, "dark_lines dark_samples bands"] | None, samples: int
) -> Float[np.ndarray, "1 columns bands"] | None:
    """What the sensor counts without light: the mean over the dark cube's lines, for each sample and band.

    A dark cube of another width cannot be matched sample by sample and gives one spectrum (columns = 1).
    """
    if dark is None:
        return None
    over_lines = dark.mean(axis=0, keepdims=True, dtype=np.float64)
    columns = over_lines if dark.shape[1] == samples else over_lines.mean(axis=1, keepdims=True)
    return columns.astype(np.float32)


def normalise(
    counts: Num[np.ndarray, "lines samples bands"],
    dark: Float[np.ndarray, "1 columns bands"] | None,
    white: Float[np.ndarray, "bands"],
    bounds: tuple[float, float] = paper.REFLECTANCE_BOUNDS,
) -> Float[np.ndarray, "lines samples bands"]:
    """Step 6: reflectance (S - D) / (W - D), clipped to ``bounds``; float32.

    ``white`` is W - D, positive in each band (``white_reference`` sees to it).
    """
    reflectance = np.array(counts, dtype=np.float32, order="C")
    if dark is not None:
        reflectance -= dark
    reflectance /= white.astype(np.float32)
    return np.clip(reflectance, *bounds, out=reflectance)


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


def calibrate(
    capture: Capture, white: WhiteReference, config: CalibrationConfig
) -> Float[np.ndarray, "lines samples bands"]:
    """Reflectance of a frame, read from disk and normalised with the tarp's spectrum."""
    counts = capture.cube.memmap()
    dark = dark_counts(None if capture.dark is None else capture.dark.memmap(), counts.shape[1])
    return normalise(counts, dark, white.spectrum, config.bounds)
