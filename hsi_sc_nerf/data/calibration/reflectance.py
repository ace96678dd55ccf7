"""Steps 6 and 7 of the paper's Algorithm 1: counts over the white spectrum, within bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from hsi_sc_nerf import paper
from hsi_sc_nerf.data.calibration.config import CalibrationConfig
from hsi_sc_nerf.data.session import Capture


@dataclass(frozen=True, eq=False)
class FrameCalibration:
    """What turns the counts of one capture into reflectance, in the file's own orientation and in all its bands.

    ``reflectance = (counts - dark) * gain / flat``. A column is a sample of the file, an element of the detector's
    line; arrays with one column hold for all of them.

    Attributes:
        dark: counts without light.
        gain: reflectance a count above dark: the panel's reflectance over the white's counts, times the ratio of the
            integration times, over the lamps' drift.
        bands: which of the file's bands are kept.
        bounds: reflectance is clipped to these.
        flat: illumination of each pixel over that of the white spectrum; None where it is taken for even.
        saturation_counts: counts from which a reading is saturated; None where nothing is.
        dead: detector elements that do not follow the light; None where all do.
        ignore_value: counts that stand for "no data"; None where all counts are data.
        quarter_turns: counter-clockwise turns by 90 degrees (``np.rot90``'s k) that set the file's image upright.
    """

    dark: Float[np.ndarray, "columns bands"]
    gain: Float[np.ndarray, "columns bands"]
    bands: Int[np.ndarray, "kept"]
    bounds: tuple[float, float] = paper.REFLECTANCE_BOUNDS
    flat: Float[np.ndarray, "lines samples"] | None = None
    saturation_counts: float | None = None
    dead: Bool[np.ndarray, "samples bands"] | None = None
    ignore_value: float | None = None
    quarter_turns: int = 0


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


def calibrate(
    capture: Capture, white: Float[np.ndarray, "bands"], config: CalibrationConfig
) -> Float[np.ndarray, "lines samples bands"]:
    """Reflectance of a frame, read from disk and normalised with the tarp's spectrum."""
    counts = capture.cube.memmap()
    dark = dark_counts(None if capture.dark is None else capture.dark.memmap(), counts.shape[1])
    return normalise(counts, dark, white, config.bounds)
