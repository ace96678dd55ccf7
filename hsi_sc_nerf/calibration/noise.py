"""Noise of a reading, from the session's dark and white cubes, and the uncertainty of reflectance that follows.

The variance of a reading is linear in its counts above dark, the photon transfer curve (Janesick, "Photon Transfer",
SPIE 2007): ``variance = read_noise^2 + counts_per_electron * counts``. The white gives the slope. A dark cube of
several lines gives the read noise; a SPECIM IQ's has one, and the white's dim bands tell it instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import stats
from scipy.optimize import nnls

from hsi_sc_nerf.calibration.detector import dark_columns
from hsi_sc_nerf.packed.cube import ReflectanceUncertainty

QUANTISATION_VARIANCE = 1.0 / 12.0
"""Variance of rounding to a whole count, counts^2."""
MAX_TRIPLES = 64
"""Triples of neighbouring lines of the white that are read; more do not improve the slope."""
MIN_PIXELS = 100
"""Fewest pixels of the white that the slope is measured on."""
MAX_SATURATED = 0.01
"""A band is not used for the slope if a larger fraction of its elements saturates on the white."""
DIM = 0.1
"""Brightness, relative to the white, of the readings whose noise must be known."""
MAX_VARIANCE_ERROR = 0.25
"""A read noise is taken from the white if this is its largest error, relative to the variance of dim readings."""
OUTLIER_PROBABILITY = 1e-4
"""Pixels and elements that noise alone would make more rarely than this are dirt or defects, and are left out."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Variance of one reading.

    Attributes:
        read_noise: standard deviation of a reading without light, counts, including rounding.
        counts_per_electron: slope of the photon transfer curve, the variance for each count above dark; the same for
            all elements.
        read_noise_measured: False if neither dark nor white tell it and ``read_noise`` is that of rounding alone.
        photon_noise_measured: False if the white is not usable and the slope is 0.
    """

    read_noise: Float[np.ndarray, "bands"]
    counts_per_electron: float
    read_noise_measured: bool
    photon_noise_measured: bool

    def variance(self, above_dark: Float[np.ndarray, "*shape bands"]) -> Float[np.ndarray, "*shape bands"]:
        """Variance of readings, counts^2, from their counts above dark; negative counts are taken as 0."""
        return self.read_noise**2 + self.counts_per_electron * np.maximum(above_dark, 0.0)


def measure_noise(
    white: Num[np.ndarray, "lines samples bands"],
    region: Bool[np.ndarray, "lines samples"],
    dark: Num[np.ndarray, "dark_lines columns bands"] | None,
    *,
    saturation_counts: float | None = None,
    dead: Bool[np.ndarray, "samples bands"] | None = None,
) -> NoiseModel:
    """Measure the noise of a session's readings.

    Args:
        white: counts of the white; of a memory map only some lines are read.
        region: pixels that show only the white and have data in all bands.
        dark: counts without light; without a dark cube, the dark level is taken as 0.
        saturation_counts: counts from which a reading is saturated; None if nothing saturates.
        dead: dead detector elements.
    """
    bands = white.shape[2]
    rounding_variance = _rounding_variance(white)
    rounding = np.full(bands, np.sqrt(rounding_variance))
    of_dark = None if dark is None or dark.shape[1] != white.shape[1] else dead
    measured = None if dark is None else read_noise(dark, of_dark, rounding_variance)
    level = dark_columns(dark, *white.shape[1:])
    # Without the dark level, the white's counts do not tell how many of them are photons.
    known = rounding if dark is None else measured
    slope, of_white = photon_transfer(
        white,
        region,
        level,
        known,
        saturation_counts=saturation_counts,
        dead=dead,
        rounding_variance=rounding_variance,
    ) or (None, None)
    if measured is None and of_white is not None:
        measured = np.full(bands, of_white)
    deviation = rounding if measured is None else np.maximum(measured, rounding)
    return NoiseModel(deviation, slope or 0.0, measured is not None, slope is not None)


def _rounding_variance(white: Num[np.ndarray, "lines samples bands"]) -> float:
    """Variance of rounding to whole counts, or of numbers with a fraction, counts^2."""
    some = white[:: -(-len(white) // MAX_TRIPLES)]
    some = some[np.isfinite(some)]
    if white.dtype.kind != "f" or np.array_equal(some, np.rint(some)):
        return QUANTISATION_VARIANCE
    return QUANTISATION_VARIANCE * float(np.spacing(np.abs(some).max())) ** 2


def reflectance_uncertainty(
    noise: NoiseModel,
    white: Float[np.ndarray, "bands"],
    *,
    white_pixels: int,
    smoothing_bands: Int[np.ndarray, "bands"],
    frame_dark_readings: int,
    white_dark_readings: int,
    panel_reflectance: Float[np.ndarray, "bands"] | float = 1.0,
    integration_ratio: float = 1.0,
) -> ReflectanceUncertainty:
    """Propagate the noise of readings, to first order, through ``R = P (S - D) / (W - D) * t_white / t_sample``.

    The errors of a corrected lamp drift and of the panel's certificate are not included.

    Args:
        noise: noise of one reading.
        white_pixels: pixels of the white that were averaged.
        smoothing_bands: width of the moving average around each band; odd.
        frame_dark_readings: dark readings averaged for each element of a frame; 0 if no dark was subtracted.
        white_dark_readings: dark readings averaged for the white (lines times columns); 0 if none was subtracted.
        panel_reflectance: P, in [0, 1].
        integration_ratio: t_white / t_sample.
    """
    gain = panel_reflectance * integration_ratio / white
    read_variance = noise.read_noise**2
    of_white = noise.variance(white) / white_pixels
    of_sample = read_variance.copy()
    if frame_dark_readings:
        of_sample += read_variance / frame_dark_readings
    if white_dark_readings:
        of_white += read_variance / white_dark_readings
    # Variance of a moving average of independent bands; the window of each band lies within the spectrum.
    cumulative, band = np.concatenate([[0.0], np.cumsum(of_white)]), np.arange(len(of_white))
    reach = smoothing_bands // 2
    of_average = (cumulative[band + reach + 1] - cumulative[band - reach]) / smoothing_bands**2
    return ReflectanceUncertainty(
        constant=gain**2 * of_sample, linear=gain * noise.counts_per_electron, quadratic=of_average / white**2
    )


def read_noise(
    dark: Num[np.ndarray, "dark_lines columns bands"],
    dead: Bool[np.ndarray, "columns bands"] | None = None,
    rounding_variance: float = QUANTISATION_VARIANCE,
) -> Float[np.ndarray, "bands"] | None:
    """Standard deviation of a reading without light in each band, counts.

    Each element's variance is taken over the dark cube's lines, and a band's is the mean over its elements, without
    dead ones and without those whose variance differs from the others' (flickering or stuck elements).

    Returns None if the cube has a single line or identical lines.
    """
    lines = len(dark)
    if lines < 2:
        return None
    variance = dark.var(axis=0, ddof=1, dtype=np.float64)
    if dead is not None:
        variance[dead] = np.nan
    variance[:, np.isnan(variance).all(axis=0)] = 0.0  # a bad band has no median
    if not np.nansum(variance) > 0.0:
        return None
    degrees = lines - 1
    middle = np.maximum(np.nanmedian(variance, axis=0), rounding_variance) / stats.chi2.median(degrees)
    low, high = (middle * stats.chi2.ppf(p, degrees) for p in (OUTLIER_PROBABILITY, 1.0 - OUTLIER_PROBABILITY))
    # Below the variance of rounding, an element is quiet if its level happens to lie between two counts.
    usual = (variance <= high) & ((variance >= low) | (low <= rounding_variance))
    return np.sqrt(np.where(usual, variance, 0.0).sum(axis=0) / np.maximum(usual.sum(axis=0), 1))


def photon_transfer(
    white: Num[np.ndarray, "lines samples bands"],
    region: Bool[np.ndarray, "lines samples"],
    dark: Float[np.ndarray, "columns bands"],
    read_noise: Float[np.ndarray, "bands"] | None = None,
    *,
    saturation_counts: float | None = None,
    dead: Bool[np.ndarray, "samples bands"] | None = None,
    rounding_variance: float = QUANTISATION_VARIANCE,
) -> tuple[float, float | None] | None:
    """Slope of the photon transfer curve, counts per electron, from the white; the read noise if it is not known.

    Second differences between three neighbouring lines cancel constants and gradients over the white; their variance
    is 6 times that of a reading. In each pixel the difference's component along the white's spectrum (a weave, a
    flickering lamp) is projected out, and pixels that are still outliers (dirt, edges) are left out. The slope is the
    weighted least-squares fit over the bands, whose signals differ, with the read noise as intercept. An intercept
    that the bands hardly determine is None.

    Returns None if the region is too small or nothing in it is lit and unsaturated.
    """
    inside_all = region[:-2] & region[1:-1] & region[2:]
    centres = np.flatnonzero(inside_all.any(axis=1)) + 1
    if len(centres) > MAX_TRIPLES:
        centres = centres[np.linspace(0, len(centres) - 1, MAX_TRIPLES).round().astype(int)]
    inside = inside_all[centres - 1]
    if inside.sum() < MIN_PIXELS:
        return None
    # Counts outside may be nan, which a product with 0 would keep.
    before, centre, after = (
        np.where(inside[..., None], white[centres + step], 0).astype(np.float32) for step in (-1, 0, 1)
    )
    difference = before - 2.0 * centre + after
    alive = np.broadcast_to(inside.any(axis=0)[:, None], white.shape[1:]) & (True if dead is None else ~dead)
    saturated = np.zeros_like(alive)
    if saturation_counts is not None:
        saturated = alive & (np.maximum(np.maximum(before, centre), after) >= saturation_counts).any(axis=0)
    readable = alive & ~saturated & (saturated.sum(axis=0) <= MAX_SATURATED * alive.sum(axis=0))
    mean = centre.sum(axis=0, dtype=np.float64) / np.maximum(inside.sum(axis=0), 1)[:, None]
    signal = np.where(readable, mean - dark, 0.0).clip(min=0.0)
    pixel_signal = signal.sum(axis=1, keepdims=True)
    if not pixel_signal.any():
        return None
    fraction = signal / np.where(pixel_signal > 0.0, pixel_signal, 1.0)
    difference = np.where(readable, difference, np.float32(0.0))
    difference -= difference.sum(axis=2, keepdims=True) * fraction.astype(np.float32)
    squared = np.square(difference, out=difference)
    squared /= 6.0
    kept = inside & _inliers(squared, inside, readable, rounding_variance)
    # Expected squares after the projection: per_slope * slope + of_read.
    read_variance = readable * (1.0 if read_noise is None else read_noise**2)
    per_slope = signal * (1.0 - fraction)
    of_read = read_variance * (1.0 - 2.0 * fraction) + fraction**2 * read_variance.sum(axis=1, keepdims=True)
    readings = kept.sum(axis=0) @ readable.astype(float)
    used = readings > 0
    x, offset = ((kept.sum(axis=0) @ (part * readable))[used] / readings[used] for part in (per_slope, of_read))
    y = np.einsum("nsb,ns->b", squared, kept.astype(np.float32))[used] / readings[used]
    if not x.any():
        # The projection leaves nothing of a single band.
        return None
    if read_noise is None:
        (slope, variance), (_, error) = _fit_variances(
            np.stack([x, offset], axis=1), y, 0.0 * y, readings[used], rounding_variance
        )
        if error <= MAX_VARIANCE_ERROR * (max(variance, rounding_variance) + slope * DIM * x.min()):
            return float(slope), float(np.sqrt(variance))
        offset = rounding_variance * offset
    (slope,), _ = _fit_variances(x[:, None], y, offset, readings[used], rounding_variance)
    return float(slope), None


def _fit_variances(
    design: Float[np.ndarray, "n k"],
    measured: Float[np.ndarray, "n"],
    offset: Float[np.ndarray, "n"],
    readings: Float[np.ndarray, "n"],
    least: float,
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Weighted least squares ``measured = offset + design @ x`` with x >= 0; x and its standard errors.

    Variances below ``least`` weigh as it does.
    """
    found = np.zeros(design.shape[1])
    scale = np.abs(design).max(axis=0).clip(min=1e-300)
    for _ in range(5):
        # The error of a variance is proportional to it, so the weights depend on what is fitted.
        weight = np.sqrt(readings) / np.maximum(offset + design @ found, least)
        weighted = weight[:, None] * design / scale
        found = nnls(weighted, weight * (measured - offset))[0] / scale
    # Variance of a squared deviation: twice the square of its mean.
    return found, np.sqrt(2.0 * np.diag(np.linalg.pinv(weighted.T @ weighted))) / scale


def _inliers(
    squared: Float[np.ndarray, "triples samples bands"],
    inside: Bool[np.ndarray, "triples samples"],
    readable: Bool[np.ndarray, "samples bands"],
    least: float,
) -> Bool[np.ndarray, "triples samples"]:
    """Pixels whose squares, summed over the bands in units of their variance, are distributed like noise."""
    pixels = squared[inside]
    counted = np.broadcast_to(readable, squared.shape)[inside]
    usual = np.maximum(np.median(pixels, axis=0) / stats.chi2.median(1), least)
    degrees = np.maximum(counted.sum(axis=1), 1)
    score = (pixels / usual).sum(axis=1) / stats.chi2.median(degrees)
    limit = stats.chi2.isf(OUTLIER_PROBABILITY, degrees) / stats.chi2.median(degrees)
    usual_pixel = np.zeros(inside.shape, bool)
    usual_pixel[inside] = score <= np.median(score) * limit
    return usual_pixel
