"""Drift of the lamps over a session, from the static part of the chamber.

Some lines of each frame are read. The pixels that follow one common course over the frames are static
(`static_pixels`). Their sum in each band, relative to the first frame, is the lamps' light, and a low-order
polynomial over 1 / wavelength removes its noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import stats

from hsi_sc_nerf.calibration.detector import no_data
from hsi_sc_nerf.calibration.noise import NoiseModel

CorrectDrift = Literal["auto", "always", "never"]
ReadLines = Callable[[int], Num[np.ndarray, "survey samples bands"]]

SURVEY_FRACTION = 0.06
"""Fraction of each frame's lines that is surveyed."""
MIN_LINES = 8
"""Fewest lines of a survey."""
MIN_PIXELS, MIN_STATIC_FRACTION = 64, 0.05
"""Fewest static pixels, and their least fraction of the surveyed ones."""
BINS = 12
"""Bins of bands in which static pixels are searched for."""
MIN_SIGNAL = 10.0
"""Least signal-to-noise ratio of a pixel's bin, so that its logarithm is normal, and of a band in the curve's fit."""
DEGREE = 2
"""Degree of the curve over 1 / wavelength. Changes of output and of colour temperature are linear in it."""
FLOOR = 0.001
"""Relative change of the light (root mean square over frames and bands) that is not taken for drift: the turning
object changes the light on the chamber's wall."""
SIGNIFICANCE = 0.001
"""p-value below which a drift is significant."""
TOLERANCE = 0.002
"""Relative deviation of a static pixel's course from the common one, beyond its noise: the lamps' light does not
change by the same factor everywhere, and a bin's bands have other weights in every pixel."""
NOISE_MARGIN = 1.5
"""Factor by which variances may exceed the noise model's."""
FALSE_ALARM = 1e-3
"""Fraction of static pixels that noise alone may exclude."""
SMALLEST_COUNT = 1e-3
"""Replaces counts that have no logarithm, which are not used."""
BLOCK_PX = 16
"""Neighbouring pixels whose median course is a candidate for the common one."""
MAX_BLOCKS, MAX_VOTERS = 256, 4096
"""Largest numbers of candidates, and of pixels that vote for them."""
ROUNDS = 5
"""Iterations of the static pixels and their common course."""


@dataclass(frozen=True, eq=False)
class LampDriftEstimate:
    """The lamps' light in each frame relative to the first frame, which stands for the time of the tarp.

    Attributes:
        factor: the smooth curve, which reflectance is divided by to correct the drift.
        measured: the same before smoothing; nan in bands without enough light.
        standard_error: of ``factor``; 0 in the first frame.
        static: which of the surveyed pixels are static.
        p_value: of such a drift under steady lamps (`drift_p_value`).
        significant: whether ``p_value`` is below ``SIGNIFICANCE``.
    """

    factor: Float[np.ndarray, "frames bands"]
    measured: Float[np.ndarray, "frames bands"]
    standard_error: Float[np.ndarray, "frames bands"]
    static: Bool[np.ndarray, "survey samples"]
    p_value: float
    significant: bool

    @property
    def static_fraction(self) -> float:
        """Fraction of the surveyed pixels that is static."""
        return float(self.static.mean())


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
        noise: of one reading.
        wavelengths_nm: band centres.
        saturation_counts: counts from which a reading is saturated; None if nothing saturates.
        dead: dead detector elements.
    """
    if frames < 2:
        return NotMeasurable("there is a single frame")
    if len(wavelengths_nm) <= DEGREE:
        return NotMeasurable(f"{len(wavelengths_nm)} bands are too few for a curve over the wavelength")
    survey = _Survey(read_lines, frames, dark, noise, saturation_counts, dead)
    static, unusable = survey.find_static(_bins(wavelengths_nm))
    fraction = float(static.mean())
    if static.sum() < MIN_PIXELS or fraction < MIN_STATIC_FRACTION:
        return NotMeasurable(
            f"only {100.0 * fraction:.1f} % of the surveyed pixels follow one course; more must stand still"
        )
    total, variance = survey.sum_over(static, unusable)
    lit = (total > MIN_SIGNAL * np.sqrt(variance)).all(axis=0)
    if lit.sum() <= DEGREE:
        return NotMeasurable("what stands still in the image is too dark")
    basis = smooth_basis(wavelengths_nm, lit, DEGREE)
    measured = np.full(total.shape, np.nan)
    measured[:, lit] = total[:, lit] / total[0, lit]
    coefficients, covariance = fit_over_wavelength(
        np.log(total[:, lit]), (variance[:, lit] / total[:, lit] ** 2).mean(axis=0), basis[lit]
    )
    factor = np.exp((coefficients - coefficients[0]) @ basis.T)
    # The first frame's error is part of all the others.
    standard_error = factor * np.sqrt(2.0 * np.einsum("bi,ij,bj->b", basis, covariance, basis))
    standard_error[0] = 0.0
    p_value = drift_p_value(coefficients, covariance)
    return LampDriftEstimate(factor, measured, standard_error, static, p_value, p_value < SIGNIFICANCE)


def correction(
    drift: LampDriftEstimate | NotMeasurable, correct: CorrectDrift
) -> Float[np.ndarray, "frames bands"] | None:
    """Factors that each frame's reflectance is divided by; None if the drift is not to be corrected."""
    if isinstance(drift, NotMeasurable) or correct == "never":
        return None
    return drift.factor if drift.significant or correct == "always" else None


def survey_lines(lines: int) -> Int[np.ndarray, "survey"]:
    """Lines of a frame that are surveyed, ascending, with the first and the last.

    They are twice as dense towards the edges of the image, where the chamber is most likely to be visible.
    """
    count = max(MIN_LINES, round(SURVEY_FRACTION * lines))
    even = np.linspace(0.0, 1.0, min(count, lines))
    denser = even - np.sin(2.0 * np.pi * even) / (4.0 * np.pi)
    return np.unique((denser * (lines - 1)).round().astype(int))


def static_pixels(
    counts: Float[np.ndarray, "pixels frames bins"], variance: Float[np.ndarray, "pixels bins"]
) -> Bool[np.ndarray, "pixels"]:
    """Pixels whose counts follow one common course over the frames, within their noise and whatever their spectrum.

    The course that most pixels follow is found as in RANSAC, but its candidates are median courses of blocks of
    neighbours, which have little noise. A rotating surface has a course of its own unless it looks the same from all
    sides. If nothing is static, few pixels agree on any course.

    Args:
        counts: counts above dark in bins of bands, pixels in reading order; overwritten.
        variance: of one count (mean over the frames); infinite if the pixel's counts cannot be used.
    """
    frames = counts.shape[1]
    bins_needed = max(1, counts.shape[2] // 2)
    mean = counts.mean(axis=1)
    usable = (mean > MIN_SIGNAL * np.sqrt(variance)) & (counts.min(axis=1) > 0.0)
    relative = np.where(usable, variance, 0.0) / np.where(usable, mean, 1.0) ** 2
    weight = (usable / (relative + TOLERANCE**2)).astype(np.float32)
    course = np.log(np.maximum(counts, SMALLEST_COUNT, out=counts), out=counts)
    course -= course.mean(axis=1, keepdims=True)
    judged = usable.sum(axis=1) >= bins_needed
    degrees = np.maximum((frames - 1) * usable.sum(axis=1), 1)
    over_frames = NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM, degrees)

    voters = np.flatnonzero(judged)
    voters = voters[:: max(1, len(voters) // MAX_VOTERS)]
    if not len(voters):
        return judged
    candidates = _candidates(course)
    votes = _chi_square(course[voters], weight[voters], candidates) <= over_frames[voters, None]
    common = candidates[int(votes.sum(axis=0).argmax())]
    in_a_frame = NOISE_MARGIN * stats.chi2.isf(FALSE_ALARM / frames, np.maximum(usable.sum(axis=1), 1))
    static = np.zeros(len(course), bool)
    for _ in range(ROUNDS):
        residual = course - common
        np.square(residual, out=residual)
        by_frame = np.matmul(residual, weight[..., None])[..., 0]
        before = static
        static = judged & (by_frame.sum(axis=1) <= over_frames) & (by_frame.max(axis=1) <= in_a_frame)
        if not static.any() or (static == before).all():
            break
        total = weight[static].sum(axis=0)
        common = np.einsum("pfk,pk->fk", course[static], weight[static]) / np.where(total > 0.0, total, 1.0)
    return static


def _candidates(course: Float[np.ndarray, "pixels frames bins"]) -> Float[np.ndarray, "blocks frames bins"]:
    """Median courses of evenly spread blocks of neighbours."""
    starts = np.arange(0, max(1, len(course) - BLOCK_PX + 1), BLOCK_PX)
    starts = starts[np.unique(np.linspace(0, len(starts) - 1, MAX_BLOCKS).round().astype(int))]
    return np.stack([np.median(course[start : start + BLOCK_PX], axis=0) for start in starts])


def _chi_square(
    course: Float[np.ndarray, "pixels frames bins"],
    weight: Float[np.ndarray, "pixels bins"],
    candidates: Float[np.ndarray, "blocks frames bins"],
) -> Float[np.ndarray, "pixels blocks"]:
    """Squared distance of each pixel's course from each candidate, in units of its variance."""
    weighted = course * weight[:, None]
    squared = np.einsum("pfk,pfk->p", course, weighted)[:, None]
    product = weighted.reshape(len(course), -1) @ candidates.reshape(len(candidates), -1).T
    return squared - 2.0 * product + weight @ np.square(candidates).sum(axis=1).T


def smooth_basis(
    wavelengths_nm: Float[np.ndarray, "bands"], lit: Bool[np.ndarray, "bands"], degree: int
) -> Float[np.ndarray, "bands terms"]:
    """Polynomials in 1 / wavelength, orthogonal and of root mean square 1 over the lit bands; the first is constant.

    By Wien's law, the logarithm of a lamp's light, and so of its drift, is linear in 1 / wavelength.
    """
    inverse = 1.0 / wavelengths_nm
    scaled = (inverse - inverse[lit].mean()) / max(float(np.ptp(inverse[lit])), 1e-12)
    powers = np.vander(scaled, degree + 1, increasing=True)
    _, triangle = np.linalg.qr(powers[lit])
    basis = np.linalg.solve(triangle.T, powers.T).T * np.sqrt(lit.sum())
    return basis * np.sign(basis[np.flatnonzero(lit)[0], 0])


def fit_over_wavelength(
    log_light: Float[np.ndarray, "frames lit"],
    variance: Float[np.ndarray, "lit"],
    basis: Float[np.ndarray, "lit terms"],
) -> tuple[Float[np.ndarray, "frames terms"], Float[np.ndarray, "terms terms"]]:
    """Weighted least squares of each frame's deviation from the mean frame: coefficients and their covariance.

    If the bands scatter about the curves by more than their variances, the covariance is scaled up accordingly.
    """
    deviation = log_light - log_light.mean(axis=0)
    weighted = basis / variance[:, None]
    covariance = np.linalg.inv(basis.T @ weighted)
    coefficients = deviation @ weighted @ covariance
    residual = deviation - coefficients @ basis.T
    degrees = (len(log_light) - 1) * max(1, basis.shape[0] - basis.shape[1])
    scatter = float((residual**2 / variance).sum()) / degrees
    return coefficients, covariance * max(1.0, scatter)


def drift_p_value(
    coefficients: Float[np.ndarray, "frames terms"],
    covariance: Float[np.ndarray, "terms terms"],
    floor: float = FLOOR,
) -> float:
    """p-value of the frames' deviations under steady lamps, by a chi-square test.

    ``floor`` is the apparent change of steady lamps, root mean square over the bands; it is distributed evenly over
    the terms, each of which has root mean square 1.
    """
    frames, terms = coefficients.shape
    expected = covariance + floor**2 / terms * np.eye(terms)
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

    def find_static(
        self, bins: Bool[np.ndarray, "bands bins"]
    ) -> tuple[Bool[np.ndarray, "survey samples"], Bool[np.ndarray, "survey samples bands"]]:
        """Static pixels, and unusable readings: of dead elements, or saturated or no data in some frame."""
        first = self.read_lines(0)
        samples, bands = first.shape[1:]
        summed = bins.astype(np.float32)
        binned = np.empty((*first.shape[:2], self.frames, bins.shape[1]), np.float32)
        unusable = np.zeros_like(first, dtype=bool)
        dead = np.nonzero(np.zeros((samples, bands), bool) if self.dead is None else self.dead)
        for frame in range(self.frames):
            (counts, missing), dark = self._read(frame), self._dark(frame, samples)
            if missing is not None:
                unusable |= missing
            if self.saturation_counts is not None and counts.max() >= self.saturation_counts:
                unusable |= counts >= self.saturation_counts
            light = counts.astype(np.float32)
            light[:, dead[0], dead[1]] = dark[dead]
            binned[:, :, frame] = light @ summed - dark @ summed
        # A dead element is in no sum, so it does not exclude its bin, even if it is stuck at the largest count.
        unusable[:, dead[0], dead[1]] = False
        excluded = np.stack([unusable[..., members].any(axis=-1) for members in bins.T], axis=-1)
        unusable[:, dead[0], dead[1]] = True
        binned = binned.reshape(-1, *binned.shape[2:])
        photon_variance = self.noise.counts_per_electron * np.maximum(binned.mean(axis=1), 0.0)
        variance = photon_variance + self.noise.read_noise**2 @ bins
        static = static_pixels(binned, np.where(excluded.reshape(variance.shape), np.inf, variance))
        return static.reshape(first.shape[:2]), unusable

    def sum_over(
        self, static: Bool[np.ndarray, "survey samples"], unusable: Bool[np.ndarray, "survey samples bands"]
    ) -> tuple[Float[np.ndarray, "frames bands"], Float[np.ndarray, "frames bands"]]:
        """Sum of the static pixels' usable counts above dark in each band, and its variance."""
        samples, bands = unusable.shape[1:]
        weight = static.astype(np.float32)[:, None]
        left_out = np.nonzero(unusable & static[..., None])
        readings = static.sum(axis=0)[:, None] - (unusable & static[..., None]).sum(axis=0)
        total = np.empty((self.frames, bands))
        for frame in range(self.frames):
            counts, _ = self._read(frame)
            total[frame] = np.matmul(weight, counts.astype(np.float32)).sum(axis=(0, 1), dtype=np.float64)
            total[frame] -= np.bincount(left_out[2], counts[left_out], minlength=bands)
            total[frame] -= (readings * self._dark(frame, samples)).sum(axis=0)
        photon_variance = self.noise.counts_per_electron * np.maximum(total, 0.0)
        return total, photon_variance + readings.sum(axis=0) * self.noise.read_noise**2

    def _read(self, frame: int) -> tuple[Num[np.ndarray, "survey samples bands"], np.ndarray | None]:
        """Raw counts of a frame's lines, 0 for no data, and which are no data (None if all are data)."""
        counts = self.read_lines(frame)
        missing = no_data(counts, None)
        return counts if missing is None else np.where(missing, 0, counts), missing

    def _dark(self, frame: int, samples: int) -> Float[np.ndarray, "samples bands"]:
        dark = self.dark[frame if len(self.dark) > 1 else 0].astype(np.float32)
        return np.broadcast_to(dark, (samples, dark.shape[1]))
