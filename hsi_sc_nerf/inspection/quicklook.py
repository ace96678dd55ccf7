"""Quicklooks: a few bands of all lines, and all bands of a few lines, of each frame."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Num, UInt8
from scipy.stats import median_abs_deviation

from hsi_sc_nerf.calibration.detector import (
    SOME_LINES,
    dark_columns,
    fill_no_data,
    light_above,
    light_of_some_lines,
    no_data,
    saturation_counts,
    some_lines,
    spread_rows,
)
from hsi_sc_nerf.calibration.reference_checks import bright_pixels
from hsi_sc_nerf.calibration.white_reference import Roi, tarp_region
from hsi_sc_nerf.calibration.white_source import panel_reflectance, white_exposure_ratio
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.poses.session_pictures import edge_slope
from hsi_sc_nerf.robust_scatter import robust_std
from hsi_sc_nerf.spectra import nearest_bands, to_8_bit

PICTURE_NM = (640.0, 550.0, 470.0)
"""Red, green and blue of the pictures; markers' inks are dark in all of them."""
DARK_SIGMAS = 3.0
"""A value is dark if it exceeds the dark cube by less than this many standard deviations."""
MARKERS_PERCENTILE = 99.5
"""Percentile of a picture that is white where markers are sought: in a dark chamber, paper may fill little of it, and
highlights fill less than the rest."""
WORKERS = 2


@dataclass(frozen=True, eq=False)
class Quicklook:
    """A capture by a few of its lines and bands. Pictures are oriented as in the file.

    Attributes:
        name: name of the capture.
        picture: pseudo-RGB reflectance; without a white, relative to its largest bright region.
        top_counts: the largest reading of the lines read, without bands that are marked as bad.
        at_top_fraction: fraction of the readings with ``top_counts``, by band.
        dark_fraction: fraction of the readings without light, by band.
        sharpness_per_px: mean slope of the strongest edges over the picture's contrast.
        digest: hash of the readings; equal for copies only.
        dark_spectrum: mean counts of the dark reference; None without one.
        bright_spectra: counts above dark of some of the brighter pixels.
    """

    name: str
    picture: Float[np.ndarray, "lines samples 3"]
    top_counts: float
    at_top_fraction: Float[np.ndarray, "bands"]
    dark_fraction: Float[np.ndarray, "bands"]
    sharpness_per_px: float
    digest: str
    dark_spectrum: Float[np.ndarray, "bands"] | None
    bright_spectra: Float[np.ndarray, "pixels bands"]

    @property
    def gray(self) -> UInt8[np.ndarray, "lines samples"]:
        """Mean of the picture's channels, which is searched for markers.

        White is the picture's brightest part: markers are seen even if a header states a wrong integration time.
        """
        mean = self.picture.mean(axis=-1)
        return to_8_bit(mean / max(float(np.percentile(mean, MARKERS_PERCENTILE)), 1e-9))


def quicklooks_of(session: Session, roi: Roi | None = None) -> list[Quicklook]:
    """The quicklooks of a session's frames, in its order; ``roi`` is the region of the tarp, if it is given."""
    with ThreadPoolExecutor(WORKERS) as pool:
        return list(pool.map(quicklook_of, session.frames, white_levels(session, roi)))


def quicklook_of(capture: Capture, white: Float[np.ndarray, "bands"]) -> Quicklook:
    """The quicklook of one capture.

    Args:
        white: counts above dark that are a reflectance of 1 at this capture's integration time.
    """
    cube = capture.cube
    counts = cube.memmap()
    lines = np.asarray(counts[spread_rows(cube.shape[0], SOME_LINES)])
    dark = None if capture.dark is None else some_lines(capture.dark)
    read, light = fill_no_data(lines, cube.ignore_value), light_above(lines, dark, cube.ignore_value)
    good, noise = cube.good_bands, np.zeros(cube.shape[2])
    channels = nearest_bands(np.where(good, cube.wavelengths_nm, np.inf), PICTURE_NM).tolist()
    if dark is not None:
        noise = _noise_above(np.asarray(dark, np.float32))
    level = dark_columns(dark, *cube.shape[1:]).mean(axis=0)
    # With the band before, which lies beside it in the file.
    bands = [slice(band - int(band > 0 and good[band - 1]), band + 1) for band in channels]
    picture = np.stack(
        [
            (_mean_counts(counts[..., near], cube.ignore_value, level[near].mean()) - level[near].mean())
            / white[near].mean()
            for near in bands
        ],
        axis=-1,
        dtype=np.float32,
    )
    top = read[..., good].max()
    return Quicklook(
        name=capture.name,
        picture=picture,
        top_counts=float(top),
        at_top_fraction=(read == top).mean(axis=(0, 1)),
        dark_fraction=(light <= DARK_SIGMAS * noise).mean(axis=(0, 1)),
        sharpness_per_px=sharpness_per_px(picture.mean(axis=-1)),
        digest=hashlib.sha256(np.ascontiguousarray(read).tobytes()).hexdigest(),
        dark_spectrum=None if dark is None else dark.mean(axis=(0, 1)),
        bright_spectra=bright_pixels(light),
    )


def white_levels(session: Session, roi: Roi | None = None) -> list[Float[np.ndarray, "bands"]]:
    """Counts above dark that are a reflectance of 1 in each frame, by band.

    They are those of the tarp at the frame's integration time, over its own reflectance. Without a tarp, or without
    raw counts, the largest bright region of the first frame is taken for white.
    """
    if session.white is None or not session.has_counts:
        return [white_counts(session.frames[0])] * len(session.frames)
    level = white_counts(session.white, roi) / panel_reflectance(session)
    return [level / white_exposure_ratio(session, "tarp", frame) for frame in session.frames]


def white_counts(capture: Capture, roi: Roi | None = None) -> Float[np.ndarray, "bands"]:
    """Counts above dark of a region, or of the largest bright one, of a capture, by band: of a tarp in its own."""
    light = light_of_some_lines(capture.cube, capture.dark)
    region = tarp_region(capture.cube, light[..., capture.cube.good_bands].mean(axis=-1), roi)
    level = np.median(light[region if region.any() else ~region], axis=0)
    return np.maximum(level, 1e-3 * max(float(level.max()), 1e-9))


def reflectance_noise(session: Session) -> float:
    """Upper limit of the standard deviation of one value's reflectance, the median over the bands.

    It is measured between the first two frames. Changes of the lamps do not contribute. Moving parts do: the limit is
    1.3 times the noise if a third of the picture turns, and twice the noise if half does.
    """
    pairs = zip(session.frames[:2], white_levels(session), strict=False)
    first, second = (light_of_some_lines(frame.cube, frame.dark) / white for frame, white in pairs)
    change = second - first
    deviation = median_abs_deviation(change.reshape(-1, change.shape[-1]), scale="normal")
    return float(np.median(deviation) / np.sqrt(2.0))


def saturation_level(session: Session, quicklooks: Sequence[Quicklook]) -> float | None:
    """Reading at which the frames saturate, by the brightest of them; None if nothing saturates."""
    brightest = sorted(range(len(quicklooks)), key=lambda index: -quicklooks[index].top_counts)[:3]
    cubes = [some_lines(session.frames[index].cube) for index in brightest]
    return saturation_counts(cubes, np.broadcast_to(session.frames[0].cube.good_bands, cubes[0].shape[1:]))


def sharpness_per_px(picture: Float[np.ndarray, "lines samples"]) -> float:
    """Mean slope of a picture's strongest edges over its contrast (1st to 99th percentile); 0 without contrast."""
    smooth = cv2.GaussianBlur(np.asarray(picture, np.float32), (0, 0), 0.7)
    low, high = np.percentile(smooth, [1.0, 99.0])
    return edge_slope(smooth) / float(high - low) if high > low else 0.0


def _noise_above(dark: Float[np.ndarray, "dark_lines dark_samples bands"]) -> Float[np.ndarray, "bands"]:
    """Standard deviation of a reading without light less the dark cube's mean, by band."""
    lines = len(dark)
    # A single line does not tell its noise; its elements differ by their pattern as well.
    pattern = np.diff(dark[0], axis=0) / np.sqrt(2.0)
    spread = dark.std(axis=0, ddof=1).mean(axis=0) if lines > 1 else robust_std(pattern, axis=0)
    return spread * np.sqrt(1.0 + 1.0 / lines)


def _mean_counts(
    counts: Num[np.ndarray, "lines samples some"], ignore_value: float | None, dark: float
) -> Float[np.ndarray, "lines samples"]:
    """Mean of the bands with data; a pixel without any is dark."""
    counts = np.asarray(counts, np.float32)
    missing = no_data(counts, ignore_value)
    return np.ma.masked_array(counts, np.ma.nomask if missing is None else missing).mean(axis=-1).filled(dark)
