"""Drift of the lamps over a session, from the static part of the chamber.

Some lines of each frame are read. Pixels whose light follows one common course over the frames are static
(`static_pixels`). The change of the grey level is a robust mean over them, in which their scatter averages out. The
change of each band is taken from the sum of their spectra. Each spectrum is first divided by its own deviation from
the grey level, so that scatter which all bands share cancels. A smooth curve over 1 / wavelength, shared by all
frames, removes the bands' noise (`drift_curves`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import stats

from hsi_sc_nerf.calibration.detector import no_data
from hsi_sc_nerf.calibration.drift_curves import common_courses, smoothing_basis
from hsi_sc_nerf.calibration.noise import NoiseModel
from hsi_sc_nerf.calibration.static_pixels import MIN_FRACTION, Courses, grey_deviation, static_pixels

CorrectDrift = Literal["auto", "always", "never"]
ReadLines = Callable[[int], Num[np.ndarray, "survey samples bands"]]

SURVEY_FRACTION, SURVEY_PIXELS = 0.06, 16384
"""Fraction of each frame's lines that is surveyed, and fewest pixels: over half of them a scatter of 5 % averages to
0.06 %."""
MIN_LINES = 8
"""Fewest lines of a survey."""
BINS = 12
"""Bins of bands in which static pixels are searched for."""
MIN_SIGNAL = 10.0
"""Least signal-to-noise ratio of a band in the curve's fit."""
TESTED_TERMS, MIN_BANDS = 6, 3
"""Number of the smoothest terms over 1 / wavelength that are tested for a drift, and fewest bands. A change of output
and colour temperature is linear in 1 / wavelength, but lamps may lose more in the blue alone."""
FLOOR = 0.001
"""Relative change of the light (root mean square over frames and bands) that is not taken for drift: the turning
object changes the light on the chamber's wall."""
SMALLEST_ERROR = 5e-5
"""Relative standard error that is stated at least: rounding of counts, and wavelengths that a smooth curve misses."""
SIGNIFICANCE = 0.001
"""p-value below which a drift is significant."""


@dataclass(frozen=True, eq=False)
class LampDriftEstimate:
    """The lamps' light in each frame relative to the first frame, which stands for the time of the tarp.

    Attributes:
        factor: the smooth curve, which reflectance is divided by to correct the drift.
        measured: the light before smoothing; nan in bands without enough light.
        standard_error: standard error of ``factor``; 0 in the first frame.
        static: which of the surveyed pixels are static.
        scatter: scatter of the static pixels' grey levels, sensor noise included (standard deviation, relative).
        p_value: probability of such a drift under steady lamps (`drift_p_value`).
    """

    factor: Float[np.ndarray, "frames bands"]
    measured: Float[np.ndarray, "frames bands"]
    standard_error: Float[np.ndarray, "frames bands"]
    static: Bool[np.ndarray, "survey samples"]
    scatter: float
    p_value: float

    @property
    def significant(self) -> bool:
        """Whether ``p_value`` is below ``SIGNIFICANCE``."""
        return self.p_value < SIGNIFICANCE


@dataclass(frozen=True)
class NotMeasurable:
    """Why the lamps' drift cannot be measured, in one sentence."""

    reason: str


def measure_lamp_drift(
    read_lines: ReadLines,
    frames: int,
    dark: Sequence[Float[np.ndarray, "columns bands"]],
    noise: NoiseModel,
    wavelengths_nm: Float[np.ndarray, "bands"],
    *,
    saturation_counts: float | None = None,
    dead: Bool[np.ndarray, "samples bands"] | None = None,
) -> LampDriftEstimate | NotMeasurable:
    """Measure the lamps' drift over frames of one integration time.

    Args:
        read_lines: gives the raw counts of a frame's surveyed lines by its number, nan for no data. It is called
            twice for each frame, so that one frame is in memory at a time.
        frames: number of frames.
        dark: counts without light of each frame, or one for all.
        noise: noise of one reading.
        wavelengths_nm: band centres.
        saturation_counts: counts from which a reading is saturated; None if nothing saturates.
        dead: dead detector elements.
    """
    if frames < 2:
        return NotMeasurable("there is a single frame")
    if len(wavelengths_nm) < MIN_BANDS:
        return NotMeasurable(f"{len(wavelengths_nm)} bands are too few for a curve over the wavelength")
    survey = _Survey(read_lines, frames, dark, noise, saturation_counts, dead)
    counts, variance, unusable = survey.read_bins(_bins(wavelengths_nm))
    courses = Courses.of(counts, variance)
    static, common = static_pixels(courses)
    image = static.reshape(unusable.shape[:2])
    if not static.any():
        return NotMeasurable(
            f"less than {100.0 * MIN_FRACTION:.0f} % of the surveyed pixels follow one course over the frames"
        )
    deviation, scatter, grey_error = grey_deviation(courses, image, common)
    total, variance = survey.sum_over(image, unusable, np.exp(-deviation))
    lit = (total > MIN_SIGNAL * np.sqrt(variance)).all(axis=0)
    if lit.sum() < MIN_BANDS:
        return NotMeasurable("the stationary part of the image is too dark")
    measured = np.full(total.shape, np.nan)
    measured[:, lit] = total[:, lit] / total[0, lit]
    log_light, variance = np.log(total[:, lit]), (variance[:, lit] / total[:, lit] ** 2).mean(axis=0)
    precision = np.zeros(len(wavelengths_nm))
    precision[lit] = 1.0 / variance
    basis, roughness = smoothing_basis(1.0 / wavelengths_nm, precision)
    coefficients, covariance = fit_over_wavelength(log_light, variance, basis[lit], grey_error)
    curve, variance_of_curve = common_courses(coefficients, covariance, basis, roughness)
    factor = np.exp(curve)
    standard_error = factor * np.sqrt(variance_of_curve + SMALLEST_ERROR**2)
    standard_error[0] = 0.0
    few = slice(None, TESTED_TERMS)
    p_value = drift_p_value(coefficients[:, few], covariance[few, few], basis[lit, few])
    return LampDriftEstimate(factor, measured, standard_error, image, scatter, p_value)


def correction(
    drift: LampDriftEstimate | NotMeasurable, correct: CorrectDrift
) -> Float[np.ndarray, "frames bands"] | None:
    """Factors that each frame's reflectance is divided by; None if the drift is not to be corrected."""
    if isinstance(drift, NotMeasurable) or correct == "never":
        return None
    return drift.factor if drift.significant or correct == "always" else None


def survey_lines(lines: int, samples: int) -> Int[np.ndarray, "survey"]:
    """Lines of a frame that are surveyed, ascending, with the first and the last.

    They are twice as dense towards the edges of the image, where the chamber is most likely to be visible.
    """
    count = min(lines, max(MIN_LINES, round(SURVEY_FRACTION * lines), -(-SURVEY_PIXELS // samples)))
    if count == lines:
        return np.arange(lines)
    even = np.linspace(0.0, 1.0, count)
    denser = even - np.sin(2.0 * np.pi * even) / (4.0 * np.pi)
    return np.unique((denser * (lines - 1)).round().astype(int))


def fit_over_wavelength(
    log_light: Float[np.ndarray, "frames lit"],
    variance: Float[np.ndarray, "lit"],
    basis: Float[np.ndarray, "lit terms"],
    grey_error: float,
) -> tuple[Float[np.ndarray, "frames terms"], Float[np.ndarray, "terms terms"]]:
    """Weighted least squares of each frame's deviation from the mean frame: coefficients and their covariance.

    If the bands scatter about the curves by more than their variances, the covariance is scaled up accordingly.

    Args:
        grey_error: standard error of the grey level, which all bands share.
    """
    deviation = log_light - log_light.mean(axis=0)
    weighted = basis / variance[:, None]
    covariance = np.linalg.inv(basis.T @ weighted)
    coefficients = deviation @ weighted @ covariance
    residual = deviation - coefficients @ basis.T
    degrees = (len(log_light) - 1) * max(1, basis.shape[0] - basis.shape[1])
    scatter = float((residual**2 / variance).sum()) / degrees
    constant = np.linalg.lstsq(basis, np.ones(len(basis)), rcond=None)[0]
    return coefficients, covariance * max(1.0, scatter) + grey_error**2 * np.outer(constant, constant)


def drift_p_value(
    coefficients: Float[np.ndarray, "frames terms"],
    covariance: Float[np.ndarray, "terms terms"],
    basis: Float[np.ndarray, "lit terms"],
) -> float:
    """p-value of the frames' deviations under steady lamps, by a chi-square test.

    ``FLOOR`` is the apparent change of steady lamps; it is distributed evenly over the terms.
    """
    frames, terms = coefficients.shape
    expected = covariance + np.diag(FLOOR**2 / terms / np.square(basis).mean(axis=0))
    distance = np.einsum("fi,ij,fj->", coefficients, np.linalg.inv(expected), coefficients)
    return float(stats.chi2.sf(distance, (frames - 1) * terms))


def _bins(wavelengths_nm: Float[np.ndarray, "bands"]) -> Bool[np.ndarray, "bands bins"]:
    """Members of each bin: neighbouring bands, evenly over 1 / wavelength, in which the lamps' colour is linear."""
    inverse = 1.0 / wavelengths_nm
    scaled = (inverse - inverse.min()) / max(float(np.ptp(inverse)), 1e-12)
    number = np.minimum((scaled * BINS).astype(int), BINS - 1)
    return number[:, None] == np.unique(number)


@dataclass(frozen=True, eq=False)
class _Survey:
    """The surveyed lines of all frames, read one frame at a time."""

    read_lines: ReadLines
    frames: int
    dark: Sequence[Float[np.ndarray, "columns bands"]]
    noise: NoiseModel
    saturation_counts: float | None
    dead: Bool[np.ndarray, "samples bands"] | None

    def read_bins(
        self, bins: Bool[np.ndarray, "bands bins"]
    ) -> tuple[
        Float[np.ndarray, "pixels frames bins"],
        Float[np.ndarray, "pixels bins"],
        Bool[np.ndarray, "survey samples bands"],
    ]:
        """Counts above dark in bins of bands; their variances, infinite if unusable; and unusable readings.

        Unusable are readings of dead elements, and those that are saturated or no data in some frame.
        """
        shape = self._read(0)[0].shape
        dead = np.zeros(shape[1:], bool) if self.dead is None else self.dead
        counts = np.empty((shape[0] * shape[1], self.frames, bins.shape[1]), np.float32)
        unusable = np.zeros(shape, dtype=bool)
        for frame in range(self.frames):
            light, missing = self._read(frame)
            unusable |= missing
            light[:, dead] = 0.0
            counts[:, frame] = (light @ bins.astype(np.float32)).reshape(len(counts), -1)
        # A dead element is in no sum, so it does not exclude its bin, even if it is stuck at the largest count.
        unusable[:, dead] = False
        excluded = np.stack([unusable[..., members].any(axis=-1) for members in bins.T], axis=-1)
        unusable[:, dead] = True
        photon_variance = self.noise.counts_per_electron * np.maximum(counts.mean(axis=1), 0.0)
        variance = photon_variance + self.noise.read_noise**2 @ bins
        return counts, np.where(excluded.reshape(variance.shape), np.inf, variance), unusable

    def sum_over(
        self,
        static: Bool[np.ndarray, "survey samples"],
        unusable: Bool[np.ndarray, "survey samples bands"],
        weight: Float[np.ndarray, "pixels frames"],
    ) -> tuple[Float[np.ndarray, "frames bands"], Float[np.ndarray, "frames bands"]]:
        """Weighted sum of the static pixels' usable counts above dark in each band, and its variance."""
        usable = ~unusable[static]
        total, photons, readings = np.empty((3, self.frames, usable.shape[1]))
        for frame in range(self.frames):
            light, squared = self._read(frame)[0][static] * usable, weight[:, frame] ** 2
            total[frame], photons[frame], readings[frame] = (
                weight[:, frame] @ light,
                squared @ light,
                squared @ usable,
            )
        photon_variance = self.noise.counts_per_electron * np.maximum(photons, 0.0)
        return total, photon_variance + readings * self.noise.read_noise**2

    def _read(
        self, frame: int
    ) -> tuple[Float[np.ndarray, "survey samples bands"], Bool[np.ndarray, "survey samples bands"]]:
        """Counts of a frame above dark, 0 for no data, and which are no data or saturated."""
        counts = self.read_lines(frame)
        missing = no_data(counts, None)
        light = counts.astype(np.float32) - self.dark[frame if len(self.dark) > 1 else 0].astype(np.float32)
        unusable = np.zeros(counts.shape, bool) if missing is None else missing
        light[unusable] = 0.0
        if self.saturation_counts is not None:
            unusable = unusable | (counts >= self.saturation_counts)
        return light, unusable
