"""Drift of the lamps over a session, from the part of the chamber that stands still in the image.

Only some lines of each frame are read. The pixels that follow one common course in time are found
(`static_pixels`); their sum in each band over the first frame's is the lamps' light, and a low-order curve over the
wavelength takes its noise off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import stats

from hsi_sc_nerf.calibration.config import LampDriftConfig
from hsi_sc_nerf.calibration.no_data import no_data
from hsi_sc_nerf.calibration.noise import NoiseModel
from hsi_sc_nerf.calibration.static_pixels import static_pixels

BINS = 12
"""Of bands, in which static pixels are looked for."""
FEWEST_LINES = 8
"""That a survey reads, however small the image."""
FEWEST_PIXELS = 64
"""That must stand still."""
SMALLEST_SIGNAL = 10.0
"""Signal over noise of the static pixels' sum from which a band takes part in the curve."""

ReadLines = Callable[[int], Num[np.ndarray, "survey samples bands"]]


@dataclass(frozen=True, eq=False)
class LampDrift:
    """The lamps' light in each frame over that in the first, which is taken for the time of the tarp.

    Attributes:
        factor: the smooth curve; reflectance is divided by it where the drift is corrected.
        measured: the same before it was smoothed over the wavelength; nan in bands without enough light.
        standard_error: of ``factor``; 0 in the first frame.
        static: which of the surveyed pixels stand still.
        p_value: how often chance would make such a drift, if the lamps were steady but for the systematic floor.
        significant: whether it is smaller than the configured level.
    """

    factor: Float[np.ndarray, "frames bands"]
    measured: Float[np.ndarray, "frames bands"]
    standard_error: Float[np.ndarray, "frames bands"]
    static: Bool[np.ndarray, "survey samples"]
    p_value: float
    significant: bool

    @property
    def static_share(self) -> float:
        """Share of the surveyed pixels that stand still."""
        return float(self.static.mean())


@dataclass(frozen=True)
class NotMeasurable:
    """Why the lamps' drift cannot be told from the frames; one sentence."""

    reason: str


def survey_lines(lines: int, count: int) -> Int[np.ndarray, "survey"]:
    """Which lines of a frame a survey reads, ascending: at most ``count``, the first and the last among them.

    Towards the edges of the image, where the chamber is most likely to be free, they lie twice as close.
    """
    even = np.linspace(0.0, 1.0, min(max(count, 2), lines))
    closer = even - np.sin(2.0 * np.pi * even) / (4.0 * np.pi)
    return np.unique((closer * (lines - 1)).round().astype(int))


def survey_count(lines: int, config: LampDriftConfig) -> int:
    """How many lines a survey reads of a frame."""
    return max(FEWEST_LINES, round(config.survey_share * lines))


def correction(drift: LampDrift | NotMeasurable, config: LampDriftConfig) -> Float[np.ndarray, "frames bands"] | None:
    """What each frame's reflectance is divided by; None where the drift is not to be corrected."""
    if isinstance(drift, NotMeasurable) or config.correct == "never":
        return None
    return drift.factor if drift.significant or config.correct == "always" else None


def measure_lamp_drift(
    read_lines: ReadLines,
    frames: int,
    dark: Sequence[Float[np.ndarray, "columns bands"]],
    noise: NoiseModel,
    wavelengths_nm: Float[np.ndarray, "bands"],
    config: LampDriftConfig,
    *,
    saturation_counts: float | None = None,
    dead: Bool[np.ndarray, "samples bands"] | None = None,
) -> LampDrift | NotMeasurable:
    """Measure the drift over ``frames`` frames of one exposure.

    Args:
        read_lines: the raw counts of the surveyed lines of a frame, by its number, nan where there is no data;
            called twice for each frame, so that they need not all be held in memory.
        frames: how many there are.
        dark: counts without light, of each frame, or one for all.
        noise: of one reading.
        wavelengths_nm: band centres.
        config: the settings.
        saturation_counts: counts from which a reading is saturated; None where nothing is.
        dead: detector elements that do not follow the light; None where all do.
    """
    if frames < 2:
        return NotMeasurable("there is a single frame")
    if len(wavelengths_nm) <= config.degree:
        return NotMeasurable(f"{len(wavelengths_nm)} bands are too few for its curve over the wavelength")
    survey = _Survey(read_lines, frames, dark, noise, saturation_counts, dead)
    static, unusable = survey.find_static(_bins(wavelengths_nm))
    share = float(static.mean())
    if static.sum() < FEWEST_PIXELS or share < config.smallest_static_share:
        return NotMeasurable(
            f"only {100.0 * share:.1f} % of the surveyed pixels follow one course, so nothing is sure to stand still"
        )
    total, variance = survey.sum_over(static, unusable)
    lit = (total > SMALLEST_SIGNAL * np.sqrt(variance)).all(axis=0)
    if lit.sum() <= config.degree:
        return NotMeasurable("what stands still in the image is too dark")
    basis = smooth_basis(wavelengths_nm, lit, config.degree)
    measured = np.full(total.shape, np.nan)
    measured[:, lit] = total[:, lit] / total[0, lit]
    coefficients, covariance = fit_over_wavelength(
        np.log(total[:, lit]), (variance[:, lit] / total[:, lit] ** 2).mean(axis=0), basis[lit]
    )
    factor = np.exp((coefficients - coefficients[0]) @ basis.T)
    # The first frame's error is in all the others.
    standard_error = factor * np.sqrt(2.0 * np.einsum("bi,ij,bj->b", basis, covariance, basis))
    standard_error[0] = 0.0
    p_value = chance_of(coefficients, covariance, config.floor)
    return LampDrift(factor, measured, standard_error, static, p_value, p_value < config.significance)


def smooth_basis(
    wavelengths_nm: Float[np.ndarray, "bands"], lit: Bool[np.ndarray, "bands"], degree: int
) -> Float[np.ndarray, "bands terms"]:
    """Polynomials in 1 / wavelength, orthogonal and of root mean square 1 over the lit bands; the first is constant.

    By Wien's law the logarithm of a lamp's light, and so of its drift, is a straight line over 1 / wavelength.
    """
    inverse = 1.0 / wavelengths_nm
    place = (inverse - inverse[lit].mean()) / max(float(np.ptp(inverse[lit])), 1e-12)
    powers = np.vander(place, degree + 1, increasing=True)
    _, triangle = np.linalg.qr(powers[lit])
    basis = np.linalg.solve(triangle.T, powers.T).T * np.sqrt(lit.sum())
    return basis * np.sign(basis[np.flatnonzero(lit)[0], 0])


def fit_over_wavelength(
    log_light: Float[np.ndarray, "frames lit"],
    variance: Float[np.ndarray, "lit"],
    basis: Float[np.ndarray, "lit terms"],
) -> tuple[Float[np.ndarray, "frames terms"], Float[np.ndarray, "terms terms"]]:
    """Weighted least squares of each frame's deviation from the mean frame; the coefficients and their covariance.

    Where the bands scatter about the curves by more than their variances, these are taken to be larger by as much.
    """
    deviation = log_light - log_light.mean(axis=0)
    weighted = basis / variance[:, None]
    covariance = np.linalg.inv(basis.T @ weighted)
    coefficients = deviation @ weighted @ covariance
    residual = deviation - coefficients @ basis.T
    degrees = (len(log_light) - 1) * max(1, basis.shape[0] - basis.shape[1])
    scatter = float((residual**2 / variance).sum()) / degrees
    return coefficients, covariance * max(1.0, scatter)


def chance_of(
    coefficients: Float[np.ndarray, "frames terms"], covariance: Float[np.ndarray, "terms terms"], floor: float
) -> float:
    """p-value of the frames' deviations under steady lamps whose light seems to change by ``floor`` all the same.

    A chi-square test: ``floor`` is the root mean square over the bands, shared out evenly among the terms (whose own
    root mean squares are 1).
    """
    frames, terms = coefficients.shape
    expected = covariance + floor**2 / terms * np.eye(terms)
    distance = np.einsum("fi,ij,fj->", coefficients, np.linalg.inv(expected), coefficients)
    return float(stats.chi2.sf(distance, (frames - 1) * terms))


def _bins(wavelengths_nm: Float[np.ndarray, "bands"]) -> Bool[np.ndarray, "bands bins"]:
    """Which bands a bin sums: neighbours, evenly over 1 / wavelength, as the lamps' colour changes."""
    inverse = 1.0 / wavelengths_nm
    place = (inverse - inverse.min()) / max(float(np.ptp(inverse)), 1e-12)
    number = np.minimum((place * BINS).astype(int), BINS - 1)
    return number[:, None] == np.unique(number)


@dataclass(frozen=True, eq=False)
class _Survey:
    """The surveyed lines of all frames, read one frame at a time and summed up in the order in which they lie."""

    read_lines: ReadLines
    frames: int
    dark: Sequence[Float[np.ndarray, "columns bands"]]
    noise: NoiseModel
    saturation_counts: float | None
    dead: Bool[np.ndarray, "samples bands"] | None

    def find_static(
        self, bins: Bool[np.ndarray, "bands bins"]
    ) -> tuple[Bool[np.ndarray, "survey samples"], Bool[np.ndarray, "survey samples bands"]]:
        """Pixels that stand still, and which readings cannot be used: dead, or saturated or no data in some frame."""
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
        # A dead element is in no sum, and spoils none if it is stuck at the largest count.
        unusable[:, dead[0], dead[1]] = False
        spoilt = np.stack([unusable[..., members].any(axis=-1) for members in bins.T], axis=-1)
        unusable[:, dead[0], dead[1]] = True
        binned = binned.reshape(-1, *binned.shape[2:])
        of_light = self.noise.counts_per_electron * np.maximum(binned.mean(axis=1), 0.0)
        variance = of_light + self.noise.read_noise**2 @ bins
        static = static_pixels(binned, np.where(spoilt.reshape(variance.shape), np.inf, variance))
        return static.reshape(first.shape[:2]), unusable

    def sum_over(
        self, static: Bool[np.ndarray, "survey samples"], unusable: Bool[np.ndarray, "survey samples bands"]
    ) -> tuple[Float[np.ndarray, "frames bands"], Float[np.ndarray, "frames bands"]]:
        """Counts above dark of the static pixels' usable readings in each band, and the variance of this sum."""
        samples, bands = unusable.shape[1:]
        weight = static.astype(np.float32)[:, None]
        left_out = np.nonzero(unusable & static[..., None])
        of_element = static.sum(axis=0)[:, None] - (unusable & static[..., None]).sum(axis=0)
        total = np.empty((self.frames, bands))
        for frame in range(self.frames):
            counts, _ = self._read(frame)
            total[frame] = np.matmul(weight, counts.astype(np.float32)).sum(axis=(0, 1), dtype=np.float64)
            total[frame] -= np.bincount(left_out[2], counts[left_out], minlength=bands)
            total[frame] -= (of_element * self._dark(frame, samples)).sum(axis=0)
        readings = of_element.sum(axis=0)
        return total, self.noise.counts_per_electron * np.maximum(total, 0.0) + readings * self.noise.read_noise**2

    def _read(self, frame: int) -> tuple[Num[np.ndarray, "survey samples bands"], np.ndarray | None]:
        """Raw counts of a frame's lines, 0 where there is no data, and where that is; None where there is nowhere."""
        counts = self.read_lines(frame)
        missing = no_data(counts, None)
        return counts if missing is None else np.where(missing, 0, counts), missing

    def _dark(self, frame: int, samples: int) -> Float[np.ndarray, "samples bands"]:
        dark = self.dark[frame if len(self.dark) > 1 else 0].astype(np.float32)
        return np.broadcast_to(dark, (samples, dark.shape[1]))
