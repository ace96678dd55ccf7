"""Flat field: falloff of the light over the image, from the white tarp, as one smooth surface for all bands."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Num

from hsi_sc_nerf.calibration.detector import Defects, dark_columns, dark_counts
from hsi_sc_nerf.calibration.white_reference import TARP_BRIGHTNESS, WhiteReference, dead_elements, mean_over_columns
from hsi_sc_nerf.capture.session import Capture
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.morphology import dilate, largest_component
from hsi_sc_nerf.robust_scatter import robust_std, tukey_weights

ORDER = 4
"""Total order of the surface's polynomial."""
EDGE_FRACTION = 32
"""A margin of the tarp's shorter side over this is left out, because its edge may be blurred, frayed or curled."""
REACH = 1.25
"""The surface is constant beyond this many half widths of the tarp from its middle."""
VALUE_REACH = 0.5
"""Beyond the tarp, the surface exceeds its range on the tarp by at most this fraction of it."""
MAX_PIXELS = 20_000
"""Pixels of the tarp that are fitted, chosen at random; ample for the 15 coefficients of order 4."""


def flat_field(
    tarp: Capture,
    white: WhiteReference,
    frame_shape: tuple[int, int],
    defects: Defects | None = None,
) -> Float[np.ndarray, "lines samples"]:
    """Illumination of each pixel relative to that of the white spectrum: positive, the same in all bands.

    Its mean is 1 over the region of the white spectrum, except for dirt and folds there, which lower the spectrum but
    not the illumination. Camera and lamps must not have moved between the tarp and the frames.

    Raises:
        InputError: the tarp's image has another size than the frames, or the tarp is too small in it.
    """
    header = tarp.cube.header_path
    if tarp.cube.shape[:2] != frame_shape:
        raise InputError(
            f"{header}: its {tarp.cube.shape[:2]} lines and samples differ from the {tuple(frame_shape)} of the "
            "frames, so that it cannot serve as their flat field; leave out --calibration.flat-field."
        )
    counts = tarp.cube.memmap()
    samples, bands = counts.shape[1:]
    use = ~white.bad_bands & ~dead_elements(defects, samples, bands)
    dark = dark_columns(dark_counts(tarp.dark), samples, bands)
    brightness = relative_brightness(counts, dark, np.nan_to_num(mean_over_columns(white.measured)), use)
    region = np.zeros(brightness.shape, bool)
    x0, y0, x1, y1 = white.roi
    region[y0:y1, x0:x1] = brightness[y0:y1, x0:x1] > TARP_BRIGHTNESS
    edge_px = 2 * max(1, min(y1 - y0, x1 - x0) // EDGE_FRACTION) + 1
    region = ~dilate(~largest_component(region), edge_px)
    terms = (ORDER + 1) * (ORDER + 2) // 2
    if np.count_nonzero(region) < 10 * terms:
        raise InputError(
            f"{header}: the tarp is too small in its image to measure the falloff of the light; leave out "
            "--calibration.flat-field."
        )
    return fit_surface(brightness, region, ORDER).astype(np.float32)


def relative_brightness(
    counts: Num[np.ndarray, "lines samples bands"],
    dark: Float[np.ndarray, "columns bands"],
    spectrum: Float[np.ndarray, "bands"],
    use: Bool[np.ndarray, "samples bands"],
) -> Float[np.ndarray, "lines samples"]:
    """Counts above dark over the white spectrum, both summed over the elements in ``use``; 0 without any."""
    used = use.astype(np.float64)
    dark_sum, white_sum = (used * dark).sum(axis=1), used @ spectrum
    light = np.stack([np.where(use, line, 0.0).sum(axis=1) for line in counts])
    return np.where(white_sum > 0.0, (light - dark_sum) / np.where(white_sum > 0.0, white_sum, 1.0), 0.0)


def fit_surface(
    brightness: Float[np.ndarray, "lines samples"], region: Bool[np.ndarray, "lines samples"], order: int
) -> Float[np.ndarray, "lines samples"]:
    """A polynomial of two variables, fitted robustly to the region and evaluated over the whole image.

    The fit minimises absolute deviations, which dirt and folds on less than half of the region do not affect, and
    then Tukey's biweight, which gives them no weight (Huber & Ronchetti, "Robust Statistics", 2nd ed., section 7).
    Outside the region the surface is limited by ``REACH`` and ``VALUE_REACH``.
    """
    at = np.argwhere(region)
    middle = (at.min(axis=0) + at.max(axis=0)) / 2.0
    half = np.maximum((at.max(axis=0) - at.min(axis=0)) / 2.0, 1.0)
    at = np.random.default_rng(0).permutation(at)[:MAX_PIXELS]
    powers = np.add.outer(np.arange(order + 1), np.arange(order + 1)) <= order

    def terms(yx: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n terms"]:
        scaled = np.clip((yx - middle) / half, -REACH, REACH)
        return np.polynomial.legendre.legvander2d(scaled[:, 0], scaled[:, 1], [order, order])[:, powers.ravel()]

    on_tarp = terms(at)
    coefficients = _robust_fit(on_tarp, brightness[tuple(at.T)])
    fitted = on_tarp @ coefficients
    beyond, darkest = VALUE_REACH * np.ptp(fitted), fitted.min()
    lines, samples = brightness.shape
    across = np.arange(samples)
    surface = [terms(np.stack([np.full(samples, y), across], axis=1)) @ coefficients for y in range(lines)]
    return np.clip(np.stack(surface), max(darkest - beyond, 0.5 * darkest), fitted.max() + beyond)


def _robust_fit(terms: Float[np.ndarray, "n terms"], values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "terms"]:
    """Coefficients by least absolute deviations, then Tukey's biweight, by iteratively reweighted least squares."""
    weights = np.ones(len(values))
    scale = 0.0
    for step in range(30):
        root = np.sqrt(weights)
        coefficients = np.linalg.lstsq(terms * root[:, None], values * root, rcond=None)[0]
        distance = np.abs(values - terms @ coefficients)
        scale = float(robust_std(distance, least=1e-6 * float(np.abs(values).max())))
        if step < 15:
            weights = 1.0 / np.maximum(distance, 0.1 * scale)
        else:
            weights = tukey_weights(distance, scale)
    return coefficients
