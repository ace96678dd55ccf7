"""How uncertain a calibrated reflectance is, from the noise of sample, white and dark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hsi_sc_nerf.calibration.noise import NoiseModel


@dataclass(frozen=True, eq=False)
class ReflectanceUncertainty:
    """Variance of a calibrated reflectance: in each band a parabola over the reflectance itself.

    ``variance = constant + linear * R + quadratic * R^2``: the sample's and the dark's readings give the first, the
    sample's photons the second, the white reference the third.

    The white's share is one error that all pixels of all frames have in common, and the dark's is common to a column
    of the detector: a mean over pixels does not make these smaller. A value that was clipped at a bound, or lies near
    it, is spread less than this says, and on one side only; a flagged value is no measurement and has no uncertainty.
    """

    constant: Float[np.ndarray, "bands"]
    linear: Float[np.ndarray, "bands"]
    quadratic: Float[np.ndarray, "bands"]

    def standard_deviation(self, reflectance: Float[np.ndarray, "*shape bands"]) -> Float[np.ndarray, "*shape bands"]:
        """Standard deviation of a pixel's reflectance; negative reflectances (noise) count as 0."""
        lit = np.maximum(reflectance, 0.0)
        return np.sqrt(self.constant + (self.linear + self.quadratic * lit) * lit)


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

    What is left out: the error of a drift of the lamps that was corrected (a share of the white's, for it is a mean
    over as many pixels), and that of the panel's own certificate.

    Args:
        noise: of one reading.
        white: counts of the white above dark, W - D, as measured or smoothed.
        white_pixels: how many of its pixels were averaged.
        smoothing_bands: over how many bands its spectrum was averaged, around each band; odd.
        frame_dark_readings: how many dark readings were averaged for each element of a frame (the dark cube's lines);
            0 where no dark was taken off.
        white_dark_readings: how many in all stand behind the mean dark of the white (lines times the tarp's columns);
            0 likewise.
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
    return ReflectanceUncertainty(
        constant=gain**2 * of_sample,
        linear=gain * noise.counts_per_electron,
        quadratic=_of_moving_average(of_white, smoothing_bands) / white**2,
    )


def typical_uncertainty(
    uncertainty: ReflectanceUncertainty, mean_reflectance: Float[np.ndarray, "bands"]
) -> Float[np.ndarray, "bands"]:
    """Standard deviation of one pixel in each band, at the object's mean reflectance."""
    return uncertainty.standard_deviation(mean_reflectance)


def _of_moving_average(
    variance: Float[np.ndarray, "bands"], width: Int[np.ndarray, "bands"]
) -> Float[np.ndarray, "bands"]:
    """Variance of a moving average of independent bands; the window of each band lies within the spectrum."""
    cumulative = np.concatenate([[0.0], np.cumsum(variance)])
    centre, reach = np.arange(len(variance)), width // 2
    return (cumulative[centre + reach + 1] - cumulative[centre - reach]) / width**2
