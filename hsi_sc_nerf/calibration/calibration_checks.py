"""Checks of the white reference and of the calibration, as findings.

A white reference is flat, brighter than the frames in the same place, and not one of the frames. Of the calibration,
the lamps' drift, clipped and saturated values, and the noise are checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float
from skimage.filters import threshold_otsu

from hsi_sc_nerf.calibration.detector import light_of_some_lines, unlit_bands
from hsi_sc_nerf.calibration.lamp_drift import NotMeasurable
from hsi_sc_nerf.calibration.reflectance import PixelCounts
from hsi_sc_nerf.calibration.session_calibration import SessionCalibration
from hsi_sc_nerf.calibration.white_reference import Roi, tarp_region
from hsi_sc_nerf.calibration.white_source import WhiteSource, panel_reflectance, white_exposure_ratio, white_source
from hsi_sc_nerf.capture.session import Capture, Session
from hsi_sc_nerf.findings import Finding, Level

ABOVE_WHITE = 1.05
"""Reflectance that counts as brighter than the white: noise and uneven light alone lift a white wall just above 1."""
ABOVE_AMBER, ABOVE_RED = 0.01, 0.05
"""Fractions of values above the white's, which will be clipped."""
OUTSHONE, OUTSHONE_FRACTION = 2.0, 0.05
"""The white is too dark, or coloured, if more than this fraction of a band's values is brighter than it by this
factor; highlights cover less of the image."""
ROUGHNESS = 0.1
"""Largest median difference between neighbouring pixels of a white (relative)."""
UNEVENNESS = 0.5
"""Largest range (10th to 90th percentile, relative) along a column of a WHITEREF cube."""
MOVING = 0.3
"""A pixel shows something that moves if its brightness varies by more than this over the frames (range, relative)."""
MARGIN = 1.1
"""Brightness counts as outside its range in the frames from this factor on."""
MIN_MOVING_PX = 50
"""With fewer moving pixels, all pixels are compared."""
ALIKE, BRIGHTER = 0.5, 0.2
"""A capture is one of the frames if at least this fraction of the moving pixels looks like the frames, and less than
this fraction of its brightest region is brighter than the frames there."""
EVEN = 0.5
"""A described panel is none of the frames if it scatters less than this, relative to them, over the moving pixels."""
SHADE_PX, SHADE_FRACTION, SHADE_BETWEEN, SHADE_LEVEL = 5, 0.1, 0.08, 0.85
"""Pixels that are averaged, least fraction of the white in shade and in light, largest fraction in the middle third
between the two levels (even gradients have 0.17), and the darker level over the brighter."""
WHITE_FRACTION = 0.25
"""A capture that outshines the others in this fraction of the pixels looks like a white."""
MAX_ERROR = 0.003
"""Largest standard error of a known drift."""
LARGE_DRIFT, IMPLAUSIBLE_DRIFT = 0.3, 0.6
"""Changes of the lamps' light: rare ones, and those larger than any warm-up."""
CLIPPED_AMBER, CLIPPED_RED = 0.01, 0.2
"""Fractions of values at the upper bound. A white that clips fewer is judged by `check_white`."""
SATURATED_AMBER, SATURATED_RED = 0.01, 0.5
"""Fractions of saturated values in a band. They are flagged and used nowhere, so few do no harm."""
LOW_SNR, USELESS_SNR = 30.0, 5.0
"""Signal-to-noise ratios of one pixel of the white, median over the bands; a SPECIM IQ has more than 100."""
MAX_SCATTER = 0.02
"""Scatter of the stationary wall from frame to frame that noise and rounding do not explain."""


def check_white(
    session: Session, source: Literal["auto"] | WhiteSource = "auto", roi: Roi | None = None
) -> list[Finding]:
    """Check the white of a session on a few lines of each cube.

    Args:
        session: its captures.
        source: where the white is. A target in the frames is not checked: the calibration measures it in its place.
        roi: region of the tarp; None finds it by its brightness.

    Returns:
        The findings ``white`` (red if the white is none), ``white-shade`` (amber if a part of a tarp is darker) and
        ``white-clipped`` (values above the white's: amber from 1 %, red from 5 %).

    Raises:
        InputError: the session does not have that source of white, or its panel's reflectance cannot be read.

    Example:
        >>> refuse_red(check_white(open_session(Path("captures"))))
    """
    found = white_source(session, source)
    if found == "product":
        return [Finding("white", "green", "The instrument's finished reflectance needs no white.")]
    if found == "target":
        return [Finding("white", "green", "White: a target in every frame, which the calibration measures.")]
    fault, clipped, values = _check_tarp(session, roi) if found == "tarp" else _check_own_whites(session)
    white = f"the capture {session.white.name}" if session.white and found == "tarp" else "the white of each capture"
    of_white = Finding("white", "green", f"White: {white} looks like a white.", values)
    if fault is not None:
        of_white = Finding("white", "red", f"{session.path}: {fault}.", values)
    level: Level = "red" if clipped > ABOVE_RED else "amber" if clipped > ABOVE_AMBER else "green"
    described = session.panel_reflectance_path is not None
    text = f"{100.0 * clipped:.2g} % of the frames' values are brighter than {white}"
    if described:
        text += " would be with a reflectance of 1"
    if level != "green":
        advice = "is what its panel_reflectance says" if described else "is white, or give its panel_reflectance"
        text = f"{session.path}: {text} and will be clipped"
        text = f"{text}; check that it was taken under the frames' light and {advice}"
    found_clipped = Finding("white-clipped", level, f"{text}.", {"fraction": clipped})
    if fault is not None or not values.get("two_levels"):
        return [of_white, found_clipped]
    sentence = (
        f"{session.path}: {white} has two distinct levels of brightness: a shadow fell on it, or something bright "
        "stands beside it; take it again, or give its place with --calibration.roi."
    )
    return [of_white, Finding("white-shade", "amber", sentence), found_clipped]


def _check_tarp(session: Session, roi: Roi | None) -> tuple[str | None, float, dict[str, object]]:
    """What is wrong with the tarp (None for nothing), the fraction of clipped values, and the figures behind it."""
    tarp, frames = session.white, session.frames
    assert tarp is not None
    light = light_of_some_lines(tarp.cube, tarp.dark)
    image = light[..., tarp.cube.good_bands].mean(axis=-1)
    region = tarp_region(tarp.cube, image, roi)
    if not region.any():
        return f"the white {tarp.name} is dark; take it again", 0.0, {}
    white = np.median(light[region], axis=0)
    perfect = white / panel_reflectance(session)
    live = ~unlit_bands(white[None]) & tarp.cube.good_bands
    exposures = np.array([white_exposure_ratio(session, "tarp", frame) for frame in frames])
    images, clipped, outshone = _compare_with_white(frames, [perfect[None] / ratio for ratio in exposures], live)
    differences = np.abs(np.diff(image, axis=1)) / np.maximum(image[:, 1:], 1e-9)
    two_levels = is_partly_shaded(image, region)
    roughness = float(np.median(differences[region[:, 1:]])) if region[:, 1:].any() else np.inf
    brighter, alike, scatter, looks_white = 1.0, 0.0, 0.0, None
    if images.shape[1:] == image.shape:
        image = light[..., live].mean(axis=-1)
        brighter, alike, scatter, best = _compare_with_frames(image, region, images * exposures[:, None, None])
        looks_white = None if best is None else frames[best].name
    fault = None
    is_grey_panel = session.panel_reflectance_path is not None and scatter < EVEN
    if brighter < BRIGHTER and alike >= ALIKE and not is_grey_panel:
        fault = "shows the same as the frames, and no part of it is brighter"
    elif outshone > OUTSHONE_FRACTION:
        fault = "is too dark or coloured: the frames are over twice as bright in some bands"
    elif roughness > ROUGHNESS:
        fault = f"is not flat: neighbouring pixels differ by {100.0 * roughness:.0f} %"
    if fault is not None:
        advice = "no other capture looks like a white, so take one"
        if looks_white is not None:
            advice = f"{looks_white} looks most like a white, so name it as 'white_reference' in session.json"
        fault = f"the white {tarp.name} {fault}; {advice}"
    return (
        fault,
        clipped,
        {
            "white": tarp.name,
            "looks_most_like_a_white": tarp.name if fault is None else looks_white,
            "area_fraction": float(region.mean()),
            "roughness": roughness,
            "two_levels": two_levels,
            "brighter_than_frames_fraction": brighter,
            "like_the_frames_fraction": alike,
            "outshone_fraction": outshone,
        },
    )


def is_partly_shaded(image: Float[np.ndarray, "lines samples"], region: Bool[np.ndarray, "lines samples"]) -> bool:
    """Whether a white's brightness has two distinct levels; uneven light alone has all levels between them."""
    smooth = cv2.blur(np.asarray(image, np.float32), (SHADE_PX, SHADE_PX))
    values = smooth[cv2.erode(region.astype(np.uint8), np.ones((SHADE_PX, SHADE_PX))) > 0].astype(float)
    if len(values) < MIN_MOVING_PX or np.ptp(values) == 0.0:
        return False
    is_low = values <= threshold_otsu(values)
    fraction, low_level, high_level = is_low.mean(), values[is_low].mean(), values[~is_low].mean()
    third = (high_level - low_level) / 3.0
    between = float(((values > low_level + third) & (values < high_level - third)).mean())
    is_split = SHADE_FRACTION < fraction < 1.0 - SHADE_FRACTION and between < SHADE_BETWEEN
    return bool(is_split and low_level < SHADE_LEVEL * high_level)


def _compare_with_frames(
    image: Float[np.ndarray, "lines samples"],
    region: Bool[np.ndarray, "lines samples"],
    frames: Float[np.ndarray, "frames lines samples"],
) -> tuple[float, float, float, int | None]:
    """Compare the white's brightness with that of the frames, pixel by pixel.

    Returns:
        The fraction of the white's region that is brighter than the frames there; the fraction of the moving pixels
        that look like the frames; the white's scatter over these pixels relative to that of the frames; and the frame
        that looks like a white, if one does.
    """
    usual = np.median(np.concatenate([frames, image[None]]), axis=0)
    outshines = (frames > MARGIN * usual).mean(axis=(1, 2))
    best = int(outshines.argmax()) if len(frames) > 2 and outshines.max() >= WHITE_FRACTION else None
    others = frames if best is None else np.delete(frames, best, axis=0)
    low, high = others.min(axis=0), others.max(axis=0)
    moving = high - low > MOVING * np.abs(usual)
    if moving.sum() < MIN_MOVING_PX:
        moving = np.ones_like(moving)
    inside = (image >= low / MARGIN) & (image <= high * MARGIN)
    scatter = [float(picture[moving].std() / max(picture[moving].mean(), 1e-9)) for picture in (image, *others)]
    relative = scatter[0] / max(float(np.median(scatter[1:])), 1e-9)
    return float((image > MARGIN * high)[region].mean()), float(inside[moving].mean()), relative, best


def _check_own_whites(session: Session) -> tuple[str | None, float, dict[str, object]]:
    """As `_check_tarp`, for WHITEREF cubes."""
    whites, uneven, good_bands = [], {}, np.ones(len(session.wavelengths_nm), bool)
    of_panel = panel_reflectance(session)
    for frame in session.frames:
        assert frame.white is not None
        light = light_of_some_lines(frame.white, frame.white_dark)
        columns = np.median(light, axis=0)
        if len(columns) != frame.cube.shape[1]:
            columns = np.median(columns, axis=0, keepdims=True)
        whites.append(columns / of_panel / white_exposure_ratio(session, "capture", frame))
        image = light[..., frame.white.good_bands].mean(axis=-1)
        low, middle, high = np.percentile(image, [10.0, 50.0, 90.0], axis=0)
        uneven[frame.name] = float(np.median((high - low) / np.maximum(middle, 1e-9)))
        good_bands &= frame.cube.good_bands
    lit = ~unlit_bands(np.stack([np.median(white, axis=0) for white in whites]))
    _, clipped, outshone = _compare_with_white(session.frames, whites, lit & good_bands)
    fault, not_flat = None, [name for name, unevenness in uneven.items() if unevenness > UNEVENNESS]
    if not_flat:
        fault = f"the WHITEREF of {', '.join(not_flat)} is not flat; take a white that fills the image"
    elif outshone > OUTSHONE_FRACTION:
        fault = "the WHITEREF cubes are too dark or coloured: the frames are over twice as bright in some bands"
    return fault, clipped, {"unevenness": max(uneven.values()), "outshone_fraction": outshone}


def _compare_with_white(
    frames: Sequence[Capture], whites: Sequence[Float[np.ndarray, "columns bands"]], live: Bool[np.ndarray, "bands"]
) -> tuple[Float[np.ndarray, "frames lines samples"], float, float]:
    """Compare frames with their whites, which are scaled to the frames' exposures and a reflectance of 1.

    Returns:
        Brightness of the frames' lines; the fraction of values above the white's; and, of the worst live band, the
        fraction far above it.
    """
    images, clipped, outshone = [], [], []
    for frame, white in zip(frames, whites, strict=True):
        light = light_of_some_lines(frame.cube, frame.dark)[..., live]
        images.append(light.mean(axis=-1))
        clipped.append((light > ABOVE_WHITE * white[..., live]).mean())
        outshone.append((light > OUTSHONE * white[..., live]).mean(axis=(0, 1)))
    return np.stack(images), float(np.mean(clipped)), float(np.mean(outshone, axis=0).max())


def check_calibration(session: Session, calibration: SessionCalibration) -> list[Finding]:
    """The findings ``drift`` and ``noise`` of a calibrated session.

    Example:
        >>> session = open_session(Path("captures"))
        >>> refuse_red(check_calibration(session, calibrate_session(session, CalibrationConfig())))
    """
    return [_check_drift(session, calibration), _check_noise(session, calibration)]


def check_clipped(session: Session, calibration: SessionCalibration, counts: PixelCounts, pixels: int) -> Finding:
    """The finding ``clipped``: values that were clipped at the upper bound or are saturated, in frames or white.

    Args:
        session: its bands.
        calibration: calibration of the session.
        counts: counts of all frames.
        pixels: number of pixels of all frames.
    """
    by_band = counts.saturated / pixels
    worst = int(by_band.argmax())
    worst_nm = float(session.wavelengths_nm[calibration.bands[worst]])
    clipped = float(counts.clipped_high.mean() / pixels)
    lost_nm: list[float] = []
    if calibration.defects is not None:
        explained = np.union1d(calibration.bands, np.flatnonzero(calibration.defects.bad_bands))
        lost_nm = np.delete(session.wavelengths_nm, explained).tolist()
    values = {"clipped": clipped, "saturated": float(by_band[worst]), "saturated_nm": worst_nm, "lost_nm": lost_nm}
    of_a_band = f"at most {100.0 * by_band[worst]:.2g} % of a band ({worst_nm:.0f} nm) are"
    text = (
        f"{100.0 * clipped:.2g} % of the values are clipped at the upper bound, and "
        f"{of_a_band if by_band[worst] else 'none is'} saturated"
    )
    if lost_nm:
        span = f"{lost_nm[0]:.0f} to {lost_nm[-1]:.0f} nm"
        text += f"; {len(lost_nm)} bands ({span}) are left out, because the white saturates in them"
    if clipped > CLIPPED_RED or by_band[worst] > SATURATED_RED:
        return Finding("clipped", "red", f"{session.path}: {text}; check the white and the integration time.", values)
    if clipped > CLIPPED_AMBER or by_band[worst] > SATURATED_AMBER or lost_nm:
        advice = "a shorter integration time avoids it"
        if not (by_band[worst] > SATURATED_AMBER or lost_nm):  # clipped readings are as bright by any exposure
            advice = "check the white, or raise the upper bound with --calibration.bounds"
        return Finding("clipped", "amber", f"{session.path}: {text}; {advice}.", values)
    return Finding("clipped", "green", f"Values: {text}.", values)


def _check_drift(session: Session, calibration: SessionCalibration) -> Finding:
    drift = calibration.drift
    if calibration.source == "product":
        return Finding("drift", "green", "Lamps: what their drift did to finished reflectance is not known.")
    if not calibration.one_white:
        return Finding("drift", "green", "Lamps: every frame has a white of its own, so their drift cancels.")
    if isinstance(drift, NotMeasurable):
        sentence = f"the lamps' drift was not measured, because {drift.reason}; show more of the chamber's wall."
        return Finding("drift", "amber", f"{session.path}: {sentence}", {"measured": False})
    change = float(np.abs(drift.factor[:, calibration.bands] - 1.0).max())
    error = float(drift.standard_error[:, calibration.bands].max())
    pixels = int(drift.static.sum())
    values = {"measured": True, "largest_change": change, "standard_error": error, "static_pixels": pixels}
    text = f"the lamps' light changes by up to {100.0 * change:.1f} %"
    if change > LARGE_DRIFT:
        level: Level = "red" if change > IMPLAUSIBLE_DRIFT else "amber"
        return Finding("drift", level, f"{session.path}: {text}; check lamps and exposure times.", values)
    if error > MAX_ERROR:
        sentence = (
            f"{text}, measured to {100.0 * error:.1f} % only, from {pixels} pixels; show more of the chamber's wall."
        )
        return Finding("drift", "amber", f"{session.path}: {sentence}", values)
    return Finding("drift", "green", f"Lamps: {text}, known to {100.0 * error:.2f} %.", values)


def _check_noise(session: Session, calibration: SessionCalibration) -> Finding:
    noise, white, drift = calibration.noise, calibration.white, calibration.drift
    if noise is None or white is None:
        return Finding("noise", "green", "The noise of the instrument's finished reflectance is not known.")
    bands = calibration.bands
    spectrum = white.mean_spectrum()[bands]
    snr = float(np.median(spectrum / np.sqrt(noise.read_noise[bands] ** 2 + noise.counts_per_electron * spectrum)))
    scatter = 0.0 if isinstance(drift, NotMeasurable) else drift.scatter
    measured = noise.read_noise_measured and noise.photon_noise_measured
    values = {"signal_to_noise_of_white": snr if measured else None, "scatter_of_wall": scatter}
    text = f"one pixel of the white has a signal-to-noise ratio of {'' if measured else 'at most '}{snr:.0f}"
    if snr < LOW_SNR:
        level: Level = "red" if snr < USELESS_SNR else "amber"
        return Finding("noise", level, f"{session.path}: {text}; use more light or a longer exposure.", values)
    if scatter > MAX_SCATTER:
        sentence = (
            f"the stationary wall scatters by {100.0 * scatter:.1f} % from frame to frame; check lamps and shadows."
        )
        return Finding("noise", "amber", f"{session.path}: {sentence}", values)
    if not measured:
        unknown = {"read noise": noise.read_noise_measured, "photon noise": noise.photon_noise_measured}
        what = " and the ".join(name for name, measured in unknown.items() if not measured)
        sentence = f"the {what} could not be measured, so no uncertainty is stated and the spectra tell the noise"
        advice = "a white that fills the image, or dark cubes of several lines, would tell it"
        return Finding("noise", "amber", f"{session.path}: {sentence}; {advice}.", values)
    return Finding("noise", "green", f"Noise: {text}.", values)
